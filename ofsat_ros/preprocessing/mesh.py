# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Meshes: background and noise on a grid of equal cells over the image.

Statistics of a subsample: 256 values of a cell at least tell its level to 3 % of the noise of one
pixel, and its noise to 4 %, with those of the cells around to 2 %.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.parallel import in_parallel
from ofsat_ros.pixels import interpolate

Image = NDArray[np.float32]

# Samples of an image, and of a cell per side at least and at most.
_SAMPLES, _LEAST, _MOST = 2**16, 16, 32
# Cells whose samples a processor's cache holds.
_CELLS_AT_ONCE = 512


def cells(
    image: NDArray[np.generic],
    mesh: tuple[int, int],
    exact: bool = True,
    samples: int = _SAMPLES,
) -> Image:
    """Sample every cell of an image evenly.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
        The image.
    mesh : (ny, nx)
        Number of cells.
    exact : bool
        Whether a sample is one pixel, as it is, or the mean of the four around its place.
    samples : int
        How many are wanted of the whole image; a cell has 256 at least.

    Returns
    -------
    (ny * nx, n) float32
        The samples of each cell, row by row.
    """
    rows, columns = mesh
    most = _MOST if rows * columns > 1 else 16 * _MOST
    side = int(np.clip(math.sqrt(samples / (rows * columns)), _LEAST, most))
    size = (columns * side, rows * side)
    if exact:
        # Nearest-neighbour resizing is an even subsample of every cell, whatever the image's size.
        some = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    else:
        # Means of 8 bits must not be rounded to 8 bits: a dark sky's noise is less than that.
        fine = image.astype(np.float32) if image.dtype == np.uint8 else image
        some = cv2.resize(fine, size, interpolation=cv2.INTER_LINEAR)
    some = some.reshape(rows, side, columns, side).transpose(0, 2, 1, 3)
    return some.reshape(rows * columns, side * side).astype(np.float32)


def statistics(
    values: Image, mesh: tuple[int, int], floor: float, reach: float = 1.0
) -> tuple[Image, Image]:
    """Clipped mean and std of each cell, the stars left out.

    Parameters
    ----------
    values : (ny * nx, n) float32
        Samples of each cell; they are changed.
    mesh : (ny, nx)
        Number of cells.
    floor : float
        Std of rounding: no std is less.
    reach : float
        A level farther than this from those around it, in std, is a bright star's.

    Returns
    -------
    level, spread : (ny, nx) float32
    """
    level, spread = (part.reshape(mesh) for part in clipped(values, floor))
    if min(mesh) >= 3:
        # A cell filled by a bright star takes its neighbours' values; others keep their level,
        # since medians flatten a curved background.
        near, spread = (cv2.medianBlur(_continued(m), 3)[1:-1, 1:-1] for m in (level, spread))
        level = np.where(np.abs(level - near) <= reach * spread, level, near)
    return level, np.ascontiguousarray(spread)


def clipped(values: Image, floor: float) -> tuple[Image, Image]:
    """Mean and std along the rows, (N, 1) each, of what is within 3 std; `values` are changed."""
    parts = in_parallel(
        lambda first: _clipped(values[first : first + _CELLS_AT_ONCE], floor),
        range(0, len(values), _CELLS_AT_ONCE),
    )
    mean, std = (np.concatenate(part) for part in zip(*parts, strict=True))
    return mean, std


def _clipped(values: Image, floor: float) -> tuple[Image, Image]:
    middle = _median(values)
    values -= middle
    deviation = np.abs(values)
    spread = 1.4826 * _median(deviation)
    shift = np.zeros_like(spread)
    for turn in range(2):
        # The slack keeps the neighbouring grey levels when most of a cell has one value.
        limit = 3 * spread + np.float32(3.5 * floor)
        if turn:
            np.abs(np.subtract(values, shift, out=deviation), out=deviation)
        inside = deviation <= limit
        number = np.count_nonzero(inside, axis=1)[:, None].astype(np.float32)
        kept = np.multiply(values, inside, out=deviation)
        shift = kept.sum(axis=1, keepdims=True) / number
        variance = np.einsum("ij,ij->i", kept, kept)[:, None] / number - shift**2
        # 0.9866: the std that is left of a normal distribution clipped at 3 sigma
        spread = np.sqrt(np.maximum(variance, 0)) / np.float32(0.9866)
    return middle + shift, np.maximum(spread, np.float32(floor))


