# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The guide's demo: simulated camera and mount, detector and guide, each a process, over DDS.

Starts detector and guide (engaged), waits until they are there, starts the simulator with an RSO
that nobody announces, and looks on until the pass is over.  It ends by itself, with a summary, a
table and a plot of the pointing error, and says by its exit code whether the RSO was held.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, PointCloud2

from ofsat_ros.camera import Camera
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.processes import children, own_graph, stop_on_signals
from ofsat_ros.nodes.runtime import prepare_for_large_images
from ofsat_ros.nodes.start import STOPPED
from ofsat_ros.nodes.topics import hear

SCENARIOS = ("guide_drift", "guide_leo")
COLUMNS = ("stamp_ns", "time_s", "right_px", "down_px", "told_right_px", "told_down_px", "state")
# Asked for: so little after so long.
HELD_PX, SETTLING_S = 2.0, 8.0
_GOOD_STATES = ("following", "coasting")
_START_S = 60.0
# Without a frame for so long, none will come any more.
_SILENCE_S = 15.0
_DEPTH = 1000
_NS = 1_000_000_000
# An offset is told for a time no farther from that of a frame.
_SAME_TIME_S = 0.1


class DemoError(Exception):
    """The demo cannot go on; the message says why."""


def main() -> int:
    """Run the demo; return 0 if the RSO was held, 1 if not, 2 if it could not be run."""
    options = _options()
    stop_on_signals()
    # The looker-on is in the same graph as the nodes.
    os.environ.update(own_graph())
    prepare_for_large_images()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        return max([_run(name, options) for name in options.scenario])
    except (DemoError, OSError) as error:
        sys.stderr.write(f"demo_guide: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("demo_guide: stopped\n")
        return STOPPED
    finally:
        rclpy.try_shutdown()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "demo_guide", description="Keep a simulated mount on an RSO that nobody announces."
    )
    parser.add_argument(
        "--scenario",
        action="append",
        choices=SCENARIOS,
        help="pass to show, may be given twice; default: all",
    )
    parser.add_argument("--seed", type=int, default=1, help="of sky and noise, %(default)s")
    parser.add_argument(
        "--output", type=Path, default=Path("demo_guide_output"), help="folder, %(default)s"
    )
    parser.add_argument(
        "--seconds", type=float, default=math.inf, help="look on so long; default: the whole pass"
    )
    options = parser.parse_args()
    options.scenario = options.scenario or list(SCENARIOS)
    return options


@dataclass
class _Heard:
    """What the looker-on has heard.

    Attributes
    ----------
    truth : list of (stamp_ns, (u, v) px; NaN outside of the image)
    told : list of (stamp_ns, (right, down) rad)
    states : list of (stamp_ns, state, target_id)
    frames : list of (stamp_ns, count)
        Of the clock, and how many images the detector had processed by then.
    """

    camera: Camera | None = None
    truth: list[tuple[int, np.ndarray]] = field(default_factory=list)
    told: list[tuple[int, np.ndarray]] = field(default_factory=list)
    states: list[tuple[int, str, int]] = field(default_factory=list)
    frames: list[tuple[int, int]] = field(default_factory=list)


class _LookerOn(Node):
    """Hears the truth, and what the guide says."""

    def __init__(self) -> None:
        super().__init__("looker_on")
        self.heard = _Heard()
        for kind, topic, take in (
            (CameraInfo, "camera_info", self._on_camera_info),
            (PointCloud2, "rso_truth", self._on_truth),
            (Vector3Stamped, "target_offset", self._on_offset),
            (DiagnosticArray, "/diagnostics", self._on_diagnostics),
        ):
            hear(self, kind, topic, take, _DEPTH)

    def _on_camera_info(self, info: CameraInfo) -> None:
        if self.heard.camera is None:
            self.heard.camera = Camera.from_message(info)

    def _on_truth(self, cloud: PointCloud2) -> None:
        rows = messages.cloud_array(cloud)
        place = np.array([rows["u"][0], rows["v"][0]]) if len(rows) else np.full(2, np.nan)
        self.heard.truth.append((messages.stamp_ns(cloud.header.stamp), place))

    def _on_offset(self, message: Vector3Stamped) -> None:
        stamp = messages.stamp_ns(message.header.stamp)
        self.heard.told.append((stamp, np.array([message.vector.x, message.vector.y])))

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        stamp = messages.stamp_ns(array.header.stamp)
        for status in array.status:
            values = {value.key: value.value for value in status.values}
            if "target_id" in values:
                self.heard.states.append((stamp, values["state"], int(values["target_id"])))
            if "frames_processed" in values:
                self.heard.frames.append((stamp, int(values["frames_processed"])))


