# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Nobody's bytes become code, paths, memory without end, or commands to a terminal.

And what SROS 2 allows each node is what the node has.  docs/security.md tells the rest.
"""

import ast
import gzip
import os
import re
import runpy
import struct
import xml.etree.ElementTree as ET
import zlib
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from command import fails, succeeds
from ros_graph import PATIENCE_S, Process, sky, write_bag

import ofsat_ros
from ofsat_ros.nodes import processes
from ofsat_ros.nodes.board import Board
from ofsat_ros.printing import printable
from ofsat_ros.recordings import BagWriter, bag, open_recording
from ofsat_ros.recordings.fits import files as fits_files
from ofsat_ros.recordings.storage import zstd

ROOT = Path(__file__).parents[1]
DATA = Path(ofsat_ros.__file__).parent / "data"
SOURCES = sorted(
    path
    for folder in ("ofsat_ros", "launch", "benchmarks", "docs", ".ci")
    for path in (ROOT / folder).rglob("*.py")
) + [ROOT / "setup.py"]
# Clears the screen, changes the window's title, and goes on in red.
ESCAPES = "\x1b[2J\x1b]0;mine\x07\x9b31m"
WRITTEN_OUT = r"\x1b[2J\x1b]0;mine\x07\x9b31m"


# What turns data into code, or talks to the world.
MODULES = {
    *("pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"),
    *("tarfile", "zipfile", "pty", "imp", "code", "codeop"),
    *("socket", "http", "urllib", "requests", "ftplib", "smtplib"),
}
CALLS = {
    *("eval", "exec", "compile", "__import__", "os.system", "os.popen"),
    *("yaml.load", "yaml.load_all", "yaml.unsafe_load", "yaml.full_load"),
    *("tempfile.mktemp", "shutil.unpack_archive"),
    *("subprocess.getoutput", "subprocess.getstatusoutput"),
    # XML is written only: who reads it would follow its entities.
    *("ET.parse", "ET.fromstring", "ET.iterparse", "ET.XML"),
}


def breaches(source: str) -> list[str]:
    """What in a program breaks a rule."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name.split(".")[0] in MODULES]
        elif isinstance(node, ast.ImportFrom):
            root = (node.module or "").split(".")[0]
            found += [root] if root in MODULES else []
            found += sorted({f"{root}.{a.name}" for a in node.names} & CALLS)
        elif isinstance(node, ast.Call):
            found += breaches_of_call(node)
    return found


def breaches_of_call(call: ast.Call) -> list[str]:
    name = ast.unparse(call.func)
    found = [name] if name in CALLS else []
    for keyword in call.keywords:
        is_off = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
        if keyword.arg in ("shell", "allow_pickle") and not is_off:
            found.append(f"{name}({keyword.arg})")
    if name.endswith("Environment") and "autoescape=True" not in ast.unparse(call):
        found.append(f"{name} without autoescape")
    return found


class TestCode:
    @pytest.mark.parametrize(
        "program",
        [
            "import pickle",
            "from pickle import loads",
            "import urllib.request",
            "eval(text)",
            "exec(text)",
            "os.system(text)",
            "from os import system",
            "subprocess.run(text, shell=True)",
            "subprocess.Popen(text, shell=flag)",
            "yaml.load(text, yaml.SafeLoader)",
            "from yaml import load",
            "np.load(path, allow_pickle=True)",
            "tempfile.mktemp()",
            "ET.fromstring(text)",
            "jinja2.Environment(loader=loader)",
        ],
    )
    def test_the_rules_see(self, program: str):
        assert breaches(program)

    def test_the_rules_allow(self):
        program = (
            "import subprocess, yaml\n"
            "subprocess.run(words, check=True)\n"
            "yaml.safe_load(text)\n"
            "np.load(path)\n"
            "Environment(loader=loader, autoescape=True)\n"
        )
        assert breaches(program) == []

    def test_no_data_becomes_code(self):
        assert len(SOURCES) > 100
        found = {path.relative_to(ROOT): breaches(path.read_text()) for path in SOURCES}
        assert {path: what for path, what in found.items() if what} == {}


