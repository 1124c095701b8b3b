# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A ROS graph for one test: a context, the nodes under test, and a probe that talks to them."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, Self

import numpy as np
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from ofsat_ros.nodes import messages
from ofsat_ros.recordings import BagWriter
from ofsat_ros.simulation import SimulatedFrame, scenario

# Discovery takes up to a second on a busy machine; what hangs shall not hang the tests.
PATIENCE_S = 20.0
# Several processes import numpy, OpenCV and ROS at once, beside other work.
START_S = 60.0


class Graph:
    """Nodes in one context, served by the test itself; `arguments` follow ``--ros-args``."""

    def __init__(self, *arguments: str) -> None:
        self.context = Context()
        self.context.init(args=["test", "--ros-args", *arguments])
        self._executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Node] = []
        self.probe = self.add(Node("probe", context=self.context, use_global_arguments=False))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for node in reversed(self._nodes):
            if hasattr(node, "close"):
                node.close()
            self._executor.remove_node(node)
            node.destroy_node()
        self._executor.shutdown()
        self.context.try_shutdown()

    def add(self, node: Node) -> Any:
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def until(self, condition: Callable[[], Any], patience_s: float = PATIENCE_S) -> None:
        """Serve the nodes until a condition holds; fail at the deadline."""
        deadline_s = time.monotonic() + patience_s
        while not condition():
            assert time.monotonic() < deadline_s, "the condition was not met in time"
            self._executor.spin_once(timeout_sec=0.02)

    def serve_once(self) -> None:
        self._executor.spin_once(timeout_sec=0)

    def serve(self, seconds: float) -> None:
        """Serve the nodes for a time in which something must not happen."""
        end_s = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end_s)

    def listen(self, kind: type, topic: str, best_effort: bool = False) -> list:
        """Return a list that fills with what is published."""
        heard: list = []
        reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        qos = QoSProfile(depth=1000, reliability=reliability)
        self.probe.create_subscription(kind, topic, heard.append, qos)
        return heard

    def publisher(self, kind: type, topic: str, best_effort: bool = False) -> Any:
        reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        return self.probe.create_publisher(
            kind, topic, QoSProfile(depth=100, reliability=reliability)
        )

    def connect(self, *publishers: Any) -> None:
        """Wait until each of these has a subscriber."""
        self.until(lambda: all(p.get_subscription_count() for p in publishers))

    def call(self, kind: type, service: str, request: Any) -> Any:
        """Return a service's response."""
        client = self.probe.create_client(kind, service)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        self.probe.destroy_client(client)
        return future.result()


class Process:
    """A node in a process of its own."""

    def __init__(self, folder: Path, node: str, *arguments: str, **environment: str) -> None:
        self._out, self._err = (folder / f"{node}.{end}" for end in ("out", "err"))
        with self._out.open("w") as out, self._err.open("w") as err:
            self.popen = subprocess.Popen(
                [sys.executable, "-m", "ofsat_ros.nodes.start", node, *arguments],
                stdout=out,
                stderr=err,
                env={**os.environ, **environment},
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGINT)
            try:
                self.popen.wait(5)
            except subprocess.TimeoutExpired:
                self.popen.kill()
                self.popen.wait()

    @property
    def out(self) -> str:
        return self._out.read_text()

    @property
    def err(self) -> str:
        return self._err.read_text()

    @property
    def shared_memory(self) -> set[str]:
        """Names of the segments that it has mapped, its own and those of whom it talks to."""
        maps = Path(f"/proc/{self.popen.pid}/maps").read_text()
        # Ports are shared by all, and outlive them.
        return set(re.findall(r"/dev/shm/(fastrtps_(?!port)\w+)", maps))

    def end(self, number: int, patience_s: float = PATIENCE_S) -> float:
        """Send a signal, twice as an impatient user does; return the CPU time until its end, s."""
        before_s = self._cpu_s()
        self.popen.send_signal(number)
        self.popen.send_signal(number)
        deadline_s = time.monotonic() + patience_s
        # It stays known to the system, with its times, until `wait` asks for the exit code.
        ended = os.WEXITED | os.WNOWAIT | os.WNOHANG
        while os.waitid(os.P_PID, self.popen.pid, ended) is None:
            assert time.monotonic() < deadline_s, f"still there {patience_s:g} s after the signal"
            time.sleep(0.02)
        return self._cpu_s() - before_s

    def _cpu_s(self) -> float:
        fields = Path(f"/proc/{self.popen.pid}/stat").read_text().rpartition(")")[2].split()
        user, system = fields[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    def wait(self, patience_s: float = PATIENCE_S) -> int:
        """Return the exit code."""
        return self.popen.wait(patience_s)

    def wait_for(self, text: str, patience_s: float = START_S) -> None:
        """Wait until it has said something."""
        deadline_s = time.monotonic() + patience_s
        while text not in self.out + self.err:
            assert self.popen.poll() is None, self.err
            assert time.monotonic() < deadline_s, self.err
            time.sleep(0.02)


def sky(frames: int, **settings: Any) -> list[SimulatedFrame]:
    """Frames with one RSO that crosses a star field at 8 px a frame, 16 bit."""
    small = {"width": 256, "height": 192, "period_s": 0.5, "exposure_s": 0.5, "star_count": 60}
    return list(islice(scenario("sidereal", 3, **{**small, "frames": 16, **settings}), frames))


def header(frame: SimulatedFrame, frame_id: str = "camera_optical_frame") -> Header:
    return Header(stamp=messages.time_message(frame.stamp_ns), frame_id=frame_id)


def image(frame: SimulatedFrame) -> Image:
    return messages.image_message(header(frame), frame.image)


def without_rso(frame: SimulatedFrame) -> SimulatedFrame:
    """The frame with a patch of blank sky in the place of its RSO."""
    x, y = (round(frame.truth[name][0]) for name in ("x_px", "y_px"))
    pixels = frame.image.copy()
    pixels[max(0, y - 12) : y + 13, max(0, x - 16) : x + 17] = np.median(pixels)
    return replace(frame, image=pixels)


def write_bag(path: Path, frames: list[SimulatedFrame], topic: str = "/camera/image") -> Path:
    with BagWriter(path) as bag:
        for frame in frames:
            bag.write_image(topic, frame.image, frame.stamp_ns, "camera_optical_frame")
    return path


def stamps(heard: list) -> list[int]:
    return [messages.stamp_ns(message.header.stamp) for message in heard]


def padded_big_endian(frame: SimulatedFrame, padding: int = 12) -> Image:
    """The frame's image with big-endian pixels and rows that are longer than their pixels."""
    message = image(frame)
    height, width = frame.image.shape
    rows = np.full((height, 2 * width + padding), 0xA5, np.uint8)
    rows[:, : 2 * width] = frame.image.astype(">u2").view(np.uint8)
    message.is_bigendian, message.step, message.data = 1, rows.shape[1], rows.tobytes()
    return message
