"""Optical flow: how far each object moved between the previous frame and the current one.

Two Lucas-Kanade engines behind one interface, both of AAS 21-364: ``SparseLucasKanade``
(pyramidal, at points; the paper's OpenCV pipeline) and ``DenseLucasKanade`` (derivative, at every
pixel; its MATLAB pipeline).  Each takes two `FlowInput` and first guesses, and returns a `Flow`.
Third stage: it measures and judges how well, but does not know what is a star.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.parameters import Parameters

Array = NDArray[np.float64]
Plane = NDArray[np.float32]

# What Lucas-Kanade adds to the uncertainty of two centroids, px (measured: docs/algorithm.md).
_FLOW_FLOOR_PX = 0.02
# The 8 bits of the stretch "noise": where they start and what they span, in sigmas of the noise.
_STRETCH_LOW, _STRETCH_SPAN = 2.0, 200.0
# OpenCV's own limit would drop stars of few grey levels; `_brightness_kept` judges them better.
_LEAST_EIGENVALUE = 1e-6
# Lengths of streak, px, up to which a window is enlarged by that much; the first not at all.
_STREAK_CLASSES_PX = (3, 6, 12, 24, 48, 96)
# The brightness at the two ends of a vector may differ by this factor, beyond the noise.
_BRIGHTNESS_RATIO = 2.0


@dataclass(frozen=True)
class FlowInput:
    """What the engines need of one frame.

    Attributes
    ----------
    smoothed : (H, W) float32
        Smoothed image, DN.
    mask : (H, W) uint8
        1 inside objects.
    labels : (H, W) int32
        1 + index of the object at each pixel, 0 for none.
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
    mask: NDArray[np.uint8]
    labels: NDArray[np.int32]
    xy: Array
    sigma: Array
    length: Array
    noise: float

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
        # cv2.remap would end at 32,767 points
        limit = np.array(self.smoothed.shape[::-1]) - 1
        near = np.clip(xy, 0, limit)
        x, y = np.minimum(near.astype(np.intp), limit - 1).T
        fx, fy = near[:, 0] - x, near[:, 1] - y
        top = self.smoothed[y, x] * (1 - fx) + self.smoothed[y, x + 1] * fx
        bottom = self.smoothed[y + 1, x] * (1 - fx) + self.smoothed[y + 1, x + 1] * fx
        return top * (1 - fy) + bottom * fy


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


def flow_engine(parameters: Parameters) -> FlowEngine:
    """Return the engine that `parameters.engine` names."""
    if parameters.engine == "sparse":
        return SparseLucasKanade(parameters)
    return DenseLucasKanade(parameters)


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
        ok = (status.ravel() == 1) & _inside(xy, end.shape)
        # OpenCV leaves the error of a lost point undefined.
        return xy, ok, np.where(ok, error.ravel(), np.inf)

    def _follow_streaks(
        self, start: NDArray[np.uint8], end: NDArray[np.uint8], frame: FlowInput, guess: Array
    ) -> tuple[Array, NDArray[np.bool_], Array]:
        """`_follow` each object in a window as much larger as its streak is long.

        A window inside a streak sees no motion along it; one much larger than the object sees the
        neighbours' motion.
        """
        xy, ok, error = (np.zeros_like(frame.xy), np.zeros(len(frame.xy), bool),
                         np.full(len(frame.xy), np.inf))  # fmt: skip
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
        position = np.where(ok[:, None], position, points)
        index = _labels_at(current.labels, position)
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
            [run[1] & _brightness_kept(previous, current, run[0], current.xy) for run in runs]
        )
        # A start at which the brightness is not kept is the wrong one, however small its error.
        error = np.stack([run[2] for run in runs]) + np.where(kept, 0, 1e6)
        best = np.argmin(error, axis=0), np.arange(len(current.xy))
        valid = kept[best]
        displacement = np.where(valid[:, None], current.xy - starts[best], 0.0)
        index = np.arange(len(current.xy))
        sigma = _displacement_sigma(current)
        return Flow.of_vectors(current.xy, displacement, sigma, valid, index)


