# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the nodes do with images over DDS: overhead, losses, latency, start, several cameras.

``python -m benchmarks.throughput`` prints a Markdown table.  Senders and detectors are processes
of their own, in a ROS graph that nobody else hears; what is said of them is what they published:
answers by their stamps, the detector's profile by its ``/diagnostics``.  A few rendered frames are
sent over and over, each moved on by 2 px, so that the sky never ends.  ``--quick`` takes a
sixteenth of the pixels and a tenth of the frames.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from benchmarks.speed import HEADLINE, Sky, alone, load, machine, render
from ofsat_ros.nodes import messages, player
from ofsat_ros.nodes.runtime import parser_of, prepare_for_large_images, run
from ofsat_ros.nodes.topics import advertise, hear
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.recordings import IMAGE, Topic

SMALL, MIDDLE, LARGE = HEADLINE
_PREPARED = 6
_NS = 1_000_000_000
_PERIOD_NS = _NS  # of the replayed frames' stamps
_STEP_PX = 2
_PATIENCE_S = 30.0
_ANSWER = "rso_detections"
_WARM_UP = 12  # frames until the history is full
_KINDS = {
    _ANSWER: PointCloud2,
    "rso_tracks": PointCloud2,
    "star_field_motion": Vector3Stamped,
    "/diagnostics": DiagnosticArray,
}
# A camera's stamps end with the number of the frame, so that gaps in the answers tell of losses.
_NUMBERS = 1000


class Frames:
    """Endless serialized images of a few prepared ones."""

    def __init__(self, folder: Path, sky: Sky) -> None:
        self._images = [load(folder, sky, number) for number in range(_PREPARED)]
        first = self._images[0]
        message = messages.image_message(Header(frame_id="camera"), first)
        self._data = bytearray(serialize_message(message))
        pixels = np.frombuffer(self._data, np.uint16, offset=len(self._data) - first.nbytes)
        self._pixels = pixels.reshape(first.shape)

    def cdr(self, number: int, stamp_ns: int) -> bytearray:
        """Return an image as CDR; the next call overwrites it."""
        image = self._images[number % _PREPARED]
        shift = _STEP_PX * number % image.shape[1]
        self._pixels[:, shift:] = image[:, : image.shape[1] - shift]
        self._pixels[:, :shift] = image[:, image.shape[1] - shift :]
        struct.pack_into("<iI", self._data, messages.HEADER_AT, *divmod(stamp_ns, _NS))
        return self._data


class CycledBag:
    """What the player needs of a `Bag`; it holds far more frames than memory."""

    def __init__(self, frames: Frames, count: int) -> None:
        self.path, self.start_ns = Path("cycled"), _PERIOD_NS
        self.topics = {"/image": Topic(IMAGE, count)}
        self.problems: list[str] = []
        self._frames, self._count = frames, count

    def messages(self, *_: object) -> Iterator[tuple[str, str, int, bytearray]]:
        """As `Bag.messages`."""
        for number in range(self._count):
            stamp_ns = (number + 1) * _PERIOD_NS
            yield "/image", IMAGE, stamp_ns, self._frames.cdr(number, stamp_ns)

    def close(self) -> None:
        """As `Bag.close`."""


def play(folder: Path, sky: Sky, count: int) -> None:
    """Be a player of so many frames, as fast as the detector answers."""
    bag = CycledBag(Frames(folder, sky), count)
    player._open = lambda _: bag
    sys.argv = ["player", "--ros-args", "-p", "rate:=0.0", "-p", "clock:=false"]
    sys.argv += ["--log-level", "warn"]
    run(lambda stop, _: player.Player(stop, "cycled"), parser_of("player", ""))


def film(folder: Path, sky: Sky, topics: Sequence[str], rate_hz: float, stop: Event) -> None:
    """Be a camera, or several with the same frames, that waits for nobody."""
    prepare_for_large_images()
    rclpy.init()
    node = rclpy.create_node("camera")
    publishers = [advertise(node, Image, topic, 5) for topic in topics]
    frames, number, due_s = Frames(folder, sky), 0, time.monotonic()
    while not stop.is_set():
        for publisher in publishers:
            stamp_ns = time.time_ns() // _NUMBERS * _NUMBERS + number % _NUMBERS
            publisher.publish(bytes(frames.cdr(number, stamp_ns)))
        number += 1
        due_s = max(due_s + 1 / rate_hz, time.monotonic() - 1 / rate_hz)
        stop.wait(max(0.0, due_s - time.monotonic()))
    node.destroy_node()
    rclpy.shutdown()


