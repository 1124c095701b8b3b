# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The sparse engine: Lucas-Kanade at points, by OpenCV."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.optical_flow.flow import Array, Flow, FlowInput, Plane, brightness_kept
from ofsat_ros.parameters import Parameters

Image = NDArray[np.uint8]

# The 8 bits of the stretch "noise": where they start and what they span, in sigmas of the noise.
_STRETCH_LOW, _STRETCH_SPAN = 2.0, 200.0
# OpenCV's own limit would drop stars of few grey levels; `brightness_kept` judges them better.
_LEAST_EIGENVALUE = 1e-6
# Streaks up to these lengths, px, and all longer ones, and how much longer their windows are.
_STREAK_CLASSES_PX = (3, 6, 12, 24, 48)
_WINDOW_GROWTH_PX = (0, 6, 12, 24, 48, 96)
# A tile gives a point this much room around its guess, px; a star further away is out of sight.
_ROOM_PX = 5
# With this part of the objects found, a guess is the star field's.
_MOST = 0.5


class SparseLucasKanade:
    """Pyramidal Lucas-Kanade at points (`cv2.calcOpticalFlowPyrLK`, 8 bit).

    Native targets are corners of the previous frame (`cv2.goodFeaturesToTrack` on I_f), followed
    forwards, as published.  Object targets are the centroids of the current frame, followed
    backwards, so that each of today's objects gets a vector or is known to be new.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters

    def measure(self, previous: FlowInput, current: FlowInput, guesses: Array) -> Flow:
        """See `FlowEngine.measure`."""
        pair = _Pair(previous, current, self._parameters.stretch)
        if self._parameters.flow_targets == "native":
            return self._measure_corners(pair, guesses[0])
        return self._measure_objects(pair, guesses)

    def _measure_corners(self, pair: _Pair, guess: Array) -> Flow:
        p, current = self._parameters, pair.current
        before, now = pair.images
        corners = cv2.goodFeaturesToTrack(
            before, p.max_corners, p.corner_quality, p.corner_distance_px
        )
        if corners is None:
            return Flow.empty()
        points = corners.reshape(-1, 2).astype(np.float64)
        position, error = _follow(
            before, now, points, points + guess, p.window_px, p.pyramid_levels
        )
        ok = np.isfinite(error) & current.contains(position)
        position = np.where(ok[:, None], position, points)
        index = current.object_at(position)
        # A corner has no measured centroid: a pixel's quantisation is what is known of it.
        sigma = np.full_like(position, np.sqrt(1 / 12))
        return Flow.of_vectors(position, position - points, sigma, ok, index)

    def _measure_objects(self, pair: _Pair, guesses: Array) -> Flow:
        current = pair.current
        count = len(current.xy)
        # A test of two frames needs each object's vector, by whichever guess fits it best.  Where
        # only the star field is asked for, a guess that finds most objects is the field's.
        field_only = self._parameters.rso_test == "history"
        for number in range(1 if field_only else len(guesses), len(guesses) + 1):
            start, valid = self._trace_back(pair, np.arange(count), guesses[:number], 0)
            if field_only and np.count_nonzero(valid) >= _MOST * count:
                break
        else:
            # The pyramid reaches further, but blends an object with its neighbours: it is for
            # those that are not found where a guess says.
            rows, levels = np.flatnonzero(~valid), self._parameters.pyramid_levels
            start[rows], valid[rows] = self._trace_back(pair, rows, guesses, levels)
        displacement = np.where(valid[:, None], current.xy - start, 0.0)
        return Flow.of_vectors(
            current.xy, displacement, current.displacement_sigma(), valid, np.arange(count)
        )

    def _trace_back(
        self, pair: _Pair, rows: NDArray[np.intp], guesses: Array, levels: int
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Where objects were in the previous frame by the best of the guesses, and whether."""
        xy, length = pair.current.xy[rows], pair.current.length[rows]
        places, errors, kept = [], [], []
        for guess in guesses:
            place, error = np.empty_like(xy), np.empty(len(xy))
            for some, window_px in self._by_streak(length):
                place[some], error[some] = pair.follow_back(
                    xy[some], xy[some] - guess, window_px, levels
                )
            same = brightness_kept(pair.previous, pair.current, place, xy)
            kept.append(np.isfinite(error) & same)
            places.append(place)
            # A place at which the brightness is not kept is wrong, however small its error.
            errors.append(error + np.where(kept[-1], 0, 1e6))
        best = np.argmin(errors, axis=0), np.arange(len(rows))
        return np.stack(places)[best], np.stack(kept)[best]

    def _by_streak(self, length: Array) -> Iterator[tuple[NDArray[np.intp], int]]:
        """Yield groups of objects and the side of their window, longer by their streaks' length.

        A window inside a streak sees no motion along it; one much larger than the object sees the
        neighbours' motion.
        """
        size = np.searchsorted(_STREAK_CLASSES_PX, length)
        for c, growth in enumerate(_WINDOW_GROWTH_PX):
            rows = np.flatnonzero(size == c)
            if rows.size:
                yield rows, self._parameters.window_px + growth


