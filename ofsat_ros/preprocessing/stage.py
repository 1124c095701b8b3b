# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Background, Gaussian smoothing and threshold: the first stage, from image to what is bright.

As published (AAS 21-364): the image is smoothed by a Gaussian to I_s, the threshold is
mean(I_s) + N std(I_s), and I_f is I_s where it is above the threshold.  The statistics, and
whether a background is subtracted first, are choices; see ``docs/algorithm.md``.

The image goes through in strips of rows that fit the processor's cache, from the camera's bytes to
the smoothed image, on as many threads as OpenCV has been given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.parallel import buffer, in_parallel
from ofsat_ros.parameters import Parameters
from ofsat_ros.pixels import SPOT_PIXEL_SIGMAS, rows_and_columns
from ofsat_ros.preprocessing import mesh as meshes
from ofsat_ros.preprocessing.defects import AROUND, SensorMemory, beside, sharp_pixels
from ofsat_ros.preprocessing.mesh import BackgroundMap

Image = NDArray[np.float32]
Index = NDArray[np.intp]

# Cells and samples per side of the image that are enough for the median of the noise.
_NOISE_CELLS, _NOISE_SAMPLES = 4, 64
# Beyond it the squares of float32 overflow; files mark missing pixels by such numbers.
_LARGEST = 1e15
# An area of one value is sought if a sample of the image has so much of it, so far from nearly all
# others, in steps of rounding; it is at least as wide, px.
_FLAT_SAMPLES, _LEAST_FLAT, _FAR_STEPS, _FLAT_PX = 128, 8, 4.0, 5
# Values that background is filled in with.
_FILL_SAMPLES = 2**16
# Side of the square around a pixel without sky in which smoothing has spread that, px.
_BLIND_PX = 11
# White noise keeps a third of itself when smoothed, what has structure nearly all: above this part
# of it, most of the image is structure, be it clouds or a sensor's bands.
_VEIL_RATIO, _WHITE_RATIO = 0.9, 0.5
# Pixels of a strip: smaller ones would stay in the processor's own cache, but Python's threads
# would wait for each other between their many short steps.
_STRIP_PIXELS, _LEAST_ROWS = 2**20, 64
# Cells side by side that share one limit in the first search for bright pixels.
_CELLS_AT_ONCE = 8
_NONE = np.zeros(0, np.intp)


@dataclass(frozen=True)
class Preprocessed:
    """An image ready for objects and flow.

    Attributes
    ----------
    smoothed : (H, W) float32
        The image less its background, defects replaced, smoothed, DN: I_s less its background.
    bright : (M,) intp
        Flat indices, ascending, of all pixels of `smoothed` above the threshold or above 2.5
        local sigmas, and of some that are not.
    above : (K,) intp
        Those of them above the threshold.
    background : float
        Median level of the background, DN.
    pedestal : float
        What I_s as published holds of it, DN: `background`, or 0 if a mesh was subtracted.
    pixel_noise, noise : float
        Std of the background before and after smoothing, DN; the median over the image.
        Never 0: at least what quantisation leaves.
    noise_ratio : (ny, nx) float32
        Noise over its median, on a mesh of equal cells; one cell when it is not local.
    threshold : float
        Threshold of `smoothed`, over the background, DN; the median over the image.
    defects : int
        Pixels that the sensor's memory knows as defects.
    veiled : bool
        Whether most of the image has a structure that hides what is faint: clouds, bands.
    blind : (H, W) bool or None
        Pixels that show no sky, and those that smoothing mixes with them; None if all do.
    """

    smoothed: Image
    bright: Index
    above: Index
    background: float
    pedestal: float
    pixel_noise: float
    noise: float
    noise_ratio: Image
    threshold: float
    defects: int
    veiled: bool
    blind: NDArray[np.bool_] | None
    _raw: NDArray[np.generic]
    _levels: BackgroundMap
    _replaced: tuple[Index, Image]

    def image_at(self, pixels: Index) -> Image:
        """The image less its background, defects replaced, at flat indices of pixels, (N,) DN."""
        y, x = rows_and_columns(pixels, self._raw.shape[1])
        values = self._raw[y, x].astype(np.float32) - self._levels.at(y, x)
        replaced, by = self._replaced
        if replaced.size:
            place = np.minimum(np.searchsorted(replaced, pixels), replaced.size - 1)
            values = np.where(replaced[place] == pixels, by[place], values)
        return values

    @cached_property
    def image(self) -> Image:
        """The same of all pixels, (H, W) DN."""
        image = np.empty(self._raw.shape, np.float32)
        self._levels.subtracted(self._raw, 0, image)
        image.ravel()[self._replaced[0]] = self._replaced[1]
        return image


