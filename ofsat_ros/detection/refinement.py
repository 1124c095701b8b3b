# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Refinement: a spot measured again, with what its track knows of it.

After ``tracking`` has said where a spot belongs and how it moves: a faint streak as a whole, a
point's centroid to the limit that its noise sets.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection.appearance import BORDER_PX
from ofsat_ros.detection.starlight import star_light
from ofsat_ros.detection.two_frames import POINT_WIDTH_PX
from ofsat_ros.history import PastFrame
from ofsat_ros.pixels import positions

Array = NDArray[np.float64]

# What moves less in a frame is no streak, nor what is shorter, px; a streak's half width, px.
_WAY_PX, _LONGEST_POINT_PX, _ACROSS_PX = 2.5, 2.0, 3
# How far beyond a streak its light reaches; what is longer is measured by this part of it, px.
_POINT_REACH_PX, _LONGEST_STREAK_PX = 4, 300.0
# What may be left of a star's light, in parts of it, and how much of the noise that may be.
_STAR_LEFT, _STAR_SIGMAS = 0.1, 3.0
# A streak must stand out from its brightest point by this, lest noise beside a point pass for one.
_STREAK_SIGMAS = 3.0
# What a point smoothed by 1 px is again weighted with: the narrower, the nearer to a matched
# filter of what it was before, until pixels and noise matter (measured: 1.1 of the bound).
_WINDOW_VARIANCE = 0.5
# Half side of the window of a centroid, and how far it may run, px.
_WINDOW_PX, _FARTHEST_PX = 5, 2.0
_STEPS = np.arange(-_WINDOW_PX, _WINDOW_PX + 1)
# Places across a streak, px, and the pixels around a place between them.
_ACROSS = np.arange(-_ACROSS_PX, _ACROSS_PX + 1.0)
_CORNERS = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
# So far from a source, its wings are in the noise, px.
WINGS_PX = 6.0
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
    of the largest sum over its noise, which in the smoothed image is the matched filter of a line.
    Noise breaks a faint streak into pieces; this measures the whole, and its middle where moving
    the part gains nothing.  Of a point, a window follows the centroid until it stays, as
    SExtractor's windowed positions do (Bertin and Arnouts 1996): for a Gaussian source in white
    noise nearly as good as a fit.

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
    moving = np.flatnonzero(ways > _WAY_PX)
    directions = motions[moving] / ways[moving, None]
    strips = [
        _strip(spot, direction, reach)
        for spot, direction, reach in zip(spots[moving], directions, ways[moving], strict=True)
    ]
    lights = _lights(frame, others, spots[moving], strips, hidden[:, moving])
    for row, direction, light in zip(moving, directions, lights, strict=True):
        streak = _refined_streak(frame, spots[row], direction, ways[row], light)
        if streak is not None:
            refined[row], points[row] = streak, False
    refined[points] = _refined_points(frame, others, spots[points], hidden[:, points])
    return refined


def _strip(spot: np.void, direction: Array, reach: float) -> Array:
    """Points around a spot along a direction and across, (N, M, 2) px."""
    half = int(np.ceil(min(reach, _LONGEST_STREAK_PX))) + _POINT_REACH_PX
    along = np.arange(-half, half + 1.0)
    normal = np.array([-direction[1], direction[0]])
    start = np.array([spot["x"], spot["y"]])
    return start + along[:, None, None] * direction + _ACROSS[None, :, None] * normal


def _lights(
    frame: PastFrame,
    others: Sequence[PastFrame],
    spots: NDArray[np.void],
    strips: Sequence[Array],
    hidden: NDArray[np.bool_],
) -> list[Array]:
    """The light at points of S spots' strips, given which of the others show them, (F, S).

    What is beyond a spot's wings is not itself in the others either.
    """
    if not strips:
        return []
    points = np.concatenate([strip.reshape(-1, 2) for strip in strips])
    sizes = [strip.shape[0] * strip.shape[1] for strip in strips]
    reach = np.repeat(spots["length"] / 2 + WINGS_PX, sizes)
    near = _length(points - np.repeat(positions(spots), sizes, axis=0)) <= reach
    itself = np.repeat(hidden, sizes, axis=1) & near
    light = _light_between(frame, others, points, itself)
    parts = np.split(light, np.cumsum(sizes)[:-1])
    return [part.reshape(strip.shape[:2]) for part, strip in zip(parts, strips, strict=True)]


