"""Drifting objects: what has left its place on the sky over several frames, however slowly.

A slow RSO hides behind itself: after one frame it has hardly left its place, and `find_spots`
takes it for a star.  Its centroid, followed over the history, shows the drift; Lucas-Kanade
against the oldest frames, with the uncertainty that its own gradients give, decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ofsat_ros.history import History, PastFrame

Array = NDArray[np.float64]

# An object is sought this near to its place in the frame before, px of the sky plane.
_REACH_PX = 3.0
# Its flux may differ by this factor.
_FLUX_RATIO = 2.5
_LEAST_FRAMES = 3
# Frames in which it may have been missed, and how many must have it for each of those.
_MOST_MISSES, _HITS_PER_MISS = 3, 2
# What centroids scatter by beyond their stated std: blends, pixel phase, px.
_CENTROID_FLOOR_PX = 0.02
# Registration and shape may move what Lucas-Kanade measures by this much, px.
_FLOW_FLOOR_PX = 0.1
_LEAST_DRIFT_PX = 0.8
_FLOW_SIGMAS = 5.5
# Window of the flow: its half side, and the sigma of its weights, px.
_HALF_PX, _WEIGHT_PX = 5, 2.5
_STEP = np.arange(-_HALF_PX, _HALF_PX + 1, dtype=float)
_DX, _DY = np.meshgrid(_STEP, _STEP)
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


@dataclass
class _Chains:
    """The paths of the newest frame's objects, as sums for straight lines through them."""

    count: Array
    t: Array
    tt: Array
    xy: Array
    txy: Array
    variance: Array

    @classmethod
    def starting_at(cls, xy: Array, variance: Array) -> _Chains:
        zero = np.zeros(len(xy))
        return cls(zero + 1, zero.copy(), zero.copy(), xy.copy(), 0 * xy, variance.copy())

    def add(self, rows: NDArray[np.intp], t: float, xy: Array, variance: Array) -> None:
        self.count[rows] += 1
        self.t[rows] += t
        self.tt[rows] += t * t
        self.xy[rows] += xy
        self.txy[rows] += t * xy
        self.variance[rows] += variance

    @property
    def spread(self) -> Array:
        """Sum of the squared times from their mean, s^2."""
        return self.tt - self.t**2 / self.count

    @property
    def velocity(self) -> Array:
        """Of the lines, px/s; 0 where they have no time to move."""
        top = self.txy - (self.t / self.count)[:, None] * self.xy
        usable = (self.count >= _LEAST_FRAMES)[:, None]
        return np.where(usable, top / np.maximum(self.spread, 1e-12)[:, None], 0)

    def at(self, t: float) -> Array:
        """Points of the lines, px of the sky plane."""
        middle = self.xy / self.count[:, None]
        return middle + self.velocity * (t - self.t / self.count)[:, None]


def find_drifting(history: History, log_limit: float) -> list[Drift]:
    """Find objects of the newest frame that drift against the stars.

    Parameters
    ----------
    history : History
        The frames, the current one last.
    log_limit : float
        Logarithm of the number of false ones in one frame that is accepted.

    Returns
    -------
    list of Drift
    """
    frame = history[-1]
    objects = frame.objects
    earlier = list(history)[-2::-1]
    if len(earlier) < _LEAST_FRAMES - 1 or not len(objects):
        return []
    chains, rows, places = _chains(frame, earlier)
    times = np.array([_seconds(other, frame) for other in earlier])
    found = rows >= 0
    long_enough = np.flatnonzero(chains.count >= _LEAST_FRAMES)
    if not long_enough.size:
        return []
    error = np.sqrt(chains.variance / chains.count + _CENTROID_FLOOR_PX**2)
    speed = np.hypot(*chains.velocity.T)
    significance = speed * np.sqrt(chains.spread) / error
    # Most objects are stars: what their significances scatter by beyond 1 is an error of scale.
    significance /= max(1.0, float(np.median(significance[long_enough])) / 1.18)
    residual = places - np.stack([chains.at(t) for t in times], axis=1)
    rms = np.sqrt(np.nansum(residual**2, axis=(1, 2)) / np.maximum(found.sum(axis=1), 1))
    drift = speed * np.max(np.where(found, -times, 0), axis=1)
    log_false = np.log(long_enough.size) - significance**2 / 2
    suspect = (chains.count >= _LEAST_FRAMES) & (log_false < log_limit)
    oldest = np.max(np.where(found, np.arange(1, len(earlier) + 1), 0), axis=1)
    hits = found.sum(axis=1)
    suspect &= hits >= _HITS_PER_MISS * (oldest - hits)
    suspect &= (drift > _LEAST_DRIFT_PX) & (drift > 3.5 * rms)
    suspect &= rms < np.maximum(0.3, 3 * error)
    suspect &= frame.contains(_xy(objects), _HALF_PX + 1)
    drifting = []
    for row in np.flatnonzero(suspect).tolist():
        seen = [(other, t) for other, t, ok in zip(earlier, times, found[row], strict=True) if ok]
        if _flow_agrees(frame, seen, row, chains.velocity[row]):
            in_frames = {
                o.number: int(r) for o, r in zip(earlier, rows[row], strict=True) if r >= 0
            }
            in_frames[frame.number] = int(row)
            drifting.append(Drift(in_frames, float(log_false[row])))
    return drifting


