# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Processes of a night: killed, restarted, doubled, hung, told to end at the worst moment."""

import ctypes
import fcntl
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, namedtuple
from collections.abc import Callable
from io import TextIOWrapper
from pathlib import Path

import pytest
import yaml
from command import environment
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros_graph import PATIENCE_S, START_S, Graph, Process, image, sky
from sensor_msgs.msg import Image, PointCloud2

from ofsat_ros.nodes import shared_memory
from ofsat_ros.nodes.detector import Detector
from ofsat_ros.nodes.guide import GuideNode
from ofsat_ros.nodes.recorder import Recorder
from ofsat_ros.nodes.runtime import profile_path, say
from ofsat_ros.nodes.tdm_writer import TdmWriter
from ofsat_ros.pipeline import Pipeline

SHM = Path("/dev/shm")
RELIABLE = ("-p", "reliable_input:=true")
STOP = threading.Event()
ANALYZERS = Path(profile_path()).with_name("diagnostic_analyzers.yaml")


def mapped(node: Process) -> str:
    try:
        return Path(f"/proc/{node.popen.pid}/maps").read_text()
    except OSError:
        return ""


# --- Told to end


@pytest.mark.parametrize(
    ("sign", "number"),
    [
        ("numpy", signal.SIGINT),  # amid the imports
        ("_rclpy", signal.SIGTERM),
        (r"/dev/shm/fastrtps_\w{16}", signal.SIGHUP),  # it has just joined the graph
    ],
)
def test_a_node_that_starts_ends_when_it_is_told_to(sign, number, tmp_path):
    with Process(tmp_path, "detector") as node:
        deadline_s = time.monotonic() + START_S
        while not re.search(sign, mapped(node)):
            assert time.monotonic() < deadline_s
        segments = node.shared_memory
        node.end(number)
        assert node.wait() == 0, node.err
    assert "Traceback" not in node.out + node.err
    assert not segments & set(os.listdir(SHM))


def test_a_signal_that_another_thread_gets_ends_a_node(tmp_path):
    """As one that comes just before the main thread waits, it does not wake that."""
    with Process(tmp_path, "detector") as node:
        node.wait_for("waiting for images on")
        pid, mask = node.popen.pid, 1 << (signal.SIGINT - 1)
        others = [
            int(task.name)
            for task in Path(f"/proc/{pid}/task").iterdir()
            if int(task.name) != pid
            and not int(re.findall(r"SigBlk:\t(\w+)", (task / "status").read_text())[0], 16) & mask
        ]
        assert ctypes.CDLL(None).tgkill(pid, others[0], signal.SIGINT) == 0
        assert node.wait() == 0, node.err


def test_a_node_that_cannot_be_made_ends_when_it_is_told_to(tmp_path):
    # A pipe that nobody writes into stands for a disk that does not answer.
    os.mkfifo(tmp_path / "night.mcap")
    with Process(tmp_path, "player", f"{tmp_path / 'night.mcap'}") as player:
        deadline_s = time.monotonic() + START_S
        while not player.shared_memory:
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
        segments = player.shared_memory
        player.end(signal.SIGTERM)
        assert player.wait() == 0
    assert "Traceback" not in player.err
    assert not segments & set(os.listdir(SHM))


def test_nohup_outlives_the_terminal(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # children inherit it
    try:
        node = Process(tmp_path, "recorder", "--ros-args", "-p", f"output:={tmp_path / 'out'}")
    finally:
        signal.signal(signal.SIGHUP, before)
    with node:
        node.wait_for("recording into")
        node.popen.send_signal(signal.SIGHUP)
        node.popen.send_signal(signal.SIGTERM)
        assert node.wait() == 0
    # Had it ended by SIGHUP, it would not have come to this.
    assert "0 frames" in node.out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_ofsat_command_that_starts_is_stopped_in_a_word(number, tmp_path):
    command = [sys.executable, "-m", "ofsat_ros.cli", "simulate", "-o", f"{tmp_path / 'bag'}"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
    ) as ofsat:
        deadline_s = time.monotonic() + START_S
        while "numpy" not in Path(f"/proc/{ofsat.pid}/maps").read_text():
            assert time.monotonic() < deadline_s
        ofsat.send_signal(number)
        err = ofsat.communicate(timeout=PATIENCE_S)[1]
    assert ofsat.returncode == 130
    assert "Traceback" not in err
    assert err.endswith("stopped\n")


def test_a_reader_that_goes_stops_nobody():
    reader, writer = os.pipe()
    os.close(reader)
    with TextIOWrapper(os.fdopen(writer, "wb")) as out:
        for _ in range(2):
            say("hearing a detector", out)


# --- Shared memory of those who were killed


@pytest.fixture
def shm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, float], None]:
    """Return a function that makes a segment of an age, s, in what stands for /dev/shm."""
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path)

    def segment(name: str, age_s: float) -> None:
        for path in (tmp_path / name, tmp_path / f"{name}_el"):
            path.touch()
            os.utime(path, (time.time() - age_s,) * 2)

    return segment


