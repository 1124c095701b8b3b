"""The sparse engine: Lucas-Kanade at points, by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.optical_flow.flow import Array, Flow, FlowInput, brightness_kept
from ofsat_ros.parameters import Parameters

# The 8 bits of the stretch "noise": where they start and what they span, in sigmas of the noise.
_STRETCH_LOW, _STRETCH_SPAN = 2.0, 200.0
# OpenCV's own limit would drop stars of few grey levels; `brightness_kept` judges them better.
_LEAST_EIGENVALUE = 1e-6
# Lengths of streak, px, up to which a window is enlarged by that much; the first not at all.
_STREAK_CLASSES_PX = (3, 6, 12, 24, 48, 96)


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
            # mask * smoothed is I_f
            image = frame.smoothed * frame.mask
            return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
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
            maxLevel=self._parameters.pyramid_levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=_LEAST_EIGENVALUE,
        )
        xy = found.reshape(-1, 2).astype(np.float64)
        ok = status.ravel() == 1
        # OpenCV leaves the error of a lost point undefined.
        return xy, ok, np.where(ok, error.ravel(), np.inf)

    def _follow_streaks(
        self, start: NDArray[np.uint8], end: NDArray[np.uint8], frame: FlowInput, guess: Array
    ) -> tuple[Array, NDArray[np.bool_], Array]:
        """`_follow` each object in a window as much larger as its streak is long.

        A window inside a streak sees no motion along it; one much larger than the object sees the
        neighbours' motion.
        """
        xy, ok = np.zeros_like(frame.xy), np.zeros(len(frame.xy), bool)
        error = np.full(len(frame.xy), np.inf)
        size = np.searchsorted(_STREAK_CLASSES_PX, frame.length)
        for c in np.unique(size):
            rows = size == c
            extra = 0 if c == 0 else _STREAK_CLASSES_PX[min(c, len(_STREAK_CLASSES_PX) - 1)]
            xy[rows], ok[rows], error[rows] = self._follow(
                start, end, frame.xy[rows], guess, self._parameters.window_px + extra
            )
        return xy, ok, error

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
        position, ok, _ = self._follow(before, now, points, guess, p.window_px)
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
        if not len(current.xy):
            return Flow.empty()
        runs = [self._follow_streaks(now, before, current, -guess) for guess in guesses]
        starts = np.stack([run[0] for run in runs])
        kept = np.stack(
            [run[1] & brightness_kept(previous, current, run[0], current.xy) for run in runs]
        )
        # A start at which the brightness is not kept is the wrong one, however small its error.
        error = np.stack([run[2] for run in runs]) + np.where(kept, 0, 1e6)
        best = np.argmin(error, axis=0), np.arange(len(current.xy))
        valid = kept[best]
        displacement = np.where(valid[:, None], current.xy - starts[best], 0.0)
        index = np.arange(len(current.xy))
        sigma = current.displacement_sigma()
        return Flow.of_vectors(current.xy, displacement, sigma, valid, index)
