# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The night over DDS: a camera, the nodes that stay up all night, and what disturbs them.

Camera, detector, guide, tdm_writer, recorder and viewers are processes of their own, in a ROS
graph that nobody else hears.  Frames bear the stamps of an even clock, so a stamp tells a frame's
number and when it was due; lateness is from then to when its answer is heard, the camera's own
included.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from benchmarks.soak.night import Night, camera_of
from benchmarks.soak.watching import MB, Held, growth, own_segments, shared_bytes
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.runtime import prepare_for_large_images
from ofsat_ros.nodes.simulator import camera_info
from ofsat_ros.nodes.topics import advertise, hear

_NS = 1_000_000_000
_PATIENCE_S = 60.0
_SAMPLE_S = 2.0
_STARTED = 5  # answers until all is loaded
_HOG = "while True: pass"
_LIVE = 4
HEAD = (
    "| over DDS | sent | answered | lost | dropped | ms late: median | p99 | most"
    " | memory, MB: detector | guide | tdm_writer | recorder | files | threads | /dev/shm, MB |\n"
    + "|---" * 15
    + "|"
)


@dataclass
class Phase:
    """What happened in a part of the night.

    Attributes
    ----------
    name : str
    sent, answered, lost, dropped : int
        Frames; `dropped` ones are those that the detector says it left out.
    late : (N,) float64
        Of each answer, s.
    held : dict of str to list of Held
        Samples of each node's process, by its name.
    shared : list of float
        Samples of the machine's shared memory, bytes.
    """

    name: str
    sent: int = 0
    answered: int = 0
    lost: int = 0
    dropped: int = 0
    late: list[float] = field(default_factory=list)
    held: dict[str, list[Held]] = field(default_factory=dict)
    shared: list[float] = field(default_factory=list)

    def __str__(self) -> str:
        ms = 1e3 * np.percentile(self.late, [50, 99, 100]) if self.late else [np.nan] * 3
        last = {name: rows[-1] for name, rows in self.held.items() if rows}
        nodes = ("detector", "guide", "tdm_writer", "recorder")
        memory = [f"{last[n].resident / MB:.1f}" if n in last else "-" for n in nodes]
        counts = [
            "+".join(f"{getattr(last[n], what)}" for n in nodes if n in last)
            for what in ("files", "threads")
        ]
        cells = [
            self.name,
            *(f"{n:,}" for n in (self.sent, self.answered, self.lost, self.dropped)),
            *(f"{value:.0f}" for value in ms),
            *memory,
            *counts,
            f"{np.median(self.shared) / MB:.0f}" if self.shared else "-",
        ]
        return f"| {' | '.join(cells)} |"


def camera(folder: Path, rate_hz: float, begin_ns: int, sent: Any, stop: Event) -> None:
    """Be a camera that sends the night's frames, evenly and reliably, until it is stopped."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare_for_large_images()
    rclpy.init()
    node = rclpy.create_node("camera")
    images = advertise(node, Image, "image", 10)
    infos = advertise(node, CameraInfo, "camera_info", 10)
    attitudes = advertise(node, QuaternionStamped, "attitude", 10)
    night, number = Night.load(folder), 0
    seen = camera_of(night)
    while not stop.is_set():
        stamp_ns = stamp_of(number, rate_hz, begin_ns)
        stop.wait(max(0.0, stamp_ns / _NS - time.time()))
        header = Header(stamp=messages.time_message(stamp_ns), frame_id="camera")
        infos.publish(camera_info(header, seen))
        attitude = QuaternionStamped(header=header)
        attitude.quaternion.w = 1.0
        attitudes.publish(attitude)
        images.publish(messages.image_message(header, night.image(number)))
        number += 1
        sent.value = number
    node.destroy_node()
    rclpy.shutdown()


def stamp_of(number: int, rate_hz: float, begin_ns: int) -> int:
    """Return a frame's stamp, ns."""
    return begin_ns + round(number * _NS / rate_hz)


def view(topic: str, pause_s: float) -> None:
    """Be a viewer that takes so long for each picture."""
    prepare_for_large_images()
    rclpy.init()
    node = rclpy.create_node("viewer")
    hear(node, Image, topic, lambda _: time.sleep(pause_s), 5)
    rclpy.spin(node)


