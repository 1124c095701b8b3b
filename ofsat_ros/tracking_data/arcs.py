# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Arcs: the directions of one object in a row, taken apart by the number of their track."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

ARC_DTYPE = np.dtype(
    [
        ("stamp_ns", "i8"),  # UTC, middle of the exposure
        ("ra", "f8"),  # rad, ICRS
        ("dec", "f8"),
        ("sigma_ra", "f8"),  # std of ra times cos dec, rad; NaN if unknown
        ("sigma_dec", "f8"),
        ("flux", "f8"),  # DN; NaN if unknown
        ("snr", "f8"),
    ]
)
_NS = 1e9
# What is faster than that (rad/s), or so far off its path (rad), is another object.
_FASTEST = math.radians(30.0)
_OFF_PATH = math.radians(0.1)
# A path bends: so much of the way since the last sight it may be off.
_BEND = 0.25
_OFF_PATH_SIGMAS = 10.0
# A rate is taken over the last second.
_RATE_S = 1.0


@dataclass(frozen=True, eq=False)
class Arc:
    """The directions of one track.

    Attributes
    ----------
    label : str
        What tells it from the others of its recording: the track's number, and if that number
        has been another object's before, which one it is: ``3``, then ``3-2``.
    rows : (N,) ARC_DTYPE
        Its directions; stamps ascend.
    continues : bool
        Whether it goes on where an arc of the same label ended, being as long as was allowed.
    """

    label: str
    rows: NDArray[np.void]
    continues: bool = False

    @property
    def first_ns(self) -> int:
        """Stamp of the first direction."""
        return int(self.rows["stamp_ns"][0])


class ArcCollector:
    """Sorts the detections of frame after frame into arcs.

    A number whose direction jumps off its path, or that comes back after its arc has been taken,
    begins a new arc.  If time runs backwards (a recording begins anew), all arcs end.
    """

    def __init__(self) -> None:
        self._open: dict[int, _OpenArc] = {}
        self._ended: list[_OpenArc] = []
        self._counts: Counter[int] = Counter()  # arcs so far of each number
        self._newest_ns: int | None = None

    def add(self, stamp_ns: int, rows: NDArray[np.void], longest: int | None = None) -> None:
        """Take a frame's detections, also if there are none: its stamp tells the time.

        An arc that has `longest` directions ends, and the track goes on in another.
        """
        if self._newest_ns is not None and stamp_ns < self._newest_ns:
            self._end(list(self._open))
        self._newest_ns = stamp_ns
        known = (rows["track_id"] > 0) & np.isfinite(rows["ra"]) & np.isfinite(rows["dec"])
        rows = rows[known]
        for track_id, row in zip(
            rows["track_id"].tolist(), _arc_rows(stamp_ns, rows), strict=True
        ):
            arc = self._open.get(track_id)
            if arc is None or not arc.is_continued_by(row):
                self._end([track_id])
                arc = self._begin(track_id)
            elif longest is not None and len(arc.rows) >= longest:
                self._end([track_id])
                arc = self._open[track_id] = _OpenArc(arc.label, continues=True)
            arc.rows.append(row)

    def all(self) -> list[Arc]:
        """Return every arc that has not been taken, in the order of their beginnings."""
        return _closed([*self._ended, *self._open.values()])

    def take_ended(self, after_s: float) -> list[Arc]:
        """Return and forget the arcs without a direction for so long before the newest frame."""
        if self._newest_ns is not None:
            before_ns = self._newest_ns - after_s * _NS
            self._end([i for i, arc in self._open.items() if arc.last_ns < before_ns])
        ended, self._ended = self._ended, []
        return _closed(ended)

    def take_all(self) -> list[Arc]:
        """Return and forget every arc."""
        self._end(list(self._open))
        return self.take_ended(0.0)

    def _begin(self, track_id: int) -> _OpenArc:
        self._counts[track_id] += 1
        count = self._counts[track_id]
        arc = _OpenArc(f"{track_id}-{count}" if count > 1 else f"{track_id}")
        self._open[track_id] = arc
        return arc

    def _end(self, track_ids: list[int]) -> None:
        self._ended += [self._open.pop(i) for i in track_ids if i in self._open]


class _OpenArc:
    """An arc that may go on."""

    def __init__(self, label: str, continues: bool = False) -> None:
        self.label, self.continues = label, continues
        self.rows: list[np.void] = []

    @property
    def last_ns(self) -> int:
        return int(self.rows[-1]["stamp_ns"])

    def is_continued_by(self, row: np.void) -> bool:
        """Tell whether a direction lies on the arc's path, in time and on the sky."""
        since_s = (int(row["stamp_ns"]) - self.last_ns) / _NS
        if since_s <= 0:
            return False
        last, new = _sight(self.rows[-1]), _sight(row)
        if _angle(last, new) > _FASTEST * since_s + _OFF_PATH:
            return False
        if len(self.rows) == 1:
            return True
        before = self._row_before()
        over_s = (self.last_ns - int(before["stamp_ns"])) / _NS
        way = (last - _sight(before)) * (since_s / over_s)
        sigma = np.nan_to_num(max(row["sigma_ra"], row["sigma_dec"])) * (1 + since_s / over_s)
        allowed = _OFF_PATH + _BEND * math.hypot(*way) + _OFF_PATH_SIGMAS * sigma
        return bool(_angle(last + way, new) <= allowed)

    def _row_before(self) -> np.void:
        """The row from which the last one's rate is taken."""
        for row in islice(reversed(self.rows), 1, None):
            if self.last_ns - row["stamp_ns"] >= _RATE_S * _NS:
                return row
        return self.rows[0]


def _arc_rows(stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void]:
    """Rows of an arc from detections of any dtype; what these do not tell is NaN."""
    made = np.zeros(len(rows), ARC_DTYPE)
    made["stamp_ns"] = stamp_ns
    given = rows.dtype.names or ()
    for name in (ARC_DTYPE.names or ())[1:]:
        made[name] = rows[name] if name in given else np.nan
    for name in ("sigma_ra", "sigma_dec"):
        made[name][~(made[name] > 0)] = np.nan
    return made


def _closed(arcs: list[_OpenArc]) -> list[Arc]:
    made = [Arc(arc.label, np.array(arc.rows, ARC_DTYPE), arc.continues) for arc in arcs]
    return sorted(made, key=lambda arc: arc.first_ns)


def _sight(row: np.void) -> NDArray[np.float64]:
    ra, dec = float(row["ra"]), float(row["dec"])
    across = math.cos(dec)
    return np.array([across * math.cos(ra), across * math.sin(ra), math.sin(dec)])


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return math.atan2(math.hypot(*np.cross(a, b)), float(a @ b))