class DenseLucasKanade:
    """Derivative Lucas-Kanade at every pixel (AAS 21-364, equation 3).

    At each pixel (u, v) minimises sum w (I_x u + I_y v + I_t)^2 over a window with binomial
    weights w: the solution of ``[[Sxx, Sxy], [Sxy, Syy]] (u, v) = -(Sxt, Syt)``.  With both
    eigenvalues above the noise threshold it is solved in full, with one, along the gradient only;
    with none, the pixel has no flow.

    Derivatives see motions of about a pixel.  With pyramid levels and iterations (not published)
    the previous image is warped by the flow found so far, and the rest is solved for again.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        side = parameters.dense_window_px | 1
        binomial = np.ones(1)
        for _ in range(side - 1):
            binomial = np.convolve(binomial, [0.5, 0.5])
        self._window = binomial.astype(np.float32)

    def measure(self, previous: FlowInput, current: FlowInput, guesses: Array) -> Flow:
        """See `FlowEngine.measure`."""
        native = self._parameters.flow_targets == "native"
        noise = (previous.noise, current.noise)
        images = (previous.smoothed, current.smoothed)
        if native:
            velocity, solved = self.velocity_map(*images, *noise, guesses[0])
            return self._regions(velocity, solved, current)
        runs = []
        for guess in guesses:
            velocity, solved = self.velocity_map(*images, *noise, guess)
            runs.append(self._combine(velocity, solved, current.labels, current, len(current.xy)))
        flow = runs[0]
        kept = [
            run.valid & _brightness_kept(previous, current, run.position - run.displacement,
                                         current.xy)
            for run in runs
        ]  # fmt: skip
        return _select(runs, kept) if len(flow) else flow

    def velocity_map(
        self, before: Plane, now: Plane, noise_before: float, noise_now: float, guess: Array
    ) -> tuple[Plane, NDArray[np.bool_]]:
        """Flow of every pixel of the current image.

        Parameters
        ----------
        before, now : (H, W) float32
            The two images, DN.
        noise_before, noise_now : float
            Std of their background, DN; scales the threshold on the eigenvalues.
        guess : (2,) float64
            Displacement to start from, px.

        Returns
        -------
        velocity : (H, W, 2) float32
            Displacement, px per frame; 0 where nothing could be solved.
        solved : (H, W) bool
            Where at least one eigenvalue was above the noise threshold.
        """
        p = self._parameters
        levels = [(before, now, float(np.hypot(noise_before, noise_now) / np.sqrt(2)))]
        while len(levels) <= p.dense_pyramid_levels and min(levels[-1][0].shape) >= 32:
            a, b, noise = levels[-1]
            # pyrDown averages: white noise drops to 0.27, smoothed noise to less than half more
            levels.append((cv2.pyrDown(a), cv2.pyrDown(b), noise / 2))
        coarsest = len(levels) - 1
        velocity = np.empty((*levels[coarsest][1].shape, 2), np.float32)
        velocity[:] = guess / 2**coarsest
        for level, (a, b, noise) in reversed([*enumerate(levels)]):
            if level < coarsest:
                size = (b.shape[1], b.shape[0])
                velocity = 2 * cv2.resize(velocity, size, interpolation=cv2.INTER_LINEAR)
            for _ in range(p.dense_iterations):
                # cv2.remap knows 32nds of a pixel: what it would round away must not be counted.
                velocity = np.rint(velocity * 32) / 32
                step, solved = self._solve(_warp(a, velocity), b, noise)
                if p.dense_iterations > 1:
                    # Derivatives say nothing beyond the width of a star; a larger step is noise.
                    np.clip(step, -2, 2, out=step)
                velocity += step
        velocity[~solved] = 0
        return velocity, solved

    def _solve(self, before: Plane, now: Plane, noise: float) -> tuple[Plane, NDArray[np.bool_]]:
        """One least-squares solution at every pixel, and where there is one."""
        middle = (before + now) / 2
        kernel, one = np.array([1, -8, 0, 8, -1], np.float32) / 12, np.ones(1, np.float32)
        ix = cv2.sepFilter2D(middle, cv2.CV_32F, kernel, one)
        iy = cv2.sepFilter2D(middle, cv2.CV_32F, one, kernel)
        it = now - before
        sums = [
            cv2.sepFilter2D(product, cv2.CV_32F, self._window, self._window)
            for product in (ix * ix, ix * iy, iy * iy, ix * it, iy * it)
        ]
        limit = self._parameters.dense_noise_threshold * self._noise_eigenvalue(noise)
        # The trace bounds the larger eigenvalue: elsewhere nothing can be solved.
        y, x = np.nonzero(sums[0] + sums[2] > limit)
        sxx, sxy, syy, sxt, syt = (total[y, x] for total in sums)
        half, gap = (sxx + syy) / 2, np.hypot((sxx - syy) / 2, sxy)
        large, small = half + gap, half - gap
        angle = np.arctan2(2 * sxy, sxx - syy) / 2
        ex, ey = np.cos(angle), np.sin(angle)
        # Aperture problem: no motion along an eigenvector whose eigenvalue is noise.
        along = -(ex * sxt + ey * syt) / np.where(large > limit, large, np.inf)
        across = (ey * sxt - ex * syt) / np.where(small > limit, small, np.inf)
        step, solved = np.zeros((*now.shape, 2), np.float32), np.zeros(now.shape, bool)
        step[y, x, 0], step[y, x, 1] = along * ex - across * ey, along * ey + across * ex
        solved[y, x] = large > limit
        return step, solved

    def _noise_eigenvalue(self, noise: float) -> float:
        """Expected eigenvalue of the matrix where there is nothing but noise.

        Noise smoothed by a Gaussian of sigma s has derivatives of variance noise^2 / (2 s^2); the
        mean of two independent images halves it.
        """
        sigma = max(self._parameters.smoothing_sigma_px, 0.6)
        return noise**2 / (4 * sigma**2)

    def _regions(self, velocity: Plane, solved: NDArray[np.bool_], current: FlowInput) -> Flow:
        """Cut the objects out of the map of speeds, as published.

        The threshold is applied to the map: I_f falls to 0 from the background's level, and the
        derivatives of that cliff would hide the stars' own.
        """
        speed = np.hypot(velocity[..., 0], velocity[..., 1])
        moving = solved & (current.mask > 0) & (speed > self._parameters.dense_min_speed_px)
        count, regions = cv2.connectedComponents(moving.astype(np.uint8), ltype=cv2.CV_32S)
        flow = self._combine(velocity, moving, regions, current, count - 1)
        index = _labels_at(current.labels, flow.position)
        values = {**flow.__dict__, "object_index": index}
        return Flow(**values)

    def _combine(
        self,
        velocity: Plane,
        solved: NDArray[np.bool_],
        labels: NDArray[np.int32],
        current: FlowInput,
        count: int,
    ) -> Flow:
        """One vector per label: the median of its pixels', and the statistics of their speeds."""
        if count == 0:
            return Flow.empty()
        y, x = np.nonzero((labels > 0) & solved)
        label = labels[y, x].astype(np.intp) - 1
        order = np.argsort(label, kind="stable")
        y, x, label = y[order], x[order], label[order]
        vectors = velocity[y, x].astype(np.float64)
        speed = np.hypot(*vectors.T)
        number = np.bincount(label, minlength=count)
        valid = number > 0

        def mean(values: NDArray[Any]) -> Array:
            return np.bincount(label, values, count) / np.maximum(number, 1)

        displacement = np.stack([_group_median(v, label, number) for v in vectors.T], axis=1)
        low, high = np.full(count, np.inf), np.zeros(count)
        np.minimum.at(low, label, speed)
        np.maximum.at(high, label, speed)
        objects = labels is current.labels
        position = current.xy if objects else np.stack([mean(x), mean(y)], axis=1)
        sigma = _displacement_sigma(current) if objects else np.full((count, 2), np.sqrt(1 / 12))
        return Flow(
            position=position,
            displacement=displacement,
            sigma=sigma,
            valid=valid,
            object_index=np.arange(count) if objects else np.full(count, -1),
            speed_mean=mean(speed),
            speed_median=_group_median(speed, label, number),
            speed_min=np.where(valid, low, 0),
            speed_max=high,
        )


