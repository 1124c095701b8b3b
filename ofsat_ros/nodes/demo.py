# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The demo: a bag's player, a detector and a recorder, each a process of its own, over DDS.

Starts recorder and detector, waits until one hears the other, plays the bag, and ends by itself
with a summary.  It joins no ROS graph: it starts the others and ends them, whatever happens.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import ofsat_ros
from ofsat_ros.nodes.processes import children, stop_on_signals
from ofsat_ros.nodes.recorder import BAG, HEARING
from ofsat_ros.nodes.start import STOPPED
from ofsat_ros.recordings import COMPRESSED_IMAGE, Bag, RecordingError, open_recording
from ofsat_ros.results import DETECTIONS, in_words

# Imports of three nodes at once take half a minute where the processor is busy.
_START_S = 60.0
# Without a new line from anybody for so long, a frame will not be answered any more.
_SILENCE_S = 30.0


class DemoError(Exception):
    """The demo cannot go on; the message says why."""


def main() -> int:
    """Run the demo; return 0 if every frame was answered, 1 if not, 2 if it could not start."""
    options = _options()
    stop_on_signals()
    try:
        return _run(options)
    except (DemoError, RecordingError) as error:
        sys.stderr.write(f"demo: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("demo: stopped\n")
        return STOPPED


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("demo", description="Replay a bag to a detector, over DDS.")
    parser.add_argument("--bag", type=Path, help="bag to play; default: the first sample bag")
    parser.add_argument(
        "--output", default="demo_output", help="folder of the results, %(default)s"
    )
    parser.add_argument(
        "--rate", type=float, default=10.0, help="speed; 0: the fastest; default %(default)s"
    )
    return parser.parse_args()


def _run(options: argparse.Namespace) -> int:
    bag = options.bag or _sample_bag()
    topic, compressed, count = _image_topic(bag)
    name = "image/compressed" if compressed else "image"
    transport = "compressed" if compressed else "raw"
    print(f"demo: {count} frames of {topic} in {bag}")
    with children() as start:
        recorder = start(
            "recorder",
            *("-p", f"output:={options.output}"),
            *("-p", "overwrite:=true"),
            *("-p", f"frames:={count}"),
            piped=True,
        )
        lines = _Echo(recorder)
        detector = start(
            "detector",
            *("-p", "reliable_input:=true"),
            *("-p", f"image_transport:={transport}"),
            *("-r", f"{name}:={topic}"),
            *_remaps_beside(bag, topic),
        )
        lines.wait_for(HEARING, detector)
        player = start(
            "player", "-p", f"bag:={bag}", "-p", f"topic:={topic}", "-p", f"rate:={options.rate}"
        )
        lines.wait_for_end(player, detector)
        if recorder.poll():
            sys.stderr.write(f"demo: the recorder has given up; {options.output} is not whole\n")
            return 1
    return _sum_up(Path(options.output), count)


def _sample_bag() -> Path:
    """Return the first sample bag of the source tree, or else of an installed share folder."""
    package = Path(ofsat_ros.__file__).parent
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    folders = [package.parent, *(Path(p, "share", "ofsat_ros") for p in prefixes if p)]
    for folder in folders:
        bags = sorted(path.parent for path in folder.glob("bags/*/metadata.yaml"))
        if bags:
            return bags[0]
    raise DemoError("no sample bag is installed: give one with --bag PATH")


def _image_topic(path: Path) -> tuple[str, bool, int]:
    """Return name, whether compressed, and count of frames of a bag's first image topic."""
    with Bag(path) as bag:
        for name, about in bag.topics.items():
            if about.is_image and about.count:
                return name, about.msgtype == COMPRESSED_IMAGE, about.count
    raise DemoError(f"{path} holds no images")


def _remaps_beside(bag: Path, topic: str) -> list[str]:
    """Return the arguments that join the detector to calibration and attitude, if there are."""
    with open_recording(bag, topic) as recording:
        beside = {
            "camera_info": recording.camera_info_topic,
            "attitude": recording.attitude_topic,
        }
    return [word for name, it in beside.items() if it for word in ("-r", f"{name}:={it}")]


class _Echo:
    """Prints the recorder's lines as they come, and waits on them."""

    def __init__(self, recorder: subprocess.Popen) -> None:
        self._recorder = recorder
        self._lines: list[str] = []
        self._last_s = time.monotonic()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for line in self._recorder.stdout:
            print(line, end="", flush=True)
            self._lines.append(line.strip())
            self._last_s = time.monotonic()

    def wait_for(self, wanted: str, *others: subprocess.Popen) -> None:
        """Wait for a line; raise if a process ends before."""
        deadline_s = time.monotonic() + _START_S
        while wanted not in self._lines:
            if any(process.poll() is not None for process in (self._recorder, *others)):
                raise DemoError("the nodes did not start; see above")
            if time.monotonic() > deadline_s:
                raise DemoError(f"the nodes do not hear each other after {_START_S:g} s")
            time.sleep(0.05)

    def wait_for_end(self, player: subprocess.Popen, detector: subprocess.Popen) -> None:
        """Wait until the recorder has all frames, or nothing happens any more."""
        while self._recorder.poll() is None:
            if player.poll() is None:
                self._last_s = time.monotonic()
            if detector.poll() is not None or time.monotonic() - self._last_s > _SILENCE_S:
                return
            time.sleep(0.05)
        self._thread.join(1.0)


def _sum_up(output: Path, count: int) -> int:
    """Print what came of it; return 0 if every frame was answered once."""
    with Bag(output / BAG) as bag:
        answered = bag.topics["/rso_detections"].count
    with (output / DETECTIONS).open(encoding="utf-8") as file:
        found = Counter(int(row["track_id"]) for row in csv.DictReader(file))
    print(
        f"demo: {count} frames played, {answered} answered, {in_words(found)};"
        f" the files are in {output}"
    )
    return 0 if answered == count else 1