def _refined_streak(
    frame: PastFrame, spot: np.void, direction: Array, reach: float, light: Array
) -> np.void | None:
    """The spot as a streak along a direction, given the light of its strip; None if it is none."""
    across, along = _ACROSS, np.arange(len(light)) - len(light) // 2
    normal = np.array([-direction[1], direction[0]])
    start = np.array([spot["x"], spot["y"]])
    weight = np.exp(-(across**2) / (2 * POINT_WIDTH_PX**2))
    profile = _profile(light, weight)
    near = float(spot["length"]) / 2 + _FARTHEST_PX
    first, last = _segment(profile, reach, near, _noise_across(weight) * frame.noise)
    if last - first <= _LONGEST_POINT_PX:
        return None
    sideways = _centroid(np.nan_to_num(light[first:last]).sum(axis=0), across)
    if abs(sideways) > _FARTHEST_PX:  # to a star beside it
        return None
    weight = np.exp(-((across - sideways) ** 2) / (2 * _WINDOW_VARIANCE))
    middle = along[0] + _middle(_profile(light, weight), first, last)
    refined = spot.copy()
    refined["x"], refined["y"] = start + middle * direction + sideways * normal
    refined["length"] = last - first
    refined["angle"] = np.arctan2(direction[1], direction[0])
    if refined["angle"] <= -np.pi / 2 or refined["angle"] > np.pi / 2:
        refined["angle"] -= np.copysign(np.pi, refined["angle"])
    ends = np.array([-0.5, 0.5]) * (last - first + POINT_WIDTH_PX)
    places = start + (middle + ends)[:, None] * direction
    refined["refined"] = frame.contains(places, BORDER_PX).all()
    if not refined["refined"]:
        # Of what the border cuts, the middle is not known: the streak may be as long as the way.
        cut = max(reach - (last - first), 0.0) / 2
        refined["sigma_x"] = np.hypot(spot["sigma_x"], cut * direction[0])
        refined["sigma_y"] = np.hypot(spot["sigma_y"], cut * direction[1])
    return refined


