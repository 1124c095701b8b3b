# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Objects: one measurement per connected region of the thresholded image.

Second stage: takes what ``preprocessing`` found above the threshold; what follows measures the
flow of these objects.  An object is a star, an RSO or an artefact; this stage does not tell which.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.pixels import Regions, connected, rows_and_columns, streak_of

Index = NDArray[np.intp]

OBJECT_DTYPE = np.dtype(
    [
        ("x", "f8"),  # centroid, px
        ("y", "f8"),
        ("sigma_x", "f8"),  # std of the centroid, px
        ("sigma_y", "f8"),
        ("flux", "f8"),  # DN, sum over the region, background subtracted
        ("snr", "f8"),  # matched filter
        ("peak", "f8"),  # highest smoothed value over the background, DN
        ("length", "f8"),  # length of the streak, px; 0 for a round object
        ("angle", "f8"),  # direction of the streak, rad from x to y, within (-pi/2, pi/2]
        ("area", "i4"),  # px
        ("edge", "?"),  # the region touches the border of the image, or what shows no sky
    ]
)

# A second peak of a region is an object of its own if it stands this far over the valley between
# them: in sigmas, and in parts of itself.
_PROMINENCE_SIGMAS, _PROMINENCE_RATIO = 5.0, 0.3
# A valley counts as high as the next of the levels that lead down from the second peak by this.
_LEVEL_STEP = 1.25


def find_objects(
    pixels: Index,
    values: NDArray[np.floating],
    smoothed: NDArray[np.float32],
    pixel_noise: float,
    noise: float,
    noise_ratio: NDArray[np.float32],
    min_area_px: int = 1,
    max_objects: int = 5000,
    blind: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.void], Regions]:
    """Measure the connected regions of the pixels above the threshold.

    The position is the mean of the region's pixels weighted by the square of the smoothed
    brightness, which is what a window as wide as the star does: wings that are mostly noise count
    little.  The shape is the second moments of the smoothed brightness.
    A uniform line of length L adds L^2/12 to the variance along it, hence
    L = sqrt(12 (major - minor)).  The SNR is the larger of two estimates of the matched filter's
    sqrt(sum s_i^2 / var_i): peak over noise in the smoothed image, right for a point source, and
    the sum over the region's pixels less what noise alone would give, right for a streak.  The
    centroid's std is sqrt(2 moment) / SNR: for a Gaussian in white noise the Cramer-Rao bound is
    that of the moment before smoothing; these centroids reach it with the moment after.

    Parameters
    ----------
    pixels : (M,) intp
        Flat indices, ascending, of the pixels above the threshold.
    values : (M,) float
        The image there less its background, DN.
    smoothed : (H, W) float32
        The image less its background, smoothed, DN.
    pixel_noise, noise : float
        Std of the background before and after smoothing, DN, greater than 0.
    noise_ratio : (ny, nx) float32
        Local noise over these, on a mesh of equal cells over the image.
    min_area_px : int
        Smaller regions are left out.
    max_objects : int
        The regions with the largest SNR are kept.
    blind : (H, W) bool, optional
        Pixels that show no sky: they cut objects as the border does.

    Returns
    -------
    objects : (N,) OBJECT_DTYPE
        Sorted by SNR, the largest first.
    regions : Regions
        The pixels of each.
    """
    shape = (smoothed.shape[0], smoothed.shape[1])
    if not pixels.size:
        return np.zeros(0, OBJECT_DTYPE), Regions(shape)
    region, count = connected(pixels, shape[1])
    # Most regions are noise of a pixel or two.
    large = (np.bincount(region, minlength=count) >= min_area_px)[region]
    region, pixels, values = region[large], pixels[large], values[large]
    light = smoothed.ravel()[pixels]
    region, count = _split(region, count, pixels, light, smoothed, noise)
    inside, region, count = _renumbered(region, count)
    pixels, raw, light = pixels[inside], values[inside].astype(np.float64), light[inside]
    y, x = rows_and_columns(pixels, shape[1])
    moments = _moments(region, count, x, y, light.astype(np.float64), noise)

    def total(weights: NDArray[np.generic] | None = None) -> NDArray[np.float64]:
        return np.bincount(region, weights, count).astype(np.float64)

    area = total()
    local = _sample_mesh(noise_ratio, moments["x"], moments["y"], shape)
    energy = total(raw * raw) / (pixel_noise * local) ** 2 - area
    snr = np.maximum(moments["peak"] / (noise * local), np.sqrt(np.maximum(energy, 0)))
    objects = np.zeros(count, OBJECT_DTYPE)
    objects["flux"], objects["snr"], objects["area"] = total(raw), snr, area
    for name in ("x", "y", "peak"):
        objects[name] = moments[name]
    for name, moment in (("sigma_x", moments["xx"]), ("sigma_y", moments["yy"])):
        objects[name] = np.sqrt(2 * moment * moments["untruncated"]) / np.maximum(snr, 1)
    objects["length"], objects["angle"] = streak_of(
        moments["xx"], moments["yy"], moments["xy"], snr
    )
    at_border = (x == 0) | (y == 0) | (x == shape[1] - 1) | (y == shape[0] - 1)
    if blind is not None:
        at_border |= blind[y, x]
    objects["edge"][region[at_border]] = True
    order = np.flatnonzero(area >= min_area_px)
    order = order[np.argsort(-snr[order], kind="stable")][:max_objects]
    owner = np.full(count, -1)
    owner[order] = np.arange(order.size)
    owner = owner[region]
    return objects[order], Regions(shape, pixels[owner >= 0], owner[owner >= 0])


