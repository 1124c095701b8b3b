# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The dense engine: Lucas-Kanade at every pixel, by its derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.optical_flow.flow import Array, Flow, FlowInput, Plane, brightness_kept
from ofsat_ros.parameters import Parameters
from ofsat_ros.pixels import rows_and_columns

Index = NDArray[np.intp]


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
            runs.append(self._of_objects(velocity, solved, current))
        flow = runs[0]
        kept = [
            run.valid
            & brightness_kept(previous, current, current.xy - run.displacement, current.xy)
            for run in runs
        ]
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
        y, x = np.nonzero(regions)
        flow = self._combine(velocity, y, x, regions[y, x].astype(np.intp) - 1, count - 1)
        return replace(flow, object_index=current.object_at(flow.position))

    def _of_objects(self, velocity: Plane, solved: NDArray[np.bool_], current: FlowInput) -> Flow:
        """One vector per object."""
        y, x = rows_and_columns(current.regions.pixels, solved.shape[1])
        inside = solved[y, x]
        label, count = current.regions.owner[inside], len(current.xy)
        flow = self._combine(velocity, y[inside], x[inside], label, count)
        return replace(
            flow,
            position=current.xy,
            sigma=current.displacement_sigma(),
            object_index=np.arange(count),
        )

    def _combine(self, velocity: Plane, y: Index, x: Index, label: Index, count: int) -> Flow:
        """One vector per label: the median of its pixels', and the statistics of their speeds."""
        if count == 0:
            return Flow.empty()
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
        return Flow(
            position=np.stack([mean(x), mean(y)], axis=1),
            displacement=displacement,
            sigma=np.full((count, 2), np.sqrt(1 / 12)),
            valid=valid,
            object_index=np.full(count, -1),
            speed_mean=mean(speed),
            speed_median=_group_median(speed, label, number),
            speed_min=np.where(valid, low, 0),
            speed_max=high,
        )


def _select(runs: list[Flow], kept: list[NDArray[np.bool_]]) -> Flow:
    """Row by row, the first run that kept the brightness."""
    choice = np.argmax(np.stack(kept), axis=0), np.arange(len(runs[0]))
    values = {
        name: np.stack([getattr(run, name) for run in runs])[choice] for name in vars(runs[0])
    }
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
        image,
        gx - velocity[..., 0],
        gy - velocity[..., 1],
        cv2.INTER_LANCZOS4,
        borderMode=cv2.BORDER_REPLICATE,
    )