def _run(name: str, options: argparse.Namespace) -> int:
    _say(f"demo_guide: {name}: simulator -> detector -> guide -> the simulator's mount")
    node = _LookerOn()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        with children() as start:
            serving = [start("detector"), start("guide", "-p", "engaged:=true")]
            _serve(
                executor,
                lambda: all(node.count_publishers(t) for t in ("rso_tracks", "mount_rate")),
                serving,
                "detector and guide did not start; see above",
            )
            simulator = start(
                "simulator",
                *("-p", f"scenario:={name}"),
                *("-p", f"seed:={options.seed}"),
                *("-p", "loop:=false"),
            )
            _look_on(executor, node.heard, simulator, serving, options.seconds)
    finally:
        executor.shutdown()
        node.destroy_node()
    return _sum_up(name, node.heard, options.output)


def _serve(
    executor: SingleThreadedExecutor,
    done: Callable[[], bool],
    alive: list[subprocess.Popen],
    otherwise: str,
) -> None:
    """Serve the looker-on until something is done; DemoError if a process ends before."""
    deadline_s = time.monotonic() + _START_S
    while not done():
        if time.monotonic() > deadline_s or any(p.poll() is not None for p in alive):
            raise DemoError(otherwise)
        executor.spin_once(timeout_sec=0.05)


def _look_on(
    executor: SingleThreadedExecutor,
    heard: _Heard,
    simulator: subprocess.Popen,
    serving: list[subprocess.Popen],
    seconds: float,
) -> None:
    """Listen until the simulator has ended, or for so long."""
    _serve(executor, lambda: bool(heard.truth), [simulator, *serving], "no frame came; see above")
    frames, last_s = 0, time.monotonic()
    end_s = last_s + seconds
    while simulator.poll() is None and time.monotonic() < end_s:
        executor.spin_once(timeout_sec=0.05)
        if len(heard.truth) != frames:
            frames, last_s = len(heard.truth), time.monotonic()
        if any(process.poll() is not None for process in serving):
            raise DemoError("detector or guide ended before the pass was over; see above")
        if time.monotonic() - last_s > _SILENCE_S:
            raise DemoError(f"no frame came for {_SILENCE_S:g} s")


def _sum_up(name: str, heard: _Heard, output: Path) -> int:
    """Write table and plot, and say how it went; return 0 if the RSO was held."""
    output.mkdir(parents=True, exist_ok=True)
    rows = _rows(heard)
    table, plot = output / f"{name}.csv", output / f"{name}.png"
    with table.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    times, off = np.array([row[1] for row in rows]), np.array([row[2:4] for row in rows])
    error = np.hypot(*off.T)
    acquired_s = _since_start_s(heard, _acquired(heard)[1])
    settled = error[times >= acquired_s + SETTLING_S]
    losses = _losses(heard)
    figures = _figures(heard, settled, losses)
    held = (
        math.isfinite(acquired_s)
        and not losses
        and len(settled) > 0
        and bool(np.sqrt(np.mean(settled**2)) <= HELD_PX)
    )
    drawn = _draw(plot, name, times, off, acquired_s, figures)
    files = f"{table} and {plot.name}" if drawn else f"{table}; no plot without matplotlib"
    _say(f"demo_guide: {name}: {'held' if held else 'NOT HELD'}; {figures}; {files}")
    return 0 if held else 1