def _renumbered(region: Index, count: int) -> tuple[NDArray[np.bool_], Index, int]:
    """Which pixels are in a region, (M,), the regions of these without gaps, and how many.

    What lies between the parts of a split region is in none, and a part may be left without a
    pixel.
    """
    inside = region >= 0
    region = region[inside]
    present = np.bincount(region, minlength=count) > 0
    return inside, (np.cumsum(present) - 1)[region], int(np.count_nonzero(present))


def _split(
    region: Index,
    count: int,
    pixels: Index,
    light: NDArray[np.float32],
    smoothed: NDArray[np.float32],
    noise: float,
) -> tuple[Index, int]:
    """Split regions of several bright peaks into one for each.

    A faint object in a bright one's wings is in the same region, but the way between their peaks
    leads through a valley.

    Returns
    -------
    region : (M,) intp
        Region of each pixel; -1 between the parts of a split one.
    count : int
        How many there are.
    """
    width = smoothed.shape[1]
    bright = np.flatnonzero(light > 2 * _PROMINENCE_SIGMAS * noise)
    peaks = bright[_is_top(pixels[bright], light[bright], smoothed)]
    several = np.bincount(region[peaks], minlength=count) > 1
    if not several.any():
        return region, count
    # The pixels and peaks of these regions only, region by region, the brightest peak first.
    mine = np.flatnonzero(several[region])
    own, pixels, light = region[mine], pixels[mine], light[mine]
    peaks = np.searchsorted(mine, peaks[several[region[peaks]]])
    peaks = peaks[np.lexsort((-light[peaks], own[peaks]))]
    valley = _valleys(pixels, light, width)[peaks]
    peaks = peaks[_stands_out(own[peaks], light[peaks], valley, noise)]
    region = region.copy()
    for label in np.flatnonzero(np.bincount(own[peaks], minlength=count) > 1):
        rows = np.flatnonzero(own == label)
        tops = np.searchsorted(rows, peaks[own[peaks] == label])
        part = _parts(pixels[rows], light[rows], tops, width, noise)
        # The first part keeps the region's number.
        region[mine[rows]] = np.where(part > 1, count + part - 2, np.where(part == 1, label, -1))
        count += int(part.max()) - 1
    return region, count


def _stands_out(
    own: Index, height: NDArray[np.float32], valley: NDArray[np.float32], noise: float
) -> NDArray[np.bool_]:
    """Which peaks are objects of their own, (P,).

    `own` is the region of each, ascending; the first one of a region is its brightest, and its
    valley -inf.
    """
    first = np.diff(own, prepend=-1) != 0
    second = height[np.flatnonzero(first) + 1][np.cumsum(first) - 1]
    steps = np.floor(np.log(second / np.maximum(valley, noise)) / np.log(_LEVEL_STEP))
    level = second / _LEVEL_STEP**steps
    least = _PROMINENCE_SIGMAS * noise
    needed = np.maximum(least, _PROMINENCE_RATIO * height)
    return (height - level > needed) | (level <= least * _LEVEL_STEP)


