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
from ofsat_ros.following import CENTROID_FLOOR_PX, Lines, Paths, as_points, follow
from ofsat_ros.history import History

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
        Which of the tracks are the stars, if any.
    drifts : list of Drift
        What had been taken for the field then.
    """

    stars: NDArray[np.intp]
    strays: NDArray[np.intp]
    to_sky: list[Array] | None
    tracks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    drifts: list[Drift] = field(default_factory=list)


def find_comoving(history: History, tracks: Paths | None = None) -> CoMoving | None:
    """Tell the stars of the newest frame by how they moved over the history.

    Parameters
    ----------
    history : History
        The frames, the current one last.
    tracks : Paths, optional
        Of tracks, if the field's motion is in doubt.  Where no two objects move alike but tracks
        do, those are the stars: a mount that follows an RSO shows it brightest, among streaks.

    Returns
    -------
    CoMoving or None
        None where nothing tells; of many objects, that none is a stray.
    """
    frame, earlier = history[-1], list(history)[-2::-1]
    rows = np.flatnonzero(~frame.objects["edge"])
    if len(rows) > _MOST_OBJECTS:
        return CoMoving(rows[:0], rows[:0], None)
    if len(earlier) < _LEAST_FRAMES - 1 or not len(rows):
        return None
    paths = follow(frame, earlier, rows)
    group = _largest(paths)
    if len(group) < 2:
        return None if tracks is None else _told_by_tracks(history, paths, rows, tracks)
    if group.may_be_chance(paths):
        return None
    stars = np.flatnonzero(group.members)
    to_sky = None
    # Where nothing moves otherwise, nothing has led the field astray.
    if group.apart.any() and (group.in_image or _have_moved(paths, stars)):
        to_sky = _straightened(history, paths, group)
    return CoMoving(rows[stars], rows[group.apart], to_sky)


@dataclass(frozen=True)
class _Group:
    """Which of N objects move alike, and which surely not as they do; (N,) each."""

    members: Mask
    apart: Mask
    in_image: bool

    def __len__(self) -> int:
        return int(np.count_nonzero(self.members))

    def may_be_chance(self, paths: Paths) -> bool:
        """Whether there are so many to choose from that two of them move alike by chance."""
        known = int(np.count_nonzero(paths.lines.count >= _LEAST_FRAMES))
        return len(self) == 2 and known > _FEW_OBJECTS


def _largest(paths: Paths) -> _Group:
    """The most that move alike on the sky, or in the image if there they are more.

    There, a turn that a few vectors made up does no harm.
    """
    sky, image = _group(paths, in_image=False), _group(paths, in_image=True)
    return image if len(image) > len(sky) else sky


def _group(paths: Paths, in_image: bool) -> _Group:
    variance = (paths.variance + CENTROID_FLOOR_PX**2 * paths.found).sum(axis=1)
    variance /= paths.lines.count
    known, squares, way = _compared(paths, paths.image if in_image else paths.places, variance)
    alike = known & ((squares < _ALIKE_SQUARES) | (way < _LEAST_WAY_PX))
    np.fill_diagonal(alike, paths.lines.count >= _LEAST_FRAMES)
    # Of groups of as many, that which stands still on the sky as it is; then what agrees best.
    own = np.abs(paths.lines.velocity)
    still = own**2 * paths.lines.spread < _ALIKE_SQUARES * variance
    still |= own * _span(paths) < _LEAST_WAY_PX
    misfit = np.where(alike, np.minimum(squares, _ALIKE_SQUARES), 0).sum(axis=1)
    misfit /= 2 * _ALIKE_SQUARES * (len(alike) + 1)
    members = alike[np.argmax(alike.sum(axis=1) + still / 2 - misfit)].copy()
    apart = known & (squares > _APART_SQUARES) & (way > _LEAST_WAY_PX)
    # A faint object agrees with all others; they need not with each other.
    members &= 2 * apart[:, members].sum(axis=1) <= np.count_nonzero(members)
    from_most = 2 * apart[:, members].sum(axis=1) > np.count_nonzero(members)
    return _Group(members, ~members & from_most, in_image)


def _compared(
    paths: Paths, places: NDArray[np.complex128], variance: Array
) -> tuple[Mask, Array, Array]:
    """Compare the rates of N objects in pairs: what moves the image moves both.

    Returns which pairs can be compared, the squared distance of their rates in sigmas, and how
    far apart they moved, px; (N, N) each.
    """
    # Pieces of one object share its past, which says nothing of two.
    both = paths.found[:, None] & paths.found & (paths.rows[:, None] != paths.rows)
    count = both.sum(axis=2)
    between = np.where(both, places[:, None] - places, 0)
    mean = (both @ paths.times) / np.maximum(count, 1)
    since = np.where(both, paths.times - mean[..., None], 0)
    spread = np.maximum((since**2).sum(axis=2), 1e-12)
    rate = (since * between).sum(axis=2) / spread
    # Streaks end anywhere: what scatters about its line is known as badly as that.
    middle = between.sum(axis=2) / np.maximum(count, 1)
    off = np.where(both, between - middle[..., None] - rate[..., None] * since, 0)
    scatter = np.sum(np.abs(off) ** 2, axis=2) / np.maximum(2 * (count - 2), 1)
    squares = np.abs(rate) ** 2 * spread / np.maximum(variance[:, None] + variance, scatter)
    way = np.abs(rate) * np.max(np.where(both, -paths.times, 0), axis=2)
    return count >= _LEAST_FRAMES, squares, way


def _told_by_tracks(
    history: History, paths: Paths, rows: NDArray[np.intp], tracks: Paths
) -> CoMoving | None:
    """Take the most tracks that move alike, two at least, for the stars."""
    if not len(tracks.rows):
        return None
    group = _largest(tracks)
    if len(group) < 2 or group.may_be_chance(tracks):
        return None
    velocity = tracks.lines.velocity[group.members].mean()
    off = np.abs(paths.lines.velocity - velocity)
    sigmas = off * np.sqrt(paths.lines.spread) / paths.error
    apart = (paths.lines.count >= _LEAST_FRAMES) & (sigmas**2 > _APART_SQUARES)
    strays = np.flatnonzero(apart & (off * _span(paths) > _LEAST_WAY_PX))
    log_false = np.log(len(rows)) - sigmas**2 / 2
    numbers = [frame.number for frame in history][::-1]
    found = [zip(numbers, paths.rows[which].tolist(), strict=True) for which in strays]
    return CoMoving(
        stars=rows[:0],
        strays=rows[strays],
        to_sky=_straightened(history, tracks, group),
        tracks=np.flatnonzero(group.members),
        drifts=[
            Drift({number: row for number, row in path if row >= 0}, float(log_false[which]))
            for which, path in zip(strays, found, strict=True)
        ],
    )


def _span(paths: Paths) -> Array:
    """Since when each was found, (N,) s."""
    return np.max(np.where(paths.found, -paths.times, 0), axis=1)


def _have_moved(paths: Paths, stars: NDArray[np.intp]) -> bool:
    """Whether the stars' mean place was surely another in one of the frames."""
    found = paths.found[stars]
    off = np.where(found, paths.places[stars] - paths.places[stars, :1], 0)
    weight = found / (paths.variance[stars] + CENTROID_FLOOR_PX**2)
    total = np.maximum(weight.sum(axis=0), 1e-12)
    way = np.abs((weight * off).sum(axis=0) / total)
    # The newest frame's places have errors, too.
    return bool(np.any(way > np.maximum(_LEAST_WAY_PX, np.sqrt(2 * _APART_SQUARES / total))))


