"""Pixels: lists of pixels and points, where images of them would be mostly empty.

Few pixels of a sky are bright.  What ``preprocessing`` finds above a threshold is a list of
pixels; ``objects``, ``history`` and ``detection`` work on such lists, so that their cost is that
of the light and not of the image.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]

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

    @classmethod
    def of_labels(cls, labels: NDArray[np.integer]) -> Self:
        """Build from an image (H, W) of 1 + index of the object, 0 for none."""
        pixels = np.flatnonzero(labels)
        shape = (labels.shape[0], labels.shape[1])
        return cls(shape, pixels, labels.ravel()[pixels].astype(np.intp) - 1)

    def at(self, y: Index, x: Index) -> Index:
        """Index of the object at pixels inside the image, of their shape; -1 for none."""
        if not self.pixels.size:
            return np.full(np.shape(x), -1, np.intp)
        flat = np.asarray(y) * self.shape[1] + x
        place = np.minimum(np.searchsorted(self.pixels, flat), self.pixels.size - 1)
        return np.where(self.pixels[place] == flat, self.owner[place], -1)

    def labels(self) -> NDArray[np.int32]:
        """Return the image (H, W) of 1 + index of the object, 0 for none."""
        labels = np.zeros(self.shape, np.int32)
        labels.ravel()[self.pixels] = self.owner + 1
        return labels
