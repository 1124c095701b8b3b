# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Drifting objects: what has left its place on the sky over several frames, however slowly.

A slow RSO hides behind itself: after one frame it has hardly left its place, and `find_spots`
takes it for a star.  Its centroid, followed over the history, shows the drift; Lucas-Kanade
against the oldest frames, with the uncertainty that its own gradients give, decides.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ofsat_ros.following import (
    CENTROID_FLOOR_PX,
    LEAST_FRAMES,
    alike,
    as_points,
    centroid_variance,
    follow,
)
from ofsat_ros.history import History, PastFrame
from ofsat_ros.pixels import interpolate, positions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# How many frames must have it for each in which it was missed.
_HITS_PER_MISS = 2
# Registration and shape may move what Lucas-Kanade measures by this much, px.
_FLOW_FLOOR_PX = 0.1
_LEAST_DRIFT_PX = 0.8
# Stars scatter by up to so many times as much as stated because they are few.
_LEAST_SCATTER = 1.5
# What was seen within so many sigmas of its place, or half the least drift, stands still.
_STILL_SIGMAS = 3.0
_FLOW_SIGMAS = 5.5
# Lucas-Kanade ends after so many steps, or when one is as short as this, or it has lost its way.
_STEPS, _LAST_STEP_PX, _LOST_PX = 8, 0.01, 8.0
# Window of the flow: its half side, and the sigma of its weights, px.
_HALF_PX, _WEIGHT_PX = 5, 2.5
_STEP = np.arange(-_HALF_PX, _HALF_PX + 1, dtype=float)
_DX, _DY = np.meshgrid(_STEP, _STEP)
# A matrix that takes the columns of a window to their gradients.
_GRADIENT = np.asarray(np.gradient(np.eye(len(_STEP)), axis=0))
_WEIGHT = np.exp(-(_DX**2 + _DY**2) / (2 * _WEIGHT_PX**2))
# Noise smoothed with sigma 1 px is correlated: a sum over pixels varies by 4 pi sigma^2 as much.
_CORRELATED = 4 * np.pi


@dataclass(frozen=True)
class Drift:
    """An object that drifts.

    Attributes
    ----------
    rows : dict of int to int
        Number of the frame to row of its objects, for the frames in which it was found.
    log_false : float
        Logarithm of the number of such objects that chance gives in one frame.
    """

    rows: dict[int, int]
    log_false: float


def find_drifting(history: History, log_limit: float, known: Collection[int] = ()) -> list[Drift]:
    """Find objects of the newest frame that drift against the stars.

    Parameters
    ----------
    history : History
        The frames, the current one last.
    log_limit : float
        Logarithm of the number of false ones in one frame that is accepted.
    known : collection of int
        Rows of the newest frame's objects that need not be looked at: tracks have them already.

    Returns
    -------
    list of Drift
    """
    frame = history[-1]
    earlier = list(history)[-2::-1]
    if len(earlier) < LEAST_FRAMES - 1 or not len(frame.objects):
        return []
    still, scale = _stand_still(frame, earlier)
    still[list(known)] = True
    followed = np.flatnonzero(~still)
    paths = follow(frame, earlier, followed)
    times, rows, places, found = paths.times, paths.rows, paths.places, paths.found
    lines, error = paths.lines, paths.error
    # Where a slew within the exposure smears stars unevenly, bright and faint ones part.
    scatter = np.array([other.scatter for other in (frame, *earlier)])
    scatter[scatter < _LEAST_SCATTER] = 1.0
    scale = np.maximum(scale, np.max(np.where(found, scatter, 1.0), axis=1))
    speed = np.abs(lines.velocity)
    significance = speed * np.sqrt(lines.spread) / error / scale
    log_false = np.log(len(frame.objects)) - significance**2 / 2
    # The newest frame, where all were found, is no test.
    off = lines.at(0.0)[:, None] + lines.velocity[:, None] * times - places
    squares = np.abs(off) ** 2 * found
    hits = lines.count - 1
    rms = np.sqrt(squares[:, 1:].sum(axis=1) / np.maximum(hits, 1))
    drift = speed * np.max(np.where(found, -times, 0), axis=1)
    oldest = np.max(np.where(found, np.arange(len(times)), 0), axis=1)
    suspect = lines.long_enough & (log_false < log_limit)
    suspect &= hits >= _HITS_PER_MISS * (oldest - hits)
    suspect &= (drift > _LEAST_DRIFT_PX) & (drift > 3.5 * rms)
    suspect &= rms < np.maximum(0.3, 3 * error)
    suspect &= frame.contains(positions(frame.objects[followed]), _HALF_PX + 1)
    chosen = np.flatnonzero(suspect)
    misfit = squares[chosen].sum(axis=1)
    chosen = chosen[misfit < _misfit_of_step(places[chosen], found[chosen])]
    if not chosen.size:
        return []
    velocity = as_points(lines.velocity[chosen])
    agrees = _flow_agrees(frame, earlier, followed[chosen], found[chosen, 1:], velocity)
    numbers = [other.number for other in (frame, *earlier)]
    return [
        Drift(
            {n: int(r) for n, r in zip(numbers, rows[row], strict=True) if r >= 0},
            float(log_false[row]),
        )
        for row in chosen[agrees].tolist()
    ]


