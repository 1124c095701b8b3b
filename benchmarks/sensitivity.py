# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How faint an RSO may be, and how well its place is measured: both beside what theory allows.

``python -m benchmarks.sensitivity`` renders RSOs of known SNR in three kinds of motion, runs the
default over them, looking back and live, and prints Markdown tables; ``--figure`` draws them.  The
detection probability is per object and frame, scored by `ofsat_ros.evaluation`, with truth under
SNR 3 counted too.  The noise is white and Gaussian, the PSF Gaussian, the RSOs points, and all of
one sky have the same SNR: what `limits` assumes.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import os
import platform
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.limits import MatchedFilter, centroid_bound, information, poisson_limit
from ofsat_ros.evaluation import FALSE_ALARM, FOUND, MISSED, detection_table, evaluate
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.simulation import RSO, SimulatorSettings, SkySimulator

Array = NDArray[np.float64]
Detections = list[NDArray[np.void]]

SNRS = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 8.0, 12.0, 20.0, 30.0)
_MODES = OFFLINE, LIVE = "looking back", "live"
_SIDE, _FRAMES, _RSOS = 320, 9, 8
_LIVE_FRAMES = 3  # what the node says counts from an object's third frame on
_STARS = 80
# False alarms per frame that the limits are allowed: the aim set for the default.
_ALLOWED = 0.02
# RSOs keep this far from the border and from each other, px.
_MARGIN_PX, _APART_PX = 12.0, 25.0
_PSF_PX = 1.0
_WIDTH_PX = np.sqrt(_PSF_PX**2 + 1 / 12)
_CONFIDENCE = 0.95
_FILTER = MatchedFilter(_SIDE, _WIDTH_PX, _ALLOWED)
_COLOURS = "tab:blue", "tab:orange", "tab:green"


@dataclass(frozen=True)
class Motion:
    """A kind of motion: speeds in px per frame, and the exposure as a part of the period."""

    title: str
    speed: tuple[float, float]  # of the RSOs against the stars
    tracked: bool  # whether the camera follows the RSOs
    exposure: float


MOTIONS = {
    "rate": Motion("rate tracking: RSOs stand, stars move 5-15 px", (5, 15), True, 0.5),
    "sidereal": Motion("star tracking: RSOs move 3-10 px", (3, 10), False, 0.05),
    "slow": Motion("star tracking: RSOs move 0.5-2 px", (0.5, 2), False, 0.05),
}


@dataclass(frozen=True)
class Trial:
    """What became of one sequence, looking back or live.

    Attributes
    ----------
    found : (N,) float64
        Part of each object's frames in which it was found.
    errors, sigmas : (K, 2) float64
        Errors of the centroids found, and their stated stds, x and y, px.
    frames : int
        Frames that count.
    false_alarms, misplaced : int
        False alarms, and those of them whose track is an RSO's in other frames.
    """

    motion: str
    snr: float
    mode: str
    found: Array
    errors: Array
    sigmas: Array
    frames: int
    false_alarms: int
    misplaced: int


@dataclass(frozen=True)
class Point:
    """All trials of one motion, SNR and mode together: a row of the CSV file."""

    motion: str
    mode: str
    snr: float
    objects: int
    probability: float
    probability_error: float
    limit_one_frame: float
    limit_sequence: float
    limit_sky_learned: float
    frames: int
    false_alarms: int
    misplaced: int
    centroid_rms_px: float  # of one axis
    centroid_core_px: float  # the same from the median of the sizes: without the tails
    centroid_stated_px: float  # rms of the stated stds
    centroid_bound_px: float
    normalised_rms: float  # of errors over their stated stds


def simulate(motion: str, snr: float, seed: int) -> SkySimulator:
    """Return a sky with RSOs of one SNR that stay in the image and apart from each other."""
    kind = MOTIONS[motion]
    # Other stars and noise for each SNR: its false alarms are its own.
    random = np.random.default_rng([seed, list(MOTIONS).index(motion), round(100 * snr)])
    own = _velocity(random, kind.speed) if kind.tracked else None
    paths: list[Array] = []
    rsos: list[RSO] = []
    times = np.arange(_FRAMES)[:, None]
    while len(rsos) < _RSOS:
        rate = _velocity(random, kind.speed) if own is None else own
        seen = rate if own is None else 0 * rate
        path = random.uniform(_MARGIN_PX, _SIDE - 1 - _MARGIN_PX, 2) + times * seen
        inside = np.all((path > _MARGIN_PX) & (path < _SIDE - 1 - _MARGIN_PX))
        if inside and all(np.hypot(*(path - p).T).min() > _APART_PX for p in paths):
            paths.append(path)
            rsos.append(RSO((path[0, 0], path[0, 1]), (rate[0], rate[1]), snr=snr))
    return SkySimulator(
        SimulatorSettings(
            width=_SIDE,
            height=_SIDE,
            frames=_FRAMES,
            pixel_scale_arcsec=1.0,
            psf_sigma_px=_PSF_PX,
            exposure_s=kind.exposure,
            camera_rate_arcsec_s=(0.0, 0.0) if own is None else (own[0], own[1]),
            star_count=_STARS,
            rsos=tuple(rsos),
            seed=int(random.integers(2**31)),
        )
    )