def _chains(frame: PastFrame, earlier: list[PastFrame]) -> tuple[_Chains, NDArray[np.intp], Array]:
    """Follow every object back through the frames.

    Returns the paths, the row of the object in each earlier frame (-1: not found), (N, K), and
    its place in the sky plane, (N, K, 2).
    """
    objects = frame.objects
    last = frame.object_sky.copy()
    chains = _Chains.starting_at(last, _variance(objects))
    rows = np.full((len(objects), len(earlier)), -1, np.intp)
    places = np.full((len(objects), len(earlier), 2), np.nan)
    misses = np.where(objects["edge"], 9, 0)
    for column, other in enumerate(earlier):
        if not len(other.objects):
            continue
        t = _seconds(other, frame)
        expected = np.where((chains.count >= _LEAST_FRAMES)[:, None], chains.at(t), last)
        distance, nearest = KDTree(other.object_sky).query(
            expected, distance_upper_bound=_REACH_PX
        )
        near = np.flatnonzero((distance < _REACH_PX) & (misses <= _MOST_MISSES))
        there = nearest[near]
        ratio = other.objects["flux"][there] / np.maximum(objects["flux"][near], 1e-9)
        alike = (ratio < _FLUX_RATIO) & (ratio > 1 / _FLUX_RATIO) & ~other.objects["edge"][there]
        near, there = near[alike], there[alike]
        rows[near, column] = there
        last[near] = places[near, column] = other.object_sky[there]
        chains.add(near, t, last[near], _variance(other.objects)[there])
        misses += rows[:, column] < 0
    return chains, rows, places


def _flow_agrees(
    frame: PastFrame, seen: list[tuple[PastFrame, float]], row: int, velocity: Array
) -> bool:
    """Whether Lucas-Kanade against the frames in which it was seen finds the same drift."""
    moved: list[float] = []
    agreement: list[float] = []
    xy = _xy(frame.objects)[row]
    x, y = np.rint(xy).astype(int)
    labels = frame.labels[y - _HALF_PX : y + _HALF_PX + 1, x - _HALF_PX : x + _HALF_PX + 1]
    # A brighter neighbour in the window, and its wings, would be what is measured.
    others = ((labels != 0) & (labels != row + 1)).astype(np.uint8)
    weight = np.where(cv2.dilate(others, np.ones((5, 5), np.uint8)) > 0, 0, _WEIGHT)
    for other, t in seen:
        expected = np.linalg.solve(frame.to_sky[:2, :2], -velocity * t)
        if np.hypot(*expected) < _LEAST_DRIFT_PX / 2:
            continue
        drift, covariance = _flow_against_field(frame, other, xy, weight)
        precision = np.linalg.inv(covariance)
        off = drift - expected
        moved.append(float(np.sqrt(drift @ precision @ drift)))
        agreement.append(moved[-1] / max(float(np.sqrt(off @ precision @ off)), 0.5))
    if not moved:
        return False
    return max(moved) > _FLOW_SIGMAS and float(np.median(agreement)) > 2


def _flow_against_field(
    frame: PastFrame, other: PastFrame, xy: Array, weight: Array
) -> tuple[Array, Array]:
    """Displacement against the field of what is at a point, by iterated Lucas-Kanade in float.

    The weights are those of the pixels of the window around the point.

    Returns
    -------
    drift : (2,) float64
        From where the field's motion carries the other frame to where it is now, px.
    covariance : (2, 2) float64
        Of it, px^2: the noise through the normal equations, so that it is large along a streak,
        where there is no gradient.
    """
    now = _patch(frame.smoothed, xy[0] + _DX, xy[1] + _DY)
    noise = (frame.noise**2 + other.noise**2) * _CORRELATED
    drift = np.zeros(2)
    for _ in range(8):
        points = np.stack([xy[0] + _DX - drift[0], xy[1] + _DY - drift[1]], axis=-1)
        places = other.pixels_of(frame, points.reshape(-1, 2)).reshape(points.shape)
        before = _patch(other.smoothed, places[..., 0], places[..., 1])
        gy, gx = (np.asarray(axis) for axis in np.gradient((now + before) / 2))
        change = now - before
        normal = _normal(gx, gy, weight)
        right = -np.array([np.sum(weight * gx * change), np.sum(weight * gy * change)])
        # The noise's own gradients keep the step small where there are no others.
        step = np.linalg.solve(normal + noise * np.eye(2), right)
        drift += step
        if np.hypot(*step) < 0.01 or np.hypot(*drift) > 8:
            break
    inverse = np.linalg.pinv(normal + 1e-9 * np.trace(normal) * np.eye(2))
    covariance = inverse @ (_normal(gx, gy, weight**2) * noise) @ inverse
    return drift, covariance + _FLOW_FLOOR_PX**2 * np.eye(2)


def _normal(gx: Array, gy: Array, weight: Array) -> Array:
    cross = np.sum(weight * gx * gy)
    return np.array([[np.sum(weight * gx * gx), cross], [cross, np.sum(weight * gy * gy)]])


def _patch(image: NDArray[np.float32], x: Array, y: Array) -> Array:
    values = cv2.remap(
        image,
        x.astype(np.float32),
        y.astype(np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return values.astype(np.float64)


def _seconds(other: PastFrame, frame: PastFrame) -> float:
    return (other.stamp_ns - frame.stamp_ns) / 1e9


def _xy(objects: NDArray[np.void]) -> Array:
    return np.stack([objects["x"], objects["y"]], axis=1)


def _variance(objects: NDArray[np.void]) -> Array:
    """Of a centroid along one axis, px^2."""
    return (objects["sigma_x"] ** 2 + objects["sigma_y"] ** 2) / 2