@contextmanager
def sending(function: Callable[..., None], *arguments: Any) -> Iterator[Any]:
    """Run a sender in a process of its own; end it by its event if it has one."""
    process = get_context("spawn").Process(target=function, args=arguments, daemon=True)
    process.start()
    try:
        yield process
    finally:
        if isinstance(arguments[-1], Event):
            arguments[-1].set()
            process.join(_PATIENCE_S)
        process.terminate()
        process.join()


@contextmanager
def detecting(*ros_arguments: str) -> Iterator[subprocess.Popen]:
    """Run a detector; whatever happens, it ends."""
    command = [sys.executable, "-m", "ofsat_ros.nodes.start", "detector", "--ros-args"]
    process = subprocess.Popen([*command, "--log-level", "warn", *ros_arguments])
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Listener:
    """Hears what detectors say; `heard` holds (time of arrival in s, CDR) by topic."""

    def __init__(self, *namespaces: str) -> None:
        self._node = rclpy.create_node("listener")
        self.heard: dict[str, list[tuple[float, bytes]]] = {}
        for name in _KINDS:  # the diagnostics last: who hears them, is heard with all others
            for topic in {name if name[0] == "/" else f"{ns}/{name}" for ns in namespaces}:
                self._listen(topic)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _listen(self, topic: str) -> None:
        rows = self.heard.setdefault(topic, [])
        kind = next(k for name, k in _KINDS.items() if topic.endswith(name))

        def on_message(data: bytes) -> None:
            rows.append((time.time(), data))

        hear(self._node, kind, topic, on_message, 1000, raw=True)

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()

    def answers(self, namespace: str = "") -> list[tuple[float, int]]:
        """Return the answers so far: when they came, s, and their stamps, ns."""
        rows = list(self.heard[f"{namespace}/{_ANSWER}"])
        return [(at, messages.header_stamp_ns(data)) for at, data in rows]

    def diagnostics(self) -> list[dict[str, str]]:
        """Return the values of every diagnostic of an answered frame."""
        arrays = [deserialize_message(d, DiagnosticArray) for _, d in self.heard["/diagnostics"]]
        told = [{pair.key: pair.value for pair in array.status[0].values} for array in arrays]
        for values, array in zip(told, arrays, strict=True):
            values["message"] = array.status[0].message
        return [values for values in told if "frame" in values]

    def bytes_per_frame(self, namespace: str = "") -> dict[str, float]:
        """Return the mean size of each topic's messages."""
        return {
            topic.rpartition("/")[2]: float(np.mean([len(data) for _, data in rows]))
            for topic, rows in self.heard.items()
            if rows
        }

    def until_connected(self) -> None:
        """Wait until a detector knows us: what it says before is not kept for us."""
        assert self.until(lambda: self.heard["/diagnostics"], _PATIENCE_S), "no detector heard"

    def until(self, condition: Callable[[], Any], patience_s: float) -> bool:
        """Wait for a condition; return whether it came."""
        end_s = time.monotonic() + patience_s
        while not condition():
            if time.monotonic() > end_s:
                return False
            time.sleep(0.02)
        return True

    def until_answered(self, count: int, namespace: str = "") -> bool:
        """Wait for so many answers, as long as they come."""
        topic, seen = self.heard[f"{namespace}/{_ANSWER}"], -1
        while len(topic) < count and len(topic) > seen:
            seen = len(topic)
            self.until(lambda seen=seen: len(topic) > max(seen, 0), _PATIENCE_S)
        return len(topic) >= count


