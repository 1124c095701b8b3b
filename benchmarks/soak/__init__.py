# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A long night, in short: what a night of eight hours does to memory, lateness and results.

``python -m benchmarks.soak`` prints Markdown tables, row by row as they come, of: 50,000 frames of
512x512 px through one `Pipeline`, with clouds and disturbances; ``ofsat process`` over a bag of
20,000 small frames; and 20 minutes over DDS, camera to detector, guide, tdm_writer and recorder,
beside processes that take all cores and viewers that are slow, stopped and killed.  What the
tables show is said below each, and is to be judged by who reads it: a machine that does other
things makes frames late.  ``--only`` runs one part; ``--quick`` takes a hundredth of each.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import rclpy

from benchmarks.soak import alone, graph, night
from benchmarks.speed import machine
from ofsat_ros.nodes.processes import own_graph
from ofsat_ros.nodes.runtime import prepare_for_large_images

PARTS = ("pipeline", "process", "dds")
_SMALL = 128  # px; of the bag's frames
_BLOCKS = 50  # rows of the pipeline's table


def main() -> None:
    """Print the tables."""
    options = _options()
    print(machine(), flush=True)
    lines = [machine()]
    with tempfile.TemporaryDirectory(prefix="ofsat_soak_") as folder:
        for line in tables(Path(folder), options):
            print(line, flush=True)
            lines.append(line)
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


def tables(folder: Path, options: argparse.Namespace) -> Iterator[str]:
    """Yield the tables, line by line, as soon as each is known."""
    share = 100 if options.quick else 1
    parts = options.only or PARTS
    sizes = {"pipeline": options.side, "process": min(_SMALL, options.side), "dds": options.side}
    for part in parts:
        place = folder / f"{sizes[part]}"
        if not place.exists():
            place.mkdir()
            night.render(place, sizes[part])
        if part == "pipeline":
            frames = options.frames // share
            yield f"\n### {frames:,} frames of {options.side}x{options.side} through `Pipeline`\n"
            yield from alone.pipeline(place, frames, max(frames // _BLOCKS, 20), options.trace)
        elif part == "process":
            frames = options.bag_frames // share
            yield f"\n### `ofsat process` over {frames:,} frames of {_SMALL}x{_SMALL}\n"
            yield from alone.process(place, frames)
        else:
            minutes = options.minutes / share
            yield f"\n### {minutes:g} minutes over DDS, {options.rate:g} frames/s\n"
            yield from _over_dds(place, options.rate, 60 * minutes)


def _over_dds(folder: Path, rate_hz: float, seconds: float) -> Iterator[str]:
    os.environ.update({name: os.environ.get(name, own) for name, own in own_graph().items()})
    prepare_for_large_images()
    rclpy.init()
    try:
        yield from graph.rows(folder, rate_hz, seconds)
    finally:
        rclpy.shutdown()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("soak", description="Watch memory and lateness for long.")
    parser.add_argument("--only", choices=PARTS, action="append", help="a part; default: all")
    parser.add_argument("--frames", type=int, default=50_000, help="default: %(default)s")
    parser.add_argument("--bag-frames", type=int, default=20_000, help="default: %(default)s")
    parser.add_argument("--minutes", type=float, default=20.0, help="default: %(default)s")
    parser.add_argument("--rate", type=float, default=5.0, help="over DDS; default: %(default)s")
    parser.add_argument("--side", type=int, default=512, help="of a frame, px (%(default)s)")
    parser.add_argument("--trace", action="store_true", help="name the lines that hold more")
    parser.add_argument("--quick", action="store_true", help="a hundredth of each")
    parser.add_argument("--out", type=Path, help="also write the tables to this file")
    return parser.parse_args()