def _light_between(
    frame: PastFrame, others: Sequence[PastFrame], points: Array, hidden: NDArray[np.bool_]
) -> Array:
    """The light at points between pixels, (N, 2) px, less that of the stars, (N,) DN.

    NaN beside bright stars: what is left of a star must not pass for a streak.  Outside of the
    image there is none.  What others show where `hidden`, (F, N), does not count.
    """
    inside = frame.contains(points, 1.0)
    corner = np.floor(points[inside]).astype(np.intp)
    part = points[inside] - corner
    pixels = (corner + _CORNERS[:, None]).reshape(-1, 2)
    values = frame.smoothed[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    if others and len(pixels):
        star = star_light(frame, others, pixels, np.tile(hidden[:, inside], 4)).star
        values = np.where(_STAR_LEFT * star < _STAR_SIGMAS * frame.noise, values - star, np.nan)
    weight = np.abs(1 - _CORNERS[:, None] - part).prod(axis=2)
    light = np.zeros(len(points))
    light[inside] = (values.reshape(4, -1) * weight).sum(axis=0)
    return light


def _profile(light: Array, weight: Array) -> Array:
    """Sums across of the light, (N, M), with weights, (M,), over what is known; between, lines."""
    known = ~np.isnan(light)
    share = known @ weight / weight.sum()
    sure = share > 0.5
    if not sure.any():
        return np.zeros(len(light))
    sums = np.nan_to_num(light) @ weight / np.where(sure, share, 1)
    rows = np.arange(len(light))
    return np.interp(rows, rows[sure], sums[sure])


def _segment(profile: Array, reach: float, near: float, unit: float) -> tuple[int, int]:
    """First and last (not included) of the samples of a profile that stand out most together.

    Of smoothed light, the sum over a segment is the matched filter of a streak of its length.
    It is `reach` long at most, and as near to the profile's middle as told: a spot is a piece of
    its streak, and what else shines on the line of its motion is a star; what is brighter than
    the spot is, too, and counts as bright as that.  `unit` is the profile's noise.
    """
    spot = len(profile) // 2
    own = profile[max(0, spot - int(near)) : spot + int(near) + 1]
    sums = np.concatenate([[0], np.cumsum(np.minimum(profile, np.max(own)))])
    first, last = np.triu_indices(len(sums), 1)
    length = last - first
    # Variance of a sum of so many samples, whose correlation is exp(-r^2 / 4): each one more has
    # its own, and twice that with all before.
    correlation = np.exp(-(np.arange(1, len(profile)) ** 2) / 4)
    grows = 1 + 2 * np.concatenate([[0], np.cumsum(correlation)])
    variance = np.cumsum(grows)[length - 1]
    merit = (sums[last] - sums[first]) / np.sqrt(variance)
    apart = (first > spot + near) | (last - 1 < spot - near)
    merit[apart | (length > reach + 1)] = -np.inf
    best, short = int(np.argmax(merit)), length <= _LONGEST_POINT_PX
    gain = (merit[best] ** 2 - np.max(merit[short]) ** 2) / unit**2
    if gain < _STREAK_SIGMAS**2:
        best = int(np.argmax(np.where(short, merit, -np.inf)))
    return int(first[best]), int(last[best])


def _middle(profile: Array, first: int, last: int) -> float:
    """The middle of a streak, in samples: where its two ends are equally bright.

    There the sum over its length is largest, the matched filter for a place between samples.
    """
    samples = np.arange(len(profile), dtype=float)
    middle, half = (first + last - 1) / 2, (last - first) / 2
    offsets = np.linspace(-_FARTHEST_PX, _FARTHEST_PX, 81)
    ends = [np.interp(middle + offsets + end, samples, profile) for end in (half, -half)]
    difference = ends[0] - ends[1]
    # The sum grows while what comes in at the far end is more than what goes out.
    sums = np.cumsum(difference)
    at = int(np.argmax(sums))
    if 0 < at < len(offsets) - 1:
        before, after = difference[at], difference[at + 1]
        if before > after:
            return middle + offsets[at] + before / (before - after) * (offsets[1] - offsets[0])
    return middle + offsets[at]


def _centroid(light: Array, places: Array) -> float:
    """Centroid of a profile of a point, as `_centroids`, from the middle."""
    place = 0.0
    gain = 1 + POINT_WIDTH_PX**2 / _WINDOW_VARIANCE
    for _ in range(8):
        weight = light * np.exp(-((places - place) ** 2) / (2 * _WINDOW_VARIANCE))
        total = weight.sum()
        if total <= 0:
            break
        step = gain * float(weight @ (places - place)) / total
        place = float(np.clip(place + step, places[0], places[-1]))
        if abs(step) < _STILL_PX:
            break
    return place


def _noise_across(weight: Array) -> float:
    """Std of a sum across with these weights, of smoothed noise of std 1.

    Noise smoothed by 1 px has the correlation exp(-r^2/4).
    """
    offset = np.arange(len(weight))
    correlation = np.exp(-((offset[:, None] - offset) ** 2) / 4)
    return float(np.sqrt(weight @ correlation @ weight))


def _refined_points(
    frame: PastFrame,
    others: Sequence[PastFrame],
    spots: NDArray[np.void],
    hidden: NDArray[np.bool_],
) -> NDArray[np.void]:
    refined = spots.copy()
    xy = positions(spots)
    middle = np.rint(xy)
    rows = np.flatnonzero(frame.contains(middle, _WINDOW_PX))
    if not len(rows):
        return refined
    middle = middle[rows]
    light = _windows(frame, others, middle.astype(np.intp), hidden[:, rows])
    place, lost = _centroids(light, xy[rows] - middle)
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