def preprocess(
    raw: NDArray[np.generic],
    parameters: Parameters,
    memory: SensorMemory | None = None,
    out: Image | None = None,
) -> Preprocessed:
    """Subtract the background, smooth and threshold one image.

    Parameters
    ----------
    raw : (H, W) uint8, uint16 or float32
        The image, DN.  Values that are not finite, or beyond 1e15, count as background.  What is
        returned may refer to it.
    parameters : Parameters
        Those of the stage ``preprocessing``.
    memory : SensorMemory, optional
        What was learned of the sensor from the images before; this one is added to it.
    out : (H, W) float32, optional
        Where to put the smoothed image; an array of another shape is left alone.

    Returns
    -------
    Preprocessed

    Raises
    ------
    ValueError
        If no pixel is finite and below 1e15.
    """
    image, blind, rounding = _seen(raw)
    mesh, level, pixel_noise = _background(image, rounding, parameters)
    levels = BackgroundMap(level, image.shape)
    background = float(np.median(level))
    smoothed = np.empty(raw.shape, np.float32) if out is None or out.shape != raw.shape else out
    replaced, defects = _smooth(image, levels, pixel_noise, parameters, memory, smoothed)

    white = _white_ratio(parameters.smoothing_sigma_px)
    limit, noise, ratio = _threshold(smoothed, mesh, rounding * white, parameters)
    local = parameters.threshold_statistics == "clipped" and white < _WHITE_RATIO
    bright, light = _bright_pixels(smoothed, np.minimum(limit, SPOT_PIXEL_SIGMAS * noise * ratio))
    return Preprocessed(
        smoothed=smoothed,
        bright=bright,
        above=_above(bright, light, limit, smoothed.shape),
        background=background,
        pedestal=0.0 if parameters.background == "mesh" else background,
        pixel_noise=pixel_noise,
        noise=noise,
        noise_ratio=ratio,
        threshold=float(np.median(limit)),
        defects=defects,
        veiled=local and noise > _VEIL_RATIO * pixel_noise,
        blind=blind,
        _raw=image,
        _levels=levels,
        _replaced=replaced,
    )


def learn(raw: NDArray[np.generic], parameters: Parameters, memory: SensorMemory) -> None:
    """Add an image to what is known of the sensor, as `preprocess` does, and do no more.

    Parameters and what is raised are those of `preprocess`.
    """
    image, _, rounding = _seen(raw)
    if parameters.hot_pixels == "replace":
        _, level, pixel_noise = _background(image, rounding, parameters)
        _learn(memory, image, BackgroundMap(level, image.shape), pixel_noise)


def _seen(
    raw: NDArray[np.generic],
) -> tuple[NDArray[np.generic], NDArray[np.bool_] | None, float]:
    """The image with background where there is no sky, where that is, the noise of rounding."""
    image, blind = _finite(raw)
    rounding = _rounding_noise(image)
    if blind is None:
        blind = _flat(image, rounding * math.sqrt(12))
    if blind is None:
        return image, None, rounding
    return _filled(image, blind), _around(blind), rounding


def _background(
    image: NDArray[np.generic], rounding: float, parameters: Parameters
) -> tuple[tuple[int, int], Image, float]:
    """Cells of the background's mesh, its levels there, and the std of pixels beside it."""
    height, width = image.shape
    cell = parameters.background_cell_px if parameters.background == "mesh" else max(image.shape)
    # A mesh needs a frame of cells to interpolate between; a small image is one cell.
    mesh = (max(1, round(height / cell)), max(1, round(width / cell)))
    # Means of four pixels have half the noise of one.
    values = meshes.cells(image, mesh, exact=False)
    # Without a mesh it is one number, whose subtraction changes no threshold.
    level, _ = meshes.statistics(values, mesh, rounding, reach=2.0)
    return mesh, level, _pixel_noise(image, mesh, level, rounding)


def _threshold(
    smoothed: Image, mesh: tuple[int, int], floor: float, parameters: Parameters
) -> tuple[Image, float, Image]:
    """Mesh of the thresholds, DN; the noise, DN, at least `floor`; and its mesh over that."""
    count = parameters.threshold_sigmas
    if parameters.threshold_statistics == "all":
        mean, std = (float(v[0, 0]) for v in cv2.meanStdDev(smoothed))
        noise = max(std, floor)
        limit = np.full((1, 1), mean + count * noise, np.float32)
        return limit, noise, np.ones((1, 1), np.float32)
    mean_mesh, noise_mesh = meshes.statistics(meshes.cells(smoothed, mesh), mesh, floor)
    noise = float(np.median(noise_mesh))
    limit = mean_mesh + np.float32(count) * noise_mesh
    return limit, noise, noise_mesh / np.float32(noise)


