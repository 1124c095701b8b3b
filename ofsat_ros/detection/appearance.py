"""Spots: what shines where the star field, as the other frames show it, has nothing.

Brightness constancy under the field's motion (Lucas and Kanade's premise, taken over a window of
frames): a star shines at the same place of the sky in all of them, also when it is below the
threshold and when it is a piece of a streak.  What is left over is a spot: an RSO, noise, a
cosmic ray or a defect of the sensor.  Which of them it is, only its motion tells; that is
``tracking``'s part.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.history import PastFrame

Array = NDArray[np.float64]

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

# Where spots' pixels end, in sigmas; their peaks exceed `spot_sigmas`.
_LOW_SIGMAS = 2.5
# A star is not told from its changes better than this fraction of the brightness nearby: errors
# of registration and interpolation, seeing.
_STAR_ERROR = 0.05
# Spots nearer to the border are cut by it, px.
BORDER_PX = 3.5
# Gaussian width of a point source in the smoothed image, px: a PSF of about 1 and the smoothing.
_POINT_WIDTH_PX = 1.4
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
# Where the surroundings of a spot are looked at: outside a point, and at many sides of a streak.
# Noise gives them less than this.
_RING_PX, _RING_POINTS, _RING_SIGMAS = 7.0, 12, 1.0
# An object whose light is new by this fraction is the spot; of others the spot is a part.
_MOSTLY_NEW = 0.7
# A star that clouds hid from most frames still shines in one; a slow RSO has left its place
# after this many.
_STAR_AGE = 4


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
    bright = cv2.findNonZero(cv2.compare(frame.smoothed, _LOW_SIGMAS * frame.noise, cv2.CMP_GT))
    if bright is None or not others:
        return np.zeros(0, SPOT_DTYPE)
    pixels = bright.reshape(-1, 2).astype(np.intp)
    excess, clean, star = _excess(frame, others, pixels)
    fresh = np.flatnonzero(excess > _LOW_SIGMAS)
    spots = _measure(frame, pixels[fresh], excess[fresh], clean[fresh], star[fresh])
    inside = frame.contains(np.stack([spots["x"], spots["y"]], axis=1), BORDER_PX)
    spots = spots[inside]
    wide = _surroundings(frame, others, spots)
    spots["excess"] -= wide
    spots["snr"] -= np.where(spots["object_index"] < 0, wide, 0)
    spots = spots[spots["excess"] > spot_sigmas]
    spots = spots[np.argsort(-spots["excess"], kind="stable")]
    return _one_per_object(spots)


def _surroundings(frame: PastFrame, others: Sequence[PastFrame], spots: NDArray[np.void]) -> Array:
    """Light around each spot that is no star's, in sigmas, (N,): a wisp of a cloud is wide."""
    angle = np.arange(_RING_POINTS) * 2 * np.pi / _RING_POINTS
    ring = _RING_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = np.stack([spots["x"], spots["y"]], axis=1)
    limit = np.array(frame.shape[::-1]) - 1
    pixels = np.clip(np.rint(xy[:, None] + ring), 0, limit).astype(np.intp).reshape(-1, 2)
    if not len(pixels):
        return np.zeros(0)
    star = _excess(frame, others, pixels)[2]
    light = frame.smoothed[pixels[:, 1], pixels[:, 0]] - star
    light /= frame.noise_at(pixels)
    around = np.median(light.reshape(len(spots), -1), axis=1)
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
    excess, clean, star = _excess(frame, others, pixels)
    near = np.hypot(*(pixels - xy).T) <= radius_px + 0.5
    if not near.any() or np.max(excess[near]) < least_sigmas:
        return np.zeros(0, SPOT_DTYPE)
    best = np.flatnonzero(near)[np.argmax(excess[near])]
    # Centroid of the brightest pixel and those around it.
    core = (np.max(np.abs(pixels - pixels[best]), axis=1) <= 1) & (excess > 0)
    spot = _measure(frame, pixels[core], excess[core], clean[core], star[core])
    return spot[np.argsort(-spot["excess"])][:1]


