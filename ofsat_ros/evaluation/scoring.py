# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The scoring: truths and detections matched frame by frame, and the figures of it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ofsat_ros.evaluation.tables import (
    DETECTIONS_DTYPE,
    TRUTH_DTYPE,
    EvaluationError,
    Table,
    as_table,
)

MATCH_PX, STREAK_PX, EDGE_PX, LEAST_SNR = 2.0, 4.0, 4.0, 3.0
DUPLICATE_FACTOR, LIVE_FRAMES = 1.5, 3
SNR_RANGES = ((20.0, math.inf), (10.0, 20.0), (5.0, 10.0), (3.0, 5.0))

FOUND, MISSED, FALSE_ALARM = "found", "missed", "false alarm"
DUPLICATE, IGNORED = "duplicate", "ignored"
OUTCOME_DTYPE = np.dtype(
    [
        ("sequence", "i8"),  # index of Evaluation.sequences
        ("outcome", "U11"),
        ("frame", "i8"),
        ("id", "U64"),  # of the truth; empty for a false alarm
        ("track_id", "i8"),  # of the detection; 0 for a miss
        ("x_px", "f8"),  # where to look: the detection; for a miss, the truth
        ("y_px", "f8"),
        ("snr", "f8"),  # of the truth; for a false alarm, what the detection claims
        ("length_px", "f8"),  # of the truth
        ("dx_px", "f8"),  # detection minus truth
        ("dy_px", "f8"),
        ("dv_px", "f8"),  # size of the difference of the velocities, px per frame
    ]
)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What became of each truth and each detection, and the figures that follow.

    Attributes
    ----------
    outcomes : (N,) OUTCOME_DTYPE
        One row for each truth that counts (``found`` or ``missed``) and for each detection that
        is not a found truth's (``false alarm``, ``duplicate``, or ``ignored``: of a don't-care).
    frames : int
        Frames that count.
    sequences : tuple of str
        Names of the sequences.
    """

    outcomes: Table
    frames: int
    sequences: tuple[str, ...] = ("",)

    def rows(self, *outcomes: str) -> Table:
        """Return the rows of these outcomes, e.g. ``rows("missed", "false alarm")``."""
        return self.outcomes[np.isin(self.outcomes["outcome"], outcomes)]

    def count(self, outcome: str, low: float = -math.inf, high: float = math.inf) -> int:
        """Return the number of rows of an outcome, of low <= SNR < high if a range is given."""
        rows = self.rows(outcome)
        if math.isinf(low) and math.isinf(high):
            return len(rows)
        return int(np.count_nonzero((rows["snr"] >= low) & (rows["snr"] < high)))

    def recall(self, low: float = -math.inf, high: float = math.inf) -> float:
        """Return the share of the truths that was found, of low <= SNR < high if a range is given.

        Without a range, truths of unknown SNR count as well.  NaN if there is none.
        """
        found = self.count(FOUND, low, high)
        return _ratio(found, found + self.count(MISSED, low, high))

    @property
    def precision(self) -> float:
        """Share of the detections that are right; duplicates and ignored ones left out."""
        found = self.count(FOUND)
        return _ratio(found, found + self.count(FALSE_ALARM))

    @property
    def false_alarms_per_frame(self) -> float:
        """False alarms over frames that count."""
        return _ratio(self.count(FALSE_ALARM), self.frames)

    @property
    def centroid_rms_px(self) -> float:
        """Root of the mean squared length of the error, sqrt(<dx^2 + dy^2>), px.

        Over found truths of SNR 5 and more that are no streaks.  That of one axis is smaller by
        sqrt(2) if the axes are alike; see `centroid_rms_xy_px`.
        """
        return math.hypot(*self.centroid_rms_xy_px)

    @property
    def centroid_rms_xy_px(self) -> tuple[float, float]:
        """Rms of the error of the centroid along x and along y, px; of the same truths."""
        rows = self.rows(FOUND)
        rows = rows[(rows["snr"] >= 5) & (rows["length_px"] < STREAK_PX)]
        if not len(rows):
            return math.nan, math.nan
        dx, dy = (float(np.sqrt(np.mean(rows[name] ** 2))) for name in ("dx_px", "dy_px"))
        return dx, dy

    def velocity_error_px(self, quantile: float = 0.5) -> float:
        """Return a quantile of the error of the velocity in the image, px per frame."""
        errors = self.rows(FOUND)["dv_px"]
        errors = errors[np.isfinite(errors)]
        return float(np.quantile(errors, quantile)) if len(errors) else math.nan

    @property
    def objects(self) -> tuple[int, int]:
        """Objects found in at least half of their frames that count, and all that have some."""
        rows = self.rows(FOUND, MISSED)
        _, index = np.unique(rows[["sequence", "id"]], return_inverse=True)
        present = np.bincount(index)
        found = np.bincount(index[rows["outcome"] == FOUND], minlength=len(present))
        return int(np.count_nonzero(2 * found >= present)), len(present)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for a JSON file; what is unknown is None."""
        found_objects, objects = self.objects
        x, y = self.centroid_rms_xy_px
        figures = {
            "sequences": list(self.sequences),
            "frames": self.frames,
            "truths": self.count(FOUND) + self.count(MISSED),
            "found": self.count(FOUND),
            "recall": self.recall(),
            "recall_by_snr": {_words(*r): _known(self.recall(*r)) for r in SNR_RANGES},
            "precision": self.precision,
            "false_alarms": self.count(FALSE_ALARM),
            "false_alarms_per_frame": self.false_alarms_per_frame,
            "duplicates": self.count(DUPLICATE),
            "ignored": self.count(IGNORED),
            "centroid_rms_px": self.centroid_rms_px,
            "centroid_rms_x_px": x,
            "centroid_rms_y_px": y,
            "velocity_error_median_px_per_frame": self.velocity_error_px(),
            "velocity_error_90_percent_px_per_frame": self.velocity_error_px(0.9),
            "objects": objects,
            "objects_found_in_half_their_frames": found_objects,
        }
        return {name: _known(value) for name, value in figures.items()}

    def __str__(self) -> str:
        lines = [f"{'':20} {'found':>6} {'of':>6} {'recall':>7}"]
        for low, high in ((-math.inf, math.inf), *SNR_RANGES):
            found, missed = self.count(FOUND, low, high), self.count(MISSED, low, high)
            name = "all" if math.isinf(low) else f"SNR {_words(low, high)}"
            recall = _number(self.recall(low, high))
            lines.append(f"{name:20} {found:6d} {found + missed:6d} {recall:>7}")
        x, y = (_number(value) for value in self.centroid_rms_xy_px)
        false_alarms, per_frame = self.count(FALSE_ALARM), _number(self.false_alarms_per_frame)
        lines += [
            f"{'precision':20} {_number(self.precision)}",
            f"{'false alarms':20} {false_alarms} in {self.frames} frames: {per_frame} per frame",
            f"{'apart':20} {self.count(DUPLICATE)} duplicates,"
            f" {self.count(IGNORED)} detections of what does not count",
            f"{'centroid error, rms':20} {_number(self.centroid_rms_px)} px (x {x}, y {y})",
            f"{'velocity error':20} median {_number(self.velocity_error_px())},"
            f" 90 % {_number(self.velocity_error_px(0.9))} px per frame",
            "{:20} {} of {} found in at least half of their frames".format(
                "objects", *self.objects
            ),
        ]
        return "\n".join(lines)


