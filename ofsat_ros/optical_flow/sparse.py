"""The sparse engine: Lucas-Kanade at points, by OpenCV."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.optical_flow.flow import Array, Flow, FlowInput, brightness_kept
from ofsat_ros.parameters import Parameters

# The 8 bits of the stretch "noise": where they start and what they span, in sigmas of the noise.
_STRETCH_LOW, _STRETCH_SPAN = 2.0, 200.0
# OpenCV's own limit would drop stars of few grey levels; `brightness_kept` judges them better.
_LEAST_EIGENVALUE = 1e-6
# Streaks up to these lengths, px, and all longer ones, and how much longer their windows are.
_STREAK_CLASSES_PX = (3, 6, 12, 24, 48)
_WINDOW_GROWTH_PX = (0, 6, 12, 24, 48, 96)


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
        before, now = self._to_8bit(previous), self._to_8bit(current)
        if self._parameters.flow_targets == "native":
            return self._measure_corners(before, now, current, guesses[0])
        return self._measure_objects(before, now, previous, current, guesses)

    def _to_8bit(self, frame: FlowInput) -> NDArray[np.uint8]:
        if self._parameters.stretch == "range":
            return cv2.normalize(frame.filtered, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
        # From where noise ends to where a star needs no help: noise would pull vectors to zero.
        scaled = frame.smoothed / np.float32(frame.noise) - np.float32(_STRETCH_LOW)
        return cv2.convertScaleAbs(np.maximum(scaled, 0), alpha=255 / _STRETCH_SPAN)

    def _follow(
        self,
        start: NDArray[np.uint8],
        end: NDArray[np.uint8],
        points: Array,
        guess: Array,
        window_px: int,
        levels: int,
    ) -> tuple[Array, NDArray[np.bool_], Array]:
        """Follow points from `start` to `end`; return where they are, whether, and the error."""
        origin = points.astype(np.float32).reshape(-1, 1, 2)
        target = (points + guess).astype(np.float32).reshape(-1, 1, 2)
        found, status, error = cv2.calcOpticalFlowPyrLK(
            start,
            end,
            origin,
            target,
            winSize=(window_px | 1, window_px | 1),
            maxLevel=levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=_LEAST_EIGENVALUE,
        )
        xy = found.reshape(-1, 2).astype(np.float64)
        ok = status.ravel() == 1
        # OpenCV leaves the error of a lost point undefined.
        return xy, ok, np.where(ok, error.ravel(), np.inf)

    def _measure_corners(
        self,
        before: NDArray[np.uint8],
        now: NDArray[np.uint8],
        current: FlowInput,
        guess: Array,
    ) -> Flow:
        p = self._parameters
        corners = cv2.goodFeaturesToTrack(
            before, p.max_corners, p.corner_quality, p.corner_distance_px
        )
        if corners is None:
            return Flow.empty()
        points = corners.reshape(-1, 2).astype(np.float64)
        position, ok, _ = self._follow(before, now, points, guess, p.window_px, p.pyramid_levels)
        ok &= current.contains(position)
        position = np.where(ok[:, None], position, points)
        index = current.object_at(position)
        # A corner has no measured centroid: a pixel's quantisation is what is known of it.
        sigma = np.full_like(position, np.sqrt(1 / 12))
        return Flow.of_vectors(position, position - points, sigma, ok, index)

    def _measure_objects(
        self,
        before: NDArray[np.uint8],
        now: NDArray[np.uint8],
        previous: FlowInput,
        current: FlowInput,
        guesses: Array,
    ) -> Flow:
        count = len(current.xy)
        start, valid = current.xy.copy(), np.zeros(count, bool)
        # The pyramid reaches further, but blends an object with its neighbours: it is for those
        # that are not found where a guess says.
        for levels in (0, self._parameters.pyramid_levels):
            for rows, window_px in self._by_streak(np.flatnonzero(~valid), current.length):
                start[rows], valid[rows] = self._trace_back(
                    before, now, previous, current, rows, guesses, window_px, levels
                )
        displacement = np.where(valid[:, None], current.xy - start, 0.0)
        return Flow.of_vectors(
            current.xy, displacement, current.displacement_sigma(), valid, np.arange(count)
        )

    def _by_streak(
        self, rows: NDArray[np.intp], length: Array
    ) -> Iterator[tuple[NDArray[np.intp], int]]:
        """Yield groups of objects and the side of their window, longer by their streaks' length.

        A window inside a streak sees no motion along it; one much larger than the object sees the
        neighbours' motion.
        """
        largest = len(_WINDOW_GROWTH_PX) - 1
        size = np.minimum(np.searchsorted(_STREAK_CLASSES_PX, length[rows]), largest)
        for c in np.unique(size):
            yield rows[size == c], self._parameters.window_px + _WINDOW_GROWTH_PX[c]

    def _trace_back(
        self,
        before: NDArray[np.uint8],
        now: NDArray[np.uint8],
        previous: FlowInput,
        current: FlowInput,
        rows: NDArray[np.intp],
        guesses: Array,
        window_px: int,
        levels: int,
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Where objects were in the previous frame by the best of the guesses, and whether."""
        xy = current.xy[rows]
        runs = [self._follow(now, before, xy, -guess, window_px, levels) for guess in guesses]
        kept = [ok & brightness_kept(previous, current, place, xy) for place, ok, _ in runs]
        # A place at which the brightness is not kept is the wrong one, however small its error.
        error = np.stack([run[2] for run in runs]) + np.where(kept, 0, 1e6)
        best = np.argmin(error, axis=0), np.arange(len(rows))
        return np.stack([run[0] for run in runs])[best], np.stack(kept)[best]
