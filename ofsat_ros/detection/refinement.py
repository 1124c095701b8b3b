"""Refinement: a spot measured again, with what its track knows of it.

After ``tracking`` has said where a spot belongs and how it moves: a faint streak as a whole, a
point's centroid to the limit that its noise sets.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection.appearance import BORDER_PX, POINT_WIDTH_PX
from ofsat_ros.detection.starlight import star_light
from ofsat_ros.history import PastFrame

Array = NDArray[np.float64]

# What moves less in a frame is no streak, nor what is shorter, px; a streak's half width, px.
_WAY_PX, _LONGEST_POINT_PX, _ACROSS_PX = 6.0, 6.0, 3
_STAR_SIGMAS = 3.0
# A streak must stand out from its brightest point by this, lest noise beside a point pass for one.
_STREAK_SIGMAS = 3.0
# What a point smoothed by 1 px is again weighted with: the narrower, the nearer to a matched
# filter of what it was before, until pixels and noise matter (measured: 1.1 of the bound).
_WINDOW_VARIANCE = 0.5
# Half side of the window of a centroid, and how far it may run, px.
_WINDOW_PX, _FARTHEST_PX = 5, 2.0
_STEPS = np.arange(-_WINDOW_PX, _WINDOW_PX + 1)
# A centroid that moves by less stays, px.
_STILL_PX = 0.01


def refine(
    frame: PastFrame,
    others: Sequence[PastFrame],
    spots: NDArray[np.void],
    motions: Array,
    hidden: NDArray[np.bool_],
) -> NDArray[np.void]:
    """Measure spots again, knowing how they move, with the star light around them subtracted.

    A streak is the part of the line of its motion that stands out most: of all its parts, the one
    of the largest sum over the root of its length, the matched filter of a line.  Noise breaks a
    faint streak into pieces; this measures the whole.  Of a point, a window follows the centroid
    until it stays, as SExtractor's windowed positions do (Bertin and Arnouts 1996): for a Gaussian
    source in white noise nearly as good as a fit.

    Parameters
    ----------
    frame, others
        As in `find_spots`, F others; without others, no star light is subtracted.
    spots : (N,) SPOT_DTYPE
        Spots of the frame.
    motions : (N, 2) float64
        Their displacements in the image, px per frame: no streak is longer.
    hidden : (F, N) bool
        Which of the others show a spot's source itself there, rather than what is behind it.

    Returns
    -------
    (N,) SPOT_DTYPE
        The spots at their new places; as they were at the border, or if a centroid runs away.
    """
    refined = spots.copy()
    ways = np.hypot(motions[:, 0], motions[:, 1])
    points = np.ones(len(spots), bool)
    for row in np.flatnonzero(ways > _WAY_PX):
        behind = [
            other for other, itself in zip(others, hidden[:, row], strict=True) if not itself
        ]
        streak = _refined_streak(frame, behind, spots[row], motions[row] / ways[row], ways[row])
        if streak is not None:
            refined[row], points[row] = streak, False
    refined[points] = _refined_points(frame, others, spots[points], hidden[:, points])
    return refined


def _refined_streak(
    frame: PastFrame,
    others: Sequence[PastFrame],
    spot: np.void,
    direction: Array,
    reach: float,
) -> np.void | None:
    """The spot as a streak along a direction; None if it is none."""
    along = np.arange(-np.ceil(reach), np.ceil(reach) + 1)
    across = np.arange(-_ACROSS_PX, _ACROSS_PX + 1)
    normal = np.array([-direction[1], direction[0]])
    start = np.array([spot["x"], spot["y"]])
    points = (start + along[:, None, None] * direction + across[None, :, None] * normal).reshape(
        -1, 2
    )
    inside = frame.contains(points, 1.0)
    pixels = np.rint(points[inside]).astype(np.intp)
    if not len(pixels):
        return None
    light = np.zeros(len(points))
    light[inside] = frame.smoothed[pixels[:, 1], pixels[:, 0]]
    if others:
        star = star_light(frame, others, pixels).star
        # Where a star shines, what is left of it must not pass for a streak.
        dark = star < _STAR_SIGMAS * frame.noise
        light[inside] = np.where(dark, light[inside] - star, 0)
    weight = np.exp(-(across**2) / (2 * POINT_WIDTH_PX**2))
    profile = light.reshape(len(along), -1) @ weight
    sums = np.concatenate([[0], np.cumsum(profile)])
    first, last = np.triu_indices(len(sums), 1)
    length = last - first
    usable = length <= reach + 2 * POINT_WIDTH_PX
    merit = np.where(usable, (sums[last] - sums[first]) / np.sqrt(length), -np.inf)
    best = int(np.argmax(merit))
    # A point smoothed is about as long as this itself.
    short = length <= _LONGEST_POINT_PX + 2 * POINT_WIDTH_PX
    unit = _line_noise(weight) * frame.noise
    gain = (merit[best] ** 2 - np.max(merit[short]) ** 2) / unit**2
    if short[best] or gain < _STREAK_SIGMAS**2:
        return None
    part = light.reshape(len(along), -1)[first[best] : last[best]].clip(0)
    sideways = float(part.sum(axis=0) @ across) / max(float(part.sum()), 1e-9)
    middle = float(along[0] + (first[best] + last[best] - 1) / 2)
    refined = spot.copy()
    refined["x"], refined["y"] = start + middle * direction + sideways * normal
    refined["length"] = max(float(length[best]) - POINT_WIDTH_PX, 0.0)
    refined["angle"] = np.arctan2(direction[1], direction[0])
    if refined["angle"] <= -np.pi / 2 or refined["angle"] > np.pi / 2:
        refined["angle"] -= np.copysign(np.pi, refined["angle"])
    # Of what the border cuts, the middle is not known.
    ends = start + (middle + np.array([[-0.5], [0.5]]) * length[best]) * direction
    refined["refined"] = frame.contains(ends, BORDER_PX).all()
    return refined


def _line_noise(weight: Array) -> float:
    """Std of a profile's sum over the root of its length, for smoothed noise of std 1.

    The profile is the sum across a line with these weights; noise smoothed by 1 px has the
    correlation exp(-r^2/4), whose sum along a line is sqrt(4 pi).
    """
    offset = np.arange(len(weight))
    correlation = np.exp(-((offset[:, None] - offset) ** 2) / 4)
    return float(np.sqrt(weight @ correlation @ weight * np.sqrt(4 * np.pi)))


def _refined_points(
    frame: PastFrame,
    others: Sequence[PastFrame],
    spots: NDArray[np.void],
    hidden: NDArray[np.bool_],
) -> NDArray[np.void]:
    refined = spots.copy()
    middle = np.rint(np.stack([spots["x"], spots["y"]], axis=1))
    rows = np.flatnonzero(frame.contains(middle, _WINDOW_PX))
    if not len(rows):
        return refined
    middle = middle[rows]
    light = _windows(frame, others, middle.astype(np.intp), hidden[:, rows])
    start = np.stack([spots["x"][rows], spots["y"][rows]], axis=1) - middle
    place, lost = _centroids(light, start)
    found = rows[~lost]
    refined["x"][found], refined["y"][found] = (place + middle)[~lost].T
    refined["refined"][found] = True
    return refined


def _windows(
    frame: PastFrame,
    others: Sequence[PastFrame],
    middle: NDArray[np.intp],
    hidden: NDArray[np.bool_],
) -> Array:
    """The light around pixels (N, 2), less that of the stars, (N, side, side) DN."""
    side = len(_STEPS)
    y, x = np.broadcast_arrays(
        middle[:, 1, None, None] + _STEPS[:, None], middle[:, 0, None, None] + _STEPS
    )
    light = frame.smoothed[y, x].astype(np.float64)
    if others:
        pixels = np.stack([x.ravel(), y.ravel()], axis=1)
        star = star_light(frame, others, pixels, np.repeat(hidden, side**2, axis=1)).star
        light -= star.reshape(light.shape)
    return light


def _centroids(light: Array, start: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Centroids in windows, from their middle, (N, 2) px, and which of them run away, (N,)."""
    place = start.copy()
    lost = np.zeros(len(light), bool)
    moving = ~lost
    # The narrower the window, the less of a shift it shows.
    gain = 1 + POINT_WIDTH_PX**2 / _WINDOW_VARIANCE
    for _ in range(8):
        off = _STEPS - place[:, :, None]
        weight = np.exp(-(off**2) / (2 * _WINDOW_VARIANCE))
        across = np.stack([weight[:, 0], weight[:, 0] * off[:, 0]], axis=2)
        down = np.stack([weight[:, 1], weight[:, 1] * off[:, 1]], axis=1)
        # Sums of the light times the weight, times it and x, and times it and y.
        (total, x), (y, _) = (down @ light @ across).transpose(1, 2, 0)
        dark = total <= 0
        step = gain * np.stack([x, y], axis=1) / np.where(dark, np.inf, total)[:, None]
        step[~moving] = 0
        place += step
        lost |= dark | (_length(place - start) > _FARTHEST_PX)
        moving &= ~lost & (_length(step) >= _STILL_PX)
        if not moving.any():
            break
    return place, lost


def _length(way: Array) -> Array:
    return np.hypot(way[:, 0], way[:, 1])
