# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What goes into the flow engines and what comes out of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.pixels import Regions, inside

Array = NDArray[np.float64]
Plane = NDArray[np.float32]

# What Lucas-Kanade adds to the uncertainty of two centroids, px (measured: docs/algorithm.md).
_FLOW_FLOOR_PX = 0.02
# The brightness at the two ends of a vector may differ by this factor, beyond the noise.
_BRIGHTNESS_RATIO = 2.0


@dataclass(frozen=True)
class FlowInput:
    """What the engines need of one frame.

    Attributes
    ----------
    smoothed : (H, W) float32
        Smoothed image less its background, DN.
    above : (M,) intp
        Flat indices of the pixels above the threshold.
    pedestal : float
        What I_s as published holds of the background, DN.
    regions : Regions
        The objects' pixels.
    xy : (N, 2) float64
        Centroids of the objects, px.
    sigma : (N, 2) float64
        Their std, px.
    length : (N,) float64
        Length of their streaks, px; 0 for a point.
    noise : float
        Std of the background in `smoothed`, DN.
    """

    smoothed: Plane
    above: NDArray[np.intp]
    pedestal: float
    regions: Regions
    xy: Array
    sigma: Array
    length: Array
    noise: float

    @property
    def mask(self) -> NDArray[np.uint8]:
        """1 above the threshold, else 0, (H, W)."""
        mask = np.zeros(self.smoothed.shape, np.uint8)
        mask.ravel()[self.above] = 1
        return mask

    @property
    def filtered(self) -> Plane:
        """I_f as published, (H, W): I_s where it is above the threshold, elsewhere 0."""
        return (self.smoothed + np.float32(self.pedestal)) * self.mask

    def brightness_at(self, xy: Array) -> Array:
        """Smoothed brightness between the pixels, DN: bilinear interpolation.

        Parameters
        ----------
        xy : (N, 2) float64
            Points, px; those outside take the value at the border.

        Returns
        -------
        (N,) float64
        """
        # cv2.remap knows 32nds of a pixel only
        limit = np.array(self.smoothed.shape[::-1]) - 1
        near = np.clip(xy, 0, limit)
        x, y = np.minimum(near.astype(np.intp), limit - 1).T
        fx, fy = near[:, 0] - x, near[:, 1] - y
        top = self.smoothed[y, x] * (1 - fx) + self.smoothed[y, x + 1] * fx
        bottom = self.smoothed[y + 1, x] * (1 - fx) + self.smoothed[y + 1, x + 1] * fx
        return top * (1 - fy) + bottom * fy

    def contains(self, xy: Array) -> NDArray[np.bool_]:
        """Whether points (N, 2) lie inside the image, (N,)."""
        return inside(xy, self.smoothed.shape)

    def object_at(self, xy: Array) -> NDArray[np.intp]:
        """Index of the object at points (N, 2) inside the image, (N,); -1 for none."""
        x, y = np.rint(xy).astype(np.intp).T
        return self.regions.at(y, x)

    def displacement_sigma(self) -> Array:
        """Std of each object's displacement, (N, 2) px: two such centroids, and the flow's own."""
        return np.sqrt(2 * self.sigma**2 + _FLOW_FLOOR_PX**2)


@dataclass(frozen=True)
class Flow:
    """Flow vectors, one a row; there may be none.

    Attributes
    ----------
    position : (N, 2) float64
        Where the vector ends: in the current frame, px.
    displacement : (N, 2) float64
        Current minus previous, px per frame.
    sigma : (N, 2) float64
        Std of the displacement, px.
    valid : (N,) bool
        Whether the vector is a measurement: found, inside both frames, brightness kept.
    object_index : (N,) int
        Object of the current frame that it belongs to, -1 for none.
    speed_mean, speed_median, speed_min, speed_max : (N,) float64
        Of the norms of the vectors that were combined into this one, px per frame.
    """

    position: Array
    displacement: Array
    sigma: Array
    valid: NDArray[np.bool_]
    object_index: NDArray[np.intp]
    speed_mean: Array
    speed_median: Array
    speed_min: Array
    speed_max: Array

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def of_vectors(
        cls,
        position: Array,
        displacement: Array,
        sigma: Array,
        valid: NDArray[np.bool_],
        object_index: NDArray[np.intp],
    ) -> Flow:
        """Build from single vectors, whose speed statistics are all their own speed."""
        speed = np.hypot(*displacement.T)
        return cls(position, displacement, sigma, valid, object_index, speed, speed, speed, speed)

    @classmethod
    def empty(cls) -> Flow:
        """Flow of a frame without vectors."""
        pair, none = np.zeros((0, 2)), np.zeros(0)
        return cls.of_vectors(pair, pair, pair, none.astype(bool), none.astype(np.intp))


class FlowEngine(Protocol):
    """The common front of the two engines."""

    def measure(self, previous: FlowInput, current: FlowInput, guesses: Array) -> Flow:
        """Measure the flow from `previous` to `current`.

        Parameters
        ----------
        previous, current : FlowInput
            Two frames of the same size.
        guesses : (K, 2) float64
            Displacements to start from, px per frame, the likeliest first; K >= 1.  Native
            targets use the first only.

        Returns
        -------
        Flow
        """
        ...


def brightness_kept(
    previous: FlowInput, current: FlowInput, start: Array, end: Array
) -> NDArray[np.bool_]:
    """Whether the smoothed brightness is the same at both ends of each vector (N,).

    Lucas-Kanade rests on constant brightness; a vector that ends where the previous frame was dark
    measured nothing.
    """
    before, now = previous.brightness_at(start), current.brightness_at(end)
    slack = 3 * (previous.noise + current.noise)
    similar = (now <= _BRIGHTNESS_RATIO * before + slack) & (
        before <= _BRIGHTNESS_RATIO * now + slack
    )
    return similar & previous.contains(start) & (before > 2 * previous.noise)