def _misfit_of_step(places: NDArray[np.complex128], found: Mask) -> Array:
    """Sum of squares, (N,) px^2, that one jump between two standstills leaves of paths (N, K).

    Where frames were torn or misplaced, the stars jump; what drifts goes evenly.
    """
    count, total = found.cumsum(axis=1), places.cumsum(axis=1)
    left = (np.abs(places) ** 2).sum(axis=1)
    after = np.maximum(count[:, -1:] - count, 1)
    explained = np.abs(total) ** 2 / np.maximum(count, 1)
    explained += np.abs(total[:, -1:] - total) ** 2 / after
    return left - explained.max(axis=1, initial=0)


def _stand_still(frame: PastFrame, earlier: list[PastFrame]) -> tuple[NDArray[np.bool_], float]:
    """Which objects one of the two oldest frames shows where they are now: most stars.

    Returns
    -------
    still : (N,) bool
    scale : float
        How many times as much as stated the centroids of all scatter, at least 1: as most objects
        are stars, what they scatter by beyond their stds is an error of scale.
    """
    objects = frame.objects
    variance = centroid_variance(objects) + CENTROID_FLOOR_PX**2
    reach = np.maximum(_LEAST_DRIFT_PX / 2, _STILL_SIGMAS * np.sqrt(variance))
    rest = np.flatnonzero(~objects["edge"])
    rows, distance = _at_places(earlier[-1], frame.object_sky[rest], objects["flux"][rest])
    seen = rows >= 0
    scale = 1.0
    if seen.any():
        both = variance[rest[seen]] + centroid_variance(earlier[-1].objects[rows[seen]])
        sigmas = distance[seen] / np.sqrt(both + CENTROID_FLOOR_PX**2)
        # the median of the distance of two axes' noise
        scale = max(scale, float(np.median(sigmas)) / 1.18)
    rest = rest[distance >= reach[rest]]
    _, distance = _at_places(earlier[-2], frame.object_sky[rest], objects["flux"][rest])
    still = ~objects["edge"]
    still[rest] = distance < reach[rest]
    return still, scale


def _at_places(other: PastFrame, sky: Array, flux: Array) -> tuple[NDArray[np.intp], Array]:
    """Rows of a frame's objects on whose pixels points lie and that are alike, and how far off.

    -1 and infinity where there is none.
    """
    xy = other.pixels(sky)
    inside = np.flatnonzero(other.contains(xy))
    x, y = np.rint(xy[inside]).astype(np.intp).T
    row = other.regions.at(y, x)
    inside, row = inside[row >= 0], row[row >= 0]
    same = alike(other, row, flux[inside])
    inside, row = inside[same], row[same]
    rows, distance = np.full(len(sky), -1), np.full(len(sky), np.inf)
    rows[inside] = row
    distance[inside] = np.hypot(*(other.object_sky[row] - sky[inside]).T)
    return rows, distance


def _flow_agrees(
    frame: PastFrame,
    earlier: list[PastFrame],
    rows: NDArray[np.intp],
    found: NDArray[np.bool_],
    velocity: Array,
) -> NDArray[np.bool_]:
    """Whether Lucas-Kanade against the frames in which they were seen finds the same drifts, (N,).

    `found` tells in which of the earlier frames each object was seen, (N, K).
    """
    times = np.array([other.seconds_since(frame) for other in earlier])
    expected = -velocity[:, None] * times[:, None] @ np.linalg.inv(frame.to_sky[:2, :2]).T
    which, against = np.nonzero(found & (np.hypot(*expected.T).T >= _LEAST_DRIFT_PX / 2))
    if not which.size:
        return np.zeros(len(rows), bool)
    xy, weight = positions(frame.objects)[rows], _weights(frame, rows)
    drift, covariance = _flow_against_field(frame, earlier, against, xy[which], weight[which])
    precision = np.linalg.inv(covariance)

    def sigmas(vectors: Array) -> Array:
        squares = np.einsum("ni,nij,nj->n", vectors, precision, vectors)
        # A rounded inverse of what has a gradient along one axis alone may be a little negative.
        return np.sqrt(np.maximum(squares, 0))

    moved, agreement = np.zeros(found.shape), np.full(found.shape, np.nan)
    moved[which, against] = sigmas(drift)
    off = sigmas(drift - expected[which, against])
    agreement[which, against] = moved[which, against] / np.maximum(off, 0.5)
    # none to compare with is no agreement
    agreement[np.isnan(agreement).all(axis=1), 0] = 0
    return (moved.max(axis=1) > _FLOW_SIGMAS) & (np.nanmedian(agreement, axis=1) > 2)