def test_only_what_the_dead_left_is_removed(shm, tmp_path):
    dead, living, starting = (f"fastrtps_{digit * 16}" for digit in "0af")
    shm(dead, 60.0)
    shm(living, 60.0)
    shm(starting, 0.0)
    shm("fastrtps_port7000", 60.0)
    shm("fastened_el", 60.0)
    with (tmp_path / f"{living}_el").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert shared_memory.remove_abandoned() == 1
    left = {path.name for path in tmp_path.iterdir()}
    assert not {dead, f"{dead}_el"} & left
    assert len(left) == 8


@pytest.mark.parametrize("free", [64e6, 1e9])
def test_too_little_shared_memory_is_said_with_the_remedy(free, monkeypatch, tmp_path):
    state = namedtuple("State", "f_bavail f_frsize")(int(free) // 4096, 4096)
    monkeypatch.setattr(os, "statvfs", lambda path: state)
    said = shared_memory.shortage(profile_path())
    assert ("has 64 MB free, and each process that sends images needs 142 MB" in said) == (
        free < 1e8
    )
    assert ("docker run --shm-size" in said) == bool(said)
    # A profile of somebody's own may say nothing of sizes, or not be there.
    assert shared_memory.shortage(str(tmp_path / "none.xml")) == ""


def test_a_killed_detector_is_replaced_and_leaves_nothing(tmp_path):
    (frame,) = sky(1)
    with Graph() as graph:
        heard = graph.listen(PointCloud2, "/rso_detections")
        camera = graph.publisher(Image, "/image")

        def answered(least: int) -> bool:
            camera.publish(image(frame))
            return len(heard) >= least

        with Process(tmp_path, "detector") as killed:
            graph.until(lambda: answered(1), START_S)
            # Ours alone: each process maps those that it hears, too.
            held = {Path(os.readlink(link)).name for link in fds(killed)}
            segments = {name.removesuffix("_el") for name in held if name.endswith("_el")}
            segments = {name for name in segments if "port" not in name}
            killed.popen.kill()
            killed.wait()
        assert segments
        assert segments <= set(os.listdir(SHM))
        for name in segments:  # or wait for it to be older than a starting process's
            os.utime(SHM / f"{name}_el", (time.time() - 60,) * 2)
        graph.serve(0.1)  # what it had still sent
        least = len(heard) + 3
        with Process(tmp_path, "detector"):
            graph.until(lambda: answered(least), START_S)
        assert not segments & set(os.listdir(SHM))


def fds(node: Process) -> list[Path]:
    links = Path(f"/proc/{node.popen.pid}/fd").iterdir()
    return [link for link in links if os.path.lexists(link) and "/dev/shm/" in os.readlink(link)]


# --- How they are, once a second


def of_detector(graph: Graph) -> list[tuple[int, str, dict[str, str]]]:
    """Return a list that fills with level, message and values of a detector's diagnostics."""
    heard: list = []

    def take(array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.endswith(": detection"):
                values = {value.key: value.value for value in status.values}
                heard.append((status.level, status.message, values))

    graph.probe.create_subscription(DiagnosticArray, "/diagnostics", take, 100)
    return heard


def test_a_camera_that_is_killed_and_started_again(tmp_path):
    parameters = (*("-p", "no_image_timeout_s:=1.0"), *("-p", "max_gap_s:=1.0"))
    camera = ("simulator", "--ros-args", "-p", "rate:=5.0")
    with Graph(*parameters) as graph:
        said = of_detector(graph)
        graph.add(Detector(context=graph.context))
        with Process(tmp_path, *camera) as killed:
            graph.until(lambda: said and said[-1][2].get("stars", "0") != "0", START_S)
            killed.popen.kill()
            graph.until(lambda: said[-1][0] == DiagnosticStatus.ERROR)
        assert "came before; the sender has paused or hangs: see to the camera" in said[-1][1]
        begun = len(said)

        def found_again() -> bool:
            reasons = [values["nothing_detected_because"] for *_, values in said[begun:]]
            if not any("no previous frame to compare with" in why for why in reasons):
                return False
            # A busy machine may drop frames, which is a warning.
            return said[-1][0] != DiagnosticStatus.ERROR and said[-1][2]["stars"] != "0"

        with Process(tmp_path, *camera):
            graph.until(found_again, START_S)
    # The new sender counts from 1 again.
    assert said[-1][2]["frames_lost"] == "0"


def test_a_frame_that_does_not_end_is_said_while_nothing_else_goes_on(monkeypatch):
    frames = sky(8)
    go_on = threading.Event()
    process = Pipeline.process

    def hang(self, pixels, stamp_ns):
        go_on.wait(PATIENCE_S)
        return process(self, pixels, stamp_ns)

    monkeypatch.setattr(Pipeline, "process", hang)
    with Graph(*RELIABLE, "-p", "no_image_timeout_s:=0.5", "-p", "queue_depth:=3") as graph:
        said = of_detector(graph)
        clouds = graph.listen(PointCloud2, "rso_detections")
        detector = graph.add(Detector(context=graph.context))
        inbox, say_it = detector._inbox, detector._diagnostics.say
        inbox._limit_bytes = 0  # callbacks wait behind three frames, not 1 GiB

        def say_and_go_on(summary, values, errors, warnings) -> None:
            say_it(summary, values, errors, warnings)
            if "in work" in "".join(errors) and len(inbox._items) == 3:
                go_on.set()

        monkeypatch.setattr(detector._diagnostics, "say", say_and_go_on)
        camera = graph.publisher(Image, "image")
        graph.connect(camera)
        for frame in frames:
            camera.publish(image(frame))
            # Here callbacks stand still until the frame ends.
            graph.serve(0.05)
        graph.until(lambda: len(clouds) == len(frames))
        graph.until(lambda: "in work" not in said[-1][1])
    words = [message for level, message, _ in said if level == DiagnosticStatus.ERROR]
    stuck = [one for one in words if one.startswith("the frame in work takes")]
    assert stuck
    assert "restart the detector" in stuck[-1]
    assert not any("no image on" in one for one in stuck)


def test_two_detectors_in_one_namespace_are_said_and_in_two_are_not():
    graphs: list[Graph] = []

    def serve_until(condition: Callable) -> None:
        def all_served() -> bool:
            for other in graphs[1:]:
                other.serve_once()
            return condition()

        graphs[0].until(all_served)

    with Graph() as graph, Graph("-r", "__ns:=/east") as east:
        graphs += [graph, east]
        said = of_detector(graph)
        for one in graphs:
            one.add(Detector(context=one.context))
        serve_until(lambda: len(said) >= 4)
        assert not any("the same topic" in message for _, message, _ in said)
        with Graph() as second:
            graphs.append(second)
            second.add(Detector(context=second.context))
            told = "/detector publishes detections on the same topic"
            serve_until(lambda: told in said[-1][1])
            assert "give each a namespace" in said[-1][1]
        graphs.remove(second)
        serve_until(lambda: "the same topic" not in said[-1][1])


def test_every_node_says_how_it_is_as_aggregators_expect(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    heard: list[DiagnosticStatus] = []
    beside = {"/guide: guidance", "/recorder: recording", "/tdm_writer: tracking data"}
    with Graph() as graph:
        graph.probe.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda array: heard.extend(array.status),
            100,
        )
        graph.add(GuideNode(context=graph.context))
        graph.add(Recorder(STOP, context=graph.context))
        graph.add(TdmWriter(context=graph.context))
        graph.until(lambda: {status.name for status in heard} == beside)
        # Without a detector none of them can do its work.
        for status in heard:
            assert status.level == DiagnosticStatus.ERROR, status.name
            assert "is the detector running?" in status.message
        graph.add(Detector(context=graph.context))
        graph.until(lambda: any(status.name.endswith("detection") for status in heard))
        heard.clear()
        begun_s, counts = time.monotonic(), Counter()

        def each_twice() -> bool:
            counts.clear()
            counts.update(status.name for status in heard)
            return len(counts) == 4 and min(counts.values()) >= 2

        graph.until(each_twice)
    assert counts.keys() == {*beside, "/detector: detection"}
    # Once a second; how much later one is depends on the machine.
    assert max(counts.values()) <= time.monotonic() - begun_s + 2
    for status in heard:
        assert status.hardware_id
        # That is what an aggregator makes of silence.
        assert status.level != DiagnosticStatus.STALE
    analyzers = yaml.safe_load(ANALYZERS.read_text())["analyzers"]["ros__parameters"]
    wanted = [
        words for one in analyzers.values() if "contains" in one for words in one["contains"]
    ]
    for name in {*counts, "/east/detector: detection"}:
        assert sum(words in name for words in wanted) == 1, name


@pytest.mark.parametrize(
    ("make", "topic"),
    [(GuideNode, "/rso_tracks"), (lambda context: Recorder(STOP, context), "/rso_detections")],
)
def test_a_publisher_that_cannot_be_heard_is_explained(make, topic, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with Graph() as graph:
        graph.add(make(context=graph.context))
        graph.publisher(PointCloud2, topic, best_effort=True)
        said = ""

        def told() -> bool:
            nonlocal said
            said += capfd.readouterr().err
            return f"a publisher of {topic} cannot be heard" in said

        graph.until(told)
    assert f"set qos_overrides.{topic}.subscription.reliability of this node to what" in said
