# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pixels: lists of pixels and points, where images of them would be mostly empty.

Few pixels of a sky are bright.  What ``preprocessing`` finds above a threshold is a list of
pixels; ``objects``, ``history`` and ``detection`` work on such lists, so that their cost is that
of the light and not of the image.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]

# Spots are made of pixels above this many local sigmas: what one stage lists for another.
SPOT_PIXEL_SIGMAS = 2.5
# A long list of points becomes rows of these.
_ROW = 1024


def connected(pixels: Index, width: int) -> tuple[Index, int]:
    """Label connected pixels; those at a corner count as connected.

    Parameters
    ----------
    pixels : (M,) intp
        Flat indices y * width + x of the pixels, ascending.
    width : int
        Width of the image, px.

    Returns
    -------
    labels : (M,) intp
        Number of the region of each pixel, from 0, in the order of their first pixels.
    count : int
        How many regions there are.
    """
    if not pixels.size:
        return np.zeros(0, np.intp), 0
    # With one column more than there is, the end of a row does not touch the next one's start.
    key = pixels + pixels // width
    starts = np.flatnonzero(np.diff(key, prepend=-2) != 1)
    ends = np.append(starts[1:], pixels.size)
    first, last = key[starts], key[ends - 1]
    # Runs of the next row that reach under this one, or touch it by a corner.
    low = np.searchsorted(last, first + width)
    number = np.searchsorted(first, last + width + 2, side="right") - low
    upper = np.repeat(np.arange(starts.size), number)
    lower = np.arange(upper.size) + np.repeat(low - np.cumsum(number) + number, number)
    root = _roots(starts.size, upper, lower)
    is_root = root == np.arange(root.size)
    of_run = (np.cumsum(is_root) - 1)[root]
    return np.repeat(of_run, ends - starts), int(np.count_nonzero(is_root))


def _roots(count: int, one: Index, other: Index) -> Index:
    """The lowest number that each of `count` is connected to by pairs."""
    root = np.arange(count)
    while one.size:
        a, b = root[one], root[other]
        apart = a != b
        one, other, a, b = one[apart], other[apart], a[apart], b[apart]
        np.minimum.at(root, np.maximum(a, b), np.minimum(a, b))
        # Every chain is made one step long.
        shorter = root[root]
        while not np.array_equal(shorter, root):
            root, shorter = shorter, shorter[shorter]
    return root


def rows_and_columns(pixels: Index, width: int) -> tuple[Index, Index]:
    """Row and column of flat indices; many times as fast as `np.divmod`."""
    row = pixels // width
    return row, pixels - row * width


def positions(rows: NDArray[np.void]) -> NDArray[np.float64]:
    """Places x, y of the rows of a table, (N, 2) px."""
    return np.stack([rows["x"], rows["y"]], axis=1)


def as_complex(xy: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Points (N, 2) as x + iy, (N,), which take half as many operations."""
    return xy[:, 0] + 1j * xy[:, 1]


def inside(
    xy: NDArray[np.floating], shape: tuple[int, ...], margin: float = 0.0
) -> NDArray[np.bool_]:
    """Whether points (N, 2) px are at least `margin` px inside an image of (height, width)."""
    x, y = xy[:, 0], xy[:, 1]
    across = (x >= margin) & (x <= shape[1] - 1 - margin)
    return across & (y >= margin) & (y <= shape[0] - 1 - margin)


def streak_of(
    xx: NDArray[np.float64],
    yy: NDArray[np.float64],
    xy: NDArray[np.float64],
    snr: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Length of streaks, px, 0 for what is round, and their angle, rad in (-pi/2, pi/2].

    Of their second moments, px^2, each (N,): a uniform line of length L adds L^2/12 along itself.
    """
    split = np.hypot((xx - yy) / 2, xy)
    # What is round has moments that differ by chance: by its SNR (97 % of them by less than
    # this), and by the pixel grid.
    chance = np.maximum(0.25, 10 / np.maximum(snr, 1)) * ((xx + yy) / 2 - split)
    length = np.where(2 * split > chance, np.sqrt(24 * split), 0)
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return length, np.where(angle <= -np.pi / 2, np.pi / 2, angle)


def interpolate(
    plane: NDArray[np.float32], x: NDArray[np.floating], y: NDArray[np.floating], how: int
) -> NDArray[np.float32]:
    """Values of an image between its pixels.

    Parameters
    ----------
    plane : (H, W) float32
        The image.
    x, y : (N,) float
        Points, px; outside, the image goes on as its border is.
    how : int
        OpenCV's constant of the interpolation, `cv2.INTER_LINEAR` or `cv2.INTER_CUBIC`.

    Returns
    -------
    (N,) float32
    """
    count = len(x)
    if count == 0:
        return np.zeros(0, np.float32)
    # cv2.remap takes images of points up to 32,767 on a side.
    rows = 1 if count < _ROW else -(-count // _ROW)
    maps = np.zeros((2, rows * _ROW if rows > 1 else count), np.float32)
    maps[0, :count], maps[1, :count] = x, y
    x_map, y_map = maps.reshape(2, rows, -1)
    values = cv2.remap(plane, x_map, y_map, how, borderMode=cv2.BORDER_REPLICATE)
    return values.ravel()[:count]


@dataclass(frozen=True)
class Regions:
    """Which object each pixel of an image belongs to.

    Attributes
    ----------
    shape : (height, width)
        Size of the image, px.
    pixels : (M,) intp
        Flat indices of the pixels that belong to an object, ascending.
    owner : (M,) intp
        Index of the object of each.
    """

    shape: tuple[int, int]
    pixels: Index = field(default_factory=lambda: np.zeros(0, np.intp))
    owner: Index = field(default_factory=lambda: np.zeros(0, np.intp))

    def at(self, y: Index, x: Index) -> Index:
        """Index of the object at pixels inside the image, of their shape; -1 for none."""
        if not self.pixels.size:
            return np.full(np.shape(x), -1, np.intp)
        flat = np.asarray(y) * self.shape[1] + x
        place = np.minimum(np.searchsorted(self.pixels, flat), self.pixels.size - 1)
        return np.where(self.pixels[place] == flat, self.owner[place], -1)
