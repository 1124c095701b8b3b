# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The watch: what it shows on a terminal, and that it leaves it as it was."""

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator

import click
import numpy as np
import pytest
from command import invoke
from diagnostic_msgs.msg import DiagnosticArray
from ros_graph import PATIENCE_S, Graph, header, image, sky
from sensor_msgs.msg import Image, PointCloud2, PointField

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.board import Board
from ofsat_ros.nodes.detector import Detector
from ofsat_ros.nodes.watch import Watch
from ofsat_ros.tracking import COASTING, TRACK_DTYPE

STAMP_NS = 1_700_000_000_000_000_000  # 22:13:20 UTC
VALUES = {
    "frames_processed": "240",
    "frames_dropped": "3",
    "frames_lost": "2",
    "frames_failed": "1",
    "rate_hz": "9.81",
    "latency_s": "0.0342",
}
OF_A_FRAME = {
    "stars": "132",
    "star_motion_x_px_s": "12.414",
    "star_motion_y_px_s": "-3.02",
    "star_residual_px": "nan",
    "noise_dn": "4.21",
}
ENTER, LEAVE = "\x1b[?1049h", "\x1b[?1049l"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the time, s, as a list of one number to be changed."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def rows(*tracks: dict) -> np.ndarray:
    found = np.zeros(len(tracks), TRACK_DTYPE)
    for name in ("ra", "dec"):
        found[name] = np.nan
    found["status"] = CONFIRMED
    for row, values in zip(found, tracks, strict=True):
        for name, value in values.items():
            row[name] = value
    return found


ONE = {
    **{"track_id": 7, "x": 1023.46, "y": 12.34, "vx": 3.0, "vy": 4.0, "rel_vx": 0.0},
    **{"rel_vy": -2.5, "snr": 31.4, "age": 61.0, "hits": 20, "misses": 1},
}


def board(nodes: tuple[str, ...] = ("/detector",), elsewhere: tuple[str, ...] = ()) -> Board:
    one = Board("/rso_tracks")
    one.publishers(nodes, elsewhere)
    return one


def shown(one: Board, width: int = 80, height: int = 24) -> list[str]:
    """The lines without colours; each fits."""
    lines = [click.unstyle(line) for line in one.lines(width, height)]
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    return lines


def test_a_track_is_a_row_under_its_titles(clock):
    one = board()
    one.tracks(STAMP_NS, rows(ONE))
    titles, row = shown(one, width=200)[-2:]
    assert re.split(r"\s{2,}", titles.strip()) == [
        *("id", "state", "x px", "y px", "px/s", "angle", "rel px/s", "SNR", "seen UTC", "for s"),
        *("hits", "misses", "RA deg", "Dec deg"),
    ]
    assert row.split() == [
        *("7", "confirmed", "1023.5", "12.3", "5.00", "53°", "2.50", "31.4", "22:13:20", "61.0"),
        *("20", "1", "-", "-"),
    ]
    # Each value ends where its title ends.
    assert row.index("1023.5") + 6 == titles.index("x px") + 4
    assert row.index("31.4") + 4 == titles.index("SNR") + 3


def test_80_columns_show_what_is_asked_first_and_fewer_show_less(clock):
    one = board()
    one.tracks(STAMP_NS, rows(ONE))
    assert shown(one, 80)[-1].split()[-1] == "61.0"
    assert shown(one, 79)[-1].split()[-1] == "61.0"
    assert shown(one, 40)[-1].split() == ["7", "confirmed", "1023.5", "12.3", "5.00"]


def test_directions_are_in_degrees(clock):
    one = board()
    one.tracks(STAMP_NS, rows({**ONE, "ra": np.radians(83.6331), "dec": np.radians(-5.391)}))
    assert shown(one, 130)[-1].split()[-2:] == ["83.6331", "-5.3910"]


def test_a_coasting_track_tells_when_it_was_seen_and_an_ended_one_stays(clock):
    one = board()
    one.tracks(STAMP_NS, rows(ONE, {**ONE, "track_id": 9}))
    second = 1_000_000_000
    one.tracks(STAMP_NS + 5 * second, rows({**ONE, "status": COASTING}, {**ONE, "track_id": 12}))
    *_, first, other, ended = (line.split() for line in shown(one))
    assert (first[:2], first[-2]) == (["7", "coasting"], "22:13:20")
    assert (other[:2], other[-2]) == (["12", "confirmed"], "22:13:25")
    assert (ended[:2], ended[-2]) == (["9", "ended"], "22:13:20")
    # The last that ended stands first; one that comes back is no longer ended.
    one.tracks(STAMP_NS + 6 * second, rows({**ONE, "track_id": 9}))
    states = [line.split()[:2] for line in shown(one)[-3:]]
    assert states == [["9", "confirmed"], ["12", "ended"], ["7", "ended"]]