def _weights(frame: PastFrame, rows: NDArray[np.intp]) -> Array:
    """Weights of the pixels of the windows around objects, (N, side, side).

    A brighter neighbour in the window, and its wings, would be what is measured.
    """
    pixels = np.rint(positions(frame.objects)[rows][:, None, None] + np.stack([_DX, _DY], axis=-1))
    x, y = pixels.astype(np.intp).transpose(3, 0, 1, 2)
    owner = frame.regions.at(y, x)
    others = (owner >= 0) & (owner != rows[:, None, None])
    padded = np.pad(others, [(0, 0), (2, 2), (2, 2)])
    beside = sliding_window_view(padded, (5, 5), (1, 2)).any(axis=(3, 4))
    return np.where(beside, 0, _WEIGHT)


def _flow_against_field(
    frame: PastFrame,
    earlier: list[PastFrame],
    against: NDArray[np.intp],
    xy: Array,
    weight: Array,
) -> tuple[Array, Array]:
    """Displacement against the field of what is at points, by iterated Lucas-Kanade in float.

    Point by point, `against` is the index of the earlier frame that it is compared with, and the
    weights are those of the pixels of the window around it.

    Returns
    -------
    drift : (N, 2) float64
        From where the field's motion carries the earlier frame to where it is now, px.
    covariance : (N, 2, 2) float64
        Of it, px^2: the noise through the normal equations, so that it is large along a streak,
        where there is no gradient.
    """
    window = xy[:, None, None] + np.stack([_DX, _DY], axis=-1)
    now = _patches(frame, window)
    noise = np.array([frame.noise**2 + other.noise**2 for other in earlier])[against]
    noise = noise[:, None, None] * _CORRELATED
    to_earlier = np.array([other.from_sky @ frame.to_sky for other in earlier])[against, :2]
    turn, shift = to_earlier[:, None, :, :2].swapaxes(2, 3), to_earlier[:, None, None, :, 2]
    drift = np.zeros((len(xy), 2))
    normal, scatter = np.zeros((len(xy), 2, 2)), np.zeros((len(xy), 2, 2))
    going = np.arange(len(xy))
    for _ in range(_STEPS):
        points = (window[going] - drift[going, None, None]) @ turn[going] + shift[going]
        before = np.empty((len(going), *_WEIGHT.shape))
        for index in np.unique(against[going]):
            some = against[going] == index
            before[some] = _patches(earlier[index], points[some])
        mean = (now[going] + before) / 2
        gradient = np.stack([mean @ _GRADIENT.T, _GRADIENT @ mean], axis=1)
        gradient = gradient.reshape(len(going), 2, -1)
        flat = weight[going].reshape(len(going), 1, -1)
        change = (now[going] - before).reshape(len(going), -1, 1)
        across = gradient.transpose(0, 2, 1)
        normal[going] = (flat * gradient) @ across
        scatter[going] = (flat**2 * gradient) @ across
        # The noise's own gradients keep the step small where there are no others.
        regular = normal[going] + noise[going] * np.eye(2)
        step = -np.linalg.solve(regular, (flat * gradient) @ change)[..., 0]
        drift[going] += step
        ends = np.hypot(*step.T) < _LAST_STEP_PX
        going = going[~ends & (np.hypot(*drift[going].T) <= _LOST_PX)]
        if not going.size:
            break
    trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.pinv(normal + 1e-9 * trace * np.eye(2))
    return drift, inverse @ (scatter * noise) @ inverse + _FLOW_FLOOR_PX**2 * np.eye(2)


def _patches(frame: PastFrame, points: Array) -> Array:
    """Brightness at the points of windows (N, side, side, 2), (N, side, side)."""
    x, y = points.reshape(-1, points.shape[2], 2).astype(np.float32).transpose(2, 0, 1)
    values = interpolate(frame.smoothed, x.ravel(), y.ravel(), cv2.INTER_CUBIC)
    return values.astype(np.float64).reshape(points.shape[:3])