def _select(runs: list[Flow], kept: list[NDArray[np.bool_]]) -> Flow:
    """Row by row, the first run that kept the brightness."""
    choice = np.argmax(np.stack(kept), axis=0), np.arange(len(runs[0]))
    values = {name: np.stack([getattr(run, name) for run in runs])[choice] for name in
              runs[0].__dict__}  # fmt: skip
    valid = np.stack(kept)[choice]
    displacement = np.where(valid[:, None], values["displacement"], 0.0)
    return Flow(**{**values, "valid": valid, "displacement": displacement})


def _group_median(values: Array, label: NDArray[np.intp], number: NDArray[np.intp]) -> Array:
    """Median of the values of each label; `label` is sorted, labels without values give 0."""
    order = np.lexsort((values, label))
    ordered = np.append(values[order], 0.0)
    first = np.concatenate([[0], np.cumsum(number)[:-1]])
    lower = ordered[np.minimum(first + (number - 1) // 2, len(values))]
    upper = ordered[np.minimum(first + number // 2, len(values))]
    return np.where(number > 0, (lower + upper) / 2, 0.0)


def _warp(image: Plane, velocity: Plane) -> Plane:
    """The previous image moved by the flow: at each pixel, its value at pixel - flow."""
    if not velocity.any():
        return image
    height, width = image.shape
    gx, gy = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    # OpenCV's cubic kernel would shift a star by up to 0.05 px, its linear one flatten it.
    return cv2.remap(
        image, gx - velocity[..., 0], gy - velocity[..., 1], cv2.INTER_LANCZOS4,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip


def _inside(xy: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    return np.all((xy >= 0) & (xy <= [shape[1] - 1, shape[0] - 1]), axis=1)


def _labels_at(labels: NDArray[np.int32], xy: Array) -> NDArray[np.intp]:
    """Index of the object at each point, -1 for none; the points lie inside the image."""
    x, y = np.rint(xy).astype(np.intp).T
    return labels[y, x].astype(np.intp) - 1


def _displacement_sigma(current: FlowInput) -> Array:
    """Std of an object's displacement: two centroids of the same quality, and the flow's own."""
    return np.sqrt(2 * current.sigma**2 + _FLOW_FLOOR_PX**2)


def _brightness_kept(
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
    return similar & _inside(start, previous.smoothed.shape) & (before > 2 * previous.noise)
