# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What parameters are worth that unusual optics call for: the table of docs/optics.md.

``python -m benchmarks.optics`` renders skies with another PSF, rate or sensor each, processes them
with the default parameters and with one changed, and prints how much is found either way, as a
Markdown table.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from ofsat_ros.evaluation import Evaluation, detection_table, evaluate
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.simulation import RSO, SimulatedFrame, scenario

_SCALE = 5.0  # arcsec a pixel
# The sky over a camera that stands still, and what one that tracks the stars sees, arcsec/s.
_AT_REST, _TRACKING = (14.81, 2.61), (0.0, 0.0)
_RSOS, _SNRS = 12, (4.0, 20.0)


@dataclass(frozen=True)
class Optics:
    """A row: a sky, what is changed for it, and how fast its RSOs are, px a frame."""

    title: str
    changed: dict[str, Any]
    speeds: tuple[float, float]
    sky: dict[str, Any]
    snrs: tuple[float, float] = _SNRS
    size: dict[str, int] = field(
        default_factory=lambda: {"width": 512, "height": 512, "frames": 15}
    )


_SHARP = {"camera_rate_arcsec_s": _AT_REST}
_HOT = {"hot_pixel_fraction": 80 / 512**2, "hot_pixel_percent": (20.0, 50.0)}
_LONG = {"width": 320, "height": 320, "frames": 40}
ROWS = (
    Optics("FWHM 4.7 px", {"smoothing_sigma_px": 1.5}, (2, 8), {"psf_sigma_px": 2.0}),
    Optics("FWHM 7 px", {"smoothing_sigma_px": 1.9}, (2, 8), {"psf_sigma_px": 3.0}),
    Optics(
        "FWHM 1.3 px, RSOs at rest",
        {"hot_pixels": "keep"},
        (0, 0),
        {"psf_sigma_px": 0.55, **_SHARP},
    ),
    Optics(
        "FWHM 1.0 px, RSOs at rest",
        {"hot_pixels": "keep"},
        (0, 0),
        {"psf_sigma_px": 0.4, **_SHARP},
    ),
    Optics(
        "the same, 80 hot pixels",
        {"hot_pixels": "keep"},
        (0, 0),
        {"psf_sigma_px": 0.4, **_SHARP, **_HOT},
    ),
    Optics(
        "eight faint stars in the image",
        {"threshold_sigmas": 3.5},
        (4, 10),
        {"star_count": 8, "star_flux_percent": (10.0, 30.0)},
    ),
    Optics("RSOs of 0.4 px a frame", {"history_frames": 15}, (0.4, 0.4), {}, size=_LONG),
    Optics("RSOs of 0.2 px a frame", {"history_frames": 21}, (0.2, 0.2), {}, size=_LONG),
    Optics(
        "RSOs of 160 to 260 px a frame",
        {"max_speed_px": 300.0},
        (160, 260),
        {"exposure_s": 0.05},
        (12.0, 30.0),
        {"width": 1024, "height": 1024, "frames": 5},
    ),
)


def render(row: Optics, seed: int) -> list[SimulatedFrame]:
    """Return the frames of a row's sky."""
    rate = row.sky.get("camera_rate_arcsec_s", _TRACKING)
    random = np.random.default_rng(seed)
    middle = np.array([row.size["width"], row.size["height"]]) / 2
    rsos = []
    for snr in np.geomspace(*row.snrs, _RSOS).tolist():
        angle = random.uniform(0, 2 * math.pi)
        way = random.uniform(*row.speeds) * np.array([math.cos(angle), math.sin(angle)])
        # Half of its way is behind it when it passes near the middle.
        start = middle * random.uniform(0.4, 1.6, 2) - way * row.size["frames"] / 2
        rsos.append(RSO(tuple(start), tuple(np.array(rate) + way * _SCALE), snr=snr))
    settings = {"camera_rate_arcsec_s": rate, **row.size, **row.sky, "rsos": tuple(rsos)}
    return list(scenario("survey", seed, **settings))


def found(shots: list[SimulatedFrame], changed: dict[str, Any]) -> Evaluation:
    """Process frames, and compare the last word on each with truth."""
    pipeline = Pipeline(Parameters.preset(**changed))
    settled = [s for shot in shots for s in pipeline.process(shot.image, shot.stamp_ns).settled]
    settled = sorted(settled + pipeline.finish(), key=lambda s: s.frame)
    said = detection_table([s.detections for s in settled], [shot.stamp_ns for shot in shots])
    truth = np.concatenate([shot.truth for shot in shots])
    return evaluate(truth, said, frames=len(shots), shape=shots[0].image.shape)


def run(task: tuple[int, int]) -> tuple[int, list[tuple[float, float]]]:
    """Return a row's number, and recall and false alarms a frame before and after the change."""
    number, seed = task
    cv2.setNumThreads(1)
    shots = render(ROWS[number], seed)
    outcomes = [found(shots, changed) for changed in ({}, ROWS[number].changed)]
    return number, [(one.recall(), one.false_alarms_per_frame) for one in outcomes]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Measure what parameters other optics call for.")
    parser.add_argument("--seeds", type=int, default=3, help="skies of each kind (%(default)s)")
    parser.add_argument("--rows", type=int, nargs="+", default=range(len(ROWS)), help="which")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="skies at a time")
    options = parser.parse_args()
    tasks = [(row, seed) for row in options.rows for seed in range(1, options.seeds + 1)]
    figures: dict[int, list[list[tuple[float, float]]]] = {row: [] for row in options.rows}
    # Spawned: OpenCV's threads do not survive a fork.
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        done = pool.imap_unordered(run, tasks)
        for row, outcome in tqdm(done, total=len(tasks), unit=" skies", disable=None):
            figures[row].append(outcome)
    head = "your recording", "parameter", "value", "found, default", "found, so", "false alarms"
    print(f"| {' | '.join(head)} a frame |\n|{'---|' * len(head)}")
    for row, outcomes in figures.items():
        ((name, value),) = ROWS[row].changed.items()
        (before, false), (after, false_after) = np.mean(outcomes, axis=0)
        print(
            f"| {ROWS[row].title} | `{name}` | {value} | {before:.2f} | {after:.2f}"
            f" | {false:.2f} to {false_after:.2f} |"
        )


if __name__ == "__main__":
    main()
