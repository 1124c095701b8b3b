"""Linking: which spots of several frames lie on one straight path that chance does not explain.

Noise gives every frame some spots.  Of a path through spots one can say how many such paths the
frames' spots would give if they lay there by chance (*a contrario*: Desolneux, Moisan and Morel,
"Meaningful alignments", 2000): the number of pairs that start one, times, for every further frame,
the number of spots as strong that chance puts as near to the path.  It adapts to any sky: where
spots abound, more is asked of a path.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import gammaln

from ofsat_ros.history import PastFrame

Array = NDArray[np.float64]

# A path starts with a spot of the newest frame and one of these frames before it.
_PAIR_AGES = 2
# After so many frames, a path with no further spot is given up.
_PATIENCE = 2
# Std of a spot's place beside its stated one, px: what position a spot of low SNR takes by chance.
_SPREAD_PX = 0.35
# The end of a streak is as good as its middle: its place is uncertain by this part of its length.
_STREAK_SPREAD = 0.12
_GATE_SIGMAS = 3.0
_LARGEST_GATE_PX = 6.0
# Side of a cell of the map that says where spots are, px.
_CELL_PX = 4
# Two spots of one RSO differ by less than this factor in brightness, also when it tumbles.
_BRIGHTNESS_RATIO = 5.0
# How far around a spot others are counted, px.
_NEARBY_PX = 40.0
# A spot that the frame before shows this near to its place on the sky is a star that changed, or
# noise that a compressed video repeats, px.
_REPEATED_PX = 0.35
# A near partner is less likely chance's than a far one: its number goes with the area, down to
# this part of it, since artefacts keep together.
_SCALES, _LEAST_AREA = 8, 0.25
# The least way on the sky that is motion, px.
_LEAST_WAY_PX = 2.0


@dataclass
class Sighting:
    """The spots of one frame.

    Attributes
    ----------
    frame : PastFrame
        The frame.
    spots : (N,) SPOT_DTYPE
        Its spots.
    sky : (N, 2) float64
        Their places in the sky plane, px.
    free : (N,) bool
        Whether no track has taken them.
    telling : (N,) bool
        Whether they are clean and not the frame before's over again: others say where something
        is, but not that.
    """

    frame: PastFrame
    spots: NDArray[np.void]
    sky: Array
    free: NDArray[np.bool_]
    telling: NDArray[np.bool_]

    @classmethod
    def of(
        cls, frame: PastFrame, spots: NDArray[np.void], before: Sighting | None = None
    ) -> Sighting:
        """Build with all spots free, given those of the frame before."""
        sky = frame.sky(np.stack([spots["x"], spots["y"]], axis=1))
        telling = spots["clean"].copy()
        if before is not None and len(before.sky):
            distance, _ = KDTree(before.sky).query(sky, distance_upper_bound=_REPEATED_PX)
            telling &= ~np.isfinite(distance)
        return cls(frame, spots, sky, np.ones(len(spots), bool), telling)

    @cached_property
    def expected(self) -> Array:
        """How many telling spots of at least each spot's strength chance gives in a frame, (N,).

        The peaks of smoothed white noise (Adler, "The geometry of random fields", 1981, for a
        Gaussian of sigma 1 px), and as many again as the frame has stronger ones, since no real
        frame is white noise alone.
        """
        height, width = self.frame.shape
        strongest = np.sort(self.spots["excess"][self.telling])
        stronger = len(strongest) - np.searchsorted(strongest, self.spots["excess"], side="right")
        return self._noise_peaks * height * width + stronger + 1

    @cached_property
    def log_density(self) -> Array:
        """Logarithm of how many there are per px^2, (N,): in the frame, or nearby if more.

        Clouds and artefacts give many spots in some places and none in others.
        """
        height, width = self.frame.shape
        pairs = KDTree(self.sky).query_pairs(_NEARBY_PX, output_type="ndarray")
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        one, other = pairs.T
        excess = self.spots["excess"]
        stronger = self.telling[other] & (excess[other] > excess[one])
        nearby = np.bincount(one[stronger], minlength=len(self.spots))
        density = self._noise_peaks + nearby / (np.pi * _NEARBY_PX**2)
        return np.log(np.maximum(density, self.expected / (height * width)))

    @cached_property
    def _vicinity(self) -> NDArray[np.uint8]:
        """Coarse map of the places that are within the usual gate of a free spot, nonzero."""
        height, width = self.frame.shape
        cells = np.zeros((height // _CELL_PX + 1, width // _CELL_PX + 1), np.uint8)
        x, y = (self.spots[name][self.free] for name in ("x", "y"))
        cells[(y / _CELL_PX).astype(int), (x / _CELL_PX).astype(int)] = 1
        reach = 2 * (math.ceil(_LARGEST_GATE_PX / _CELL_PX) + 1) + 1
        return cv2.dilate(cells, np.ones((reach, reach), np.uint8))

    def may_be_near(self, xy: Array, reach: Array) -> NDArray[np.bool_]:
        """Whether a free spot may lie within reach of points (N, 2) px inside the image, (N,).

        Most points of most paths are far from all spots, and this costs less than a search.
        """
        column, row = np.clip(xy / _CELL_PX, 0, None).astype(int).T
        rows, columns = self._vicinity.shape
        near = self._vicinity[np.minimum(row, rows - 1), np.minimum(column, columns - 1)] > 0
        return near | (reach > _LARGEST_GATE_PX)

    @property
    def _noise_peaks(self) -> Array:
        excess = self.spots["excess"]
        return (2 * np.pi) ** -1.5 / 2 * excess * np.exp(-(excess**2) / 2)


@dataclass(frozen=True)
class Link:
    """Spots on one path.

    Attributes
    ----------
    rows : dict of int to int
        Number of the frame to row of its spots.
    log_false : float
        Logarithm of the number of such paths that chance gives in one frame.
    """

    rows: dict[int, int]
    log_false: float


def find_links(sightings: Sequence[Sighting], log_limit: float, max_speed_px: float) -> list[Link]:
    """Find paths that end at free spots of the newest frame.

    Parameters
    ----------
    sightings : sequence of Sighting
        The frames' spots, oldest first.
    log_limit : float
        Logarithm of the number of false paths in one frame that is accepted.
    max_speed_px : float
        Fastest motion against the stars, px per frame.

    Returns
    -------
    list of Link
        The surest first; no two share a spot.
    """
    newest, earlier = sightings[-1], list(sightings[-2::-1])
    if len(earlier) < 2:
        return []
    found: list[tuple[float, dict[int, int]]] = []
    for age in range(1, 1 + min(_PAIR_AGES, len(earlier))):
        paths = _Paths.of_pairs(newest, earlier[age - 1], max_speed_px * age)
        # Those next to the pair in time first, where the path is best known.
        others = [*earlier[: age - 1], *earlier[age:]]
        for checked, other in enumerate(others):
            if checked == _PATIENCE:
                paths = paths.having(3)
            paths.extend(other)
        found += paths.surest(log_limit - np.log(_PAIR_AGES))
    links: list[Link] = []
    taken: set[tuple[int, int]] = set()
    for log_false, rows in sorted(found, key=lambda item: item[0]):
        if taken.isdisjoint(rows.items()):
            taken.update(rows.items())
            links.append(Link(rows, log_false))
    return links


class _Paths:
    """Paths through two or more spots each, as sums for straight lines through them."""

    def __init__(self, newest: Sighting, other: Sighting, a: NDArray, b: NDArray) -> None:
        self._newest = newest
        self._rows = {newest.frame.number: a, other.frame.number: b}
        t = _seconds(other, newest)
        self._count = np.full(len(a), 2.0)
        self._t, self._tt = np.full(len(a), t), np.full(len(a), t * t)
        self._xy = newest.sky[a] + other.sky[b]
        self._txy = other.sky[b] * t
        self._span = np.full(len(a), -t)
        # Frames in which a path could be seen, and those of them up to its oldest spot.
        self._visible = np.full(len(a), 2)
        self._since_first = np.full(len(a), 2)
        height, width = newest.frame.shape
        reach = np.hypot(*(newest.sky[a] - other.sky[b]).T)
        area = _SCALES * np.pi * reach**2 / (height * width)
        partners = other.expected[b] * np.clip(area, _LEAST_AREA, 1)
        self._log_false = np.log(newest.expected[a]) + np.log(partners)
        first, second = newest.spots[a], other.spots[b]
        self._length = np.maximum(first["length"], second["length"])
        self._strength = np.sqrt(first["excess"] * second["excess"])

    @classmethod
    def of_pairs(cls, newest: Sighting, other: Sighting, reach_px: float) -> _Paths:
        """Start a path with every pair of spots of like brightness within reach."""
        a = np.flatnonzero(newest.free & newest.telling)
        b = np.flatnonzero(other.free & other.telling)
        if not (a.size and b.size):
            return cls(newest, other, a[:0], b[:0])
        pairs = KDTree(newest.sky[a]).sparse_distance_matrix(
            KDTree(other.sky[b]), reach_px, output_type="ndarray"
        )
        a, b = a[pairs["i"]], b[pairs["j"]]
        ratio = newest.spots["excess"][a] / other.spots["excess"][b]
        alike = (ratio < _BRIGHTNESS_RATIO) & (ratio > 1 / _BRIGHTNESS_RATIO)
        return cls(newest, other, a[alike], b[alike])

    def having(self, count: int) -> _Paths:
        """Return the paths that have this many spots at least."""
        keep = self._count >= count
        kept = _Paths.__new__(_Paths)
        for name, value in vars(self).items():
            setattr(kept, name, value[keep] if isinstance(value, np.ndarray) else value)
        kept._rows = {number: rows[keep] for number, rows in self._rows.items()}
        return kept

    def _spread(self) -> Array:
        return np.hypot(_SPREAD_PX, _STREAK_SPREAD * self._length)

    def _time_spread(self) -> Array:
        return self._tt - self._t**2 / self._count

    def _velocity(self) -> Array:
        top = self._txy - (self._t / self._count)[:, None] * self._xy
        return top / self._time_spread()[:, None]

    def extend(self, other: Sighting) -> None:
        """Add to each path the spot of another frame that is nearest to it, if one is near."""
        t = _seconds(other, self._newest)
        since = t - self._t / self._count
        expected = self._xy / self._count[:, None] + self._velocity() * since[:, None]
        places = other.frame.pixels(expected)
        rows = np.full(len(places), -1, np.intp)
        self._rows[other.frame.number] = rows
        visible = other.frame.contains(places, 3.5)
        self._visible += visible
        free = np.flatnonzero(other.free)
        seen = np.flatnonzero(visible)
        if not (free.size and seen.size):
            return
        spread = self._spread()[seen]
        error = spread * np.sqrt(
            1 + 1 / self._count[seen] + since[seen] ** 2 / self._time_spread()[seen]
        )
        gate = np.minimum(_GATE_SIGMAS * error, _LARGEST_GATE_PX + 0.3 * self._length[seen])
        close = other.may_be_near(places[seen], gate)
        seen, error, gate = seen[close], error[close], gate[close]
        if not seen.size:
            return
        xy = np.stack([other.spots["x"], other.spots["y"]], axis=1)[free]
        distance, nearest = KDTree(xy).query(places[seen], distance_upper_bound=float(gate.max()))
        near = distance < gate
        spot = free[nearest[near]]
        seen, distance, error = seen[near], distance[near], error[near]
        area = np.pi * np.maximum(distance, 1.2 * error) ** 2
        gain = np.log(area) + other.log_density[spot]
        gain = np.where(other.telling[spot], gain, 0.0)
        ratio = other.spots["excess"][spot] / self._strength[seen]
        good = (gain < 0.5) & (ratio < _BRIGHTNESS_RATIO) & (ratio > 1 / _BRIGHTNESS_RATIO)
        seen, spot = seen[good], spot[good]
        rows[seen] = spot
        self._log_false[seen] += gain[good]
        self._count[seen] += 1
        self._t[seen] += t
        self._tt[seen] += t * t
        self._xy[seen] += other.sky[spot]
        self._txy[seen] += t * other.sky[spot]
        self._span[seen] = np.maximum(self._span[seen], -t)
        self._since_first[seen] = self._visible[seen]

    def surest(self, log_limit: float) -> list[tuple[float, dict[int, int]]]:
        """Paths that chance explains less often than the limit, with their spots."""
        k, n = self._count, self._since_first
        # When it began, and in which frames between it was missed, is what chance could choose.
        choices = (
            gammaln(n - 1)
            - gammaln(k - 1)
            - gammaln(n - k + 1)
            + np.log(np.maximum(self._visible - 2, 1))
        )
        log_false = self._log_false + choices
        way = np.hypot(*self._velocity().T) * self._span
        error = self._spread() / np.sqrt(self._time_spread()) * self._span
        good = (log_false < log_limit) & (k >= 3) & (way > _LEAST_WAY_PX) & (way > 6 * error)
        return [
            (
                float(log_false[path]),
                {
                    number: int(rows[path])
                    for number, rows in self._rows.items()
                    if rows[path] >= 0
                },
            )
            for path in np.flatnonzero(good)
        ]


def _seconds(other: Sighting, newest: Sighting) -> float:
    return (other.frame.stamp_ns - newest.frame.stamp_ns) / 1e9
