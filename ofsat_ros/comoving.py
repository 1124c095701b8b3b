# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Co-moving objects: which of few are the stars, as several frames tell.

Stands between the history and detection, and puts right what the flow of two frames gave.  The
motion that most of their vectors share is that of the stars, if there are many.  Where there are
few, a bright RSO that drifts along with them by less than their errors pulls the fit after it,
and in the sky plane the stars drift.  They do so alike, and over a window of frames that shows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import Drift
from ofsat_ros.following import CENTROID_FLOOR_PX, Paths, follow
from ofsat_ros.history import History, PastFrame
from ofsat_ros.pixels import as_complex, positions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Among more objects than this, no RSO outweighs the stars.
_MOST_OBJECTS = 30
# Among more than so many, two move alike by chance.
_FEW_OBJECTS = 4
# Two objects must have been found together in so many frames, the newest included, to be compared.
_LEAST_FRAMES = 4
# Squared distance of two rates in sigmas, of two axes: what is nearer moves alike; what is
# farther does not.
_ALIKE_SQUARES, _APART_SQUARES = 9.2, 16.0
# What moved by less over these frames may be an error of the places, px.
_LEAST_WAY_PX = 0.8
# Rates of tracks that differ by this part of them, or by less than their errors, are alike.
_RATE_SHARE = 0.1


@dataclass(frozen=True)
class CoMoving:
    """Which objects of the newest frame are stars.

    Attributes
    ----------
    stars : (N,) intp
        Rows of those that move alike; none if tracks do.
    strays : (M,) intp
        Rows of those that surely move otherwise.
    to_sky : list of (3, 3) float64, or None
        Where the history's frames are if those are the stars; None if they are there already.
    tracks : (T,) intp
        Rows of the rates that are the stars', if tracks are.
    drifts : list of Drift
        What had been taken for the field then.
    """

    stars: NDArray[np.intp]
    strays: NDArray[np.intp]
    to_sky: list[Array] | None
    tracks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    drifts: list[Drift] = field(default_factory=list)


def find_comoving(history: History, rates: Array, errors: Array) -> CoMoving | None:
    """Tell the stars of the newest frame by how they moved over the history.

    Parameters
    ----------
    history : History
        The frames, the current one last.
    rates : (N, 2) float64
        Of tracks, in the sky plane, px/s.  If no two objects move alike, but tracks do, those are
        the stars: a telescope that follows an RSO sees it brightest, and standing still.
    errors : (N,) float64
        Std of these rates on each axis, px/s.

    Returns
    -------
    CoMoving or None
        None where there is nothing to tell: many objects, or nothing that moves alike.
    """
    frame, earlier = history[-1], list(history)[-2::-1]
    rows = np.flatnonzero(~frame.objects["edge"])
    if len(earlier) < _LEAST_FRAMES - 1 or not 0 < len(rows) <= _MOST_OBJECTS:
        return None
    paths = follow(frame, earlier, rows)
    # In the sky plane; and in the image, where a turn that a few vectors made up does no harm.
    planes = [_Group(paths, paths.places), _Group(paths, _in_image(paths, (frame, *earlier)))]
    image = len(planes[1]) > len(planes[0])
    group = planes[image]
    if len(group) < 2:
        tracks = _moving_alike(rates, errors)
        if not len(tracks):
            return None
        drift: Array = np.average(rates[tracks], axis=0, weights=errors[tracks] ** -2.0)
        followed = np.flatnonzero(paths.lines.count >= _LEAST_FRAMES)
        drifts = _drifts(paths, followed, drift, [other.number for other in (frame, *earlier)])
        there = [_drifted(other, frame, drift) for other in history]
        return CoMoving(rows[:0], rows[followed], there, tracks, drifts)
    stars = np.flatnonzero(group.members)
    if len(stars) == 2 and np.count_nonzero(paths.lines.count >= _LEAST_FRAMES) > _FEW_OBJECTS:
        return None
    to_sky = None
    # Where nothing moves otherwise, nothing has led the field astray.
    if group.apart.any() and (image or _have_moved(paths, stars)):
        to_sky = _straightened(history, paths, stars, image)
    return CoMoving(rows[stars], rows[group.apart], to_sky)


