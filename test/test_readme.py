# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What README and docs say is so: every command runs, tables and pictures are the present ones.

A command of a kind that another test runs, or CI itself, is only checked for what it names.
"""

import ast
import re
import runpy
import shlex
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import succeeds
from night import write_night
from ros_graph import Process

from ofsat_ros.camera import to_radec
from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.parameters import Parameters
from ofsat_ros.results import DETECTION_COLUMNS, STAR_FIELD_COLUMNS, TRACK_COLUMNS
from ofsat_ros.simulation import scenario

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
INTEGRATION = (ROOT / "docs" / "integration.md").read_text()
TROUBLESHOOTING = (ROOT / "docs" / "troubleshooting.md").read_text()
RELIABILITY = (ROOT / "docs" / "reliability.md").read_text()
# Pages with commands for users; the README's are those of `.venv`.
PAGES = (
    "README.md",
    *(
        f"docs/{name}.md"
        for name in ("tutorial", "optics", "troubleshooting", "commands", "integration")
    ),
)
# Ready when it has said this.
READY = {
    "detector": "waiting for images on",
    "player": "waiting for 1 subscriber",
    "recorder": "recording into",
    "simulator": "px every",
    "guide": "waiting for tracks on",
    "tdm_writer": "writing the tracks of",
}
# What only a machine with ROS from apt can do, and what the tests of colcon and launch do.
ELSEWHERE = (
    *("rosdep install", "pip install", "colcon build", "source install", "ros2 launch"),
    *("python3 -m venv", "~/ofsat/bin/pip install", "export "),
)
OFSAT = (".venv/bin/ofsat ", "ofsat ")


def commands(text: str) -> list[str]:
    """Every line of the shell blocks."""
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    return [line for block in blocks for line in block.strip().splitlines()]


def starting(prefix: str, text: str = README) -> list[str]:
    found = [line for line in commands(text) if line.startswith(prefix)]
    assert found, prefix
    return found


def example(with_words: str) -> str:
    """The one block of Python in docs/integration.md that holds some words."""
    blocks = re.findall(r"```python\n(.*?)```", INTEGRATION, re.S)
    (code,) = [block for block in blocks if with_words in block]
    return code


def installed(text: str) -> str:
    """The command with paths of this tree for those of a workspace."""
    text = text.replace("install/ofsat_ros/share/ofsat_ros/config", f"{ROOT}/ofsat_ros/presets")
    return text.replace("src/ofsat_ros/", f"{ROOT}/")


@pytest.mark.parametrize("page", PAGES)
def test_every_command_is_of_a_kind_that_is_run(page: str) -> None:
    kinds = (*OFSAT, "make ", "ros2 run ofsat_ros ", "ros2 param set", *ELSEWHERE)
    lines = commands((ROOT / page).read_text())
    assert [line for line in lines if not line.startswith(kinds)] == []


def test_make_targets_are_what_ci_runs() -> None:
    ci = (ROOT / ".ci" / "run").read_text()
    assert [line for line in starting("make ") if line not in ci] == []


def test_extras_to_install_are_those_of_setup() -> None:
    extras = set(re.findall(r'^        "(\w+)": ', (ROOT / "setup.py").read_text(), re.M))
    for page in PAGES:
        for named in re.findall(r"'\.\[([\w,]+)\]'", (ROOT / page).read_text()):
            assert set(named.split(",")) <= extras


# What a page's commands leave behind, and what stands in it at least.
MADE = {
    "README.md": {
        "night1/detections.csv": "track_id",
        "my_sky.truth.csv": "snr",
        "night1_angles/tracks.tdm": "ANGLE_1",
        "night1_angles/tracks.iod": "9999",
    },
    "docs/tutorial.md": {
        "results/report.html": "<html",
        "results/tracks.csv": "track_id",
        "results/last_night.mp4": "",
        "results_angles/tracks.tdm": "ANGLE_2",
        "results_angles/tracks.iod": "9999",
        "results_bag/results/metadata.yaml": "rso_detections",
    },
    "docs/optics.md": {"my_optics.yaml": "ros__parameters"},
    "docs/troubleshooting.md": {},
    "docs/commands.md": {"survey_bag/metadata.yaml": "/camera/image_raw"},
    "docs/integration.md": {"out/tracks.tdm": "ANGLE_1"},
}


@pytest.mark.parametrize("page", PAGES)
def test_ofsat_commands_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bags").symlink_to(ROOT / "bags")
    if page == "docs/tutorial.md":
        sky = scenario("survey", 1, width=256, height=208, frames=12, exposure_s=0.8)
        write_night(tmp_path / "last_night", sky, exposure_s=0.8)
    lines = [line for line in commands((ROOT / page).read_text()) if line.startswith(OFSAT)]
    for line in lines:
        succeeds(*shlex.split(line)[1:])
    assert len(lines) >= 1
    for file, content in MADE[page].items():
        made = (tmp_path / file).read_bytes()
        assert len(made) > 50
        assert content.encode() in made


@pytest.mark.parametrize(
    "line", [*starting("ros2 run ofsat_ros "), *starting("ros2 run ofsat_ros ", INTEGRATION)]
)
def test_ros2_run_commands_start_and_stop(line: str, tmp_path: Path) -> None:
    node, *arguments = shlex.split(installed(line))[3:]
    # What it writes shall not land in the tree.
    arguments = [a.replace("output:=", f"output:={tmp_path}/") for a in arguments]
    with Process(tmp_path, node, *arguments) as process:
        process.wait_for(READY[node])
        process.popen.send_signal(signal.SIGINT)
        assert process.wait() == 0, process.err
        assert "Traceback" not in process.err


@pytest.mark.parametrize("line", starting("ros2 param set"))
def test_ros2_param_commands_name_live_parameters(line: str) -> None:
    name, value = shlex.split(line)[4:]
    (about,) = (p for p in Parameters.describe() if p.name == name)
    assert about.live
    assert about.check(float(value) if isinstance(about.default, float) else value)


@pytest.mark.parametrize("line", starting("ros2 launch"))
def test_launch_commands_name_files_and_arguments(line: str) -> None:
    file, *arguments = shlex.split(line)[3:]
    text = (ROOT / "launch" / file).read_text()
    for argument in arguments:
        assert f'"{argument.split(":=")[0]}"' in text


def test_python_example_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    exec(compile(example("open_recording("), "docs/integration.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) > 20


def test_the_attitude_of_a_plate_solution_is_as_the_docs_say() -> None:
    names: dict = {}
    exec(compile(example("def attitude_of("), "docs/integration.md", "exec"), names)
    ra, dec, position_angle = 2.0, 1.1, 0.4
    attitude = names["attitude_of"](ra, dec, position_angle)
    # The centre, what is a little up in the image, and what is to its left: north through east.
    step = 1e-4
    up_left = np.array([[0, 0, 1], [0, -step, 1], [-step, 0, 1]])
    ras, decs = to_radec(up_left / np.linalg.norm(up_left, axis=1)[:, None], attitude)
    assert (ras[0], decs[0]) == pytest.approx((ra, dec), abs=1e-12)
    east, north = (ras - ra) * np.cos(dec) / step, (decs - dec) / step
    angles = np.arctan2(east[1:], north[1:])
    # The sky is curved: over the step, to 2e-4.
    assert angles == pytest.approx([position_angle, position_angle + np.pi / 2], abs=5e-4)


def test_the_example_of_tracking_data_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    frames = []
    for number in range(4):
        rows = np.zeros(1, DETECTION_DTYPE)
        rows["track_id"], rows["status"], rows["ra"], rows["dec"] = 1, 1, 0.1 + 1e-5 * number, 0.2
        frames.append((10**18 + number * 10**9, rows))
    code = compile(example("TrackArcs("), "docs/integration.md", "exec")
    exec(code, {"located_detections": frames})
    assert (tmp_path / "tracks.tdm").read_text().count("ANGLE_1 ") == 4


def test_table_of_parameters_is_the_present_one() -> None:
    generate = runpy.run_path(f"{ROOT}/docs/generate.py")
    assert generate["with_table"](README) == README, "run python docs/generate.py"


# What the README calls the methods that docs/performance.md compares.
METHODS = {
    "`ofsat process`": "robust, looking back",
    "the node, from an RSO's third frame": "robust, live",
    "SExtractor, star fit, linking": "SExtractor (sep), linking",
    "as published, sparse": "paper, OpenCV (sparse)",
    "as published, dense": "paper, MATLAB (dense)",
}


@pytest.mark.parametrize("name", METHODS)
def test_figures_are_those_of_the_benchmark(name: str) -> None:
    def row(text: str, first: str) -> list[str]:
        line = next(line for line in text.splitlines() if line.startswith(f"| {first} |"))
        return [cell.strip() for cell in line.split("|")[2:8]]

    performance = (ROOT / "docs" / "performance.md").read_text()
    assert row(README, name) == row(performance, METHODS[name])


def test_columns_of_files_are_the_present_ones() -> None:
    text = " ".join(INTEGRATION.split())
    assert ", ".join(DETECTION_COLUMNS) in text
    assert ", ".join(STAR_FIELD_COLUMNS) in text
    assert ", ".join(TRACK_COLUMNS) in text


def test_pictures_are_the_present_ones() -> None:
    generate = runpy.run_path(f"{ROOT}/docs/generate.py")
    for file, *what in generate["PICTURES"]:
        kept = cv2.imread(str(ROOT / "docs" / "images" / file))
        made = generate["picture"](*what)
        # Other versions of OpenCV draw and filter a little otherwise.
        different = np.mean(np.abs(kept.astype(int) - made).max(axis=2) > 60)
        assert different < 0.01, f"{file}: run python docs/generate.py"


def texts(tree: ast.AST) -> Iterator[str]:
    """Every string of some code, with a zero byte for each value that is put in."""
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [n.value if isinstance(n, ast.Constant) else "\0" for n in node.values]
            yield "".join(str(part) for part in parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def messages() -> set[str]:
    """Every string that the program may say, among others."""
    return {
        text
        for path in (ROOT / "ofsat_ros").rglob("*.py")
        for text in texts(ast.parse(path.read_text()))
    }


def says(row: str, said: set[str]) -> bool:
    pieces = [re.escape(piece.strip()) for piece in row.split("...") if piece.strip()]
    pattern = re.compile(r"[\s\S]*".join(pieces))
    return any(pattern.search(text) for text in said)


def test_messages_that_are_explained_are_the_programs() -> None:
    said = messages()
    rows = re.findall(r"^\| `(.+?)` \|", TROUBLESHOOTING, re.M)
    assert len(rows) > 30
    for row in rows:
        assert says(row, said), f"no message says {row!r}"


def test_each_fault_has_its_words_and_its_test() -> None:
    said = messages()
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", RELIABILITY, re.M)
    rows = [row for row in rows if row[0] != "fault" and set(row[0]) != {"-"}]
    assert len(rows) > 30
    for fault, seen, _, proof in rows:
        for words in re.findall(r"`([^`]+)`", seen):
            assert says(words, said), f"{fault}: no message says {words!r}"
        proofs = re.findall(r"`(\w+)::(\w+)`", proof)
        assert proofs, fault
        for file, test in proofs:
            assert f"\ndef {test}(" in (ROOT / "test" / f"{file}.py").read_text(), (fault, test)


def anchors(text: str) -> set[str]:
    """What GitHub calls the headings of a page."""
    titles = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_links_lead_somewhere() -> None:
    pages = [path.relative_to(ROOT) for path in (ROOT / "docs").glob("*.md")]
    others = ("README.md", "CONTRIBUTING.md", "QUALITY_DECLARATION.md", "bags/README.md")
    for page in (*others, *pages):
        text = (ROOT / page).read_text()
        for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", text):
            if target.startswith("https://"):  # not to be asked for here
                continue
            there = (ROOT / page).parent / target if target else ROOT / page
            assert there.exists(), (page, target)
            assert not anchor or anchor in anchors(there.read_text()), (page, target, anchor)
