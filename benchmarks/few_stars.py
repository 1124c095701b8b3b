# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Fields of few stars, in which RSOs are as many, or brighter: what is found, what is invented.

``python -m benchmarks.few_stars`` renders skies of our own simulator and prints a Markdown table.
In a narrow field, or with a short exposure, three RSOs may outshine all stars.  They drift by less
than 3 px a frame against them, as what is hard to tell from a star does, in three ways to point:
stars that stand still, stars that drift along, and a mount that follows one RSO while the stars
streak.  Scored by `ofsat_ros.evaluation`, looking back and live.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros.evaluation import FALSE_ALARM, FOUND, MISSED, detection_table, evaluate
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.simulation import RSO, SimulatorSettings, SkySimulator

Array = NDArray[np.float64]

POINTINGS = ("stands still", "drifts", "follows an RSO")
# In the image, most of them too faint to be objects.
STAR_COUNTS = (8, 16, 32, 64)
_STAR_FLUX = 2.0, 2000.0
_SIDE, _FRAMES, _RSOS = 320, 20, 3
# px per frame: of slow RSOs against the stars, of a field that drifts, of one that streaks.
_SLOW, _DRIFT, _STREAK = (0.3, 3.0), (0.5, 3.0), (6.0, 25.0)
_SNRS = 8.0, 50.0


def simulate(pointing: str, stars: int, seed: int) -> SkySimulator:
    """Return a sky of so many stars with three RSOs that stay in view."""
    random = np.random.default_rng([seed, POINTINGS.index(pointing), stars])
    ways = {"stands still": (0.0, 0.0), "drifts": _DRIFT, "follows an RSO": _STREAK}
    camera = _velocity(random, *ways[pointing])
    follows = pointing == "follows an RSO"
    rsos = []
    for row in range(_RSOS):
        # What is followed stands still in the image, and the others nearly do.
        own = _velocity(random, *_SLOW) * (row > 0 or not follows)
        rate = own + camera if follows else own
        middle = random.uniform(0.3, 0.7, 2) * _SIDE
        start = middle - (rate - camera) * _FRAMES / 2
        snr = float(np.exp(random.uniform(*np.log(_SNRS))))
        rsos.append(RSO((start[0], start[1]), (rate[0], rate[1]), snr=snr))
    return SkySimulator(
        SimulatorSettings(
            width=_SIDE,
            height=_SIDE,
            frames=_FRAMES,
            period_s=1.0,
            exposure_s=0.9 if follows else 0.2,
            pixel_scale_arcsec=1.0,
            camera_rate_arcsec_s=(camera[0], camera[1]),
            star_count=stars,
            star_flux_percent=_STAR_FLUX,
            noise_std_percent=0.5,
            noise_mean_percent=5.0,
            rsos=tuple(rsos),
            seed=int(random.integers(2**31)),
        )
    )


def _velocity(random: np.random.Generator, least: float, most: float) -> Array:
    angle = random.uniform(0, 2 * np.pi)
    return random.uniform(least, most) * np.array([np.cos(angle), np.sin(angle)])


def run(task: tuple[str, int, int]) -> tuple[str, int, NDArray[np.intp]]:
    """Count (found, of, false rows) of a sky, looking back, then live; and the frames that count.

    The result begins with the pointing and the number of stars.
    """
    cv2.setNumThreads(1)
    frames = list(simulate(*task))
    pipeline = Pipeline()
    results = [pipeline.process(frame.image, frame.stamp_ns) for frame in frames]
    settled = [s for result in results for s in result.settled] + pipeline.finish()
    truth = np.concatenate([frame.truth for frame in frames])
    stamps_ns = [frame.stamp_ns for frame in frames]
    counts: list[int] = []
    for live, said in (
        (False, [s.detections for s in sorted(settled, key=lambda s: s.frame)]),
        (True, [result.detections for result in results]),
    ):
        scored = evaluate(truth, detection_table(said, stamps_ns), frames=_FRAMES, live=live)
        found, missed, false = (len(scored.rows(what)) for what in (FOUND, MISSED, FALSE_ALARM))
        counts += [found, found + missed, false]
    return task[0], task[1], np.array([*counts, _FRAMES - 1])


def table(counts: Sequence[tuple[str, int, NDArray[np.intp]]]) -> str:
    """Return the Markdown table: parts found, and false rows a frame."""
    lines = [
        "| the field | stars | found, looking back | live | false a frame, looking back | live |",
        "|---|---|---|---|---|---|",
    ]
    for pointing, stars in product(POINTINGS, sorted({row[1] for row in counts})):
        found, of, false, live, live_of, live_false, frames = sum(
            row[2] for row in counts if row[:2] == (pointing, stars)
        )
        parts = [f"{found / max(of, 1):.2f}", f"{live / max(live_of, 1):.2f}"]
        parts += [f"{n / frames:.2f}" for n in (false, live_false)]
        lines.append(f"| {pointing} | {stars} | {' | '.join(parts)} |")
    return "\n".join(lines)


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stars", type=int, nargs="+", default=STAR_COUNTS, metavar="N")
    parser.add_argument("--seeds", type=int, default=10, help="skies of each kind (10)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes (all cores)")
    given = parser.parse_args(args)
    tasks = list(product(POINTINGS, given.stars, range(1, given.seeds + 1)))
    with ExitStack() as stack:
        # Spawned: OpenCV's threads do not survive a fork.
        pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(given.jobs))
        done = pool.imap(run, tasks)
        counts = list(tqdm(done, total=len(tasks), unit=" skies", disable=None))
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}"
    print(f"{versions}, OpenCV {cv2.__version__}; {given.seeds} skies a row\n")
    print(table(counts))


if __name__ == "__main__":
    main()
