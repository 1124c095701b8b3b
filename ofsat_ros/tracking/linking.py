# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
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

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import BORDER_PX
from ofsat_ros.tracking.sightings import Places, Sighting, Vicinity

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

# A path starts with a spot of the newest frame and one of these frames before it.
_PAIR_AGES = 2
# Without a third spot when this one before the newest is searched, too, it is none.
_PATIENCE = 2
_GATE_SIGMAS = 3.0
# No gate is larger than this, px, and this part of the streak's length.
_LARGEST_GATE_PX, _GATE_LENGTH = 6.0, 0.3
# Two spots of one RSO differ by less than this factor in brightness, also when it tumbles.
_BRIGHTNESS_RATIO = 5.0
# A near partner is less likely chance's than a far one: its number goes with the area, down to
# this part of it, since artefacts keep together.
_SCALES, _LEAST_AREA = 8, 0.25
# The least way on the sky that is motion, px.
_LEAST_WAY_PX = 2.0


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
    started = []
    for age, (a, b) in enumerate(_pairs(newest, earlier, max_speed_px), 1):
        paths = _Paths(newest, earlier[age - 1], a, b)
        paths.extend(earlier[_PAIR_AGES - age])
        started.append(paths)
    paths = _Paths.of_all(started)
    for checked, other in enumerate(earlier[_PAIR_AGES:], _PAIR_AGES):
        paths.extend(other)
        if checked == _PATIENCE:
            paths = paths.only(paths.count >= 3)
    links: list[Link] = []
    taken: set[tuple[int, int]] = set()
    for link in sorted(paths.surest(log_limit - np.log(_PAIR_AGES)), key=lambda o: o.log_false):
        if taken.isdisjoint(link.rows.items()):
            taken.update(link.rows.items())
            links.append(link)
    return links


def _pairs(
    newest: Sighting, earlier: list[Sighting], max_speed_px: float
) -> list[tuple[Rows, Rows]]:
    """For each age, the pairs that may have a third spot in one of the next two frames.

    Three spots on a line are found from any two of them: soonest from those in frames that follow
    each other, of which the fewest are within reach.  Of all pairs, few have a third: the test
    that tells costs two look-ups and a sum.  Only if a streak's length allows for more than
    `Vicinity` knows, they are found from the two that start the path.
    """
    one, two = earlier[:2]
    # In the order of the index: what neighbours need is in the cache.
    ends, starts = (
        seen.index.order[(seen.free & seen.telling)[seen.index.order]] for seen in (newest, two)
    )
    reach, far = max_speed_px, 2 * max_speed_px
    # A path of the largest reach to the older frame passes the one between this near.
    between = max(reach, far * _part(newest, two, one) + Vicinity.reach_px)
    (a, b, c), *more = _aligned(newest, ends, one, earlier[1:3], between)
    first = [(a, b), *(lines[:2] for lines in more)]
    long = starts[two.spread[starts] > _known_spread(newest, one, two)]
    ((other_c, other_a, _),) = _aligned(two, long, newest, [one], far)
    second = [(a, c), (other_a, other_c)]
    for three in earlier[2:3]:
        before = far * abs(_part(newest, two, three) - 1) + Vicinity.reach_px
        ((c, _, a),) = _aligned(two, starts, three, [newest], before)
        long = ends[newest.spread[ends] > _known_spread(two, three, newest)]
        ((other_a, other_c, _),) = _aligned(newest, long, two, [three], far)
        second += [(a, c), (other_a, other_c)]
    return [_distinct(newest, one, first, reach), _distinct(newest, two, second, far)]


def _distinct(
    newest: Sighting, other: Sighting, pairs: list[tuple[Rows, Rows]], reach_px: float
) -> tuple[Rows, Rows]:
    """Of pairs found several times, those that may start a path, once each."""
    a, b = (np.concatenate(rows) for rows in zip(*pairs, strict=True))
    ratio = newest.excess[a] / other.excess[b]
    good = (ratio < _BRIGHTNESS_RATIO) & (ratio > 1 / _BRIGHTNESS_RATIO)
    good &= (newest.free & newest.telling)[a] & (other.free & other.telling)[b]
    good &= np.abs(newest.places[a] - other.places[b]) <= reach_px
    number = np.sort(a[good] * len(other.spots) + b[good])
    a, b = np.divmod(number[np.diff(number, prepend=-1) > 0], max(len(other.spots), 1))
    return a, b


def _aligned(
    one: Sighting, rows: Rows, other: Sighting, thirds: Sequence[Sighting], reach_px: float
) -> list[tuple[Rows, Rows, Rows]]:
    """For each third frame, rows of three spots that lie on a line.

    The first two, some of the first frame's and any of the other's, are within reach.
    """
    lines = [_Lines(one, rows, other, third) for third in thirds]
    for pairs in other.index.ranges(one.places[rows], np.full(len(rows), reach_px)):
        for line in lines:
            line.seek(*pairs)
    return [line.found() for line in lines]