def refine(frame: PastFrame, others: Sequence[PastFrame], spot: np.void, motion: Array) -> np.void:
    """Measure a spot again, knowing how it moves, with the star light around it subtracted.

    A streak is the part of the line of its motion that stands out most: of all its parts, the one
    of the largest sum over the root of its length, the matched filter of a line.  Noise breaks a
    faint streak into pieces; this measures the whole.  Of a point, a window follows the centroid
    until it stays, as SExtractor's windowed positions do (Bertin and Arnouts 1996): for a Gaussian
    source in white noise nearly as good as a fit.

    Parameters
    ----------
    frame, others
        As in `find_spots`; without others, no star light is subtracted.
    spot : SPOT_DTYPE
        A spot of the frame.
    motion : (2,) float64
        Its displacement in the image, px per frame: no streak is longer.

    Returns
    -------
    SPOT_DTYPE
        The spot at its new place; as it was at the border, or if its centroid runs away.
    """
    way = float(np.hypot(*motion))
    streak = _refined_streak(frame, others, spot, motion / way, way) if way > _WAY_PX else None
    return _refined_point(frame, others, spot) if streak is None else streak


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
        star = _excess(frame, others, pixels)[2]
        # Where a star shines, what is left of it must not pass for a streak.
        dark = star < _STAR_SIGMAS * frame.noise
        light[inside] = np.where(dark, light[inside] - star, 0)
    weight = np.exp(-(across**2) / (2 * _POINT_WIDTH_PX**2))
    profile = light.reshape(len(along), -1) @ weight
    sums = np.concatenate([[0], np.cumsum(profile)])
    first, last = np.triu_indices(len(sums), 1)
    length = last - first
    usable = length <= reach + 2 * _POINT_WIDTH_PX
    merit = np.where(usable, (sums[last] - sums[first]) / np.sqrt(length), -np.inf)
    best = int(np.argmax(merit))
    # A point smoothed is about as long as this itself.
    short = length <= _LONGEST_POINT_PX + 2 * _POINT_WIDTH_PX
    unit = _line_noise(weight) * frame.noise
    gain = (merit[best] ** 2 - np.max(merit[short]) ** 2) / unit**2
    if short[best] or gain < _STREAK_SIGMAS**2:
        return None
    part = light.reshape(len(along), -1)[first[best] : last[best]].clip(0)
    sideways = float(part.sum(axis=0) @ across) / max(float(part.sum()), 1e-9)
    middle = float(along[0] + (first[best] + last[best] - 1) / 2)
    refined = spot.copy()
    refined["x"], refined["y"] = start + middle * direction + sideways * normal
    refined["length"] = max(float(length[best]) - _POINT_WIDTH_PX, 0.0)
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