def _velocity(random: np.random.Generator, speed: tuple[float, float]) -> Array:
    angle = random.uniform(0, 2 * np.pi)
    return random.uniform(*speed) * np.array([np.cos(angle), np.sin(angle)])


def run(task: tuple[str, float, int]) -> list[Trial]:
    """Render a sequence of (motion, SNR, seed) and process it."""
    motion, snr, seed = task
    cv2.setNumThreads(1)
    frames = list(simulate(motion, snr, seed))
    pipeline = Pipeline()
    results = [pipeline.process(frame.image, frame.stamp_ns) for frame in frames]
    settled = [s for result in results for s in result.settled] + pipeline.finish()
    said = {
        OFFLINE: [s.detections for s in sorted(settled, key=lambda s: s.frame)],
        LIVE: [result.detections for result in results],
    }
    truth = np.concatenate([frame.truth for frame in frames])
    # The evaluation leaves out what is under SNR 3, but not what is of unknown SNR.
    truth["snr"] = np.nan
    stamps_ns = [frame.stamp_ns for frame in frames]
    return [
        _trial(motion, snr, mode, truth, detections, stamps_ns)
        for mode, detections in said.items()
    ]


def _trial(
    motion: str,
    snr: float,
    mode: str,
    truth: NDArray[np.void],
    detections: Detections,
    stamps_ns: Sequence[int],
) -> Trial:
    evaluation = evaluate(
        truth,
        detection_table(detections, stamps_ns),
        frames=len(stamps_ns),
        live=mode == LIVE,
    )
    counted, found = evaluation.rows(FOUND, MISSED), evaluation.rows(FOUND)
    false = evaluation.rows(FALSE_ALARM)
    ids = np.unique(counted["id"])
    part = [np.mean(counted["outcome"][counted["id"] == rso] == FOUND) for rso in ids]
    sigmas = np.zeros((len(found), 2))
    for row, match in enumerate(found):
        said = detections[match["frame"]]
        own = said[(said["x"] == match["x_px"]) & (said["y"] == match["y_px"])][0]
        sigmas[row] = own["sigma_x"], own["sigma_y"]
    return Trial(
        motion=motion,
        snr=snr,
        mode=mode,
        found=np.array(part, np.float64),
        errors=np.stack([found["dx_px"], found["dy_px"]], axis=1),
        sigmas=sigmas,
        frames=evaluation.frames,
        false_alarms=len(false),
        misplaced=int(np.count_nonzero(np.isin(false["track_id"], found["track_id"]))),
    )


def measure(snrs: Sequence[float], seeds: int, jobs: int) -> list[Point]:
    """Return the points of all motions and modes, `seeds` sequences each."""
    tasks = list(product(MOTIONS, snrs, range(1, seeds + 1)))
    trials: list[Trial] = []
    with ExitStack() as stack:
        # Spawned: OpenCV's threads do not survive a fork.
        pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(jobs))
        done = pool.imap_unordered(run, tasks, chunksize=2)
        for some in tqdm(done, total=len(tasks), unit=" sequences", disable=None):
            trials += some
    return [
        _point([t for t in trials if (t.motion, t.mode, t.snr) == (motion, mode, snr)])
        for motion, mode, snr in product(MOTIONS, _MODES, snrs)
    ]