class _Pair:
    """Two frames in 8 bits: as a whole, or as mosaics of tiles around points.

    OpenCV's work grows with the pixels of the images that it is given, and between the objects
    there is nothing to see.
    """

    def __init__(self, previous: FlowInput, current: FlowInput, stretch: str) -> None:
        self.previous, self.current, self._stretch = previous, current, stretch

    @cached_property
    def images(self) -> tuple[Image, Image]:
        """Both frames in 8 bits, the previous one first."""
        frames = self.previous, self.current
        if self._stretch == "range":
            before, now = (
                cv2.normalize(frame.filtered, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
                for frame in frames
            )
        else:
            before, now = (_above_noise(frame.smoothed, frame.noise) for frame in frames)
        return before, now

    def follow_back(
        self, xy: Array, place: Array, window_px: int, levels: int
    ) -> tuple[Array, Array]:
        """Follow points of the current frame to the previous one, from places near there.

        Returns where they are, and the error, infinite for those that were lost.
        """
        side = (window_px | 1) + 2 * (_ROOM_PX + 1)
        shape = self.current.smoothed.shape
        fewer = side <= min(shape) and len(xy) * side**2 < shape[0] * shape[1]
        if levels or self._stretch == "range" or not fewer:
            before, now = self.images
            return _follow(now, before, xy, place, window_px, levels)
        columns = int(np.ceil(np.sqrt(len(xy))))
        row, column = np.divmod(np.arange(len(xy)), columns)
        tile = side * np.stack([column, row], axis=1)
        from_now, from_before = (np.rint(points) - side // 2 for points in (xy, place))
        found, error = _follow(
            _mosaic(self.current, from_now, side, columns),
            _mosaic(self.previous, from_before, side, columns),
            xy - from_now + tile,
            place - from_before + tile,
            window_px,
        )
        found += from_before - tile
        lost = np.any(np.abs(found - place) > _ROOM_PX, axis=1)
        return found, np.where(lost, np.inf, error)


def _follow(
    start: Image, end: Image, points: Array, guess: Array, window_px: int, levels: int = 0
) -> tuple[Array, Array]:
    """Follow points from `start` to `end`: where they are, and the error, infinite if lost."""
    found, status, error = cv2.calcOpticalFlowPyrLK(
        start,
        end,
        points.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2),
        winSize=(window_px | 1, window_px | 1),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_LEAST_EIGENVALUE,
    )
    # OpenCV leaves the error of a lost point undefined.
    error = np.where(status.ravel() == 1, error.ravel(), np.inf)
    return found.reshape(-1, 2).astype(np.float64), error


def _above_noise(values: Plane, noise: float) -> Image:
    """8 bits from where noise ends, which would pull vectors to zero, to where stars are clear."""
    step = 255 / _STRETCH_SPAN
    return cv2.addWeighted(values, step / noise, values, 0, -step * _STRETCH_LOW, dtype=cv2.CV_8U)


def _mosaic(frame: FlowInput, corner: Array, side: int, columns: int) -> Image:
    """Squares of a frame in 8 bits, from their corners (N, 2), set in rows of so many.

    The border's pixels go on outside: so nothing moves across it, where a mirror image would move
    the other way.
    """
    image, step = frame.smoothed, np.arange(side)
    height, width = image.shape
    rows = -(-len(corner) // columns)
    first = np.zeros((rows * columns, 2), np.intp)
    first[: len(corner)] = corner
    left = np.clip(first[:, 0], 0, width - side)
    y = np.clip(first[:, 1, None] + step, 0, height - 1)
    start = (y * width + left[:, None]).reshape(rows, columns, side).swapaxes(1, 2)
    # A square's row is copied as one item, which is faster than pixel by pixel.
    flat = image.ravel()
    runs = np.ndarray(flat.size - side + 1, f"V{side * flat.itemsize}", flat, strides=flat.strides)
    squares = runs[start.ravel()].view(flat.dtype).reshape(rows, side, columns, side)
    beyond = np.flatnonzero(first[:, 0] != left)
    x = np.clip(first[beyond, :1] + step, 0, width - 1)
    squares[beyond // columns, :, beyond % columns] = image[y[beyond, :, None], x[:, None]]
    return _above_noise(squares.reshape(rows * side, columns * side), frame.noise)