def _is_top(
    pixels: Index, light: NDArray[np.float32], smoothed: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Which pixels, of brightness `light`, have no brighter one around them, (M,)."""
    height, width = smoothed.shape
    flat = smoothed.ravel()
    y, x = rows_and_columns(pixels, width)
    left, right = -(x > 0).astype(np.intp), (x < width - 1).astype(np.intp)
    top = light >= np.maximum(flat[pixels + left], flat[pixels + right])
    some = np.flatnonzero(top)
    pixels, light, y, left, right = pixels[some], light[some], y[some], left[some], right[some]
    for row in (pixels - width * (y > 0), pixels + width * (y < height - 1)):
        top[some] &= light >= flat[[row + left, row, row + right]].max(axis=0)
    return top


def _valleys(pixels: Index, light: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Lowest point of the best way from each pixel to a brighter one, (M,); -inf without a way.

    Whatever surrounds a top joins it, from the highest pass to it down: so each pixel learns at
    what height it meets a brighter one, in as many rounds as the tops are nested.
    """
    order = np.argsort(-light, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    one, other = _neighbours(pixels, width)
    passes = np.minimum(light[one], light[other])
    one, other = rank[one], rank[other]
    valley = np.full(order.size, -np.inf, np.float32)
    root = np.arange(order.size)
    while passes.size:
        fainter, brighter = np.maximum(one, other), np.minimum(one, other)
        highest = np.full(order.size, -np.inf, np.float32)
        np.maximum.at(highest, one, passes)
        np.maximum.at(highest, other, passes)
        joins = passes == highest[fainter]
        valley[fainter[joins]] = passes[joins]
        root[fainter[joins]] = brighter[joins]
        shorter = root[root]
        while not np.array_equal(shorter, root):
            root, shorter = shorter, shorter[shorter]
        one, other = root[one], root[other]
        apart = one != other
        one, other, passes = one[apart], other[apart], passes[apart]
    return valley[rank]


def _neighbours(pixels: Index, width: int) -> tuple[Index, Index]:
    """Pairs of the pixels, by their places in the list, that touch: a side or a corner."""
    _, x = rows_and_columns(pixels, width)
    firsts, seconds = [], []
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        one = np.flatnonzero((x + right >= 0) & (x + right < width))
        sought = pixels[one] + down * width + right
        other = np.searchsorted(pixels[:-1], sought)
        there = pixels[other] == sought
        firsts.append(one[there])
        seconds.append(other[there])
    return np.concatenate(firsts), np.concatenate(seconds)


def _parts(
    pixels: Index, light: NDArray[np.float32], peaks: Index, width: int, noise: float
) -> NDArray[np.int32]:
    """Part of a region that each of its pixels belongs to, from 1, and 0 between them, (M,).

    A part for each of the peaks, which are places in the list of pixels, the brightest first.
    """
    y, x = rows_and_columns(pixels, width)
    # The flood leaves out the border of its image.
    y, x = y - y.min() + 1, x - x.min() + 1
    outside = len(peaks) + 1
    markers = np.full((y.max() + 2, x.max() + 2), outside, np.int32)
    markers[y, x] = 0
    markers[y[peaks], x[peaks]] = np.arange(1, outside)
    grey = np.full(markers.shape, 255, np.uint8)
    grey[y, x] = 255 * (1 - np.log1p(light / noise) / np.log1p(light[peaks[0]] / noise))
    cv2.watershed(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), markers)
    part = markers[y, x]
    return np.where((part > 0) & (part < outside), part, 0)


def _moments(
    region: NDArray[np.integer],
    count: int,
    x: NDArray[np.intp],
    y: NDArray[np.intp],
    value: NDArray[np.float64],
    noise: float,
) -> dict[str, NDArray[np.float64]]:
    """Centroid, second moments and peak of each region from its pixels' smoothed values."""
    lowest, peak = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(lowest, region, value)
    np.maximum.at(peak, region, value)
    # Every weight is positive, also where a published threshold lies below the background.
    weight = value - np.minimum(lowest, 0)[region] + 1e-6 * noise

    def total(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(region, weights, count).astype(np.float64)

    square = weight * weight
    squares, weights = total(square), total(weight)
    cx, cy = total(square * x) / squares, total(square * y) / squares
    dx, dy = x - cx[region], y - cy[region]
    weighted = weight * dx
    return {
        "x": cx,
        "y": cy,
        # A pixel is a square of side 1: its variance keeps a single pixel from having none.
        "xx": total(weighted * dx) / weights + 1 / 12,
        "yy": total(weight * dy * dy) / weights + 1 / 12,
        "xy": total(weighted * dy) / weights,
        "peak": peak,
        "untruncated": _untruncated(lowest / np.maximum(peak, 1e-9)),
    }


def _untruncated(cut: NDArray[np.float64]) -> NDArray[np.float64]:
    """Factor from the variance of what lies above the threshold to that of the whole object.

    A Gaussian cut at the fraction q of its peak keeps (1 - q + q ln q) / (1 - q) of its variance.
    The square root of the inverse is what makes the stated std of faint objects true (measured at
    SNR 7 to 50): the noise that lifts pixels over the threshold widens them again.
    """
    q = np.clip(cut, 1e-3, 0.9)
    return np.sqrt((1 - q) / (1 - q + q * np.log(q)))


def _sample_mesh(
    mesh: NDArray[np.float32],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    shape: tuple[int, ...],
) -> NDArray[np.float64]:
    """Value of the mesh cell that each point lies in, (N,)."""
    rows, columns = mesh.shape
    row = np.clip(((y + 0.5) * rows / shape[0]).astype(int), 0, rows - 1)
    column = np.clip(((x + 0.5) * columns / shape[1]).astype(int), 0, columns - 1)
    return mesh[row, column].astype(np.float64)