class Ears:
    """Hears the answers, and what the detector says of itself."""

    def __init__(self, rate_hz: float, begin_ns: int) -> None:
        self._rate_hz, self._begin_ns = rate_hz, begin_ns
        self._node = rclpy.create_node("ears")
        self.late: dict[int, float] = {}  # of the frames answered so far
        self.again = 0
        self.values: dict[str, str] = {}
        self.messages: set[str] = set()
        hear(self._node, PointCloud2, "rso_detections", self._on_answer, 1000, raw=True)
        hear(self._node, DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hear no more."""
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()

    def _on_answer(self, data: bytes) -> None:
        since_ns = messages.header_stamp_ns(data) - self._begin_ns
        number = round(since_ns * self._rate_hz / _NS)
        self.again += number in self.late
        self.late[number] = time.time() - (self._begin_ns + since_ns) / _NS

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.endswith("detection"):
                self.values = {pair.key: pair.value for pair in status.values}
                self.messages.add(status.message)

    def count(self, what: str) -> int:
        """Return one of the detector's counts of frames."""
        return int(self.values.get(f"frames_{what}", 0))


def wait_for(condition: Callable[[], Any], what: str, patience_s: float = _PATIENCE_S) -> None:
    """Wait until something is so; raise if it does not become so."""
    end_s = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(f"{what}: not within {patience_s:g} s")
        time.sleep(0.05)


class Observatory:
    """A camera, a detector and its companions, all at work.

    Parameters
    ----------
    folder : Path
        Of the night's frames; what the nodes write goes there, too.
    rate_hz : float
        Frames per second.
    live : bool
        Whether the detector takes the newest frame, and no others.
    """

    def __init__(self, folder: Path, rate_hz: float, live: bool = False) -> None:
        self._folder, self._rate_hz, self._live = folder, rate_hz, live
        self._open = ExitStack()
        self.nodes: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> Observatory:
        with self._open:
            begin_ns = time.time_ns() + 2 * _NS
            self.ears = Ears(self._rate_hz, begin_ns)
            self._open.callback(self.ears.close)
            word = "false" if self._live else "true"
            self._start("detector", "-p", f"reliable_input:={word}")
            self._start("guide")
            self._start("tdm_writer", "-p", f"output:={self._folder / 'tracks'}")
            self._start(
                "recorder", "-p", f"output:={self._folder / 'record'}", "-p", "overwrite:=true"
            )
            context = get_context("spawn")
            self._sent, stop = context.Value("q", 0), context.Event()
            arguments = (self._folder, self._rate_hz, begin_ns, self._sent, stop)
            sender = context.Process(target=camera, args=arguments, daemon=True)
            sender.start()
            self._open.callback(_end_camera, sender, stop)
            wait_for(lambda: len(self.ears.late) >= _STARTED, "the first answers")
            self._open = self._open.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _start(self, node: str, *arguments: str) -> None:
        command = [sys.executable, "-m", "ofsat_ros.nodes.start", node, "--ros-args", *arguments]
        with (self._folder / f"{node}.out").open("w") as out:
            process = subprocess.Popen(command, stdout=out, stderr=out)
        self.nodes[node] = process
        self._open.callback(_end, process)

    def watch(self, name: str, seconds: float) -> Phase:
        """Look on for so long, and say what was seen."""
        phase = Phase(name, held={node: [] for node in self.nodes})
        first, dropped = self._sent.value, self._dropped()
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            time.sleep(min(left_s, _SAMPLE_S))
            self._sample(phase)
        last = self._sent.value
        if not self._live:
            self._wait_for_answers(first, last)
        else:
            time.sleep(1.0)
        heard = {n: late for n, late in self.ears.late.copy().items() if first <= n < last}
        phase.sent, phase.answered, phase.late = last - first, len(heard), list(heard.values())
        phase.dropped = self._dropped() - dropped
        phase.lost = phase.sent - phase.answered - phase.dropped
        return phase

    def _dropped(self) -> int:
        return self.ears.count("dropped")

    def _sample(self, phase: Phase) -> None:
        for name, process in self.nodes.items():
            if process.poll() is not None:
                said = (self._folder / f"{name}.out").read_text()[-2000:]
                raise RuntimeError(f"{name} has ended with {process.returncode}: {said}")
            phase.held[name].append(Held.by(process.pid))
        phase.shared.append(shared_bytes())

    def _wait_for_answers(self, first: int, last: int) -> None:
        """Wait for what was sent, as long as answers come."""
        wanted, missing = range(first, last), last - first + 1
        while (now := sum(n not in self.ears.late for n in wanted)) and now < missing:
            missing, end_s = now, time.monotonic() + _PATIENCE_S
            while sum(n not in self.ears.late for n in wanted) == now:
                if time.monotonic() > end_s:
                    return
                time.sleep(0.1)


def rows(folder: Path, rate_hz: float, seconds: float) -> Iterator[str]:
    """Yield the table of a night of so many seconds, and what it shows."""
    yield HEAD
    with Observatory(folder, rate_hz) as all_night:
        phases = []
        for phase in _phases(all_night, seconds):
            phases.append(phase)
            yield f"{phase}"
        again = all_night.ears.again
    # More than it can take: a live detector answers for the newest frames.
    with Observatory(folder, _LIVE * rate_hz, live=True) as live, hogs():
        phase = live.watch(f"live, {_LIVE} times as fast, hogs beside it", 0.05 * seconds)
        yield f"{phase}"
    yield f"\n{said(phases, phase, again)}"


def _phases(night: Observatory, seconds: float) -> Iterator[Phase]:
    yield night.watch("quiet", 0.6 * seconds)
    with hogs():
        yield night.watch("hogs beside it", 0.1 * seconds)
    yield night.watch("quiet again", 0.05 * seconds)
    with viewer(0.0):
        yield night.watch("a viewer of `image_annotated`", 0.05 * seconds)
    with viewer(1.0):
        yield night.watch("one that takes 1 s a picture", 0.05 * seconds)
    with viewer(0.0) as stopped:
        time.sleep(5.0)  # until it is known
        stopped.send_signal(signal.SIGSTOP)
        yield night.watch("one that is stopped", 0.05 * seconds)
    yield night.watch("one that was killed", 0.05 * seconds)


def said(phases: list[Phase], live: Phase, again: int) -> str:
    """What the table shows, in words."""
    quiet = phases[0]
    grown = ", ".join(
        f"{name} {growth([held.resident for held in rows[len(rows) // 5 :]]) / MB:+.1f} MB"
        for name, rows in quiet.held.items()
    )
    half = len(quiet.late) // 2
    late = [1e3 * float(np.median(part)) for part in (quiet.late[:half], quiet.late[half:])]
    return (
        f"{sum(p.lost for p in phases)} of {sum(p.sent for p in phases):,} frames lost on"
        f" reliable input, {again} answered twice; while it was quiet, from its first half to its"
        f" second: {grown}; {late[0]:.0f} ms late, then {late[1]:.0f} ms; live, {live.answered}"
        f" of {live.sent} answered, {live.dropped} said to be dropped, {live.lost} unaccounted for"
    )


@contextmanager
def hogs() -> Iterator[None]:
    """Have a process on each core that does nothing but take time."""
    running = [subprocess.Popen([sys.executable, "-c", _HOG]) for _ in os.sched_getaffinity(0)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


@contextmanager
def viewer(pause_s: float) -> Iterator[subprocess.Popen]:
    """Have somebody look at ``image_annotated``, and take so long for each picture."""
    code = f"from benchmarks.soak.graph import view; view('image_annotated', {pause_s})"
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        yield process
    finally:
        _bury(process)


def _bury(process: subprocess.Popen) -> None:
    """Kill a process, and remove the shared memory that it then leaves."""
    names = own_segments(process.pid) if process.poll() is None else set()
    process.kill()
    process.wait()
    for name in names:
        Path("/dev/shm", name).unlink(missing_ok=True)


def _end(process: subprocess.Popen) -> None:
    process.send_signal(signal.SIGCONT)
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _end_camera(process: Any, stop: Event) -> None:
    stop.set()
    process.join(10)
    process.kill()
    process.join()
