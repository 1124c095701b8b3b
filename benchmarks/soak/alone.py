# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The night without ROS: `Pipeline` frame by frame, and ``ofsat process`` over one long bag."""

from __future__ import annotations

import csv
import gc
import os
import subprocess
import sys
import time
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.soak.night import Image, Night
from benchmarks.soak.watching import MB, Held, growth
from ofsat_ros.cli.process import UNFINISHED
from ofsat_ros.detection import CONFIRMED
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.recordings import BagWriter

_NS = 1_000_000_000
PERIOD_NS = _NS
# An RSO is found if it is said to be within so many px, and a track is of one it came so near to.
_NEAR_PX, _OF_IT_PX = 2.0, 6.0
# Frames until an RSO is expected to be found again after a disturbance, and since it has come.
_PATIENCE = 6
_DISTURBANCES = (
    "a gap of an hour",
    "one frame of another size",
    "one frame that is no image",
    "one frame twice",
    "a reset",
    "other parameters for one frame",
)
# Types of which there are this many more at the end are told.
_MANY_MORE = 200


@dataclass
class Block:
    """What was seen in some frames in a row.

    Attributes
    ----------
    last : int
        Number of frames so far.
    seconds : list of float
        Time of each frame, s.
    sure, found : int
        RSOs that were to be found, and that were.
    tracks : dict of int to bool
        Confirmed tracks, and whether they came near to an RSO.
    resident : float
        Memory at the end, bytes.
    alive : int
        Objects that Python's collector knows at the end.
    """

    last: int
    seconds: list[float] = field(default_factory=list)
    sure: int = 0
    found: int = 0
    tracks: dict[int, bool] = field(default_factory=dict)
    resident: float = 0.0
    alive: int = 0

    @property
    def false_tracks(self) -> int:
        """Tracks of nothing."""
        return sum(not good for good in self.tracks.values())

    def __str__(self) -> str:
        ms = 1e3 * np.percentile(self.seconds, [50, 99, 100])
        return (
            f"| {self.last:,} | {ms[0]:.1f} | {ms[1]:.1f} | {ms[2]:.0f}"
            f" | {self.resident / MB:.1f} | {self.alive:,}"
            f" | {self.found / max(self.sure, 1):.3f}"
            f" | {self.false_tracks} of {len(self.tracks)} |"
        )


HEAD = (
    "| frames | ms: median | p99 | most | memory, MB | objects alive | found | false tracks |\n"
    "|---|---|---|---|---|---|---|---|"
)