def _point(trials: Sequence[Trial]) -> Point:
    motion, mode, snr = trials[0].motion, trials[0].mode, trials[0].snr
    found = np.concatenate([trial.found for trial in trials])
    errors = np.concatenate([trial.errors for trial in trials])
    sigmas = np.concatenate([trial.sigmas for trial in trials])
    # Objects, not frames, are independent.  One more found and one more missed keep the error
    # from being 0 where all or none are found.
    spread = np.std([*found, 0.0, 1.0]) / np.sqrt(len(found))
    one, stack, learned = detection_limits(motion, mode, snr)
    return Point(
        motion=motion,
        mode=mode,
        snr=snr,
        objects=len(found),
        probability=float(found.mean()),
        probability_error=float(spread),
        limit_one_frame=one,
        limit_sequence=stack,
        limit_sky_learned=learned,
        frames=sum(trial.frames for trial in trials),
        false_alarms=sum(trial.false_alarms for trial in trials),
        misplaced=sum(trial.misplaced for trial in trials),
        centroid_rms_px=_rms(errors),
        centroid_core_px=_core(errors),
        centroid_stated_px=_rms(sigmas),
        centroid_bound_px=centroid_bound(snr, _WIDTH_PX),
        normalised_rms=_rms(errors / sigmas),
    )