def merge(evaluations: Iterable[Evaluation]) -> Evaluation:
    """Return the evaluation of several sequences together; each keeps its own objects."""
    tables, frames = [np.zeros(0, OUTCOME_DTYPE)], 0
    names: tuple[str, ...] = ()
    for one in evaluations:
        rows = one.outcomes.copy()
        rows["sequence"] += len(names)
        tables.append(rows)
        names += one.sequences
        frames += one.frames
    return Evaluation(np.concatenate(tables), frames, tuple(names))


def evaluate(
    truth: Table,
    detections: Table,
    *,
    frames: int | None = None,
    shape: tuple[int, int] | None = None,
    live: bool = False,
    candidates: bool = False,
    name: str = "",
) -> Evaluation:
    """Compare the detections of one sequence with its truth, by the rules above.

    Parameters
    ----------
    truth : (N,) structured array
        Fields of TRUTH_DTYPE, as `read_truth` and the simulator give them.  ``edge``, ``snr``,
        ``length_px`` and the velocities may be absent.
    detections : (K,) structured array
        Fields of DETECTIONS_DTYPE, as `read_detections` and `detection_table` give them.
    frames : int, optional
        Number of frames of the sequence, frame 0 included; default: up to the last frame that
        occurs.  It matters for the false alarms per frame only: a truth counts whether its frame
        was processed or not.
    shape : (height, width), optional
        Size of the image, px, for a truth without ``edge``: cut by the border is what has an end
        of its path nearer than 4 px to it.
    live : bool
        Count truths from their object's third visible frame on only.
    candidates : bool
        Count candidates as well, not only confirmed detections.
    name : str
        Name of the sequence.

    Returns
    -------
    Evaluation

    Raises
    ------
    EvaluationError
        If a field is absent, or the stamps of truth and detections contradict each other.
    """
    truth = as_table(truth, TRUTH_DTYPE, "truth")
    truth["length_px"] = np.nan_to_num(truth["length_px"])
    if shape is not None:
        truth["edge"] |= _cut_by_border(truth, shape)
    detections = as_table(detections, DETECTIONS_DTYPE, "detections")
    numbers = np.concatenate([truth["frame"], detections["frame"]])
    period_s = _frame_periods(truth, detections, name)
    counts = _counts(truth, live)
    if not candidates:
        detections = detections[detections["confirmed"]]
    outcomes = [np.zeros(0, OUTCOME_DTYPE)]
    for frame in np.unique(numbers[numbers > 0]):
        now, said = truth["frame"] == frame, detections["frame"] == frame
        found = _outcomes(truth[now], counts[now], detections[said], period_s.get(frame, math.nan))
        outcomes.append(found)
    if frames is None:
        frames = int(numbers.max(initial=0)) + 1
    return Evaluation(np.concatenate(outcomes), max(frames - 1, 0), (name,))