def test_a_low_terminal_shows_the_first_tracks_and_says_that_there_are_more(clock):
    one = board()
    one.tracks(STAMP_NS, rows(*({**ONE, "track_id": number} for number in range(1, 31))))
    lines = shown(one, height=12)
    assert len(lines) == 12
    numbers = [int(line.split()[0]) for line in lines if "confirmed" in line]
    assert numbers == list(range(1, len(numbers) + 1))
    assert lines[-1] == f"and {30 - len(numbers)} more, for which the terminal is too low"
    for height in range(1, 8):
        shown(one, height=height)


@pytest.mark.parametrize("width", [1, 8, 14, 30])
def test_a_narrow_terminal_shows_as_much_as_fits(width, clock):
    one = board()
    shown(one, width)
    one.status("/detector: detection", True, "no image on /image for 9 s", VALUES)
    one.tracks(STAMP_NS, rows(*({**ONE, "track_id": number} for number in range(1, 31))))
    shown(one, width, 200)
    shown(one, width, 12)


def test_only_so_many_ended_tracks_are_kept(clock):
    one = board()
    for number in range(1, 300):
        one.tracks(STAMP_NS, rows({**ONE, "track_id": number}))
    ended = [line.split()[0] for line in shown(one, height=400) if " ended " in line]
    assert ended == [str(number) for number in range(298, 198, -1)]


def test_health_is_that_of_the_node_which_publishes_the_tracks(clock):
    one = board(("/east/detector",))
    one.status("/detector: detection", False, "of another telescope", VALUES)
    one.status("/east/detector: detection", False, "3 RSOs", VALUES | OF_A_FRAME)
    text = "\n".join(shown(one))
    assert "another telescope" not in text
    assert shown(one)[0].startswith(" ofsat watch  /east/detector ")
    assert shown(one)[1:4] == [
        "3 RSOs",
        "240 frames  9.8 Hz  latency 34 ms  3 dropped  2 lost  1 failed",
        "132 stars  moving (12.41, -3.02) px/s  residual - px  noise 4.2 DN",
    ]


def test_before_the_first_frame_there_are_counts_only(clock):
    one = board()
    one.status("/detector: detection", False, "waiting for images", VALUES)
    assert not [line for line in shown(one) if "stars  moving" in line]
    assert shown(one)[-1] == "no track so far"


def test_what_is_wrong_is_told_in_full_and_yellow(clock):
    one = board()
    problem = "no image on /image for 9 s: nobody publishes it; remap image to the camera's"
    one.status("/detector: detection", True, problem + "; images are on /cam/image", VALUES)
    assert problem in " ".join(shown(one))
    assert click.style(shown(one)[1], fg="yellow") == one.lines(80, 24)[1]


def test_the_guide_beside_the_detector_is_shown_and_others_are_not(clock):
    one = board(("/east/detector",))
    one.status("/east/guide: guidance", False, "following track 3", {})
    one.status("/west/guide: guidance", False, "following track 4", {})
    one.status("/east/camera: temperature", True, "too warm", {})
    text = "\n".join(shown(one))
    assert "/east/guide: following track 3" in text
    assert "track 4" not in text
    assert "too warm" not in text
    clock[0] += 4  # it has ended
    assert "following" not in "\n".join(shown(one))


def test_a_silent_detector_and_an_old_frame_are_told(clock):
    one = board()
    one.status("/detector: detection", False, "1 RSO", VALUES)
    one.tracks(STAMP_NS, rows(ONE))
    clock[0] += 2.5
    assert "last image 2023-11-14 22:13:20 UTC, answered 2.5 s ago" in shown(one)
    assert "says nothing" not in "\n".join(shown(one))
    assert "\x1b[32m" in one.lines(80, 24)[-1]
    clock[0] += 5
    assert shown(one)[1] == "/detector says nothing for 8 s"
    # What is shown is no longer so.
    assert "\x1b[2m" in one.lines(80, 24)[-1]
    assert "\x1b[32m" not in one.lines(80, 24)[-1]


def test_a_slow_cameras_tracks_are_not_of_the_past(clock):
    one = board()
    for _ in range(3):
        clock[0] += 20
        one.tracks(STAMP_NS, rows(ONE))
    clock[0] += 30
    assert "\x1b[32m" in one.lines(80, 24)[-1]


def test_without_a_detector_it_says_where_else_there_is_one(clock):
    assert shown(board(()))[1] == "nobody publishes /rso_tracks: is the detector running?"
    text = " ".join(shown(board((), ("/east/rso_tracks",))))
    assert "Tracks are on /east/rso_tracks: ofsat watch --namespace /east" in text


def test_a_namespace_that_is_none_is_bad_usage():
    for name in ("a b", "1st", "/a//b", "east;"):
        done = invoke("watch", "--namespace", name)
        assert done.exit_code == 2
        assert f"'{name}' is no namespace" in " ".join(done.stderr.split())