def detection_limits(motion: str, mode: str, snr: float) -> tuple[float, float, float]:
    """Return what one frame allows, the stack of frames, and the stack with the sky learned."""
    # The frames that a detection may rest on; live, those so far.
    counts = [_FRAMES] if mode == OFFLINE else list(range(_LIVE_FRAMES, _FRAMES + 1))
    ways = list(product(counts, np.linspace(*MOTIONS[motion].speed, 20).tolist()))
    learned = [information(n, speed, _WIDTH_PX) for n, speed in ways]
    return (
        _FILTER.probability(snr, [1]),
        _FILTER.probability(snr, counts),
        _FILTER.probability(snr, [n for n, _ in ways], learned),
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else np.nan


def _core(values: Array) -> float:
    """Std of a normal distribution with the same median of the absolute values."""
    return float(np.median(np.abs(values)) / 0.6745) if values.size else np.nan


def probability_table(points: Sequence[Point]) -> str:
    """Return the Markdown table of detection probabilities beside their limits."""
    by = {(p.motion, p.mode, p.snr): p for p in points}
    lines = _header(
        ["SNR", *(f"{motion}, {mode}" for mode in _MODES for motion in MOTIONS)]
        + ["limit: one frame", f"{_FRAMES} frames", "frames so far"]
        + [f"sky learned, slow, {mode}" for mode in _MODES]
    )
    for snr in _snrs(points):
        row = [by[motion, mode, snr] for mode in _MODES for motion in MOTIONS]
        slow, slow_live = by["slow", OFFLINE, snr], by["slow", LIVE, snr]
        values = [p.probability for p in row]
        values += [slow.limit_one_frame, slow.limit_sequence, slow_live.limit_sequence]
        values += [slow.limit_sky_learned, slow_live.limit_sky_learned]
        lines.append(_line([f"{snr:g}", *(f"{value:.2f}" for value in values)]))
    return "\n".join(lines)


def false_alarm_table(points: Sequence[Point]) -> str:
    """Return the Markdown table of false alarms, all SNRs together."""
    lines = _header(
        ["motion", "frames", "false alarms", "of an RSO's track, misplaced", "per frame"]
        + [f"{_CONFIDENCE:.0%} upper limit", "without the misplaced", "its upper limit"]
    )
    for motion, mode in product(MOTIONS, _MODES):
        own = [p for p in points if (p.motion, p.mode) == (motion, mode)]
        frames, count, misplaced = (
            sum(getattr(p, name) for p in own) for name in ("frames", "false_alarms", "misplaced")
        )
        cells = [str(frames), str(count), str(misplaced)]
        for n in (count, count - misplaced):
            cells += [f"{n / frames:.4f}", f"{poisson_limit(n, _CONFIDENCE) / frames:.4f}"]
        lines.append(_line([f"{motion}, {mode}", *cells]))
    return "\n".join(lines)


def centroid_table(points: Sequence[Point]) -> str:
    """Return the Markdown table of the centroid's error along one axis, looking back."""
    by = {(p.motion, p.snr): p for p in points if p.mode == OFFLINE}
    names = [f"{m}: {what}" for m in MOTIONS for what in ("rms", "by median", "rms / stated std")]
    lines = _header(["SNR", "bound, px", *names])
    for snr in _snrs(points):
        cells = [f"{by['slow', snr].centroid_bound_px:.3f}"]
        for p in (by[motion, snr] for motion in MOTIONS):
            values = p.centroid_rms_px, p.centroid_core_px, p.normalised_rms
            cells += [_number(v, digits) for v, digits in zip(values, (3, 3, 2), strict=True)]
        lines.append(_line([f"{snr:g}", *cells]))
    return "\n".join(lines)


def _number(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def _snrs(points: Iterable[Point]) -> list[float]:
    return sorted({p.snr for p in points})


def _header(names: Sequence[str]) -> list[str]:
    return [_line(names), "|" + "---|" * len(names)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def write(path: Path, points: Iterable[Point]) -> None:
    """Write the points as CSV."""
    names = [field.name for field in fields(Point)]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows([getattr(point, name) for name in names] for point in points)


def draw(path: Path, points: Sequence[Point]) -> None:
    """Draw probabilities and centroid errors against SNR, beside their limits."""
    # Only drawing needs it.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_limits(left, right)
    for colour, (motion, kind) in zip(_COLOURS, MOTIONS.items(), strict=True):
        for mode, style in ((OFFLINE, "o-"), (LIVE, "s--")):
            own = [p for p in points if (p.motion, p.mode) == (motion, mode)]
            snr, found, error = _columns(own, "snr", "probability", "probability_error")
            label = f"{kind.title}; {mode}" if mode == OFFLINE else f"{motion}, {mode}"
            left.errorbar(snr, found, error, fmt=style, ms=4, lw=1.2, color=colour, label=label)
        own = [p for p in points if (p.motion, p.mode) == (motion, OFFLINE)]
        snr, rms, stated = _columns(own, "snr", "centroid_rms_px", "centroid_stated_px")
        right.plot(snr, rms, "o", ms=4, color=colour, label=f"{motion}, rms")
        right.plot(snr, stated, "--", lw=1.2, color=colour, label=f"{motion}, as stated")
    for axes in (left, right):
        axes.set(xscale="log", xlabel="SNR of one frame")
        _plain_ticks(axes.xaxis, (2, 3, 4, 5, 6, 8, 10, 15, 20, 30))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    left.set(ylim=(-0.03, 1.03), ylabel="detection probability per object and frame")
    right.set(yscale="log", ylabel="error of the centroid along one axis, px")
    _plain_ticks(right.yaxis, (0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _draw_limits(left: Any, right: Any) -> None:
    snr = np.geomspace(min(SNRS), max(SNRS), 100)
    stack = np.array([detection_limits("slow", OFFLINE, s) for s in snr.tolist()])
    so_far = np.array([detection_limits("slow", LIVE, s) for s in snr.tolist()])
    left.plot(snr, stack[:, 0], ":", color="gray", label="limit of one frame")
    left.plot(snr, stack[:, 1], "-", color="black", label=f"limit of {_FRAMES} frames")
    left.plot(snr, so_far[:, 1], "--", color="black", label="limit, live: of the frames so far")
    for limit, style, mode in ((stack, "-", OFFLINE), (so_far, "--", LIVE)):
        label = f"limit, slow, if they show the sky too; {mode}"
        left.plot(snr, limit[:, 2], style, lw=4, alpha=0.25, color=_COLOURS[-1], label=label)
    bound = [centroid_bound(s, _WIDTH_PX) for s in snr.tolist()]
    right.plot(snr, bound, "-", color="black", label="Cramer-Rao bound")


def _plain_ticks(axis: Any, ticks: Sequence[float]) -> None:
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)


def _columns(points: Sequence[Point], *names: str) -> list[list[float]]:
    return [[getattr(p, name) for p in points] for name in names]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Measure what SNR the default needs.")
    parser.add_argument("--seeds", type=int, default=12, help="sequences per point (%(default)s)")
    parser.add_argument("--snr", type=float, nargs="+", default=SNRS, help="(%(default)s)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="sequences at a time")
    parser.add_argument("--figure", type=Path, help="picture to draw")
    parser.add_argument("--output", type=Path, help="CSV file for all figures of each point")
    return parser.parse_args()


def main() -> None:
    """Print the tables."""
    options = _options()
    points = measure(options.snr, options.seeds, options.jobs)
    if options.output:
        write(options.output, points)
    if options.figure:
        draw(options.figure, points)
    worst = max(p.probability_error for p in points)
    one, stack = (_FILTER.threshold(n) for n in (1, _FRAMES))
    velocities = _FILTER.exceeding(_FRAMES, stack) / _FILTER.exceeding(1, stack)
    print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, OpenCV {cv2.__version__};"
        f" {points[0].objects} objects and {points[0].frames} frames of {_SIDE}x{_SIDE} px a"
        f" point; probabilities to {worst:.2f}\n\n"
        f"Limits with {_ALLOWED:g} false alarms per frame: {one:.2f} sigmas in one frame,"
        f" {stack:.2f} in a stack of {_FRAMES}"
        f" ({velocities:.2g} trial velocities)\n"
    )
    for table in (probability_table, false_alarm_table, centroid_table):
        print(table(points), end="\n\n")


if __name__ == "__main__":
    main()
