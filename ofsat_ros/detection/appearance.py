# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Spots: what shines where the star field, as the other frames show it, has nothing.

What ``starlight`` leaves over is a spot: an RSO, noise, a cosmic ray or a defect of the sensor.
Which of them it is, only its motion tells; that is ``tracking``'s part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection.starlight import (
    BRIGHT_SIGMAS,
    excess_over_stars,
    star_error_of,
    star_light,
)
from ofsat_ros.detection.two_frames import MEASURED_FIELDS, POINT_WIDTH_PX, first_of_each
from ofsat_ros.history import PastFrame
from ofsat_ros.parallel import in_parallel
from ofsat_ros.pixels import (
    SPOT_PIXEL_SIGMAS,
    connected,
    positions,
    rows_and_columns,
    streak_of,
)

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SPOT_DTYPE = np.dtype(
    [
        ("x", "f8"),  # centroid, px
        ("y", "f8"),
        ("sigma_x", "f8"),  # std of the centroid, px
        ("sigma_y", "f8"),
        ("excess", "f8"),  # brightness over the star field's, in sigmas
        ("snr", "f8"),  # of the object, or the excess
        ("flux", "f8"),  # DN
        ("length", "f8"),  # px
        ("angle", "f8"),  # rad, from x to y
        ("clean", "?"),  # no star at or beside it
        ("refined", "?"),  # measured with what its track knows
        ("object_index", "i4"),  # row of the frame's objects, -1 for none
    ]
)

# Small groups of pixels, and the star light under which there is none, in sigmas.
_SMALL_PX, _DARK_SIGMAS = 12, 0.5
# A pixel of a star that is worth a look is brighter than before by this, in sigmas.
_BRIGHTER_SIGMAS = 2.0
# So many of them are looked at together.
_PART = 16384
# Spots nearer to the border are cut by it, px.
BORDER_PX = 3.5
# Where the surroundings of a spot are looked at: outside a point, and at many sides of a streak.
# Noise gives them less than this.
_RING_PX, _RING_POINTS, _RING_SIGMAS = 7.0, 12, 1.0
# An object whose light is new by this fraction is the spot; of others the spot is a part.
_MOSTLY_NEW = 0.7


def find_spots(
    frame: PastFrame, others: Sequence[PastFrame], spot_sigmas: float
) -> NDArray[np.void]:
    """Find what shines in a frame and not at the same place of the sky in others.

    The star light at a pixel is the median of the other frames' brightness at the place that the
    field's motion carries it to.  The excess over it is taken in units of its uncertainty: the
    noise, that of the median where there is a star, the spread of the other frames, and a
    fraction of the brightest light within 2 px, which bounds what errors of registration and
    changes of seeing leave of a star.

    Parameters
    ----------
    frame : PastFrame
        The frame to search.
    others : sequence of PastFrame
        Frames to compare with.
    spot_sigmas : float
        Least peak of a spot, in sigmas.

    Returns
    -------
    (K,) SPOT_DTYPE
        The largest excess first; none if `others` is empty.
    """
    if not (frame.bright.size and others):
        return np.zeros(0, SPOT_DTYPE)
    pixels, excess, clean, star = _fresh_pixels(frame, others, spot_sigmas)
    spots = _measure(frame, pixels, excess, clean, star)
    xy = positions(spots)
    inside = frame.contains(xy, BORDER_PX)
    if frame.blind is not None:
        column, row = np.rint(xy).astype(np.intp).T
        inside &= ~frame.blind[row, column]
    spots = spots[inside]
    wide = _surroundings(frame, others, spots)
    spots["excess"] -= wide
    spots["snr"] -= np.where(spots["object_index"] < 0, wide, 0)
    spots = spots[spots["excess"] > spot_sigmas]
    spots = spots[np.argsort(-spots["excess"], kind="stable")]
    return spots[first_of_each(spots["object_index"])]