class _Lines:
    """Lines through some spots of two frames, and free spots of a third that lie on them."""

    def __init__(self, one: Sighting, rows: Rows, other: Sighting, third: Sighting) -> None:
        order, part = other.index.order, _part(one, other, third)
        self._gate, self._known = _line_gate(one, other, third), _known_spread(one, other, third)
        self._rows, self._order, self._third = rows, order, third
        self._spreads = one.spread[rows], other.spread[order]
        # The place on the line is a sum of what each of the two gives, and so is its cell.
        self._begin, self._way = (1 - part) * one.places[rows], part * other.places[order]
        self._cells = third.vicinity.cells(self._begin)
        self._steps = third.vicinity.steps(self._way)
        self._cells[self._spreads[0] > self._known] = Vicinity.anywhere
        self._steps[self._spreads[1] > self._known] = Vicinity.anywhere
        self._found = [(rows[:0], rows[:0], rows[:0])]

    def seek(self, i: Rows, count: Rows, j: Rows) -> None:
        """Look for spots on the lines through rows[i], each so often, and order[j]."""
        third, gate = self._third, self._gate
        cells = self._cells.take(i).repeat(count)
        cells += self._steps.take(j)
        near = third.vicinity.near(cells)
        i, j = i.repeat(count).take(near), j.take(near)
        place = self._begin.take(i) + self._way.take(j)
        spread = np.maximum(self._spreads[0].take(i), self._spreads[1].take(j))
        near = third.vicinity.within(place, gate * spread)
        i, j, spread, place = i.take(near), j.take(near), spread.take(near), place.take(near)
        for n, k, distance in third.near(place, gate * np.maximum(spread, self._known)):
            good = distance <= gate * np.maximum(spread.take(n), third.spread.take(k))
            on_line = np.flatnonzero(good & third.free.take(k))
            n, k = n.take(on_line), k.take(on_line)
            self._found.append((self._rows.take(i.take(n)), self._order.take(j.take(n)), k))

    def found(self) -> tuple[Rows, Rows, Rows]:
        """Rows of the three spots of each line."""
        one, other, third = (np.concatenate(rows) for rows in zip(*self._found, strict=True))
        return one, other, third


def _part(one: Sighting, other: Sighting, third: Sighting) -> float:
    """Where between the times of the first two, 0 and 1, that of the third is."""
    return third.frame.seconds_since(one.frame) / other.frame.seconds_since(one.frame)


def _line_gate(one: Sighting, other: Sighting, third: Sighting) -> float:
    """How far from the line through two spots a third may be, in spreads."""
    part = _part(one, other, third)
    return _GATE_SIGMAS * math.sqrt((1 - part) ** 2 + part**2 + 1)


def _known_spread(one: Sighting, other: Sighting, third: Sighting) -> float:
    """The largest spread of spots for which `Vicinity` knows whether a third is on the line."""
    return Vicinity.reach_px / _line_gate(one, other, third)