def _counts(truth: Table, live: bool) -> NDArray[np.bool_]:
    """Whether each truth counts; those that do not are don't-care."""
    visible = ~(truth["snr"] < LEAST_SNR)  # what is unknown counts
    counts = visible & ~truth["edge"]
    if live:
        for rso in np.unique(truth["id"]):
            seen = np.flatnonzero(visible & (truth["id"] == rso))
            seen = seen[np.argsort(truth["frame"][seen], kind="stable")]
            counts[seen[: LIVE_FRAMES - 1]] = False
    return counts


def _outcomes(
    truth: Table, counts: NDArray[np.bool_], detections: Table, period_s: float
) -> Table:
    """What became of the truths and detections of one frame."""
    distance = _distance(truth, detections)
    # A pair too far apart costs more than all that are allowed together.
    costs = np.where(distance <= 1, distance, 1e6)
    said, there = linear_sum_assignment(costs)
    near = distance[said, there] <= 1
    said, there = said[near], there[near]
    pairs = [(counts[there], FOUND), (~counts[there], IGNORED)]
    parts = [_rows(kind, truth[there[k]], detections[said[k]], period_s) for k, kind in pairs]

    missed = counts.copy()
    missed[there] = False
    parts.append(_rows(MISSED, truth[missed], None))

    left = np.setdiff1d(np.arange(len(detections)), said)
    again = distance[np.ix_(left, there)]
    nearest = np.argmin(again, axis=1) if len(there) else np.zeros(len(left), int)
    second = np.any(again <= DUPLICATE_FACTOR, axis=1)
    twice = truth[there[nearest[second]]]
    parts.append(_rows(DUPLICATE, twice, detections[left[second]], period_s))
    parts.append(_rows(FALSE_ALARM, None, detections[left[~second]]))
    return np.concatenate(parts)