def _fresh_pixels(
    frame: PastFrame, others: Sequence[PastFrame], spot_sigmas: float
) -> tuple[Index, Array, NDArray[np.bool_], Array]:
    """Pixels (N, 2) of spots, their excess in sigmas, whether no star is near, the star light, DN.

    Most bright pixels are noise or stars, and each look into all other frames has its cost.
    Small groups of pixels without a star are judged by their brightest one; of stars, only those
    pixels are looked at that are brighter than in two of the frames.
    """
    pixels, light, noise, group, count = _bright_groups(frame)
    sigmas = light / noise
    highest = np.zeros(count)
    np.maximum.at(highest, group, sigmas)
    peaks = np.flatnonzero((sigmas == highest[group]) & (sigmas > spot_sigmas))
    peaks = peaks[np.unique(group[peaks], return_index=True)[1]]
    error = star_error_of(frame, others, pixels[light > BRIGHT_SIGMAS * frame.noise])
    excess, clean, star = excess_over_stars(frame, others, pixels[peaks], error, SPOT_PIXEL_SIGMAS)

    size = np.bincount(group, minlength=count)[group[peaks]]
    alone = (size <= _SMALL_PX) & (star < _DARK_SIGMAS * noise[peaks])
    peak_of = np.full(count, -1)
    spot = np.flatnonzero(alone & (excess > spot_sigmas))
    peak_of[group[peaks[spot]]] = spot
    together = np.flatnonzero(peak_of[group] >= 0)
    peak = peak_of[group[together]]
    first = (light[together] - star[peak]) / noise[together], clean[peak], star[peak]

    at_stars = np.zeros(count, bool)
    at_stars[group[peaks[~alone]]] = True
    single = np.flatnonzero(at_stars[group])
    single = single[_brighter(frame, others, pixels[single], light[single], noise[single])]
    second = excess_over_stars(frame, others, pixels[single], error, SPOT_PIXEL_SIGMAS)

    rows = np.concatenate([together, single])
    excess, clean, star = (np.concatenate(both) for both in zip(first, second, strict=True))
    fresh = np.flatnonzero(excess > SPOT_PIXEL_SIGMAS)
    # In the order of the image again.
    fresh = fresh[np.argsort(rows[fresh], kind="stable")]
    return pixels[rows[fresh]], excess[fresh], clean[fresh], star[fresh]


def _bright_groups(frame: PastFrame) -> tuple[Index, Array, Array, Index, int]:
    """Bright pixels (N, 2), their light and noise, DN, their groups, and how many groups."""
    y, x = rows_and_columns(frame.bright, frame.shape[1])
    pixels = np.stack([x, y], axis=1)
    light = frame.smoothed.ravel()[frame.bright].astype(np.float64)
    noise = frame.noise_at(pixels)
    usable = np.flatnonzero(light > SPOT_PIXEL_SIGMAS * noise)
    group, count = connected(frame.bright[usable], frame.shape[1])
    return pixels[usable], light[usable], noise[usable], group, count


def _brighter(
    frame: PastFrame,
    others: Sequence[PastFrame],
    pixels: Index,
    light: Array,
    noise: Array,
) -> NDArray[np.bool_]:
    """Whether pixels are brighter than in one of two frames, near in time and far, (N,).

    What is not, is no spot: the median of all frames is hardly less than the least of two.
    """
    by_age = sorted(others, key=lambda other: abs(other.number - frame.number))

    def look(first: int) -> NDArray[np.bool_]:
        part = np.s_[first : first + _PART]
        before, _, _ = frame.seen_by((by_age[0], by_age[-1]), pixels[part])
        return ~np.all(light[part] - before < _BRIGHTER_SIGMAS * noise[part], axis=0)

    parts = in_parallel(look, range(0, len(pixels), _PART))
    return np.concatenate(parts) if parts else np.zeros(0, bool)


def _surroundings(frame: PastFrame, others: Sequence[PastFrame], spots: NDArray[np.void]) -> Array:
    """Light around each spot that is no star's, in sigmas, (N,): a wisp of a cloud is wide."""
    angle = np.arange(_RING_POINTS) * 2 * np.pi / _RING_POINTS
    ring = _RING_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = positions(spots)
    limit = np.array(frame.shape[::-1]) - 1
    pixels = np.clip(np.rint(xy[:, None] + ring), 0, limit).astype(np.intp)
    noise = frame.noise_at(pixels.reshape(-1, 2)).reshape(pixels.shape[:2])
    light = frame.smoothed[pixels[..., 1], pixels[..., 0]] / noise
    around = np.zeros(len(spots))
    if len(spots):
        # Without the stars it is darker still.
        rows = np.flatnonzero(np.median(light, axis=1) > _RING_SIGMAS)
        star = star_light(frame, others, pixels[rows].reshape(-1, 2)).star
        light = light[rows] - star.reshape(len(rows), _RING_POINTS) / noise[rows]
        around[rows] = np.median(light, axis=1)
    return np.where(around > _RING_SIGMAS, around, 0)