class Terminal:
    """Stands in for a terminal; `screen` is what it shows last."""

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> None:
        self.text += text

    def flush(self) -> None:
        pass

    @property
    def screen(self) -> str:
        return click.unstyle(self.text.rpartition("\x1b[H")[2])


@pytest.fixture
def watched() -> Iterator[tuple[Graph, Watch, Terminal]]:
    terminal = Terminal()
    with Graph("-p", "reliable_input:=true") as graph:
        yield graph, graph.add(Watch(threading.Event(), terminal, graph.context)), terminal
    # `close` was called.
    assert terminal.text.startswith(ENTER)
    assert terminal.text.endswith(LEAVE)


def test_over_dds_it_shows_what_the_detector_says(watched):
    graph, _, terminal = watched
    # A process that an earlier test has killed is remembered for 20 s, DDS's lease.
    graph.until(lambda: "nobody publishes /rso_tracks" in terminal.screen, 2 * PATIENCE_S)
    graph.add(Detector(context=graph.context))
    camera = graph.publisher(Image, "image")
    graph.connect(camera)
    graph.until(lambda: "waiting for images" in terminal.screen)
    frames = sky(6)
    for frame in frames:
        camera.publish(image(frame))
        graph.serve_once()
    graph.until(lambda: "6 frames" in terminal.screen)
    graph.until(lambda: re.search(r"^ +1 confirmed +\d", terminal.screen, re.M))
    truth = frames[-1].truth[0]
    (row,) = re.findall(r"^ +1 confirmed +(\S+) +(\S+)", terminal.screen, re.M)
    # The row is that of the last frame, and of its place to a pixel.
    assert np.hypot(float(row[0]) - truth["x_px"], float(row[1]) - truth["y_px"]) < 1.5


def test_what_others_publish_does_not_end_it(watched):
    graph, watch, terminal = watched
    clouds = graph.publisher(PointCloud2, "rso_tracks")
    statuses = graph.publisher(DiagnosticArray, "/diagnostics")
    graph.connect(clouds, statuses)
    (frame,) = sky(1)
    fields = [PointField(name="x", datatype=PointField.FLOAT32, count=1)]
    clouds.publish(PointCloud2(header=header(frame), fields=fields, width=3, point_step=4))
    statuses.publish(DiagnosticArray())
    clouds.publish(messages.tracks_cloud(header(frame), rows(ONE)))
    graph.until(lambda: "confirmed" in terminal.screen)
    # A node's name may be known later than what it sends.
    graph.until(lambda: "probe" in terminal.screen.splitlines()[0])
    assert watch.exit_code == 0


def test_a_terminal_that_is_gone_ends_it():
    class Gone(Terminal):
        def write(self, text: str) -> None:
            raise OSError(5, "Input/output error")

    stop = threading.Event()
    with Graph() as graph:
        watch = graph.add(Watch(stop, Gone(), graph.context))
        assert stop.wait(PATIENCE_S)
        assert watch.exit_code == 1


def read_until(terminal: int, wanted: str, text: str = "") -> str:
    """Read from a terminal until it has said something."""
    deadline_s = time.monotonic() + PATIENCE_S
    while wanted not in text:
        assert time.monotonic() < deadline_s, text
        try:
            text += os.read(terminal, 65536).decode(errors="replace")
        except OSError:  # its other end is closed
            assert wanted in text
    return text


@pytest.mark.parametrize("how", ["Ctrl-C", "SIGTERM"])
def test_on_a_real_terminal_it_ends_clean(how: str):
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-m", "ofsat_ros.cli", "watch", "--namespace", "east"],
        **dict.fromkeys(("stdin", "stdout", "stderr"), theirs),
        start_new_session=True,
        # A session's leader takes a terminal that it opens as its own: Ctrl-C comes from there.
        preexec_fn=lambda: os.close(os.open(os.ttyname(theirs), os.O_RDWR)),
    )
    os.close(theirs)
    try:
        text = read_until(ours, "/east/rso_tracks")
        if how == "Ctrl-C":
            os.write(ours, b"\x03")
        else:
            process.send_signal(signal.SIGTERM)
        text = read_until(ours, LEAVE, text)
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        os.close(ours)
    assert text.count(ENTER) == text.count(LEAVE) == 1
    assert text.index("\x1b[?25l") < text.rindex("\x1b[?25h")
    assert "Traceback" not in text


def test_without_a_terminal_it_says_what_else_there_is():
    done = subprocess.run(
        [sys.executable, "-m", "ofsat_ros.nodes.start", "watch"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("watch: this is for a terminal")
    assert "recorder" in done.stderr


def test_without_ros_the_command_says_what_to_do(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    done = invoke("watch")
    assert done.exit_code == 1
    assert "source /opt/ros/jazzy/setup.bash" in done.stderr