def _refined_point(frame: PastFrame, others: Sequence[PastFrame], spot: np.void) -> np.void:
    start = np.array([spot["x"], spot["y"]])
    steps = np.arange(-_WINDOW_PX, _WINDOW_PX + 1)
    dx, dy = (axis.ravel() for axis in np.meshgrid(steps, steps))
    pixels = np.stack([dx, dy], axis=1) + np.rint(start).astype(np.intp)
    if not frame.contains(pixels.astype(float)).all():
        return spot
    light = frame.smoothed[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    if others:
        light -= _excess(frame, others, pixels)[2]
    place = start.copy()
    for _ in range(8):
        off = pixels - place
        weight = light * np.exp(-np.sum(off**2, axis=1) / (2 * _WINDOW_VARIANCE))
        total = weight.sum()
        if total <= 0:
            return spot
        # The narrower the window, the less of a shift it shows.
        step = (1 + _POINT_WIDTH_PX**2 / _WINDOW_VARIANCE) * (weight @ off) / total
        place += step
        if np.hypot(*(place - start)) > _FARTHEST_PX:
            return spot
        if np.hypot(*step) < 0.01:
            break
    refined = spot.copy()
    refined["x"], refined["y"] = place
    refined["refined"] = True
    return refined


def _excess(
    frame: PastFrame, others: Sequence[PastFrame], pixels: NDArray[np.intp]
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Of each pixel: the excess in sigmas, whether no star is near, and the star light, DN."""
    x, y = pixels.T
    now = frame.smoothed[y, x].astype(np.float64)
    points = pixels.astype(np.float64)
    places = [other.pixels_of(frame, points) for other in others]
    seen = np.stack([o.brightness(place) for o, place in zip(others, places, strict=True)])
    seen = seen.astype(np.float64)
    count = np.sum(np.isfinite(seen), axis=0)
    order = np.sort(seen, axis=0)  # NaN last
    rows = np.arange(len(pixels))
    middle = (order[np.maximum(count - 1, 0) // 2, rows] + order[count // 2 % len(seen), rows]) / 2
    highest = order[np.maximum(count - 1, 0), rows]
    star = np.maximum(np.nan_to_num(middle), 0)
    # The two nearest in time have the most alike surroundings.
    nearest = sorted(range(len(others)), key=lambda i: abs(others[i].number - frame.number))[:2]
    around = np.max([others[i].envelope_at(places[i]) for i in nearest], axis=0)
    # Those may not see the place, or see it dark; what shines there is near it in any case.
    around = np.maximum(around, star)
    noise = frame.noise_at(pixels)
    known = np.maximum(count, 1)
    has_star = star > 1.5 * noise / np.sqrt(known)
    variance = noise**2 * (1 + np.where(has_star, 1.2 / known, 0))
    variance += np.where(star > 5 * noise, np.nan_to_num(highest) - star, 0) ** 2
    variance += (_star_error(now, star, around, frame.noise) * around) ** 2
    excess = np.where(count > 0, (now - star) / np.sqrt(variance), -1)
    clean = (star < 0.5 * now) & (around < 3 * now)
    old = [abs(other.number - frame.number) >= _STAR_AGE for other in others]
    if any(old):
        once = np.nan_to_num(seen[old]).max(axis=0)
        clean &= once < np.maximum(0.6 * now, 3 * noise)
    return excess, clean, star


def _star_error(now: Array, star: Array, around: Array, noise: float) -> float:
    """Fraction of the light nearby that a star's subtraction may leave, as this frame shows it."""
    bright = star > 30 * noise
    if np.count_nonzero(bright) <= 20:
        return _STAR_ERROR
    left = np.abs(now - star)[bright] / around[bright]
    return max(_STAR_ERROR, 1.48 * float(np.median(left)))


def _measure(
    frame: PastFrame,
    pixels: NDArray[np.intp],
    excess: Array,
    clean: NDArray[np.bool_],
    star: Array,
) -> NDArray[np.void]:
    """One spot for each connected group of pixels."""
    if not len(pixels):
        return np.zeros(0, SPOT_DTYPE)
    x, y = pixels.T
    left, top = x.min(), y.min()
    canvas = np.zeros((y.max() - top + 1, x.max() - left + 1), np.uint8)
    canvas[y - top, x - left] = 1
    count, regions = cv2.connectedComponents(canvas, connectivity=8)
    count, group = count - 1, regions[y - top, x - left] - 1

    def mean(values: NDArray, weight: Array) -> Array:
        return np.bincount(group, weight * values, count) / np.bincount(group, weight, count)

    spots = np.zeros(count, SPOT_DTYPE)
    weight = np.maximum(excess, 1e-3)
    cx, cy = mean(x, weight**2), mean(y, weight**2)
    dx, dy = x - cx[group], y - cy[group]
    # A pixel is a square of side 1: its variance keeps a single pixel from having none.
    xx, yy = mean(dx * dx, weight) + 1 / 12, mean(dy * dy, weight) + 1 / 12
    xy = mean(dx * dy, weight)
    peak = np.zeros(count)
    np.maximum.at(peak, group, excess)
    order = np.lexsort((excess, group))
    top_pixel = order[np.searchsorted(group[order], np.arange(count), side="right") - 1]
    spots["x"], spots["y"], spots["excess"], spots["snr"] = cx, cy, peak, peak
    spots["sigma_x"] = spots["sigma_y"] = _POINT_WIDTH_PX / np.maximum(peak, 1)
    split = np.hypot((xx - yy) / 2, xy)
    chance = np.maximum(0.25, 10 / np.maximum(peak, 1)) * ((xx + yy) / 2 - split)
    spots["length"] = np.where(2 * split > chance, np.sqrt(24 * split), 0)
    spots["angle"] = np.arctan2(2 * xy, xx - yy) / 2
    spots["clean"] = mean(clean, weight**2) > 0.5
    light = frame.smoothed[y, x] - star
    # A Gaussian's flux is its peak times its area.
    spots["flux"] = light[top_pixel] * 2 * np.pi * _POINT_WIDTH_PX**2
    index = frame.labels[y[top_pixel], x[top_pixel]] - 1
    new = np.bincount(frame.labels[y, x], light, len(frame.objects) + 1)[1:]
    spots["object_index"] = index
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
    for name in ("x", "y", "sigma_x", "sigma_y", "snr", "flux", "length", "angle"):
        spots[name][rows] = objects[name][index[same]]
    spots["object_index"][np.flatnonzero(owned)[~same]] = -1


def _one_per_object(spots: NDArray[np.void]) -> NDArray[np.void]:
    """Of several spots measured by one object, the first."""
    owner = np.where(spots["object_index"] >= 0, spots["object_index"], -1 - np.arange(len(spots)))
    return spots[np.sort(np.unique(owner, return_index=True)[1])]