class TestTerminal:
    def test_control_characters_are_written_out(self):
        assert printable(f"/camera{ESCAPES}\n") == rf"/camera{WRITTEN_OUT}\x0a"
        assert printable("Ωmega 20″ é") == "Ωmega 20″ é"

    def test_a_bag_cannot_command_the_terminal(self, tmp_path: Path):
        path = write_bag(tmp_path / "bag", sky(3), f"/camera{ESCAPES}/image")
        told = succeeds("info", path).output
        assert f"/camera{WRITTEN_OUT}/image" in told
        assert not set(told) & set("\x1b\x07\x9b")

    def test_nor_can_what_a_command_complains_of(self, tmp_path: Path):
        told = fails(1, "info", tmp_path / f"x{ESCAPES}.mcap")
        assert f"{WRITTEN_OUT}.mcap does not exist" in told

    def test_nor_can_who_sends_diagnostics(self):
        board = Board("/rso_tracks")
        board.publishers([f"/detector{ESCAPES}"], [f"/other{ESCAPES}"])
        values = {"stars": ESCAPES, "frames_processed": ESCAPES}
        board.status(f"/detector{ESCAPES}: detection", True, f"well{ESCAPES}", values)
        lines = "".join(board.lines(200, 30))
        assert f"well{WRITTEN_OUT}" in lines
        # Its own colours are all that is left.
        assert "\x1b" not in re.sub(r"\x1b\[\d*m", "", lines)
        assert not set(lines) & set("\x07\x9b")


