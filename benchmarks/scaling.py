# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How ``ofsat batch`` scales with workers, and what each part of it costs.

``python -m benchmarks.scaling`` prints one Markdown table: frames per second with one worker and
with two, over many recordings and over one long one in segments, beside ``ofsat process``; and the
costs from which docs/scaling.md tells what more workers would do.  Each row of the first kind is
a process of its own, timed from its start to its end.  ``--quick`` takes a few small frames: to
see that it works.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.speed import machine
from ofsat_ros.batch import Cluster, Order, Place, Settings, content_key, find_recordings
from ofsat_ros.batch.tasks import Answer, look
from ofsat_ros.catalog import Catalog
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.recordings import BagWriter, open_recording
from ofsat_ros.report.archive import write_pages
from ofsat_ros.simulation import scenario

_TASKS = 300
_FRAMES = 1000
_MB = 1e6


@dataclass(frozen=True)
class Size:
    """What is processed: recordings, frames of each, frames of the long one, px of a side."""

    recordings: int
    frames: int
    long: int
    side: int


FULL, QUICK = Size(8, 32, 192, 768), Size(2, 6, 12, 96)


def main() -> None:
    """Measure, and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--quick", action="store_true")
    size = QUICK if options.parse_args().quick else FULL
    print(f"{machine()}\n\n| what | measured | against the first of its kind |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        render(folder, size)
        for row in rows(folder, size):
            print(f"| {' | '.join(row)} |", flush=True)


def render(folder: Path, size: Size) -> None:
    """Write recordings into ``many``, all of one sky but none the same, and one into ``long``."""
    frames = [
        (frame.image, frame.stamp_ns)
        for frame in scenario("survey", 1, frames=size.frames, width=size.side, height=size.side)
    ]
    for number in range(size.recordings):
        write(folder / "many" / f"night{number}", frames, number)
    # To and fro, for its stars and RSOs have to go on.
    there_and_back = [image for image, _ in (*frames, *frames[-2:0:-1])]
    images = [there_and_back[i % len(there_and_back)] for i in range(size.long)]
    first_ns = frames[0][1]
    step_ns = frames[1][1] - first_ns
    shots = [(image, first_ns + i * step_ns) for i, image in enumerate(images)]
    write(folder / "long" / "night", shots, 0)


def write(path: Path, frames: list[tuple[Any, int]], number: int) -> None:
    """Write a bag whose last pixel is its number."""
    path.parent.mkdir(exist_ok=True)
    with BagWriter(path) as bag:
        for image, stamp_ns in frames:
            own = image.copy()
            own[-1, -1] += number
            bag.write_image("/camera/image_raw", own, stamp_ns, "camera_optical_frame")


def rows(folder: Path, size: Size) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of the table, as they are measured."""
    count = size.recordings * size.frames
    many = sorted((folder / "many").iterdir())

    def one_by_one() -> None:
        for path in many:
            ofsat("process", path, "-o", folder / "found" / path.name, "--no-report")

    def batch(what: str, workers: int) -> Callable[[], None]:
        least = max(size.long // 2, 1)
        words = ("--workers", workers, "--segment-frames", least, "--no-report")
        return lambda: ofsat("batch", folder / what, "-o", folder / f"{what}{workers}", *words)

    each = f"{size.recordings} recordings of {size.frames} frames"
    yield from compared(
        count,
        (f"{each}, 1 worker", batch("many", 1)),
        (f"{each}, 2 workers", batch("many", 2)),
        (f"{each}, `ofsat process` in turn, each on all cores", one_by_one),
    )
    yield from compared(
        size.long,
        (f"a recording of {size.long} frames, 1 worker", batch("long", 1)),
        ("the same in 2 segments, 2 workers", batch("long", 2)),
    )
    yield "a batch of which all is done", f"{taken(batch('many', 2)):.2f} s", ""
    learned_s, processed_s = seconds_of_frame(many[0])
    yield "processing a frame", f"{1e3 * processed_s:.1f} ms", ""
    yield "learning the sensor from it", f"{1e3 * learned_s:.1f} ms", ""
    yield from parts(folder, size, processed_s)


def compared(frames: int, *runs: tuple[str, Callable[[], None]]) -> Iterator[tuple[str, str, str]]:
    """Yield how fast each was, and how much faster than the first."""
    rates: list[float] = []
    for what, work in runs:
        rates.append(frames / taken(work))
        yield what, f"{rates[-1]:.1f} frames/s", f"{rates[-1] / rates[0]:.2f}"


def taken(work: Callable[[], object]) -> float:
    """Return how long some work takes, s."""
    start_s = time.perf_counter()
    work()
    return time.perf_counter() - start_s


def ofsat(*words: object) -> None:
    """Run a command as users do."""
    command = [sys.executable, "-m", "ofsat_ros.cli", *map(str, words)]
    subprocess.run(command, check=True, capture_output=True)


def seconds_of_frame(recording: Path) -> tuple[float, float]:
    """Return how long one thread takes to learn from a frame, and to process it, s."""
    cv2.setNumThreads(1)
    with open_recording(recording) as opened:
        frames = [(frame.image, frame.stamp_ns) for frame in opened]
    seconds = []
    for take in (Pipeline.learn, Pipeline.process):
        pipeline = Pipeline()
        each = [taken(lambda: take(pipeline, image, at)) for image, at in frames]  # noqa: B023
        seconds.append(float(np.median(each)))
    return seconds[0], seconds[1]


def idle(order: Order, number: int) -> Answer:
    """Do nothing, in a worker."""
    return Answer({"number": number})


def parts(folder: Path, size: Size, frame_s: float) -> Iterator[tuple[str, str, str]]:
    """Yield what the coordinating process and the scheduler take, and for how many it suffices."""
    out = folder / "many2"
    found = find_recordings([folder / "many"], besides=out)
    with Place(folder / "own") as place:
        order = Order(f"{folder / 'own'}", place.run, 1, None)
        with Cluster(order, None, 2) as cluster:
            drain(cluster, [(idle, order, number) for number in range(4)])
            idle_s = taken(
                lambda: drain(cluster, [(idle, order, number) for number in range(_TASKS)])
            )
            idle_s /= _TASKS
            yield "a task that does nothing", f"{1e3 * idle_s:.1f} ms", ""
            job = Settings({}, "robust", {}, (), False, False, 0).job(found[0])
            known = look(order, found[0], job, {}).value or {}
            tasks = [(look, order, found[0], job, known)] * _TASKS
            each_s = taken(lambda: drain(cluster, tasks))
            yield "a recording that is known", f"{1e3 * each_s / _TASKS:.1f} ms", ""
    files = [file for each in found for file in each.files if file.stat().st_size > _MB / 10]
    bytes_read = sum(file.stat().st_size for file in files)
    rate = bytes_read / taken(lambda: content_key(files)) / _MB
    yield "hashing files that are in memory", f"{rate:.0f} MB/s", ""
    results = sorted((out / "results").iterdir())
    with Catalog(folder / "again.sqlite", write=True) as catalog:
        added_s = taken(lambda: [catalog.add(result) for result in results]) / len(results)
        yield "taking a result into the catalogue", f"{1e3 * added_s:.1f} ms", ""
        pages_s = taken(lambda: write_pages(catalog, folder / "pages"))
        yield f"pages on {len(results)} results", f"{pages_s:.2f} s", ""
    busy = _FRAMES * frame_s / (2 * idle_s + added_s)
    yield (
        f"workers whom one scheduler keeps busy, at {_FRAMES} frames a recording",
        f"{busy:.0f}",
        "",
    )
    read = size.side**2 * 2 / frame_s / _MB
    yield "what a worker reads while it processes", f"{read:.1f} MB/s", ""


def drain(cluster: Cluster, tasks: list[tuple[Any, ...]]) -> None:
    """Have tasks done, as many at a time as there are workers."""
    left = list(enumerate(tasks))
    while left or cluster.busy:
        while left and cluster.busy < cluster.slots:
            number, (call, *arguments) = left.pop()
            cluster.submit(f"{number}", call, *arguments)
        cluster.news(1.0)


if __name__ == "__main__":
    main()