class _Group:
    """The most of N objects that move alike, given their places, (N, K) x + iy px."""

    def __init__(self, paths: Paths, places: NDArray[np.complex128]) -> None:
        both = paths.found[:, None] & paths.found
        count = both.sum(axis=2)
        # Of pairs: what moves the image moves both.
        between = np.where(both, places[:, None] - places, 0)
        mean = (both @ paths.times) / np.maximum(count, 1)
        since = np.where(both, paths.times - mean[..., None], 0)
        spread = np.maximum((since**2).sum(axis=2), 1e-12)
        rate = (since * between).sum(axis=2) / spread
        floor = CENTROID_FLOOR_PX**2 * paths.found
        variance = (paths.variance + floor).sum(axis=1) / paths.lines.count
        squares = np.abs(rate) ** 2 * spread / (variance[:, None] + variance)
        way = np.abs(rate) * np.max(np.where(both, -paths.times, 0), axis=2)
        known = count >= _LEAST_FRAMES
        alike = known & ((squares < _ALIKE_SQUARES) | (way < _LEAST_WAY_PX))
        np.fill_diagonal(alike, paths.lines.count >= _LEAST_FRAMES)
        # Of groups of as many, that which stands still on the sky as it is; then what agrees best.
        misfit = np.where(alike, np.minimum(squares, _ALIKE_SQUARES), 0).sum(axis=1)
        misfit /= 2 * _ALIKE_SQUARES * (len(alike) + 1)
        own = np.abs(paths.lines.velocity)
        still = own**2 * paths.lines.spread < _ALIKE_SQUARES * variance
        still |= own * np.max(np.where(paths.found, -paths.times, 0), axis=1) < _LEAST_WAY_PX
        self.members = alike[np.argmax(alike.sum(axis=1) + still / 2 - misfit)]
        apart = known & (squares > _APART_SQUARES) & (way > _LEAST_WAY_PX)
        inside = apart[:, self.members]
        self.apart = ~self.members & (2 * inside.sum(axis=1) > np.count_nonzero(self.members))

    def __len__(self) -> int:
        return int(np.count_nonzero(self.members))


def _moving_alike(rates: Array, errors: Array) -> NDArray[np.intp]:
    """Rows of the most tracks that move alike, two at least and most of all; or none."""
    if len(rates) < 2:
        return np.zeros(0, np.intp)
    off = np.hypot(*(rates[:, None] - rates).transpose(2, 0, 1))
    speed = np.hypot(*rates.T)
    reach = np.sqrt(_ALIKE_SQUARES * (errors[:, None] ** 2 + errors**2))
    alike = off < np.maximum(reach, _RATE_SHARE * np.maximum(speed[:, None], speed))
    best = np.flatnonzero(alike[np.argmax(alike.sum(axis=1))])
    return best if len(best) > max(1, len(rates) / 2) else best[:0]


def _drifts(
    paths: Paths, followed: NDArray[np.intp], stars: Array, numbers: list[int]
) -> list[Drift]:
    """Followed objects as what drifts against stars of that rate, px/s."""
    off = np.abs(paths.lines.velocity - complex(*stars))
    sigmas = off * np.sqrt(paths.lines.spread) / paths.error
    log_false = np.log(len(paths.rows)) - sigmas**2 / 2
    return [
        Drift(
            {n: int(row) for n, row in zip(numbers, paths.rows[which], strict=True) if row >= 0},
            float(log_false[which]),
        )
        for which in followed.tolist()
    ]


def _drifted(frame: PastFrame, newest: PastFrame, drift: Array) -> Array:
    """Where a frame is on the sky if the stars drift by so much there, px/s."""
    back = np.eye(3)
    back[:2, 2] = -drift * frame.seconds_since(newest)
    return back @ frame.to_sky


def _in_image(paths: Paths, frames: tuple[PastFrame, ...]) -> NDArray[np.complex128]:
    """The places in the frames' own pixels, (N, K)."""
    places = np.zeros(paths.places.shape, np.complex128)
    for column, frame in enumerate(frames):
        there = paths.found[:, column]
        xy = positions(frame.objects)[paths.rows[there, column]]
        places[there, column] = as_complex(xy)
    return places


def _have_moved(paths: Paths, stars: NDArray[np.intp]) -> bool:
    """Whether the stars' mean place was surely another in one of the frames."""
    found = paths.found[stars]
    off = np.where(found, paths.places[stars] - paths.places[stars, :1], 0)
    weight = found / (paths.variance[stars] + CENTROID_FLOOR_PX**2)
    total = np.maximum(weight.sum(axis=0), 1e-12)
    way = np.abs((weight * off).sum(axis=0) / total)
    # The newest frame's places have errors, too.
    return bool(np.any(way > np.maximum(_LEAST_WAY_PX, np.sqrt(2 * _APART_SQUARES / total))))


def _straightened(
    history: History, paths: Paths, stars: NDArray[np.intp], turned: bool
) -> list[Array]:
    """Where the frames are if the stars stand still; `turned` as the newest one if so asked."""
    newest = history[-1]
    now = paths.places[stars, 0]
    places = []
    shift = np.zeros(2)
    for column, frame in enumerate(list(history)[::-1]):
        matrix = frame.to_sky.copy()
        if turned:
            matrix[:2, :2] = newest.to_sky[:2, :2]
        there = paths.found[stars, column]
        if there.any():
            xy = positions(frame.objects)[paths.rows[stars[there], column]]
            weight = 1 / (paths.variance[stars[there], column] + CENTROID_FLOOR_PX**2)
            sky = np.stack([now[there].real, now[there].imag], axis=1)
            shift = weight @ (sky - xy @ matrix[:2, :2].T) / weight.sum() - matrix[:2, 2]
        # A frame that shows none of them goes with the one after it.
        matrix[:2, 2] += shift
        places.append(matrix)
    return places[::-1]