def _rows(heard: _Heard) -> list[tuple]:
    """What COLUMNS says, of each frame."""
    if heard.camera is None:
        raise DemoError("no camera_info came")
    scale, centre = heard.camera.matrix[0, 0], heard.camera.matrix[:2, 2]
    told_ns = np.array([stamp for stamp, _ in heard.told], np.int64)
    state_ns = [stamp for stamp, *_ in heard.states]
    rows = []
    for stamp, place in heard.truth:
        told = np.full(2, np.nan)
        if len(told_ns):
            nearest = int(np.argmin(np.abs(told_ns - stamp)))
            if abs(told_ns[nearest] - stamp) <= _SAME_TIME_S * _NS:
                told = np.tan(heard.told[nearest][1]) * scale
        index = int(np.searchsorted(state_ns, stamp, side="right")) - 1
        state = heard.states[index][1] if index >= 0 else ""
        pixels = [round(float(value), 3) for value in (*(place - centre), *told)]
        rows.append((stamp, round(_since_start_s(heard, stamp), 4), *pixels, state))
    return rows


def _since_start_s(heard: _Heard, stamp: float) -> float:
    """Time since the first frame that the looker-on heard; for NaN, NaN."""
    return (stamp - heard.truth[0][0]) / _NS


def _acquired(heard: _Heard) -> tuple[int, float]:
    """Index in the states, and stamp, at which a target is followed; or their end, and NaN.

    The guide says each change of its state as it happens.
    """
    for index, (stamp, state, _) in enumerate(heard.states):
        if state == "following":
            return index, stamp
    return len(heard.states), math.nan


def _losses(heard: _Heard) -> int:
    """How often the target was lost, or another one taken, while frames came."""
    index, _ = _acquired(heard)
    last_ns = heard.truth[-1][0]
    later = [(state, target) for stamp, state, target in heard.states[index:] if stamp <= last_ns]
    good = [state in _GOOD_STATES for state, _ in later]
    lost = sum(before and not now for before, now in pairwise(good))
    return lost + len({target for _, target in later if target}) - 1 if later else 0


def _figures(heard: _Heard, settled: np.ndarray, losses: int) -> str:
    _, acquired_ns = _acquired(heard)
    if not math.isfinite(acquired_ns):
        return "nothing was acquired"
    # Discovery takes the looker-on longer than a few frames: the detector itself counts them.
    needed = max([count for stamp, count in heard.frames if stamp <= acquired_ns], default=0)
    acquired = f"acquired with frame {needed}"
    lost = "no loss" if not losses else f"{losses} losses"
    if not len(settled):
        return f"{acquired}; {lost}; over before it had settled"
    outside = int(np.isnan(settled).sum())
    away = f", out of the image in {outside} frames" if outside else ""
    rms, worst = np.sqrt(np.mean(settled**2)), np.max(settled)
    return (
        f"{acquired}; error {SETTLING_S:g} s later {rms:.2f} px rms, {worst:.2f} px at worst;"
        f" {lost}{away}"
    )


def _draw(
    path: Path, name: str, times: np.ndarray, off: np.ndarray, acquired_s: float, figures: str
) -> bool:
    """Draw the pointing error over time; False if there is nothing to draw with."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return False
    figure = Figure((9, 6), layout="constrained")
    FigureCanvasAgg(figure)
    whole, near = figure.subplots(2, sharex=True)
    for axes in (whole, near):
        for values, label in zip(off.T, ("right", "down"), strict=True):
            axes.plot(times, values, label=label)
        if math.isfinite(acquired_s):
            axes.axvline(acquired_s, color="grey", linestyle=":", label="acquired")
            axes.axvline(
                acquired_s + SETTLING_S, color="grey", linestyle="--", label="to be settled"
            )
        axes.set_ylabel("RSO from boresight, px")
        axes.grid(alpha=0.3)
    near.axhspan(-HELD_PX, HELD_PX, alpha=0.1, color="green")
    near.set_ylim(-2.5 * HELD_PX, 2.5 * HELD_PX)
    near.set_xlabel("time, s")
    whole.legend(loc="upper right")
    whole.set_title(f"{name}: {figures}", fontsize="small")
    figure.savefig(path, dpi=100)
    return True


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