def _median(values: Image) -> Image:
    """Median along the rows, (N, 1); of an even number, the upper of the middle two."""
    middle = values.shape[1] // 2
    return np.partition(values, middle, axis=1)[:, middle : middle + 1]


class BackgroundMap:
    """A mesh of levels interpolated between its cells, and continued to the image's border.

    Parameters
    ----------
    level : (ny, nx) float32
        Levels of the cells.
    shape : (height, width)
        Size of the image, px.
    """

    def __init__(self, level: Image, shape: tuple[int, ...]) -> None:
        self._mesh = _continued(level)
        # To whole pixels: what the background rises by in one is far under the noise.
        (self._top, self._rows), (self._left, self._columns) = (
            (round(size / count), round(size + 2 * size / count))
            for size, count in zip(shape, level.shape, strict=True)
        )
        # At all columns, but only at the mesh's rows.
        wide = cv2.resize(self._mesh, (self._columns, len(self._mesh)))
        self._wide = np.ascontiguousarray(wide[:, self._left : self._left + shape[1]])

    def subtracted(self, image: NDArray[np.generic], first: int, out: Image) -> Image:
        """Write rows of the image, of which `first` is the first, less the levels to `out`."""
        place = self._place(np.arange(len(image)) + first, self._top, len(self._mesh), self._rows)
        cells = np.minimum(place.astype(np.intp), len(self._mesh) - 2)
        # All rows between the same two of the mesh at once, while the cache holds them.
        for cell in range(cells[0], cells[-1] + 1):
            start, end = np.searchsorted(cells, (cell, cell + 1))
            weight = (place[start:end, None] - cell).astype(np.float32)
            part = out[start:end]
            np.multiply(weight, self._wide[cell + 1] - self._wide[cell], out=part)
            part += self._wide[cell]
            np.subtract(image[start:end], part, out=part)
        return out

    def at(self, y: NDArray[np.integer], x: NDArray[np.integer]) -> Image:
        """Levels at pixels, (N,)."""
        rows, columns = self._mesh.shape
        return interpolate(
            self._mesh,
            self._place(x, self._left, columns, self._columns),
            self._place(y, self._top, rows, self._rows),
            cv2.INTER_LINEAR,
        )

    @staticmethod
    def _place(pixel: NDArray[np.integer], margin: int, cells: int, size: int) -> NDArray:
        """Where pixels lie among the centres of the mesh's cells along one axis."""
        place = (pixel + (margin + 0.5)) * (cells / size) - 0.5
        return np.minimum(np.maximum(place, 0), cells - 1)


def _continued(mesh: Image) -> Image:
    """A mesh with one more cell on each side, (ny + 2, nx + 2).

    It goes on by the last step, or twice the one before if that is less, in the same direction:
    a gradient or vignetting goes on, the shadow of an occulter does not.
    """
    for _ in range(2):
        ends = []
        for side in (mesh, mesh[::-1]):
            outer, inner = side[0], side[min(1, len(side) - 1)]
            first, limit = outer - inner, 2 * (inner - side[min(2, len(side) - 1)])
            step = np.minimum(np.maximum(first, np.minimum(limit, 0)), np.maximum(limit, 0))
            ends.append(outer + step)
        mesh = np.vstack([ends[0], mesh, ends[1]]).T
    return np.ascontiguousarray(mesh)


def sample(mesh: Image, y: NDArray[np.integer], x: NDArray[np.integer], shape: tuple) -> Image:
    """Values of a mesh, interpolated between its cells, at pixels of an image of `shape`, (N,)."""
    rows, columns = mesh.shape
    if rows * columns == 1:
        return np.full(len(x), mesh[0, 0], np.float32)
    u, v = (x + 0.5) * (columns / shape[1]) - 0.5, (y + 0.5) * (rows / shape[0]) - 0.5
    return interpolate(mesh, u, v, cv2.INTER_LINEAR)
