# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Sightings: the spots of one frame, with what linking asks of them many times.

Which of them are near to a place, which tell something, and how many such spots chance gives.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.history import PastFrame
from ofsat_ros.pixels import as_complex, positions

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
# Places in a plane as x + iy, px: they need half as many operations as pairs of numbers.
Places = NDArray[np.complex128]

# Side of a cell of the index of places, and of that for what is next to them, px.
_SIDE_PX, _CLOSE_PX = 50.0, 16.0
# So many pairs at a time stay in the cache.
_CHUNK = 1 << 16
# So few are sooner looked at than looked up.
_FEW_PAIRS = 1 << 14
# The map of where spots are has smaller cells, and marks so many on each side of a spot's own.
_FINE_PX, _FINE_REACH = 2.0, 4
# Std of a spot's place beside its stated one, px: what position a spot of low SNR takes by chance.
SPREAD_PX = 0.35
# The end of a streak is as good as its middle: its place is uncertain by this part of its length.
STREAK_SPREAD = 0.12
# How far around a spot others are counted, px.
_NEARBY_PX = 40.0
# A spot that the frame before shows this near to its place on the sky is a star that changed, or
# noise that a compressed video repeats, px.
_REPEATED_PX = 0.35


class Index:
    """Places in a plane, sorted by square cells, to find those near to others."""

    def __init__(self, places: Places) -> None:
        self._cells = _Cells(places, _SIDE_PX)
        column, row = _grid(self._cells.at(places))
        self.order, self._starts = self._cells.sorted(row, column)

    def ranges(self, places: Places, reach: Array) -> Iterator[tuple[Rows, Rows, Rows]]:
        """Yield pairs as i, how often each i is there, and j for each pair.

        Those such that order[j] is a row within reach[i] px of places[i], and others that share
        cells with them.
        """
        cells = self._cells
        for begin in range(0, len(places), _CHUNK // 8):
            part = slice(begin, begin + _CHUNK // 8)
            at, far = cells.at(places[part]), reach[part] * (1 / _SIDE_PX)
            top = _clipped(at.imag - far, cells.rows - 1)
            count = _clipped(at.imag + far, cells.rows - 1) + 1 - top
            row = _numbers(top, count)
            # One range for each row of cells in the circle.
            x, y, far = (axis.repeat(count) for axis in (at.real, at.imag, far))
            off = np.maximum(np.abs(row + 0.5 - y) - 0.5, 0)
            half = np.sqrt(np.maximum(far**2 - off**2, 0))
            row *= cells.columns
            start = self._starts.take(row + _clipped(x - half, cells.columns - 1))
            i = np.arange(begin, begin + len(at)).repeat(count)
            count = self._starts.take(row + _clipped(x + half, cells.columns - 1) + 1) - start
            some = count.nonzero()[0]
            i, start, count = i.take(some), start.take(some), count.take(some)
            total = np.cumsum(count)
            cuts = total.searchsorted(np.arange(_CHUNK, total[-1] if len(total) else 0, _CHUNK))
            for first, last in zip([0, *cuts], [*cuts, len(total)], strict=True):
                cut = slice(first, last)
                yield i[cut], count[cut], _numbers(start[cut], count[cut])


class Surroundings:
    """Places in a plane, each in two rows of cells, to find those next to others in one look."""

    # What is next to a place, px.
    reach_px = _CLOSE_PX / 2

    def __init__(self, places: Places) -> None:
        self._cells = _Cells(places, _CLOSE_PX)
        at = self._cells.at(places)
        (column, _), (_, row) = _grid(at), _grid(at - 0.5j)
        rows = np.concatenate([row, row + 1])
        order, self._starts = self._cells.sorted(rows, np.tile(column, 2))
        self._order = order % max(len(places), 1)

    def near(self, places: Places) -> tuple[Rows, Rows]:
        """Pairs i, j such that row j is next to places[i], and others that share cells."""
        cells, at = self._cells, self._cells.at(places)
        cell = _clipped(at.imag, cells.rows - 1) * cells.columns
        cell += _clipped(at.real - 0.5, cells.columns - 2)
        start = self._starts.take(cell)
        count = self._starts.take(cell + 2) - start
        some = count.nonzero()[0]
        count = count.take(some)
        return some.repeat(count), self._order.take(_numbers(start.take(some), count))


class _Cells:
    """Square cells over places in a plane, with a margin of one cell on each side."""

    def __init__(self, places: Places, side_px: float) -> None:
        self._corner, self._scale = _corner(places) - (1 + 1j) * side_px, 1 / side_px
        column, row = _grid(self.at(places))
        self.columns, self.rows = (int(n.max(initial=1)) + 2 for n in (column, row))

    def at(self, places: Places) -> Places:
        """Places in sides of cells."""
        return (places - self._corner) * self._scale

    def sorted(self, row: Rows, column: Rows) -> tuple[Rows, Rows]:
        """The order of cells by their numbers, and where each number begins in it."""
        cell = row * self.columns + column
        counts = np.bincount(cell, minlength=self.columns * self.rows)
        return np.argsort(cell, kind="stable"), np.concatenate([[0], np.cumsum(counts)])


def _corner(places: Places) -> complex:
    """The corner of a rectangle around places."""
    return complex(places.real.min(), places.imag.min()) if len(places) else 0j


def _grid(places: Places) -> tuple[Rows, Rows]:
    """Column and row, rounded down."""
    return np.floor(places.real).astype(np.intp), np.floor(places.imag).astype(np.intp)


def _clipped(x: Array, last: int) -> Rows:
    return np.minimum(np.maximum(x, 0), last).astype(np.intp)


def _numbers(start: Rows, count: Rows) -> Rows:
    """All numbers of ranges, one after the other."""
    number = (start - count.cumsum() + count).repeat(count)
    number += np.arange(len(number))
    return number


class Vicinity:
    """A map of the places that are near to some of a plane, which costs less than a search.

    Its cells are numbered such that one may add what two ways need, rather than the ways.  What
    is as near as it knows to a wide place, a streak, counts as next to it.
    """

    # How near is near enough for it to know, px, in spite of two places rounded to cells and one
    # of the cells' own.
    reach_px = (_FINE_REACH - 0.5) * _FINE_PX
    # The number of a cell that is near.
    anywhere = -(1 << 40)

    def __init__(self, places: Places, wide: NDArray[np.bool_]) -> None:
        self._corner = _corner(places) - _FINE_REACH * _FINE_PX * (1 + 1j)
        column, row = _grid((places - self._corner) * (1 / _FINE_PX) + (0.5 + 0.5j))
        self._width = column.max(initial=0) + _FINE_REACH + 1
        cell = row * self._width + column
        step = np.arange(-_FINE_REACH, _FINE_REACH + 1)
        around = (step[:, None] * self._width + step).ravel()
        far = np.maximum(*np.abs(np.meshgrid(step, step))).ravel()
        # How many rings of cells within _FINE_REACH of it have a place.
        self._rings = np.zeros(self._width * (row.max(initial=0) + _FINE_REACH + 1), np.uint8)
        for ring in range(_FINE_REACH, -1, -1):
            self._rings[cell[:, None] + around[far == ring]] = _FINE_REACH + 1 - ring
        self._rings[cell[wide, None] + around] = _FINE_REACH + 1
        self._rings[0] = _FINE_REACH + 1

    def cells(self, places: Places) -> Rows:
        """Numbers of the cells at places (N,)."""
        return self.steps(places - self._corner)

    def steps(self, way: Places) -> Rows:
        """How much farther, as a difference of numbers, the cells at ways (N,) px are."""
        column, row = _grid(way * (1 / _FINE_PX) + (0.5 + 0.5j))
        return row * self._width + column

    def near(self, cells: Rows) -> Rows:
        """Which of the cells of these numbers are near; some others seem to be."""
        return np.flatnonzero(self._rings.take(cells, mode="clip") > 0)

    def within(self, places: Places, reach: Array) -> Rows:
        """Which places (N,) may be within reach (N,) px; all if that is farther than known."""
        least = _FINE_REACH - reach * (1 / _FINE_PX)
        return np.flatnonzero(self._rings.take(self.cells(places), mode="clip") > least)


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
        sky = frame.sky(positions(spots))
        telling = spots["clean"].copy()
        if before is not None:
            reach = np.full(len(sky), _REPEATED_PX)
            for row, _, distance in before.near(as_complex(sky), reach):
                telling[row[distance < _REPEATED_PX]] = False
        return cls(frame, spots, sky, np.ones(len(spots), bool), telling)

    def seen_in(self, frame: PastFrame, before: Sighting | None) -> Sighting:
        """Return the same with its frame at another place on the sky."""
        other = Sighting.of(frame, self.spots, before)
        other.free[:] = self.free
        if before is None:
            # The frame that told what is repeated has left.
            other.telling[:] = self.telling
        return other

    @cached_property
    def places(self) -> Places:
        """`sky` as complex numbers, (N,)."""
        return as_complex(self.sky)

    @cached_property
    def excess(self) -> Array:
        """Brightness of the spots over the star field's, in sigmas, (N,)."""
        return self.spots["excess"].copy()

    @cached_property
    def length(self) -> Array:
        """Length of the spots, px, (N,)."""
        return self.spots["length"].copy()

    @cached_property
    def spread(self) -> Array:
        """Std of the spots' places beside the stated one, px, (N,)."""
        return spread(self.length)

    @cached_property
    def expected(self) -> Array:
        """How many telling spots of at least each spot's strength chance gives in a frame, (N,).

        The peaks of smoothed white noise (Adler, "The geometry of random fields", 1981, for a
        Gaussian of sigma 1 px), and as many again as the frame has stronger ones, since no real
        frame is white noise alone.
        """
        height, width = self.frame.shape
        strongest = np.sort(self.excess[self.telling])
        stronger = len(strongest) - np.searchsorted(strongest, self.excess, side="right")
        return self._noise_peaks * height * width + stronger + 1

    @cached_property
    def log_density(self) -> Array:
        """Logarithm of how many there are per px^2, (N,): in the frame, or nearby if more.

        Clouds and artefacts give many spots in some places and none in others.
        """
        height, width = self.frame.shape
        nearby = np.zeros(len(self.spots))
        for one, other, distance in self.near(self.places, np.full(len(self.sky), _NEARBY_PX)):
            counts = self.telling[other] & (self.excess[other] > self.excess[one])
            counts &= distance <= _NEARBY_PX
            nearby += np.bincount(one[counts], minlength=len(nearby))
        density = self._noise_peaks + nearby / (np.pi * _NEARBY_PX**2)
        return np.log(np.maximum(density, self.expected / (height * width)))

    @property
    def _noise_peaks(self) -> Array:
        return (2 * np.pi) ** -1.5 / 2 * self.excess * np.exp(-(self.excess**2) / 2)

    @cached_property
    def index(self) -> Index:
        """The index of the spots in the sky plane."""
        return Index(self.places)

    @cached_property
    def surroundings(self) -> Surroundings:
        """The same for what is next to something."""
        return Surroundings(self.places)

    @cached_property
    def vicinity(self) -> Vicinity:
        """The map of the spots in the sky plane."""
        return Vicinity(self.places, self.length > 0)

    def near(self, places: Places, reach: Array) -> Iterator[tuple[Rows, Rows, Array]]:
        """Yield rows of places (N,), of spots that may be within reach (N,), and distances."""
        small = reach <= Surroundings.reach_px
        close, far = np.flatnonzero(small), np.flatnonzero(~small)
        if len(close):
            i, rows = self.surroundings.near(places.take(close))
            i = close.take(i)
            yield i, rows, np.abs(places.take(i) - self.places.take(rows))
        if len(far) * len(self.sky) < _FEW_PAIRS:
            distance = np.abs(places.take(far)[:, None] - self.places)
            i, rows = np.nonzero(distance <= reach.take(far)[:, None])
            yield far.take(i), rows, distance[i, rows]
        else:
            for i, count, j in self.index.ranges(places.take(far), reach.take(far)):
                i, rows = np.repeat(far.take(i), count), self.index.order.take(j)
                yield i, rows, np.abs(places.take(i) - self.places.take(rows))


def spread(length: Array) -> Array:
    """Std of a place beside its stated one, given the length of what is there, px."""
    return np.sqrt(SPREAD_PX**2 + (STREAK_SPREAD * length) ** 2)