class Soak:
    """Takes frame after frame of a night through one `Pipeline`.

    Parameters
    ----------
    night : Night
    preset : str

    Attributes
    ----------
    blocks : list of Block
        What was seen so far.
    more : dict of str to int
        Types of which many more objects are alive than after the first block.
    """

    def __init__(self, night: Night, preset: str = "robust") -> None:
        self._night = night
        self._pipeline = Pipeline(Parameters.preset(preset))
        self._stamp_ns = PERIOD_NS
        self._since = 0  # frames since the last disturbance
        self._seen: NDArray[np.int64] = np.zeros(0, np.int64)
        self._first: Counter[str] = Counter()
        self.blocks: list[Block] = []
        self.more: dict[str, int] = {}

    def run(self, frames: int, block: int) -> Iterator[Block]:
        """Process so many frames; yield what was seen in each so many of them."""
        for first in range(0, frames, block):
            now = Block(min(first + block, frames))
            for number in range(first, now.last):
                if number % block == block // 2:
                    self._disturb(_DISTURBANCES[first // block % len(_DISTURBANCES)], number)
                self._take(number, now)
            self._weigh(now)
            self.blocks.append(now)
            yield now

    def _take(self, number: int, block: Block) -> None:
        image = self._night.image(number)
        start_s = time.perf_counter()
        result = self._pipeline.process(image, self._stamp_ns)
        block.seconds.append(time.perf_counter() - start_s)
        self._stamp_ns += PERIOD_NS
        self._since += 1
        self._judge(number, result, block)

    def _judge(self, number: int, result: FrameResult, block: Block) -> None:
        """Compare what is said of a frame with the truth."""
        xy, sure = self._night.rsos(number)
        said = result.detections[result.detections["status"] == CONFIRMED]
        places = np.stack([said["x"], said["y"]], axis=1)
        far = np.hypot(*(xy[:, None] - places).transpose(2, 0, 1))
        # One that has just come is not known yet.
        before, _ = self._night.rsos(max(number - _PATIENCE, 0))
        if self._since > _PATIENCE and len(before) == len(xy):
            block.sure += int(sure.sum())
            block.found += int((far.min(axis=1, initial=np.inf) < _NEAR_PX)[sure].sum())
        for track, least in zip(
            said["track_id"].tolist(), far.min(axis=0, initial=np.inf), strict=True
        ):
            block.tracks[track] = block.tracks.get(track, False) or bool(least < _OF_IT_PX)

    def _disturb(self, what: str, number: int) -> None:
        """Have something happen between two frames."""
        pipeline, image = self._pipeline, self._night.image(number)
        self._since = 0
        if what == "a gap of an hour":
            self._stamp_ns += 3600 * _NS
            self._also(image)  # not believed until the next one goes on from there
        elif what == "one frame of another size":
            self._also(image[: image.shape[0] // 2])
        elif what == "one frame that is no image":
            self._also(np.zeros((2, 2, 2), np.uint16))
        elif what == "one frame twice":
            self._stamp_ns -= PERIOD_NS
            self._also(self._night.image(number - 1))
        elif what == "a reset":
            pipeline.reset()
        else:
            usual = pipeline.parameters
            pipeline.parameters = Parameters.preset("paper_opencv")
            self._also(image)
            pipeline.parameters = usual

    def _also(self, image: Image) -> None:
        with suppress(ImageError):
            self._pipeline.process(image, self._stamp_ns)
        self._stamp_ns += PERIOD_NS

    def _weigh(self, block: Block) -> None:
        gc.collect()
        kinds = Counter(type(each).__name__ for each in gc.get_objects())
        block.alive = kinds.total()
        block.resident = Held.by(os.getpid()).resident
        # The first frames load what is needed.
        if len(self.blocks) < 2:
            self._first = kinds
        self.more = {
            kind: count - self._first[kind]
            for kind, count in kinds.items()
            if count - self._first[kind] > _MANY_MORE
        }


def pipeline(folder: Path, frames: int, block: int, trace: bool) -> Iterator[str]:
    """Yield the rows of the table, and what they say."""
    soak = Soak(Night.load(folder))
    yield HEAD
    for done in soak.run(frames, block):
        yield f"{done}"
        if trace and len(soak.blocks) == 2:
            tracemalloc.start(8)
            before = tracemalloc.take_snapshot()
    if trace and len(soak.blocks) > 1:
        after = tracemalloc.take_snapshot()
        yield from (f"{line}" for line in after.compare_to(before, "lineno")[:20])
    yield f"\n{said(soak)}"


def said(soak: Soak) -> str:
    """What the table of a soak shows, in words."""
    blocks = soak.blocks[1:]  # in the first, all is loaded and learned
    memory = growth([block.resident for block in blocks]) / MB
    half = len(blocks) // 2
    early, late = (
        np.percentile([s for block in part for s in block.seconds], [50, 99])
        for part in (blocks[:half] or blocks, blocks[half:])
    )
    grown = ", ".join(f"{count:+,} {kind}" for kind, count in soak.more.items()) or "nothing"
    sure, found = (sum(getattr(b, name) for b in soak.blocks) for name in ("sure", "found"))
    return (
        f"memory {memory:+.1f} MB from the first half to the second; a frame takes"
        f" {late[0] / early[0]:.2f} (median) and {late[1] / early[1]:.2f} (p99) of what it took;"
        f" more objects alive: {grown}; {found:,} of {sure:,} RSOs found,"
        f" {sum(b.false_tracks for b in soak.blocks)} false tracks"
    )


def process(folder: Path, frames: int, samples: int = 10) -> Iterator[str]:
    """Yield a table of what ``ofsat process`` holds and has written, over one long bag."""
    bag, results = folder / "bag", folder / "results"
    night = Night.load(folder)
    with BagWriter(bag, force=True) as writer:
        for number in range(frames):
            stamp_ns = PERIOD_NS * (number + 1)
            writer.write_image("/image", night.image(number), stamp_ns, "camera")
    yield "| frames written | detections | memory, MB | files |\n|---|---|---|---|"
    command = [sys.executable, "-m", "ofsat_ros.cli", "process", f"{bag}", "-o", f"{results}"]
    command += ["--no-report", "--force"]
    with (folder / "process.out").open("w") as out:
        running = subprocess.Popen(command, stdout=out, stderr=out)
    memory: list[float] = []
    try:
        for wanted in np.linspace(0, frames, samples + 1)[1:].astype(int):
            written, held = _until(running, results, int(wanted) - 20)
            memory.append(held.resident)
            found = _lines(results, "detections.csv")
            yield f"| {written:,} | {found:,} | {held.resident / MB:.1f} | {held.files} |"
        running.wait()
    finally:
        running.kill()
        running.wait()
    with (results / "tracks.csv").open() as file:
        tracks = sum(1 for _ in csv.reader(file)) - 1
    yield (
        f"\nexit code {running.returncode}; {_lines(results, 'star_field.csv'):,} frames,"
        f" {tracks:,} tracks; memory {(memory[-1] - memory[1]) / MB:+.1f} MB since a fifth"
    )


def _until(running: subprocess.Popen, results: Path, lines: int) -> tuple[int, Held]:
    """Wait until so many frames are written; return how many are, and what is held then."""
    held = Held.by(running.pid)
    while (written := _lines(results, "star_field.csv")) < lines:
        if running.poll() is not None:
            raise RuntimeError(f"`ofsat process` has ended with {running.returncode}")
        held = Held.by(running.pid)
        time.sleep(0.05)
    return written, Held.by(running.pid) if running.poll() is None else held


def _lines(results: Path, name: str) -> int:
    """Count the lines of a table, without its head; until the end it lies in a folder apart."""
    for table in (results / UNFINISHED / name, results / name):
        with suppress(FileNotFoundError), table.open("rb") as file:
            return max(sum(1 for _ in file) - 1, 0)
    return 0
