# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Sharpness: what keeps to its place in the sensor and is sharper than the stars is a defect.

A pixel, a column or a few pixels that begin to shine do what an RSO does that the camera follows.
But no optics made their image.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.history import PastFrame
from ofsat_ros.pixels import positions

Array = NDArray[np.float64]

# Where beside the middle light is measured, px.
_BESIDE_PX = 2.0
# Stars that tell how wide a point is: so many at least, and so bright.
_LEAST_STARS, _MOST_STARS, _STAR_SNR = 5, 50, 15.0
# A defect's image has less than this part of the variance of a star's.
_NARROWER = 0.75
_SURE_SIGMAS = 2.0
# Noise smoothed with sigma 1 px: std of the mean of two places 4 px apart, in parts of one's.
_OF_TWO = 0.72


def is_sharper_than_stars(spots: Mapping[int, np.void], frames: Mapping[int, PastFrame]) -> bool:
    """Whether what was seen is surely narrower than a star's image.

    Parameters
    ----------
    spots : mapping of int to SPOT_DTYPE
        Number of the frame to what was seen there.
    frames : mapping of int to PastFrame
        The frames by their numbers.
    """
    newest = frames[max(spots)]
    star = _left_of_stars(newest)
    if not 0 < star < 1:
        return False
    # The light beside a Gaussian falls as its variance tells.
    limit = star ** (1 / _NARROWER)
    middle, beside, noise = np.zeros(2), np.zeros(2), 0.0
    for number, spot in spots.items():
        frame = frames[number]
        place = np.rint([[spot["x"], spot["y"]]])
        middle += frame.light_at(place)
        for axis, way in enumerate(np.eye(2)):
            pair = frame.light_at(place + _BESIDE_PX * np.array([way, -way]))
            beside[axis] += pair.mean()
        noise += (_OF_TWO * frame.noise) ** 2
    return bool(np.any(beside + _SURE_SIGMAS * np.sqrt(noise) < limit * middle))


def _left_of_stars(frame: PastFrame) -> float:
    """What part of their light stars still have beside their middle; 0 if too few tell."""
    objects = frame.objects
    rows = np.flatnonzero((objects["snr"] > _STAR_SNR) & ~objects["edge"])[:_MOST_STARS]
    if len(rows) < _LEAST_STARS:
        return 0.0
    xy = positions(objects)[rows]
    # Across a streak.
    angle = objects["angle"][rows] + np.pi / 2
    way = _BESIDE_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    beside = (frame.light_at(xy + way) + frame.light_at(xy - way)) / 2
    return float(np.median(beside / np.maximum(frame.light_at(xy), 1e-9)))