def _straightened(history: History, paths: Paths, group: _Group) -> list[Array]:
    """Where the frames are if a group stands still; turned as the newest one if that tells it."""
    newest, stars = history[-1], np.flatnonzero(group.members)
    lines = Lines(paths.times, paths.image[stars], paths.found[stars])
    now = np.where(paths.found[stars, 0], paths.image[stars, 0], lines.at(0.0))
    sky = newest.sky(as_points(now))
    matrices = [frame.to_sky.copy() for frame in history][::-1]
    shifts = np.zeros((len(matrices), 2))
    middle = (np.array(newest.shape[::-1]) - 1) / 2
    for column, matrix in enumerate(matrices):
        if group.in_image:
            # About the middle: what a turn about a corner moves would pass for a shift.
            matrix[:2, 2] += (matrix[:2, :2] - newest.to_sky[:2, :2]) @ middle
            matrix[:2, :2] = newest.to_sky[:2, :2]
        there = paths.found[stars, column]
        if there.any():
            weight = 1 / (paths.variance[stars[there], column] + CENTROID_FLOOR_PX**2)
            xy = as_points(paths.image[stars[there], column])
            off = sky[there] - xy @ matrix[:2, :2].T - matrix[:2, 2]
            shifts[column] = weight @ off / weight.sum()
    known = paths.found[stars].any(axis=0) | (paths.times == 0)
    # A frame that shows none of them lies between, or beyond, those that do.
    for axis in (0, 1):
        line = np.polyfit(paths.times[known], shifts[known, axis], 1)
        shifts[~known, axis] = np.polyval(line, paths.times[~known])
    for matrix, shift in zip(matrices, shifts, strict=True):
        matrix[:2, 2] += shift
    return matrices[::-1]