def spot_near(
    frame: PastFrame, others: Sequence[PastFrame], xy: Array, radius_px: int, least_sigmas: float
) -> NDArray[np.void]:
    """Look for a spot near a point where one is expected, under the usual threshold too.

    Parameters
    ----------
    frame, others
        As in `find_spots`.
    xy : (2,) float64
        Where it is expected, px.
    radius_px : int
        How far from it to look.
    least_sigmas : float
        Least excess.

    Returns
    -------
    (0,) or (1,) SPOT_DTYPE
        The spot of the largest excess.
    """
    steps = np.arange(-radius_px - 1, radius_px + 2)
    dx, dy = (axis.ravel() for axis in np.meshgrid(steps, steps))
    pixels = np.stack([dx, dy], axis=1) + np.rint(xy).astype(np.intp)
    pixels = pixels[frame.contains(pixels.astype(float), BORDER_PX)]
    if not (len(pixels) and others):
        return np.zeros(0, SPOT_DTYPE)
    excess, clean, star = excess_over_stars(frame, others, pixels)
    near = np.hypot(*(pixels - xy).T) <= radius_px + 0.5
    if not near.any() or np.max(excess[near]) < least_sigmas:
        return np.zeros(0, SPOT_DTYPE)
    best = np.flatnonzero(near)[np.argmax(excess[near])]
    # Centroid of the brightest pixel and those around it.
    core = (np.max(np.abs(pixels - pixels[best]), axis=1) <= 1) & (excess > 0)
    spot = _measure(frame, pixels[core], excess[core], clean[core], star[core])
    return spot[np.argsort(-spot["excess"])][:1]


def _measure(
    frame: PastFrame,
    pixels: Index,
    excess: Array,
    clean: NDArray[np.bool_],
    star: Array,
) -> NDArray[np.void]:
    """One spot for each connected group of pixels, which are in the order of the image."""
    if not len(pixels):
        return np.zeros(0, SPOT_DTYPE)
    x, y = pixels.T
    group, count = connected(y * frame.shape[1] + x, frame.shape[1])

    def mean(values: NDArray, weight: Array) -> Array:
        return np.bincount(group, weight * values, count) / np.bincount(group, weight, count)

    spots = np.zeros(count, SPOT_DTYPE)
    weight = np.maximum(excess, 1e-3)
    cx, cy = mean(x, weight**2), mean(y, weight**2)
    dx, dy = x - cx[group], y - cy[group]
    # A pixel is a square of side 1: its variance keeps a single pixel from having none.
    xx, yy = mean(dx * dx, weight) + 1 / 12, mean(dy * dy, weight) + 1 / 12
    peak = np.full(count, -np.inf)
    np.maximum.at(peak, group, excess)
    top_pixel = np.zeros(count, np.intp)
    highest = np.flatnonzero(excess == peak[group])
    top_pixel[group[highest]] = highest
    spots["x"], spots["y"], spots["excess"], spots["snr"] = cx, cy, peak, peak
    spots["sigma_x"] = spots["sigma_y"] = POINT_WIDTH_PX / np.maximum(peak, 1)
    spots["length"], spots["angle"] = streak_of(xx, yy, mean(dx * dy, weight), peak)
    spots["clean"] = mean(clean, weight**2) > 0.5
    light = frame.smoothed[y, x] - star
    # A Gaussian's flux is its peak times its area.
    spots["flux"] = light[top_pixel] * 2 * np.pi * POINT_WIDTH_PX**2
    owner = frame.regions.at(y, x)
    new = np.bincount(owner[owner >= 0], light[owner >= 0], len(frame.objects))
    spots["object_index"] = owner[top_pixel]
    _take_objects(spots, frame, new.astype(np.float64))
    return spots


def _take_objects(spots: NDArray[np.void], frame: PastFrame, new: Array) -> None:
    """Measure a spot by its object, if the object is the spot and not a star beside it."""
    objects = frame.objects
    owned = spots["object_index"] >= 0
    index = spots["object_index"][owned]
    shift = np.hypot(
        objects["x"][index] - spots["x"][owned], objects["y"][index] - spots["y"][owned]
    )
    fraction = new[index] / np.maximum(frame.object_light[index], 1e-9)
    round_one = (objects["length"][index] < 4) & (shift < 2.5)
    same = (fraction > _MOSTLY_NEW) | round_one
    rows = np.flatnonzero(owned)[same]
    for name in MEASURED_FIELDS:
        spots[name][rows] = objects[name][index[same]]
    spots["object_index"][np.flatnonzero(owned)[~same]] = -1
