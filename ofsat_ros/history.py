# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""History: the last frames, each with its place on the sky.

Stands between the motion of the star field and detection: chaining the field's motions puts every
frame of a window into one plane that is fixed to the stars, the *sky plane* (the pixels of the
frame that the history began with).  There a star stands still and an RSO does not, whatever the
mount does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.pixels import Regions, inside, interpolate, positions
from ofsat_ros.star_field import StarFieldMotion

if TYPE_CHECKING:
    from scipy.spatial import KDTree

Array = NDArray[np.float64]
Plane = NDArray[np.float32]

# How far around a pixel the envelope looks for a brighter star, px.
_AROUND = np.arange(-2, 3)
# Cubic interpolation looks this far beyond a point, px.
_MARGIN = 2


@dataclass(frozen=True)
class PastFrame:
    """One frame of the history.

    Attributes
    ----------
    number : int
        Its number in the pipeline.
    stamp_ns : int
        Its stamp, ns UTC.
    smoothed : (H, W) float32
        The smoothed image less its background, DN.
    noise : float
        Std of the background in `smoothed`, DN.
    noise_ratio : (ny, nx) float32
        Local noise over it, on a mesh of equal cells.
    objects : (N,) OBJECT_DTYPE
        Its objects.
    regions : Regions
        The objects' pixels.
    to_sky, from_sky : (3, 3) float64
        Homogeneous matrices from px to the sky plane, and back.
    bright : (M,) intp
        Flat indices, ascending, of the pixels that spots may be made of.
    blind : (H, W) bool or None
        Pixels that show no sky; None if all do.
    scatter : float
        How many times as much as stated its stars scatter about the motion that gave it its place.
    """

    number: int
    stamp_ns: int
    smoothed: Plane
    noise: float
    noise_ratio: Plane
    objects: NDArray[np.void]
    regions: Regions
    to_sky: Array
    bright: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    blind: NDArray[np.bool_] | None = None
    scatter: float = 1.0
    from_sky: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "from_sky", np.linalg.inv(self.to_sky))

    def seconds_since(self, other: PastFrame) -> float:
        """Time from another frame to this one, s."""
        return (self.stamp_ns - other.stamp_ns) / 1e9

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.smoothed.shape[0], self.smoothed.shape[1]

    @cached_property
    def object_sky(self) -> Array:
        """The objects' centroids in the sky plane, (N, 2)."""
        return self.sky(positions(self.objects))

    @cached_property
    def object_light(self) -> Array:
        """The smoothed brightness summed over each object's pixels, (N,) DN."""
        light = self.smoothed.ravel()[self.regions.pixels]
        return np.bincount(self.regions.owner, light, len(self.objects)).astype(np.float64)

    @cached_property
    def object_tree(self) -> KDTree:
        """Their places in the sky plane, for searches."""
        from scipy.spatial import KDTree  # not before it is asked for: it takes its time

        return KDTree(self.object_sky)

    def sky(self, xy: Array) -> Array:
        """Points (N, 2) px of this frame in the sky plane, (N, 2)."""
        return _transform(self.to_sky, xy)

    def pixels(self, sky: Array) -> Array:
        """Points (N, 2) of the sky plane in this frame, (N, 2) px."""
        return _transform(self.from_sky, sky)

    def contains(self, xy: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points (N, 2) px are at least `margin` px inside the image, (N,)."""
        return inside(xy, self.shape, margin)

    def light_at(self, xy: Array) -> Array:
        """Brightness of `smoothed` at points (N, 2) px, by cubic interpolation, (N,) DN."""
        x, y = np.ascontiguousarray(xy.T, np.float32)
        return interpolate(self.smoothed, x, y, cv2.INTER_CUBIC).astype(np.float64)

    def seen_by(self, others: Sequence[PastFrame], xy: NDArray[Any]) -> tuple[Plane, Plane, Plane]:
        """How other frames show the places of the sky at points of this one.

        Parameters
        ----------
        others : sequence of F PastFrame
            Frames of the same size.
        xy : (N, 2) float or int
            Points, px.

        Returns
        -------
        brightness : (F, N) float32
            Smoothed brightness by cubic interpolation, DN; NaN within 2 px of the border and
            outside, where there is nothing to interpolate between, and where a frame is blind.
        x, y : (F, N) float32
            Where the points are in each, px.
        """
        matrix = np.array([other.from_sky for other in others]) @ self.to_sky
        # Single precision knows a pixel of a large image to 0.0003.
        points = np.ascontiguousarray(xy.T, np.float32)
        x, y = (
            matrix[:, axis, :1].astype(np.float32) * points[0]
            + matrix[:, axis, 1:2].astype(np.float32) * points[1]
            + matrix[:, axis, 2:].astype(np.float32)
            for axis in (0, 1)
        )
        height, width = self.shape
        outside = (x < _MARGIN) | (x > width - 1 - _MARGIN)
        outside |= (y < _MARGIN) | (y > height - 1 - _MARGIN)
        brightness = np.stack(
            [
                interpolate(other.smoothed, across, down, cv2.INTER_CUBIC)
                for other, across, down in zip(others, x, y, strict=True)
            ]
        )
        brightness[outside] = np.nan
        for row, other in enumerate(others):
            if other.blind is not None:
                seen = np.flatnonzero(~outside[row])
                places = np.rint(np.stack([y[row, seen], x[row, seen]])).astype(np.intp)
                brightness[row, seen[other.blind[*places]]] = np.nan
        return brightness, x, y

    def noise_at(self, pixels: NDArray[np.intp]) -> Array:
        """Std of the background in `smoothed` at pixels (N, 2), (N,) DN."""
        rows, columns = self.noise_ratio.shape
        if rows * columns == 1:
            return np.full(len(pixels), self.noise * float(self.noise_ratio[0, 0]))
        x = pixels[:, 0] * columns // self.shape[1]
        y = pixels[:, 1] * rows // self.shape[0]
        return self.noise * self.noise_ratio[y, x].astype(np.float64)

    def envelope_at(self, x: Plane, y: Plane) -> Plane:
        """Highest value of `smoothed` within 2 px of the pixels nearest to points, (N,) DN.

        0 for points (x, y), (N,) px each, outside.  It says whether a pixel lies beside a star.
        """
        height, width = self.shape
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        column, row = (np.rint(np.where(inside, axis, 0)).astype(np.intp) for axis in (x, y))
        rows = np.minimum(np.maximum(row[:, None] + _AROUND, 0), height - 1) * width
        columns = np.minimum(np.maximum(column[:, None] + _AROUND, 0), width - 1)
        near = self.smoothed.ravel().take(rows[:, :, None] + columns[:, None, :])
        highest = near.reshape(len(x), len(_AROUND) ** 2).max(axis=1, initial=0)
        return np.where(inside, highest, np.float32(0))


class History:
    """The last frames, oldest first; the newest is the current one.

    Parameters
    ----------
    length : int
        How many frames are kept.
    """

    def __init__(self, length: int) -> None:
        self._frames: deque[PastFrame] = deque(maxlen=length)

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[PastFrame]:
        return iter(self._frames)

    def __getitem__(self, index: int) -> PastFrame:
        return self._frames[index]

    @property
    def length(self) -> int:
        """How many frames are kept at most."""
        return self._frames.maxlen or 0

    def clear(self) -> None:
        """Forget all frames."""
        self._frames.clear()

    def add(self, frame: PastFrame) -> None:
        """Append the next frame; the oldest is forgotten when the window is full."""
        self._frames.append(frame)

    def others(self, frame: PastFrame) -> list[PastFrame]:
        """All frames but this one, oldest first."""
        return [other for other in self._frames if other is not frame]

    def straighten(self, to_sky: Sequence[Array]) -> None:
        """Give all frames other places on the sky: matrices (3, 3) as `PastFrame.to_sky`."""
        for index, matrix in enumerate(to_sky):
            self._frames[index] = replace(self._frames[index], to_sky=matrix, scatter=1.0)

    def place(self, motion: StarFieldMotion | None, since: Array | None = None) -> Array:
        """Matrix from px of a new frame to the sky plane, (3, 3).

        Parameters
        ----------
        motion : StarFieldMotion or None
            Motion of the field from an earlier frame to the new one; None for the first frame,
            or to assume that the field did not move.
        since : (3, 3) float64, optional
            Matrix of the earlier frame; default: of the newest one.
        """
        if not self._frames:
            return np.eye(3)
        last = self._frames[-1].to_sky if since is None else since
        return last if motion is None else last @ _backwards(motion)


def _backwards(motion: StarFieldMotion) -> Array:
    """Matrix from px of the current frame to px of the previous one, (3, 3)."""
    turn = np.array([[motion.scale, -motion.rotation], [motion.rotation, motion.scale]])
    matrix = np.eye(3)
    matrix[:2, :2] -= turn
    matrix[:2, 2] = turn @ motion.centre - motion.displacement
    return matrix


def _transform(matrix: Array, xy: Array) -> Array:
    # Written out: a matrix product of two columns takes many times as long.
    x, y = xy[..., 0], xy[..., 1]
    rows = [row[0] * x + row[1] * y + row[2] for row in matrix[:2]]
    return np.stack(rows, axis=-1)