class _Paths:
    """Paths through two or more spots each, as sums for straight lines through them."""

    def __init__(self, newest: Sighting, other: Sighting, a: Rows, b: Rows) -> None:
        self._newest = newest
        self._rows = {newest.frame.number: a, other.frame.number: b}
        t = other.frame.seconds_since(newest.frame)
        self.count = np.full(len(a), 2.0)
        self._t, self._tt = np.full(len(a), t), np.full(len(a), t * t)
        self._xy = newest.places[a] + other.places[b]
        self._txy = other.places[b] * t
        self._span = np.full(len(a), -t)
        # The line: its mean time, one over the sum of squared times from it, its place at the
        # newest frame's time, and its velocity.
        self._mean, self._leverage = np.empty(len(a)), np.empty(len(a))
        self._origin, self._velocity = np.empty_like(self._xy), np.empty_like(self._xy)
        self._fit(np.arange(len(a)))
        # Frames in which a path could be seen, and those of them up to its oldest spot.
        self._visible = np.full(len(a), 2)
        self._since_first = np.full(len(a), 2)
        height, width = newest.frame.shape
        reach = np.abs(newest.places[a] - other.places[b])
        area = _SCALES * np.pi * reach**2 / (height * width)
        partners = other.expected[b] * np.clip(area, _LEAST_AREA, 1)
        self._log_false = np.log(newest.expected[a] * partners)
        self._length = np.maximum(newest.length[a], other.length[b])
        self._spread = np.maximum(newest.spread[a], other.spread[b])
        self._strength = np.sqrt(newest.excess[a] * other.excess[b])

    @classmethod
    def of_all(cls, parts: list[_Paths]) -> _Paths:
        """Join paths that were looked for in the same frames."""
        whole = cls.__new__(cls)
        for name, value in vars(parts[0]).items():
            if isinstance(value, np.ndarray):
                value = np.concatenate([vars(part)[name] for part in parts])
            setattr(whole, name, value)
        whole._rows = {
            number: np.concatenate([part._rows[number] for part in parts])
            for number in parts[0]._rows
        }
        return whole

    def only(self, these: NDArray[np.bool_]) -> _Paths:
        """Return these paths."""
        keep = np.flatnonzero(these)
        kept = _Paths.__new__(_Paths)
        for name, value in vars(self).items():
            setattr(kept, name, value.take(keep) if isinstance(value, np.ndarray) else value)
        kept._rows = {number: rows.take(keep) for number, rows in self._rows.items()}
        return kept

    def _fit(self, rows: Rows) -> None:
        """Lay the lines of these paths through their spots."""
        count, t, xy = self.count.take(rows), self._t.take(rows), self._xy.take(rows)
        mean = t / count
        leverage = 1 / (self._tt.take(rows) - t * mean)
        velocity = (self._txy.take(rows) - mean * xy) * leverage
        self._mean[rows], self._leverage[rows], self._velocity[rows] = mean, leverage, velocity
        self._origin[rows] = xy / count - velocity * mean

    def extend(self, other: Sighting) -> None:
        """Add to each path the spot of another frame that is nearest to it, if one is near."""
        t = other.frame.seconds_since(self._newest.frame)
        expected = self._origin + t * self._velocity
        rows = np.full(len(expected), -1, np.intp)
        self._rows[other.frame.number] = rows
        visible = _is_visible(other, expected)
        self._visible += visible
        # Most places are far from all spots, which is soon told.
        largest = _LARGEST_GATE_PX + _GATE_LENGTH * self._length
        near = other.vicinity.within(expected, largest)
        seen = near[visible.take(near)]
        variance = 1 + 1 / self.count.take(seen)
        variance += (t - self._mean.take(seen)) ** 2 * self._leverage.take(seen)
        error = self._spread.take(seen) * np.sqrt(variance)
        gate = np.minimum(_GATE_SIGMAS * error, largest.take(seen))
        near, spot, distance = _nearest(other, expected.take(seen), gate)
        seen, error = seen.take(near), error.take(near)
        area = np.pi * np.maximum(distance, 1.2 * error) ** 2
        gain = np.where(other.telling[spot], np.log(area) + other.log_density[spot], 0.0)
        ratio = other.excess[spot] / self._strength[seen]
        good = (gain < 0.5) & (ratio < _BRIGHTNESS_RATIO) & (ratio > 1 / _BRIGHTNESS_RATIO)
        seen, spot = seen[good], spot[good]
        rows[seen] = spot
        self._log_false[seen] += gain[good]
        self.count[seen] += 1
        self._t[seen] += t
        self._tt[seen] += t * t
        self._xy[seen] += other.places[spot]
        self._txy[seen] += t * other.places[spot]
        self._span[seen] = np.maximum(self._span[seen], -t)
        self._since_first[seen] = self._visible[seen]
        self._fit(seen)

    def surest(self, log_limit: float) -> list[Link]:
        """Paths that chance explains less often than the limit."""
        # What chance could choose only makes them less sure.
        paths = self.only((self._log_false < log_limit) & (self.count >= 3))
        k, n = paths.count.astype(np.intp), paths._since_first
        # When it began, and in which frames between it was missed, is what chance could choose.
        log_gamma = np.array([math.inf, *map(math.lgamma, range(1, n.max(initial=0) + 1))])
        choices = (
            log_gamma[n - 1]
            - log_gamma[k - 1]
            - log_gamma[n - k + 1]
            + np.log(np.maximum(paths._visible - 2, 1))
        )
        log_false = paths._log_false + choices
        way = np.abs(paths._velocity) * paths._span
        error = paths._spread * np.sqrt(paths._leverage) * paths._span
        good = (log_false < log_limit) & (way > _LEAST_WAY_PX) & (way > 6 * error)
        return [
            Link(
                {number: int(r[path]) for number, r in paths._rows.items() if r[path] >= 0},
                float(log_false[path]),
            )
            for path in np.flatnonzero(good)
        ]


def _is_visible(other: Sighting, places: Places) -> NDArray[np.bool_]:
    """Whether places in the sky plane are surely inside the image of a frame, (N,)."""
    height, width = other.frame.shape
    (xx, xy, x0), (yx, yy, y0) = other.frame.from_sky[:2].tolist()
    x, y = np.ascontiguousarray(places.real), np.ascontiguousarray(places.imag)
    column, row = xx * x + xy * y + x0, yx * x + yy * y + y0
    inside = (column >= BORDER_PX) & (column <= width - 1 - BORDER_PX)
    return inside & (row >= BORDER_PX) & (row <= height - 1 - BORDER_PX)


def _nearest(other: Sighting, places: Places, gate: Array) -> tuple[Rows, Rows, Array]:
    """Rows of the places with a free spot within their gates, of the nearest such, and how far."""
    none = np.zeros(0, np.intp)
    found = [(none, none, gate[:0])]
    for i, spot, distance in other.near(places, gate):
        good = np.flatnonzero((distance < gate.take(i)) & other.free.take(spot))
        found.append((i.take(good), spot.take(good), distance.take(good)))
    i, spot, distance = (np.concatenate(part) for part in zip(*found, strict=True))
    least = np.full(len(places), np.inf)
    np.minimum.at(least, i, distance)
    best = np.flatnonzero(distance == least.take(i))
    # What belongs to one place is together.
    best = best[np.flatnonzero(np.diff(i.take(best), prepend=-1))]
    return i.take(best), spot.take(best), distance.take(best)