def _above(bright: Index, light: Image, limit: Image, shape: tuple[int, ...]) -> Index:
    """Those of the bright pixels whose light is above a mesh of limits."""
    near = np.flatnonzero(light > limit.min())
    pixels = bright[near]
    return pixels[light[near] > meshes.sample(limit, *rows_and_columns(pixels, shape[1]), shape)]


def _white_ratio(sigma: float) -> float:
    """What a Gaussian of sigma s lowers white noise to: 1 / (2 sqrt(pi) s), if s is not tiny."""
    return min(1.0, 0.5 / (math.sqrt(math.pi) * sigma)) if sigma > 0 else 1.0


def _flat(image: NDArray[np.generic], step: float) -> NDArray[np.bool_] | None:
    """Areas of one value at an end of the range, and far from all others, (H, W); None if none.

    Masks, lost rows, what is saturated.  The black of a compressed sky has others next to it.
    """
    some = cv2.resize(image, (_FLAT_SAMPLES, _FLAT_SAMPLES), interpolation=cv2.INTER_NEAREST)
    flat = np.zeros(image.shape, np.uint8)
    for end in (some.min(), some.max()):
        others = some[some != end].astype(np.float64)
        if not 0 < others.size <= some.size - _LEAST_FLAT:
            continue
        spread = np.median(np.abs(others - np.median(others)))
        if np.percentile(np.abs(others - float(end)), 5) < max(_FAR_STEPS * step, 2 * spread):
            continue
        alike = cv2.compare(image, float(end), cv2.CMP_EQ)
        flat |= cv2.morphologyEx(alike, cv2.MORPH_OPEN, np.ones((_FLAT_PX, _FLAT_PX), np.uint8))
    return flat > 0 if flat.any() else None