class TestInput:
    """What is small and claims, or unpacks to, more than there is memory; what is no file."""

    @staticmethod
    def header(width: int, height: int, **cards: object) -> bytes:
        header = fits.PrimaryHDU(np.zeros((2, 2), "i2")).header
        header.update({"NAXIS1": width, "NAXIS2": height, "DATE-OBS": "2026-03-01", **cards})
        return header.tostring().encode()

    def test_fits_in_gzip_is_unpacked_to_a_limit(self, tmp_path: Path, monkeypatch):
        monkeypatch.setattr(fits_files, "_MOST_BYTES", 1 << 20)
        bomb = gzip.compress(self.header(4096, 4096) + bytes(4096 * 4096 * 2))
        assert len(bomb) < 1 << 16
        (tmp_path / "a.fits.gz").write_bytes(bomb)
        assert "unpacks to more than" in fails(1, "info", tmp_path)

    def test_compressed_fits_cannot_claim_more_pixels_than_allowed(self, tmp_path: Path):
        tiles = fits.CompImageHDU(np.zeros((4, 4), "i2"), compression_type="GZIP_1")
        path = tmp_path / "a.fits.fz"
        fits.HDUList([fits.PrimaryHDU(), tiles]).writeto(path)
        claims = re.sub(rb"(ZNAXIS[12] = ) {19}4", rb"\1%20d" % 30_000, path.read_bytes())
        path.write_bytes(claims)
        with open_recording(path, fps=1) as recording:
            assert list(recording) == []
        assert re.search("30000 x 30000.* 200000000", " ".join(recording.problems))

    def test_png_cannot_claim_more_pixels_than_allowed(self, tmp_path: Path):
        def chunk(kind: bytes, data: bytes) -> bytes:
            body = kind + data
            return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

        size = struct.pack(">IIBBBBB", 30_000, 30_000, 1, 0, 0, 0, 0)
        rows = zlib.compress(bytes(30_000 * (1 + 30_000 // 8)))
        parts = (chunk(b"IHDR", size), chunk(b"IDAT", rows), chunk(b"IEND", b""))
        (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
        with open_recording(tmp_path, fps=1) as recording:
            assert list(recording) == []
        assert re.search("30000 x 30000.* 200000000", " ".join(recording.problems))

    def test_a_bags_message_is_unpacked_to_a_limit(self, tmp_path: Path, monkeypatch):
        monkeypatch.setattr(bag, "_MOST_BYTES", 1 << 20)
        frames = sky(2)
        with BagWriter(tmp_path / "bag") as writer:
            writer.write("/image", bag.IMAGE, zstd.compress(bytes(4 << 20)), 1)
            for frame in frames:
                writer.write_image("/image", frame.image, frame.stamp_ns, "camera")
        with open_recording(tmp_path / "bag") as recording:
            assert [frame.stamp_ns for frame in recording] == [f.stamp_ns for f in frames]
        assert "unpacks to more than" in " ".join(recording.problems)

    def test_what_a_file_unpacks_to_is_never_held_in_memory(self, tmp_path: Path):
        """64 MiB of nothing behind a bag's end: they come by block, and cost no frame."""
        frames = sky(2)
        (file,) = write_bag(tmp_path / "bag", frames).glob("*.mcap")
        packed = zstd.compress(file.read_bytes()) + zstd.compress(bytes(64 << 20))
        path = tmp_path / "bag.mcap.zstd"
        path.write_bytes(packed)
        with open_recording(path) as recording:
            assert len(list(recording)) == len(frames)

    def test_unpacking_removes_no_folder_of_the_user(self, tmp_path: Path, monkeypatch):
        mine = tmp_path / "ofsat_results"
        mine.mkdir()
        (file,) = write_bag(tmp_path / "bag", sky(3)).glob("*.mcap")
        path = tmp_path / "bag.mcap.zstd"
        path.write_bytes(zstd.compress(file.read_bytes()))
        monkeypatch.setattr("tempfile.tempdir", f"{tmp_path}")
        before = sorted(tmp_path.iterdir())
        with open_recording(path) as recording:
            assert len(list(recording)) == 3
            assert sorted(tmp_path.iterdir()) != before  # it is here that it was unpacked
        assert sorted(tmp_path.iterdir()) == before

    @pytest.mark.parametrize("name", ["a.png", "a.fits", "a.ser", "a.mcap", "a.mp4", "a.tif"])
    def test_a_device_is_not_opened(self, name: str, tmp_path: Path):
        """One that never ends, or never begins, would be waited for until the morning."""
        (tmp_path / name).symlink_to("/dev/null")
        assert "is no file but a pipe or a device" in fails(1, "info", tmp_path / name)
        assert "holds no recording" in fails(1, "info", tmp_path)

    def test_metadata_leads_to_no_file_outside_of_the_bag(self, tmp_path: Path):
        (theirs,) = write_bag(tmp_path / "theirs", sky(3)).glob("*.mcap")
        path = write_bag(tmp_path / "bag", sky(2))
        metadata = path / "metadata.yaml"
        (own,) = path.glob("*.mcap")
        for elsewhere in (f"../theirs/{theirs.name}", f"{theirs}"):
            metadata.write_text(metadata.read_text().replace(own.name, elsewhere))
            with open_recording(path) as recording:
                assert len(list(recording)) == 2

    @pytest.mark.parametrize("text", ["[" * 1_000, "{a: &a [*a]}", "!!python/name:os.system"])
    def test_metadata_that_attacks_its_reader_is_not_used(self, text: str, tmp_path: Path):
        path = write_bag(tmp_path / "bag", sky(2))
        (path / "metadata.yaml").write_text(text)
        with open_recording(path) as recording:
            assert len(list(recording)) == 2
            assert "is damaged and not used" in recording.problems[0]


class TestGraph:
    def test_the_policy_is_what_the_nodes_have(self):
        policy = runpy.run_path(f"{ROOT}/docs/policy.py")
        expected = policy["text"](policy["rights_of_all"]())
        assert (DATA / "sros2_policy.xml").read_text() == expected, "run python docs/policy.py"

    def test_the_policy_lets_only_the_guide_move_the_mount_and_only_the_operator_engage_it(self):
        def who(right: str, name: str) -> list[str]:
            enclaves = ET.parse(DATA / "sros2_policy.xml").getroot().findall("enclaves/enclave")
            allowed = f"profiles/profile/*[@{right}='ALLOW']/*[.='{name}']"
            return [enclave.get("path") for enclave in enclaves if enclave.findall(allowed)]

        assert who("publish", "mount_rate") == ["/ofsat/guide"]
        assert who("request", "guide/engage") == ["/ofsat/operator"]
        assert who("reply", "~/engage") == ["/ofsat/guide"]
        assert "*" not in (DATA / "sros2_policy.xml").read_text()

    def test_the_profile_for_this_machine_is_the_other_one_but_closed(self):
        def elements(name: str) -> list[tuple[str, str]]:
            root = ET.parse(DATA / name).getroot()
            return [
                (element.tag.partition("}")[2], (element.text or "").strip())
                for element in root.iter()
            ]

        wide, closed = elements("fastdds_large_images.xml"), elements("fastdds_this_machine.xml")
        assert [each for each in closed if each not in wide] == [
            ("interfaceWhiteList", ""),
            ("address", "127.0.0.1"),
        ]
        assert [each for each in wide if each not in closed] == []

    @pytest.mark.parametrize("profile", ["fastdds_this_machine", "fastdds_large_images"])
    def test_it_lets_nobody_in_from_elsewhere(self, profile: str, tmp_path: Path):
        domain = 1 + (os.getpid() + 1) % 100
        environment = {
            "FASTRTPS_DEFAULT_PROFILES_FILE": f"{DATA / profile}.xml",
            "ROS_DOMAIN_ID": f"{domain}",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        with Process(tmp_path, "guide", **environment) as guide:
            guide.wait_for("waiting for tracks", PATIENCE_S)
            found = listens_on(guide.popen.pid, 7400 + 250 * domain)
        # The range alone leaves its ports open to whoever names this machine as a peer.
        assert found == ({"127.0.0.1"} if profile == "fastdds_this_machine" else {"0.0.0.0"})

    def test_demos_are_in_a_graph_of_their_own_whatever_the_environment_says(
        self, monkeypatch: pytest.MonkeyPatch
    ):
        theirs = {
            "ROS_DOMAIN_ID": f"{1 + os.getpid() % 100}",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "ROS_STATIC_PEERS": "10.0.0.11",
            "FASTRTPS_DEFAULT_PROFILES_FILE": "/theirs.xml",
        }
        for name, value in theirs.items():
            monkeypatch.setenv(name, value)
        processes.own_graph.cache_clear()
        with processes.children() as start:
            node = start("guide")
            environment = Path(f"/proc/{node.pid}/environ").read_text().split("\0")
        processes.own_graph.cache_clear()
        own = {name: next(e for e in environment if e.startswith(f"{name}=")) for name in theirs}
        assert own["ROS_DOMAIN_ID"] != f"ROS_DOMAIN_ID={theirs['ROS_DOMAIN_ID']}"
        assert own["ROS_AUTOMATIC_DISCOVERY_RANGE"].endswith("=LOCALHOST")
        assert own["ROS_STATIC_PEERS"].endswith("=")
        assert own["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("/fastdds_this_machine.xml")


def listens_on(pid: int, first_port: int) -> set[str]:
    """Addresses on which a process has a UDP port of a domain (250 of them, from the first)."""
    sockets = set()
    for file in Path(f"/proc/{pid}/fd").iterdir():
        try:
            sockets.add(os.readlink(file))
        except FileNotFoundError:  # closed meanwhile
            continue
    found = set()
    for line in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        address, port = (bytes.fromhex(part) for part in fields[1].split(":"))
        if f"socket:[{fields[9]}]" in sockets:
            if first_port <= int.from_bytes(port, "big") < first_port + 250:
                found.add(".".join(map(str, reversed(address))))
    return found


class TestAudit:
    """What CI says of pip-audit's answer."""

    report = staticmethod(runpy.run_path(f"{ROOT}/.ci/audit.py")["report"])

    def test_nothing_looked_up_is_no_clean_bill(self):
        lines, code = self.report([{"name": "numpy", "skip_reason": "no service"}])
        assert code == 0
        assert "NOT AUDITED" in lines[0]

    def test_what_can_be_mended_fails(self):
        clean = {"name": "numpy", "version": "2.4", "vulns": []}
        unknown = {"name": "ours", "skip_reason": "not on an index"}
        open_one = {"id": "PYSEC-1", "fix_versions": []}
        found = {"name": "pillow", "version": "1.0", "vulns": [open_one]}
        lines, code = self.report([clean, unknown, found])
        assert (code, len(lines)) == (0, 3)
        assert lines[0] == "audit: pillow 1.0: PYSEC-1, not mended yet"
        assert lines[1] == "audit: 2 of 3 packages looked up, 1 advisories"
        assert lines[2] == "audit: nothing is known of ours"
        found["vulns"].append({"id": "PYSEC-2", "fix_versions": ["1.1"]})
        lines, code = self.report([clean, found])
        assert code == 1
        assert "PYSEC-2, mended in 1.1: upgrade" in lines[1]
