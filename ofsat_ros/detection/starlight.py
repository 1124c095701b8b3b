# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Star light: what a frame shows beyond the stars, as the other frames show them.

Brightness constancy under the field's motion (Lucas and Kanade's premise, taken over a window of
frames): a star shines at the same place of the sky in all of them, also when it is below the
threshold and when it is a piece of a streak.  The first part of detection: ``appearance`` makes
spots of what is left over, ``refinement`` measures them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.history import PastFrame
from ofsat_ros.parallel import in_parallel

Array = NDArray[np.float64]
Plane = NDArray[np.float32]
Index = NDArray[np.intp]

# A star is not told from its changes better than this fraction of the brightness nearby: errors
# of registration and interpolation, seeing.
_STAR_ERROR = 0.05
# Stars this bright show the error of their subtraction; so many pixels of them are enough.
BRIGHT_SIGMAS, _ERROR_SAMPLE = 30.0, 200
# A star that clouds hid from most frames still shines in one; a slow RSO has left its place
# after this many.
_STAR_AGE = 4
# Pixels that are looked at together: what the processor's cache holds of them in all frames.
_PART = 4096


@dataclass(frozen=True)
class StarLight:
    """What some frames show at the places of the sky of N pixels of another.

    Attributes
    ----------
    now : (N,) float64
        The other's own smoothed brightness there, DN.
    seen : (F, N) float32
        Theirs, DN; NaN where a frame does not show the place.
    known : (N,) int
        How many show it.
    star : (N,) float64
        The star light: their median, DN; 0 if that is negative, or none shows it.
    x, y : (F, N) float32
        The places, px.
    """

    now: Array
    seen: Plane
    known: Index
    star: Array
    x: Plane
    y: Plane


def star_light(
    frame: PastFrame,
    others: Sequence[PastFrame],
    pixels: Index,
    hidden: NDArray[np.bool_] | None = None,
) -> StarLight:
    """Look up what other frames show at pixels (N, 2) of a frame.

    Where `hidden`, (F, N), what a frame shows there does not count.
    """
    now = frame.smoothed[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    seen, x, y = frame.seen_by(others, pixels)
    if hidden is not None:
        seen[hidden] = np.nan
    ordered = np.sort(seen, axis=0)  # NaN last
    count = len(seen)
    known = count - np.count_nonzero(np.isnan(seen), axis=0)
    if np.all(known == count):
        middle = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
    else:
        rows = np.arange(len(pixels))
        low, high = np.maximum(known - 1, 0) // 2, known // 2 % count
        middle = np.nan_to_num((ordered[low, rows] + ordered[high, rows]) / 2)
    return StarLight(now, seen, known, np.maximum(middle, 0).astype(np.float64), x, y)


def excess_over_stars(
    frame: PastFrame,
    others: Sequence[PastFrame],
    pixels: Index,
    star_error: float | None = None,
    least: float = -np.inf,
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Of each pixel: the excess in sigmas, whether no star is near, and the star light, DN.

    Parameters
    ----------
    frame : PastFrame
        The frame.
    others : sequence of PastFrame
        Frames to compare with.
    pixels : (N, 2) intp
        Pixels of the frame.
    star_error : float, optional
        Fraction of the light nearby that a star's subtraction may leave; measured on the pixels
        themselves if it is not given.
    least : float
        Pixels of no more than this excess are not looked at closely: theirs is an upper bound.
    """
    if star_error is not None and len(pixels) > _PART:
        parts = [pixels[first : first + _PART] for first in range(0, len(pixels), _PART)]
        looks = in_parallel(
            lambda part: excess_over_stars(frame, others, part, star_error, least), parts
        )
        excess, clean, star = (np.concatenate(look) for look in zip(*looks, strict=True))
        return excess, clean, star
    light = star_light(frame, others, pixels)
    now, star, known = light.now, light.star, light.known
    noise = frame.noise_at(pixels)
    shared = 1 / np.maximum(known, 1)
    has_star = star > 1.5 * noise * np.sqrt(shared)
    variance = noise**2 * (1 + np.where(has_star, 1.2 * shared, 0))
    # Not a number where no frame shows the place.
    highest = np.fmax.reduce(light.seen, axis=0)
    variance += np.where(star > 5 * noise, highest - star, 0) ** 2
    excess = np.where(known > 0, (now - star) / np.sqrt(variance), -1)
    clean = star < 0.5 * now
    rows = np.flatnonzero(excess > least)
    around = _around(frame, others, light, rows)
    if star_error is None:
        star_error = _star_error(now[rows], star[rows], around, frame.noise)
    excess[rows] *= np.sqrt(variance[rows] / (variance[rows] + (star_error * around) ** 2))
    excess[known == 0] = -1
    clean[rows] &= around < 3 * now[rows]
    old = [abs(other.number - frame.number) >= _STAR_AGE for other in others]
    if any(old):
        once = np.fmax.reduce(light.seen[old][:, rows], axis=0)
        clean[rows] &= ~(once >= np.maximum(0.6 * now[rows], 3 * noise[rows]))
    return excess, clean, star


def star_error_of(frame: PastFrame, others: Sequence[PastFrame], bright: Index) -> float:
    """Fraction of the light nearby that a star's subtraction may leave, from bright pixels (N, 2).

    A sample of them is enough.
    """
    light = star_light(frame, others, bright[:: 1 + len(bright) // _ERROR_SAMPLE])
    around = _around(frame, others, light, np.arange(len(light.star)))
    return _star_error(light.now, light.star, around, frame.noise)


def _star_error(now: Array, star: Array, around: Array, noise: float) -> float:
    bright = star > BRIGHT_SIGMAS * noise
    if np.count_nonzero(bright) <= 20:
        return _STAR_ERROR
    left = np.abs(now - star)[bright] / around[bright]
    return max(_STAR_ERROR, 1.48 * float(np.median(left)))


def _around(frame: PastFrame, others: Sequence[PastFrame], light: StarLight, rows: Index) -> Array:
    """The brightest star light within 2 px of some of the pixels, (N,) DN."""
    # The two nearest in time have the most alike surroundings.
    nearest = sorted(range(len(others)), key=lambda i: abs(others[i].number - frame.number))[:2]
    around = np.max(
        [others[i].envelope_at(light.x[i, rows], light.y[i, rows]) for i in nearest], axis=0
    )
    # Those may not see the place, or see it dark; what shines there is near it in any case.
    return np.maximum(around, light.star[rows])