def cpu_s(process: subprocess.Popen) -> float:
    """Return the CPU time of a running process, s."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def process_alone_s(folder: Path, sky: Sky, frames: int) -> float:
    """Return the median time of `Pipeline.process` without any node, s."""
    pipeline, taken = Pipeline(), []
    images = [load(folder, sky, number) for number in range(_PREPARED)]
    for number in range(frames):
        image = np.roll(images[number % _PREPARED], _STEP_PX * number, axis=1)
        start_s = time.perf_counter()
        pipeline.process(image, (number + 1) * _PERIOD_NS)
        taken.append(time.perf_counter() - start_s)
    return float(np.median(taken[_WARM_UP:]))


def overhead(folder: Path, sky: Sky) -> tuple[str, str, float]:
    """Say what the node adds to `process`; return that, what it sends, and a frame's time, s."""
    frames = _WARM_UP + 8
    with ExitStack() as stack:
        listener = stack.enter_context(Listener(""))
        detector = stack.enter_context(detecting("-p", "reliable_input:=true"))
        listener.until_connected()
        stack.enter_context(sending(play, folder, sky, frames))
        listener.until_answered(_WARM_UP)
        before_s, count = cpu_s(detector), len(listener.answers())
        listener.until_answered(frames)
        cpu = (cpu_s(detector) - before_s) / (len(listener.answers()) - count)
        listener.until(lambda: len(listener.diagnostics()) >= frames, 5.0)
        told = listener.diagnostics()[_WARM_UP:]
        sizes = listener.bytes_per_frame()
    ms = {
        step: float(np.median([float(values[f"profile_{step}_ms"]) for values in told]))
        for step in ("receive", "convert", "publish", "process")
    }
    alone_ms = 1e3 * alone(process_alone_s, folder, sky, frames)
    added = ms["receive"] + ms["convert"] + ms["publish"]
    said = (
        f"receive {ms['receive']:.1f} + convert {ms['convert']:.2f} + publish"
        f" {ms['publish']:.2f} ms beside `process` {ms['process']:.1f} ms:"
        f" {added / ms['process']:.1%}; `process` without a node {alone_ms:.1f} ms;"
        f" CPU of the node {1e3 * cpu:.0f} ms per frame"
    )
    sent = ", ".join(f"`{topic}` {size:,.0f}" for topic, size in sizes.items())
    return said, f"{sent} bytes", ms["process"] / 1e3


def replay(folder: Path, sky: Sky, count: int) -> str:
    """Say how many frames of a replay were lost."""
    with ExitStack() as stack:
        listener = stack.enter_context(Listener(""))
        stack.enter_context(detecting("-p", "reliable_input:=true"))
        listener.until_connected()
        stack.enter_context(sending(play, folder, sky, count))
        listener.until_answered(count)
        time.sleep(0.5)  # for what should not come
        answers = listener.answers()
    stamps = [stamp for _, stamp in answers]
    expected = {(number + 1) * _PERIOD_NS for number in range(count)}
    took_s = answers[-1][0] - answers[0][0]
    return (
        f"{len(expected - set(stamps))} lost, {len(stamps) - len(set(stamps))} repeated,"
        f" {'in order' if stamps == sorted(stamps) else 'out of order'};"
        f" {(len(stamps) - 1) / took_s:.1f} frames/s"
    )