def _around(blind: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Areas without sky, and what smoothing mixes with them, (H, W); None if none is as wide.

    A bad pixel here and there takes little from what is around it.
    """
    square = np.ones((_FLAT_PX, _FLAT_PX), np.uint8)
    wide = cv2.morphologyEx(blind.view(np.uint8), cv2.MORPH_OPEN, square)
    if not wide.any():
        return None
    return cv2.dilate(wide, np.ones((_BLIND_PX, _BLIND_PX), np.uint8)) > 0


def _filled(image: NDArray[np.generic], blind: NDArray[np.bool_]) -> NDArray[np.generic]:
    """The image with background, and its noise, where there is no sky."""
    seen = image[~blind]
    some = seen[:: 1 + seen.size // _FILL_SAMPLES].astype(np.float64)
    middle = np.median(some)
    off = np.abs(some - middle)
    some = some[off <= 3 * 1.4826 * np.median(off)]
    filled = image.copy()
    filled[blind] = np.resize(some, np.count_nonzero(blind))
    return filled


def _finite(raw: NDArray[np.generic]) -> tuple[NDArray[np.generic], NDArray[np.bool_] | None]:
    """The image in this machine's byte order, every value and its square finite.

    And the pixels that were not, (H, W), None if all were.
    """
    image = np.ascontiguousarray(raw, raw.dtype.newbyteorder("="))
    if image.dtype.kind != "f" or cv2.checkRange(image, True, -_LARGEST, _LARGEST)[0]:
        return image, None
    usable = np.abs(image) < _LARGEST
    if not usable.any():
        what = "below 1e15, as DN are" if np.isfinite(image).any() else "a finite number"
        raise ValueError(f"no pixel of the image is {what}")
    return np.where(usable, image, image[usable].min()), ~usable


def _rounding_noise(image: NDArray[np.generic]) -> float:
    """Std of rounding to whole DN, or of a float image to 16 bits; never 0.

    Compressed black sky and simulated frames have a std of 0, which nothing may be divided by.
    """
    step = 1.0
    if image.dtype.kind == "f":
        # All but the wildest pixels, which a division by a bad flat field makes.
        some = cv2.resize(image, (512, 512), interpolation=cv2.INTER_NEAREST)
        low, high = np.percentile(some, (0.01, 99.99))
        step = max(float(high - low) / 65535, 1e-15)
    return step / math.sqrt(12)


def _pixel_noise(
    image: NDArray[np.generic], mesh: tuple[int, int], level: Image, rounding: float
) -> float:
    """Median std of the image less its background: a gradient inside a cell is no noise."""
    coarse = (min(mesh[0], _NOISE_CELLS), min(mesh[1], _NOISE_CELLS))
    shape = tuple(count * (_NOISE_SAMPLES // count) for count in coarse)
    small = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_NEAREST)
    less = BackgroundMap(level, shape).subtracted(small, 0, np.empty(shape, np.float32))
    values = meshes.cells(less, coarse, samples=less.size)
    return float(np.median(meshes.clipped(values, rounding)[1]))


def _smooth(
    image: NDArray[np.generic],
    levels: BackgroundMap,
    noise: float,
    parameters: Parameters,
    memory: SensorMemory | None,
    smoothed: Image,
) -> tuple[tuple[Index, Image], int]:
    """Subtract the background, replace defects and smooth, into `smoothed`.

    Returns
    -------
    replaced : (N,) intp, (N,) float32
        Flat indices, ascending, of the replaced pixels, and their values.
    defects : int
        How many of them the memory knew.
    """
    height, width = image.shape
    sigma = parameters.smoothing_sigma_px
    replace = parameters.hot_pixels == "replace"
    known = _NONE
    if replace and memory is not None:
        known = _learn(memory, image, levels, noise)
    # As far as the smoothing reaches, and a defect's neighbours beyond.
    margin = math.ceil(4 * sigma) + 2
    rows = max(_strip_rows(width), 4 * margin)

    def smooth_rows(first: int) -> tuple[Index, Image]:
        last = min(first + rows, height)
        top, bottom = max(0, first - margin), min(height, last + margin)
        strip = _less_background(image, levels, top, bottom)
        core = slice(first - top, last - top)
        places = _NONE
        if replace:
            start, end = np.searchsorted(known, (top * width, bottom * width))
            for pixels in (sharp_pixels(strip, noise), known[start:end] - top * width):
                if pixels.size:
                    strip.ravel()[pixels] = np.median(beside(strip, pixels, AROUND), axis=1)
                    places = np.union1d(places, pixels)
            places = places[(places >= core.start * width) & (places < core.stop * width)]
        if sigma > 0:
            whole = len(strip) == last - first
            target = smoothed[first:last] if whole else buffer("blurred", strip.shape)
            cv2.GaussianBlur(strip, (0, 0), sigma, dst=target)
            if not whole:
                smoothed[first:last] = target[core]
        else:
            smoothed[first:last] = strip[core]
        return places + top * width, strip.ravel()[places]

    parts = in_parallel(smooth_rows, range(0, height, rows))
    pixels, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return (pixels, values), len(known)


def _learn(
    memory: SensorMemory, image: NDArray[np.generic], levels: BackgroundMap, noise: float
) -> Index:
    """Show the memory what it takes of this image; return the defects that it knows."""
    rows = _strip_rows(image.shape[1])
    start, end = memory.begin(image.shape, noise, image.dtype)

    def show(first: int) -> None:
        last = min(first + rows, end)
        memory.add(_less_background(image, levels, first, last), first)

    in_parallel(show, range(start, end, rows))
    return memory.finish()


def _strip_rows(width: int) -> int:
    return max(_LEAST_ROWS, _STRIP_PIXELS // width)


def _less_background(
    image: NDArray[np.generic], levels: BackgroundMap, first: int, last: int
) -> Image:
    """Rows of the image less its background, in this thread's buffer."""
    strip = buffer("strip", (last - first, image.shape[1]))
    return levels.subtracted(image[first:last], first, strip)


def _bright_pixels(smoothed: Image, limit: Image) -> tuple[Index, Image]:
    """Flat indices, ascending, of the pixels above the lowest limit nearby, and their values."""
    height, width = smoothed.shape
    rows, columns = limit.shape
    # Between two cells the limit lies between theirs: the lowest of a cell and those around it.
    lowest = cv2.erode(limit, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    step = max(1, _strip_rows(width) * rows // height)

    def search(row: int) -> tuple[Index, Image]:
        below = min(row + step, rows)
        first, last = row * height // rows, below * height // rows
        mask = buffer("mask", (last - first, width), np.bool_)
        for column in range(0, columns, _CELLS_AT_ONCE):
            beyond = min(column + _CELLS_AT_ONCE, columns)
            block = np.s_[:, column * width // columns : beyond * width // columns]
            least = lowest[row:below, column:beyond].min()
            np.greater(smoothed[first:last][block], least, out=mask[block])
        pixels = np.flatnonzero(mask)
        return pixels + first * width, smoothed[first:last].ravel()[pixels]

    parts = in_parallel(search, range(0, rows, step))
    pixels, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return pixels, values