def _distance(truth: Table, detections: Table) -> NDArray[np.float64]:
    """Distance of each detection from each truth in units of the tolerance, (K, N)."""
    dx = detections["x_px"][:, None] - truth["x_px"]
    dy = detections["y_px"][:, None] - truth["y_px"]
    speed = np.hypot(truth["vx_px_s"], truth["vy_px_s"])
    streak = (truth["length_px"] >= STREAK_PX) & (speed > 0)
    ux, uy = _direction(truth)
    reach = np.maximum(MATCH_PX, truth["length_px"] / 2)
    along, across = np.abs(dx * ux + dy * uy) / reach, np.abs(dy * ux - dx * uy) / MATCH_PX
    return np.where(streak, np.maximum(along, across), np.hypot(dx, dy) / MATCH_PX)


def _direction(truth: Table) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vector of each truth's motion; 0 if it has none."""
    speed = np.hypot(truth["vx_px_s"], truth["vy_px_s"])
    moves = speed > 0
    speed = np.where(moves, speed, 1.0)
    ux, uy = (np.where(moves, truth[v] / speed, 0.0) for v in ("vx_px_s", "vy_px_s"))
    return ux, uy


def _cut_by_border(truth: Table, shape: tuple[int, int]) -> NDArray[np.bool_]:
    cut = np.zeros(len(truth), bool)
    for name, direction, size in zip(
        ("x_px", "y_px"), _direction(truth), shape[::-1], strict=True
    ):
        reach = EDGE_PX + np.abs(direction) * truth["length_px"] / 2
        cut |= (truth[name] < reach) | (truth[name] > size - 1 - reach)
    return cut


def _rows(
    outcome: str, truth: Table | None, detections: Table | None, period_s: float = math.nan
) -> Table:
    """Rows of one outcome; truth and detections in pairs, or one of them."""
    given = [table for table in (truth, detections) if table is not None]
    rows = np.zeros(len(given[0]), OUTCOME_DTYPE)
    rows["outcome"] = outcome
    for name in ("length_px", "dx_px", "dy_px", "dv_px"):
        rows[name] = math.nan
    # Of what both have, the position is the detection's and the SNR the truth's.
    if detections is not None:
        rows["track_id"], rows["snr"] = detections["track_id"], detections["snr"]
    if truth is not None:
        for name in ("id", "snr", "length_px"):
            rows[name] = truth[name]
    for name in ("frame", "x_px", "y_px"):
        rows[name] = given[-1][name]
    if truth is not None and detections is not None:
        rows["dx_px"] = detections["x_px"] - truth["x_px"]
        rows["dy_px"] = detections["y_px"] - truth["y_px"]
        dvx, dvy = (detections[v] - truth[v] for v in ("vx_px_s", "vy_px_s"))
        rows["dv_px"] = np.hypot(dvx, dvy) * period_s
    return rows


def _frame_periods(truth: Table, detections: Table, name: str) -> dict[int, float]:
    """Time since the frame before of each frame that occurs, s, by number.

    Frames without truth and detections leave gaps, across which the period is the mean; that of
    the first frame known is the next one's.
    """
    numbers, first = np.unique(truth["frame"], return_index=True)
    stamps = dict(zip(numbers.tolist(), truth["stamp_ns"][first].tolist(), strict=True))
    others, first = np.unique(detections["frame"], return_index=True)
    theirs = dict(zip(others.tolist(), detections["stamp_ns"][first].tolist(), strict=True))
    both = {**theirs, **stamps}
    known = np.array(sorted(both), "i8")
    if len(known) < 2:
        return {}
    slope = np.diff([both[k] for k in known.tolist()]) / np.diff(known) / 1e9
    for frame in stamps.keys() & theirs.keys():
        if abs(stamps[frame] - theirs[frame]) / 1e9 > np.median(slope) / 2:
            raise EvaluationError(
                f"{name or 'the sequence'}: frame {frame} has stamp {stamps[frame]} ns in the"
                f" truth but {theirs[frame]} ns in the detections; are both of the same recording,"
                " and no frame lost?"
            )
    return dict(zip(known.tolist(), np.r_[slope[:1], slope].tolist(), strict=True))


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _words(low: float, high: float) -> str:
    return f">= {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
