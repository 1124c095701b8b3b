"""Objects: one measurement per connected region of the thresholded image.

Second stage: takes the mask and the images of ``preprocessing``; what follows measures the flow
of these objects.  An object is a star, an RSO or an artefact; this stage does not tell which.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

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
        ("edge", "?"),  # the region touches the border of the image
    ]
)

# A second peak of a region is an object of its own if it stands this far over the valley between
# them: in sigmas, and in parts of itself.
_PROMINENCE_SIGMAS, _PROMINENCE_RATIO = 5.0, 0.3
# Levels at which a valley is looked for, and peaks of a region that are looked at.
_LEVEL_STEP, _MOST_PEAKS = 1.25, 20
_AROUND = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]


def find_objects(
    image: NDArray[np.float32],
    smoothed: NDArray[np.float32],
    mask: NDArray[np.uint8],
    pixel_noise: float,
    noise: float,
    noise_ratio: NDArray[np.float32],
    min_area_px: int = 1,
    max_objects: int = 5000,
) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """Measure the connected regions of a mask.

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
    image, smoothed : (H, W) float32
        The image and its smoothed version, DN, less their background.
    mask : (H, W) uint8
        Nonzero inside objects.
    pixel_noise, noise : float
        Std of the background in `image` and in `smoothed`, DN, greater than 0.
    noise_ratio : (ny, nx) float32
        Local noise over these, on a mesh of equal cells over the image.
    min_area_px : int
        Smaller regions are left out.
    max_objects : int
        The regions with the largest SNR are kept.

    Returns
    -------
    objects : (N,) OBJECT_DTYPE
        Sorted by SNR, the largest first.
    labels : (H, W) int32
        1 + index of the object that a pixel belongs to, 0 for none.
    """
    inside = cv2.findNonZero(mask)
    labels = np.zeros(mask.shape, np.int32)
    if inside is None:
        return np.zeros(0, OBJECT_DTYPE), labels
    count, regions = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
    x, y = inside.reshape(-1, 2).T.astype(np.intp)
    count = _split(regions, count, x, y, smoothed, noise)
    # What lies between the parts of a split region belongs to none.
    x, y = x[regions[y, x] > 0], y[regions[y, x] > 0]
    # A part may be left without a pixel.
    region = regions[y, x]
    present = np.bincount(region, minlength=count) > 0
    region = (np.cumsum(present) - 1)[region]
    count = int(np.count_nonzero(present)) + 1
    moments = _moments(region, count - 1, x, y, smoothed[y, x].astype(np.float64), noise)

    def total(weights: NDArray[np.generic] | None = None) -> NDArray[np.float64]:
        return np.bincount(region, weights, count - 1).astype(np.float64)

    raw = image[y, x].astype(np.float64)
    area = total()
    local = _sample_mesh(noise_ratio, moments["x"], moments["y"], mask.shape)
    energy = total(raw * raw) / (pixel_noise * local) ** 2 - area
    snr = np.maximum(moments["peak"] / (noise * local), np.sqrt(np.maximum(energy, 0)))
    objects = np.zeros(count - 1, OBJECT_DTYPE)
    objects["flux"], objects["snr"], objects["area"] = total(raw), snr, area
    for name in ("x", "y", "peak"):
        objects[name] = moments[name]
    for name, moment in (("sigma_x", moments["xx"]), ("sigma_y", moments["yy"])):
        objects[name] = np.sqrt(2 * moment * moments["untruncated"]) / np.maximum(snr, 1)
    objects["length"], objects["angle"] = _streak(moments, snr)
    height, width = mask.shape
    at_border = (x == 0) | (y == 0) | (x == width - 1) | (y == height - 1)
    objects["edge"] = total(at_border) > 0

    order = np.flatnonzero(area >= min_area_px)
    order = order[np.argsort(-snr[order], kind="stable")][:max_objects]
    rank = np.zeros(count - 1, np.int32)
    rank[order] = np.arange(1, order.size + 1)
    labels[y, x] = rank[region]
    return objects[order], labels


def _split(
    regions: NDArray[np.int32],
    count: int,
    x: NDArray[np.intp],
    y: NDArray[np.intp],
    smoothed: NDArray[np.float32],
    noise: float,
) -> int:
    """Split, in place, regions of several bright peaks into one for each; return the new count.

    A faint object in a bright one's wings is in the same region, but the way between their peaks
    leads through a valley.
    """
    height, width = smoothed.shape
    bright = smoothed[y, x] > 2 * _PROMINENCE_SIGMAS * noise
    px, py = x[bright], y[bright]
    for dy, dx in _AROUND:
        beside = smoothed[np.clip(py + dy, 0, height - 1), np.clip(px + dx, 0, width - 1)]
        top = smoothed[py, px] >= beside
        px, py = px[top], py[top]
    owner = regions[py, px]
    several = np.flatnonzero(np.bincount(owner, minlength=count) > 1)
    several = several[several > 0]
    if not several.size:
        return count
    # The region's box, from its pixels in order.
    mine = np.isin(regions[y, x], several)
    mx, my, mr = x[mine], y[mine], regions[y[mine], x[mine]]
    order = np.argsort(mr, kind="stable")
    starts = np.searchsorted(mr[order], several)
    ends = np.searchsorted(mr[order], several, side="right")
    for label, start, end in zip(several, starts, ends, strict=True):
        rows = order[start:end]
        left, top_row = mx[rows].min(), my[rows].min()
        box = np.s_[top_row : my[rows].max() + 1, left : mx[rows].max() + 1]
        own = regions[box] == label
        peaks = np.flatnonzero(owner == label)
        peaks = peaks[np.argsort(-smoothed[py[peaks], px[peaks]])][:_MOST_PEAKS]
        places = np.stack([py[peaks] - top_row, px[peaks] - left], axis=1)
        parts = _parts(np.where(own, smoothed[box], 0), places, noise)
        if parts is None:
            continue
        for part in range(1, parts.max() + 1):
            regions[box][parts == part] = label if part == 1 else count
            count += part > 1
        regions[box][own & (parts == 0)] = 0
    return count


def _parts(
    light: NDArray[np.float32], peaks: NDArray[np.intp], noise: float
) -> NDArray[np.int32] | None:
    """Part of a region that each pixel belongs to, from 1, and 0 between them.

    None if no second of its peaks, (P, 2) rows and columns, the brightest first, stands out.
    """
    height = light[peaks[:, 0], peaks[:, 1]]
    alive = np.ones(len(peaks), bool)
    valley = np.zeros(len(peaks))
    level = float(height[1]) / _LEVEL_STEP
    while level > _PROMINENCE_SIGMAS * noise and not valley[1:].all():
        _, labels = cv2.connectedComponents((light > level).astype(np.uint8), connectivity=8)
        at = labels[peaks[:, 0], peaks[:, 1]]
        for fainter in np.flatnonzero((height > level) & (valley == 0)):
            if fainter and np.any(at[:fainter] == at[fainter]):
                # Somewhere between this level and the one before.
                valley[fainter] = level * _LEVEL_STEP
                needed = max(_PROMINENCE_SIGMAS * noise, _PROMINENCE_RATIO * height[fainter])
                alive[fainter] = height[fainter] - valley[fainter] > needed
        level /= _LEVEL_STEP
    if np.count_nonzero(alive) < 2:
        return None
    # The flood leaves out the border of its image.
    light, peaks = np.pad(light, 1), peaks + 1
    markers = np.where(light > 0, 0, len(peaks) + 1).astype(np.int32)
    for part, (row, column) in enumerate(peaks[alive], start=1):
        markers[row, column] = part
    grey = 255 * (1 - np.log1p(light / noise) / np.log1p(height[0] / noise))
    flood = cv2.watershed(np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2), markers)
    return np.where((flood > 0) & (flood <= len(peaks)), flood, 0)[1:-1, 1:-1]


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
    weight = value - np.minimum(lowest[region], 0) + 1e-6 * noise

    def mean(values: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(region, weights * values, count) / np.bincount(region, weights, count)

    cx, cy = mean(x, weight**2), mean(y, weight**2)
    dx, dy = x - cx[region], y - cy[region]
    return {
        "x": cx,
        "y": cy,
        # A pixel is a square of side 1: its variance keeps a single pixel from having none.
        "xx": mean(dx * dx, weight) + 1 / 12,
        "yy": mean(dy * dy, weight) + 1 / 12,
        "xy": mean(dx * dy, weight),
        "peak": peak,
        "untruncated": _untruncated(lowest / np.maximum(peak, 1e-9)),
    }


def _streak(
    moments: dict[str, NDArray[np.float64]], snr: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Length of each object's streak, px, 0 if it is round, and its angle, rad."""
    xx, yy, xy = moments["xx"], moments["yy"], moments["xy"]
    split = np.hypot((xx - yy) / 2, xy)
    # A round object's moments differ by chance: by its SNR (97 % of them by less than this), and
    # by the pixel grid.
    chance = np.maximum(0.25, 10 / np.maximum(snr, 1)) * ((xx + yy) / 2 - split)
    length = np.where(2 * split > chance, np.sqrt(12 * 2 * split), 0)
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return length, np.where(angle <= -np.pi / 2, np.pi / 2, angle)


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
