"""History: the last frames, each with its place on the sky.

Stands between the motion of the star field and detection: chaining the field's motions puts every
frame of a window into one plane that is fixed to the stars, the *sky plane* (the pixels of the
frame that the history began with).  There a star stands still and an RSO does not, whatever the
mount does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.star_field import StarFieldMotion

Array = NDArray[np.float64]
Plane = NDArray[np.float32]

# cv2.remap takes images of points up to 32,767 on a side: a list of points becomes rows of these.
_ROW = 1024
# How far around a pixel the envelope looks for a brighter star, px.
_ENVELOPE_PX = 2
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
    labels : (H, W) int32
        1 + index of the object at each pixel, 0 for none.
    to_sky, from_sky : (3, 3) float64
        Homogeneous matrices from px to the sky plane, and back.
    """

    number: int
    stamp_ns: int
    smoothed: Plane
    noise: float
    noise_ratio: Plane
    objects: NDArray[np.void]
    labels: NDArray[np.int32]
    to_sky: Array
    from_sky: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "from_sky", np.linalg.inv(self.to_sky))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.smoothed.shape[0], self.smoothed.shape[1]

    @cached_property
    def envelope(self) -> Plane:
        """Highest value of `smoothed` within 2 px of each pixel, (H, W): is it beside a star."""
        side = 2 * _ENVELOPE_PX + 1
        return cv2.dilate(self.smoothed, np.ones((side, side), np.uint8))

    @cached_property
    def object_sky(self) -> Array:
        """The objects' centroids in the sky plane, (N, 2)."""
        return self.sky(np.stack([self.objects["x"], self.objects["y"]], axis=1))

    @cached_property
    def object_light(self) -> Array:
        """The smoothed brightness summed over each object's pixels, (N,) DN."""
        labels = self.labels.ravel()
        inside = np.flatnonzero(labels)
        light = self.smoothed.ravel()[inside]
        return np.bincount(labels[inside], light, len(self.objects) + 1)[1:].astype(np.float64)

    def sky(self, xy: Array) -> Array:
        """Points (N, 2) px of this frame in the sky plane, (N, 2)."""
        return _transform(self.to_sky, xy)

    def pixels(self, sky: Array) -> Array:
        """Points (N, 2) of the sky plane in this frame, (N, 2) px."""
        return _transform(self.from_sky, sky)

    def pixels_of(self, other: PastFrame, xy: Array) -> Array:
        """Where stars seen at points (N, 2) px of another frame are in this one, (N, 2) px."""
        return _transform(self.from_sky @ other.to_sky, xy)

    def contains(self, xy: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points (N, 2) px are at least `margin` px inside the image, (N,)."""
        height, width = self.shape
        limit = np.array([width - 1 - margin, height - 1 - margin])
        return np.all((xy >= margin) & (xy <= limit), axis=1)

    def brightness(self, xy: Array) -> Plane:
        """Smoothed brightness between the pixels by cubic interpolation, (N,) DN.

        NaN within 2 px of the border and outside, where there is nothing to interpolate between.
        """
        inside = self.contains(xy, _MARGIN)
        rows = -(-len(xy) // _ROW)
        grid = np.zeros((rows * _ROW, 2), np.float32)
        grid[: len(xy)] = np.where(inside[:, None], xy, 0)
        x, y = (np.ascontiguousarray(grid[:, axis].reshape(rows, _ROW)) for axis in (0, 1))
        if not rows:
            return np.zeros(0, np.float32)
        values = cv2.remap(self.smoothed, x, y, cv2.INTER_CUBIC).ravel()[: len(xy)]
        return np.where(inside, values, np.float32(np.nan))

    def noise_at(self, pixels: NDArray[np.intp]) -> Array:
        """Std of the background in `smoothed` at pixels (N, 2), (N,) DN."""
        rows, columns = self.noise_ratio.shape
        x = pixels[:, 0] * columns // self.shape[1]
        y = pixels[:, 1] * rows // self.shape[0]
        return self.noise * self.noise_ratio[y, x].astype(np.float64)

    def envelope_at(self, xy: Array) -> Plane:
        """`envelope` at the pixels nearest to points (N, 2) px, (N,) DN; 0 outside."""
        inside = self.contains(xy)
        x, y = np.where(inside[:, None], np.rint(xy), 0).astype(np.intp).T
        return np.where(inside, self.envelope[y, x], np.float32(0))


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

    def place(self, motion: StarFieldMotion | None) -> Array:
        """Matrix from px of a new frame to the sky plane, (3, 3).

        Parameters
        ----------
        motion : StarFieldMotion or None
            Motion of the field from the newest frame to the new one; None for the first frame,
            or to assume that the field did not move.
        """
        if not self._frames:
            return np.eye(3)
        last = self._frames[-1].to_sky
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
