# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Objects followed back through the history, and the straight lines of their paths.

Stands between the history and those that ask how objects have moved over several frames: of two
that follow each other, slow motions are in the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.history import PastFrame
from ofsat_ros.pixels import as_complex, positions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A line through fewer has no speed.
LEAST_FRAMES = 3
# What centroids scatter by beyond their stated std: blends, pixel phase, px.
CENTROID_FLOOR_PX = 0.02
# An object is sought this near to its place in the frame before, px of the sky plane.
_REACH_PX = 3.0
# Its flux may differ by this factor.
_FLUX_RATIO = 2.5
# Frames in which it may have been missed.
_MOST_MISSES = 3


class Lines:
    """Straight lines of constant speed through the paths of objects.

    Parameters
    ----------
    times : (K,) float64
        Of the frames, s.
    places : (N, K) complex128
        Places of the objects in the sky plane, x + iy px; 0 where they were not found.
    found : (N, K) bool
        Where they were; at least once each.
    """

    def __init__(self, times: Array, places: NDArray[np.complex128], found: Mask) -> None:
        self.count = found.sum(axis=1)
        self._time = found @ times / self.count
        self._place = places.sum(axis=1) / self.count
        since = np.where(found, times - self._time[:, None], 0)
        # sum of the squared times from their mean, s^2
        self.spread = np.einsum("nk,nk->n", since, since)
        slope = np.einsum("nk,nk->n", since, places) / np.maximum(self.spread, 1e-12)
        self.long_enough = self.count >= LEAST_FRAMES
        # px/s; 0 where they have no time to move
        self.velocity = np.where(self.long_enough, slope, 0)

    def at(self, t: float) -> NDArray[np.complex128]:
        """Points of the lines, (N,)."""
        return self._place + self.velocity * (t - self._time)


@dataclass(frozen=True)
class Paths:
    """Where N objects of a frame were in the frames before.

    Attributes
    ----------
    times : (K,) float64
        Of the frames since the newest, s: 0 first, and negative.
    rows : (N, K) intp
        Which object each is there; -1 where it was not found.
    places : (N, K) complex128
        Its place in the sky plane, x + iy px; 0 where it was not found.
    image : (N, K) complex128
        The same in the frame's own pixels.
    variance : (N, K) float64
        Of the centroid along one axis, px^2; 0 where it was not found.
    """

    times: Array
    rows: NDArray[np.intp]
    places: NDArray[np.complex128]
    image: NDArray[np.complex128]
    variance: Array

    @cached_property
    def found(self) -> Mask:
        """Where each was found, (N, K)."""
        return self.rows >= 0

    @cached_property
    def lines(self) -> Lines:
        """The lines through them."""
        return Lines(self.times, self.places, self.found)

    @cached_property
    def error(self) -> Array:
        """Std of their centroids along one axis, (N,) px."""
        return np.sqrt(self.variance.sum(axis=1) / self.lines.count + CENTROID_FLOOR_PX**2)


def follow(frame: PastFrame, earlier: list[PastFrame], followed: NDArray[np.intp]) -> Paths:
    """Follow objects, rows (N,) of a frame, back through those before it, the newest first."""
    times = np.array([other.seconds_since(frame) for other in (frame, *earlier)])
    objects = frame.objects[followed]
    shape = len(followed), len(times)
    rows, places = np.full(shape, -1, np.intp), np.zeros(shape, np.complex128)
    variance = np.zeros(shape)
    last = as_complex(frame.object_sky[followed])
    rows[:, 0], places[:, 0], variance[:, 0] = followed, last, centroid_variance(objects)
    misses = np.where(objects["edge"], _MOST_MISSES + 1, 0)
    for column, other in enumerate(earlier, start=1):
        before = np.s_[:, :column]
        lines = Lines(times[:column], places[before], rows[before] >= 0)
        expected = np.where(lines.long_enough, lines.at(times[column]), last)
        there = _nearest(other, as_points(expected), objects["flux"])
        near = np.flatnonzero((there >= 0) & (misses <= _MOST_MISSES))
        there = there[near]
        rows[near, column], variance[near, column] = there, centroid_variance(other.objects[there])
        last[near] = places[near, column] = as_complex(other.object_sky[there])
        misses += rows[:, column] < 0
    image = np.zeros(shape, np.complex128)
    for column, other in enumerate((frame, *earlier)):
        seen = np.flatnonzero(rows[:, column] >= 0)
        image[seen, column] = as_complex(positions(other.objects)[rows[seen, column]])
    return Paths(times, rows, places, image, variance)


def _nearest(other: PastFrame, sky: Array, flux: Array) -> NDArray[np.intp]:
    """Rows of a frame's objects that are nearest to points, in reach and alike, else -1, (N,)."""
    if not (len(sky) and len(other.objects)):
        return np.full(len(sky), -1)
    distance, row = other.object_tree.query(sky)
    return np.where((distance < _REACH_PX) & alike(other, row, flux), row, -1)


def alike(other: PastFrame, row: NDArray[np.intp], flux: Array) -> NDArray[np.bool_]:
    """Whether objects of a frame are as bright as told, (N,), and whole."""
    ratio = other.objects["flux"][row] / np.maximum(flux, 1e-9)
    return (ratio < _FLUX_RATIO) & (ratio > 1 / _FLUX_RATIO) & ~other.objects["edge"][row]


def centroid_variance(objects: NDArray[np.void]) -> Array:
    """Of a centroid along one axis, px^2."""
    return (objects["sigma_x"] ** 2 + objects["sigma_y"] ** 2) / 2


def as_points(places: NDArray[np.complex128]) -> Array:
    """Places x + iy, (N,), as rows of x and y, (N, 2)."""
    return np.stack([places.real, places.imag], axis=1)
