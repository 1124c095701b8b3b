# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Defects of the sensor: pixels that shine without light.

One that stands alone too sharply shows in a single frame (`sharp_pixels`); one that is too faint
for that, or of a few pixels, in the mean of many (`SensorMemory`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.pixels import rows_and_columns

Image = NDArray[np.float32]
Index = NDArray[np.intp]

# A star's neighbour holds at least this fraction of its peak (a Gaussian of FWHM 1.4 px or more,
# anywhere on the pixel grid); a defect's neighbours hold noise.
_DEFECT_RATIO = 0.25
_DEFECT_SIGMAS = 6.0
_NONE = np.zeros(0, np.intp)
# What smoothing by 1 px takes in on each side, px.
_MARGIN = 3
AROUND = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
# Smoothed by 1 px, a star keeps this fraction of its peak at least, one or two pixels alone 0.26
# at most; and it keeps what the others keep, less what noise and their shape may change.
_LEAST_KEPT, _KEPT_RATIO = 0.3, 0.7
_KEPT_SIGMAS = 20.0
# Stars of a strip that tell what is usual.
_STARS = 50
# Frames over which the sensor's fixed pattern is averaged at most.
_MEMORY_FRAMES = 100
# After so many frames the memory takes one part of the rows per frame: it has time.
_TRAINED_FRAMES, _PARTS = 16, 16


class SensorMemory:
    """What the sensor shows in every frame: the mean of its images less their background.

    A defect too faint for one frame, or one of a few pixels, stands out in the mean: it keeps less
    of its peak when smoothed than the stars do, which are as wide as the optics make a point.

    A frame is taken in strips of rows between `begin` and `finish`; strips may be added in any
    order and from several threads.  A trained memory takes a sixteenth of each frame.
    """

    def __init__(self) -> None:
        self._mean: Image | None = None
        self._dtype: np.dtype | None = None
        self._frames = 0
        self._turns = [0] * _PARTS
        self._noise = 1.0
        self._kept: list[NDArray[np.float64]] = []
        self._known: list[Index] = [_NONE] * _PARTS

    def begin(self, shape: tuple[int, ...], noise: float, dtype: np.dtype) -> tuple[int, int]:
        """Make ready for a frame.

        Parameters
        ----------
        shape : (height, width)
            Size of the image, px.
        noise : float
            Std of the image's background, DN.
        dtype : dtype
            Type of the camera's image.  Another size or type than before starts afresh.

        Returns
        -------
        first, last : int
            The rows that it takes of this frame, the latter left out.
        """
        if self._mean is None or self._mean.shape != shape or self._dtype != dtype:
            self.__init__()  # type: ignore[misc]
            self._mean, self._dtype = np.zeros(shape, np.float32), dtype
        due = self._due()
        for part in due:
            self._turns[part] = min(self._turns[part] + 1, _MEMORY_FRAMES)
        self._noise, self._kept = noise, []
        return self._first_row(due.start), self._first_row(due.stop)

    def add(self, rows: Image, first: int) -> None:
        """Add rows of the frame, less their background, of which `first` is the first."""
        assert self._mean is not None
        mean = self._mean[first : first + len(rows)]
        # Parts that are due together have had as many turns.
        cv2.accumulateWeighted(rows, mean, 1 / self._turns[self._due().start])
        stars = _peaks(rows, _KEPT_SIGMAS * self._noise)[:_STARS]
        self._kept.append(_kept(rows, stars))

    def finish(self) -> Index:
        """Look for defects in the mean.

        Returns
        -------
        (N,) intp
            Flat indices of the pixels known as defects, ascending.
        """
        assert self._mean is not None
        stars = np.concatenate(self._kept)
        # Squared: a streak is smoothed along one axis only, a point along both.
        usual = float(np.median(stars)) ** 2 if stars.size else 0.0
        width = self._mean.shape[1]
        for part in self._due():
            limit = _DEFECT_SIGMAS * self._noise / math.sqrt(self._turns[part])
            start, end = self._first_row(part), self._first_row(part + 1)
            top = max(0, start - _MARGIN)
            rows = self._mean[top : end + _MARGIN]
            pixels = _peaks(rows, limit)
            row = pixels // width + top
            pixels = pixels[(row >= start) & (row < end)]
            sharp = _kept(rows, pixels) < max(_LEAST_KEPT, _KEPT_RATIO * usual)
            self._known[part] = _with_leaks(rows, pixels[sharp], limit) + top * width
        self._frames += 1
        return np.unique(np.concatenate(self._known))

    def _due(self) -> range:
        """Parts of the rows that take this frame."""
        if self._frames < _TRAINED_FRAMES:
            return range(_PARTS)
        part = self._frames % _PARTS
        return range(part, part + 1)

    def _first_row(self, part: int) -> int:
        assert self._mean is not None
        return len(self._mean) * part // _PARTS


def sharp_pixels(image: Image, noise: float) -> Index:
    """Flat indices of pixels that stand alone too sharply to be an image of a star."""
    pixels = _brighter(image, _DEFECT_SIGMAS * noise)
    flat = image.ravel()
    # One neighbour tells most of them from defects.
    alone = flat.take(pixels + 1, mode="clip") < _DEFECT_RATIO * flat[pixels]
    pixels = pixels[alone | (pixels % image.shape[1] == image.shape[1] - 1)]
    highest = beside(image, pixels, AROUND).max(axis=1, initial=-np.inf)
    return pixels[highest < _DEFECT_RATIO * flat[pixels]]


def beside(image: Image, pixels: Index, steps: Sequence[tuple[int, int]]) -> Image:
    """Values of the S pixels that lie steps (dy, dx) from others, (N, S).

    Beyond a border the image is mirrored.
    """
    height, width = image.shape
    dy, dx = np.array(steps).T
    places = pixels[:, None] + (dy * width + dx)
    y, x = rows_and_columns(pixels, width)
    far = max(np.max(np.abs(steps)), 1)
    edge = (x < far) | (x >= width - far) | (y < far) | (y >= height - far)
    if edge.any():
        rows = _mirrored(y[edge, None] + dy, height)
        places[edge] = rows * width + _mirrored(x[edge, None] + dx, width)
    return image.ravel()[places]


def _mirrored(index: Index, size: int) -> Index:
    """Indices of which those a few steps outside are mirrored at the border."""
    last = size - 1
    return np.maximum(last - np.abs(last - np.abs(index)), 0)


def _with_leaks(image: Image, pixels: Index, limit: float) -> Index:
    """Pixels and those of their neighbours above a limit, where charge has leaked to."""
    if not pixels.size:
        return pixels
    around = pixels[:, None] + [dy * image.shape[1] + dx for dy, dx in AROUND]
    around = np.clip(around.ravel(), 0, image.size - 1)
    leaks = around[image.ravel()[around] > limit]
    return np.unique(np.concatenate([pixels, leaks]))


def _peaks(image: Image, limit: float) -> Index:
    """Flat indices of the local maxima above a limit."""
    pixels = _brighter(image, limit)
    highest = beside(image, pixels, AROUND).max(axis=1, initial=-np.inf)
    return pixels[highest <= image.ravel()[pixels]]


def _kept(image: Image, pixels: Index) -> NDArray[np.float64]:
    """What pixels keep of their value when smoothed by a Gaussian of 1 px, (N,)."""
    line = cv2.getGaussianKernel(7, 1.0).ravel()
    steps = [(dy, dx) for dy in range(-3, 4) for dx in range(-3, 4)]
    smoothed = beside(image, pixels, steps) @ np.outer(line, line).ravel()
    return np.asarray(smoothed / image.ravel()[pixels], np.float64)


def _brighter(image: Image, limit: float) -> Index:
    """Flat indices of the pixels above a limit."""
    return np.flatnonzero(cv2.compare(image, limit, cv2.CMP_GT).view(bool))