def live(folder: Path, sky: Sky, frame_s: float, *parameters: str) -> str:
    """Say what becomes of a camera that is two and a half times as fast as the detector."""
    rate_hz, stop = 2.5 / frame_s, get_context("spawn").Event()
    with ExitStack() as stack:
        listener = stack.enter_context(Listener(""))
        stack.enter_context(detecting(*parameters))
        stack.enter_context(sending(film, folder, sky, ["/image"], rate_hz, stop))
        listener.until_answered(_WARM_UP)
        listener.until(lambda: False, max(3.0, 25 * frame_s))
        answers, told = listener.answers(), listener.diagnostics()
    answers, told = answers[len(answers) // 2 :], told[len(told) // 2 :]
    frame_s = float(np.median([float(values["profile_process_ms"]) for values in told])) / 1e3
    latency = np.array([at - stamp / _NS for at, stamp in answers]) / frame_s
    intervals = {now: (now - before) / _NS for (_, before), (_, now) in pairwise(answers)}
    true = [
        abs(float(values["frame_interval_s"]) - intervals[int(values["stamp_ns"])]) < 1e-3
        for values in told
        if int(values["stamp_ns"]) in intervals
    ]
    drops = int(told[-1]["frames_dropped"]) - int(told[0]["frames_dropped"])
    warned = sum("slower than the camera" in values["message"] for values in told)
    return (
        f"{rate_hz:.1f} frames/s sent, {1 / frame_s:.1f} processed at most; from stamp to answer"
        f" {np.median(latency):.2f} frame times, at most {latency.max():.2f}; {drops} dropped"
        f" beside {len(told)} answered, said in {warned} of {len(told)} diagnostics;"
        f" dt_s is that of the stamps in {sum(true)} of {len(true)}"
    )


def several(folder: Path, sky: Sky, cameras: int, rate_hz: float, seconds: float) -> str:
    """Say what several detectors lose, each with its own camera."""
    names, stop = [f"/camera_{k}" for k in range(cameras)], get_context("spawn").Event()
    topics = [f"{name}/image" for name in names]
    with ExitStack() as stack:
        listener = stack.enter_context(Listener(*names))
        nodes = [stack.enter_context(detecting("-r", f"__ns:={name}")) for name in names]
        stack.enter_context(sending(film, folder, sky, topics, rate_hz, stop))
        for name in names:
            listener.until_answered(_WARM_UP, name)
        before_s, begun_s = [cpu_s(node) for node in nodes], time.time()
        listener.until(lambda: False, seconds)
        cores = sum(map(cpu_s, nodes)) - sum(before_s)
        until_ns = time.time_ns() - _NS  # what was sent a second ago has its answer
        listener.until(lambda: False, 1.0)
        lost = answered = 0
        for name in names:
            stamps = [s for _, s in listener.answers(name) if begun_s * _NS < s < until_ns]
            answered += len(stamps)
            lost += int(np.sum((np.diff(stamps) - 1) % _NUMBERS))
    return f"{answered} answered, {lost} lost; CPU {cores / seconds / cameras:.2f} cores each"


def start(folder: Path, sky: Sky) -> str:
    """Say how long a detector takes from its start to its first answer, at its best of three."""
    taken, stop = [], get_context("spawn").Event()
    with ExitStack() as stack:
        stack.enter_context(sending(film, folder, sky, ["/image"], 20.0, stop))
        for _ in range(3):
            begun_s = time.time()
            with Listener("") as listener, detecting():
                listener.until_answered(1)
                taken.append(listener.answers()[0][0] - begun_s)
    return f"{min(taken):.2f} s (median {np.median(taken):.2f} s)"


def rows(folder: Path, quick: bool) -> Iterator[tuple[str, str]]:
    """Yield what was done, and what came of it."""
    scale = 4 if quick else 1
    small, middle, large = (sky.scaled(scale) for sky in (SMALL, MIDDLE, LARGE))
    for sky in (small, middle, large):
        alone(render, folder, sky, _PREPARED, (0.0, 0.0))
    frame_s = {}
    for sky in (small, middle, large):
        said, sent, frame_s[sky] = overhead(folder, sky)
        yield f"node overhead, {sky}", said
    yield f"results per frame, {large}", sent
    count = 50 if quick else 500
    yield f"replay, reliable, {count} frames of {large}", replay(folder, large, count)
    yield f"live, {middle}", live(folder, middle, frame_s[middle])
    yield f"live, {large}", live(folder, large, frame_s[large])
    yield f"4 detectors, 5 frames/s each, {small}", several(folder, small, 4, 5.0, 10.0)
    yield "start of the node to the first answer", start(folder, small)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Measure the nodes over DDS.")
    parser.add_argument("--quick", action="store_true", help="a sixteenth of the pixels")
    parser.add_argument("--out", type=Path, help="also write the table to this file")
    options = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    prepare_for_large_images()
    rclpy.init()
    lines = [machine(), "", "| what | measured |", "|---|---|"]
    print("\n".join(lines), flush=True)
    with tempfile.TemporaryDirectory(prefix="ofsat_throughput_") as folder:
        for what, measured in rows(Path(folder), options.quick):
            lines.append(f"| {what} | {measured} |")
            print(lines[-1], flush=True)
    rclpy.shutdown()
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
