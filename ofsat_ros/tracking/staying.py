# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What stays at its place on the sky is a star, however new it looked.

A star that comes out of a cloud, from behind a dome or beside a masked part of the image shines
where the frames before showed nothing.  So does an RSO; but that has left the place a few frames
later, and the star has not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import BORDER_PX, POINT_WIDTH_PX
from ofsat_ros.history import PastFrame
from ofsat_ros.pixels import positions

Array = NDArray[np.float64]

# The least way after which it can be told whether a point's light has gone, px.
_LEAST_WAY_PX = 2.0
# How surely that must be told, in sigmas of the noise.
_SURE_SIGMAS = 2.0
# What moves is seen at so many places at least.
_LEAST_PLACES = 3


def moves_on(
    paths: Sequence[Mapping[int, np.void]], frames: Mapping[int, PastFrame]
) -> list[bool]:
    """Whether the light of paths leaves the places where it was.

    Parameters
    ----------
    paths : sequence of mapping of int to SPOT_DTYPE
        Number of the frame to the spot of each path there; two at least.
    frames : mapping of int to PastFrame
        The frames by their numbers.

    Returns
    -------
    list of bool
        False for a path of which most places that can be looked at still shine, or too few do
        not: stars that came out one after the other.
    """
    if not paths:
        return []
    path = np.repeat(np.arange(len(paths)), [len(spots) for spots in paths])
    number = np.array([n for spots in paths for n in spots])
    spots = np.array([spot for one in paths for spot in one.values()])
    sky, star, new = (np.zeros((len(spots), *shape)) for shape in ((2,), (), ()))
    time = np.zeros(len(spots))
    for n, frame in frames.items():
        rows = np.flatnonzero(number == n)
        xy = positions(spots)[rows]
        sky[rows] = frame.sky(xy)
        new[rows] = spots["excess"][rows] * frame.noise_at(np.rint(xy).astype(np.intp))
        star[rows] = np.maximum(frame.light_at(xy) - new[rows], 0)
        time[rows] = frame.stamp_ns / 1e9
    speed = _speeds(path, len(paths), sky, time)[path]
    seen, still = np.zeros(len(spots), np.intp), np.zeros(len(spots), np.intp)
    for n, frame in frames.items():
        way = speed * (frame.stamp_ns / 1e9 - time) - spots["length"] / 2
        # How much of a point source is left beside it.
        least = np.exp(-(np.maximum(way, 0) ** 2) / (4 * POINT_WIDTH_PX**2))
        told = (number < n) & (way > _LEAST_WAY_PX)
        told &= (1 - least) / 2 * spots["excess"] > _SURE_SIGMAS
        rows = np.flatnonzero(told)
        xy = frame.pixels(sky[rows])
        inside = frame.contains(xy, BORDER_PX)
        rows, xy = rows[inside], xy[inside]
        seen[rows] += 1
        still[rows] += frame.light_at(xy) > star[rows] + (1 + least[rows]) / 2 * new[rows]
    stays = 2 * still > seen
    told_in, staying, places = (
        np.bincount(path, weight, len(paths)) for weight in (seen > 0, stays, ~stays)
    )
    return ((2 * staying <= told_in) & (places >= _LEAST_PLACES)).tolist()


def _speeds(path: NDArray[np.intp], count: int, sky: Array, time: Array) -> Array:
    """Speed of each path from its first to its last place, (count,) px/s."""
    first, last = np.full(count, len(path) - 1), np.zeros(count, np.intp)
    order = np.lexsort((time, path))
    first[path[order[::-1]]] = order[::-1]
    last[path[order]] = order
    way = np.hypot(*(sky[last] - sky[first]).T)
    return way / np.maximum(time[last] - time[first], 1e-9)
