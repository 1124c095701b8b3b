"""Background, Gaussian smoothing and threshold: the first stage, from image to mask.

As published (AAS 21-364): the image is smoothed by a Gaussian to I_s, the threshold is
mean(I_s) + N std(I_s), and I_f is I_s where it is above the threshold.  The statistics, and
whether a background is subtracted first, are choices; see ``docs/algorithm.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.parameters import Parameters

Image = NDArray[np.float32]
Index = NDArray[np.intp]

# Samples per side of a mesh cell: 1,024 values give its level to 4 % of the noise.
_SAMPLES = 32
# Cells per side that are enough for one number, the median of the noise.
_NOISE_CELLS = 8
# Beyond it the squares of float32 overflow; files mark missing pixels by such numbers.
_LARGEST = 1e15
# A star's neighbour holds at least this fraction of its peak (a Gaussian of FWHM 1.4 px or more,
# anywhere on the pixel grid); a defect's neighbours hold noise.
_DEFECT_RATIO = 0.25
_DEFECT_SIGMAS = 6.0
_NONE = np.zeros(0, np.intp)
_AROUND = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
# Smoothed by 1 px, a star keeps this fraction of its peak at least, one or two pixels alone 0.26
# at most; and it keeps what the others keep, less what noise and their shape may change.
_LEAST_KEPT, _KEPT_RATIO = 0.3, 0.7
_KEPT_SIGMAS = 20.0
# Frames over which the sensor's fixed pattern is averaged at most.
_MEMORY_FRAMES = 100


@dataclass(frozen=True)
class Preprocessed:
    """An image ready for objects and flow.

    Attributes
    ----------
    image : (H, W) float32
        Image less its background, defects replaced, DN.
    smoothed : (H, W) float32
        The same, smoothed, DN: I_s less its background.
    mask : (H, W) uint8
        1 where `smoothed` is above the threshold.
    background : float
        Median level of the background, DN.
    pedestal : float
        What I_s as published holds of it, DN: `background`, or 0 if a mesh was subtracted.
    pixel_noise, noise : float
        Std of the background in `image` and in `smoothed`, DN; the median over the image.
        Never 0: at least what quantisation leaves.
    noise_ratio : (ny, nx) float32
        Noise over its median, on a mesh of equal cells; one cell when it is not local.
    threshold : float
        Threshold of `smoothed`, over the background, DN; the median over the image.
    defects : int
        Pixels that the sensor's memory knows as defects.
    """

    image: Image
    smoothed: Image
    mask: NDArray[np.uint8]
    background: float
    pedestal: float
    pixel_noise: float
    noise: float
    noise_ratio: Image
    threshold: float
    defects: int


class SensorMemory:
    """What the sensor shows in every frame: the mean of its images less their background.

    A defect too faint for one frame, or one of a few pixels, stands out in the mean: it keeps less
    of its peak when smoothed than the stars do, which are as wide as the optics make a point.
    """

    def __init__(self) -> None:
        self._mean: Image | None = None
        self._dtype: np.dtype | None = None
        self._count = 0

    def defects(
        self, image: Image, noise: float, dtype: np.dtype
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Add an image and return the rows and columns of the defects that the mean shows.

        Parameters
        ----------
        image : (H, W) float32
            Image less its background, DN.
        noise : float
            Std of its background, DN.
        dtype : dtype
            Type of the camera's image.  Another size or type than before starts afresh.
        """
        if self._mean is None or self._mean.shape != image.shape or self._dtype != dtype:
            self._mean, self._count, self._dtype = np.zeros_like(image), 0, dtype
        self._count = min(self._count + 1, _MEMORY_FRAMES)
        cv2.accumulateWeighted(image, self._mean, 1 / self._count)
        stars = _kept(image, *_peaks(image, _KEPT_SIGMAS * noise))
        # Squared: a streak is smoothed along one axis only, a point along both.
        usual = float(np.median(stars)) ** 2 if stars.size else 0.0
        limit = _DEFECT_SIGMAS * noise / math.sqrt(self._count)
        y, x = _peaks(self._mean, limit)
        sharp = _kept(self._mean, y, x) < max(_LEAST_KEPT, _KEPT_RATIO * usual)
        y, x = y[sharp], x[sharp]
        # Its neighbours too, where its charge has leaked to.
        parts = [
            (self._mean[ny, nx] > limit, ny, nx)
            for ny, nx in (_beside(self._mean.shape, y, x, step) for step in [(0, 0), *_AROUND])
        ]
        rows = np.concatenate([ny[part] for part, ny, _ in parts])
        return rows, np.concatenate([nx[part] for part, _, nx in parts])


def preprocess(
    raw: NDArray[np.generic], parameters: Parameters, memory: SensorMemory | None = None
) -> Preprocessed:
    """Subtract the background, smooth and threshold one image.

    Parameters
    ----------
    raw : (H, W) uint8, uint16 or float32
        The image, DN.  Values that are not finite, or beyond 1e15, count as background.
    parameters : Parameters
        Those of the stage ``preprocessing``.
    memory : SensorMemory, optional
        What was learned of the sensor from the images before; this one is added to it.

    Returns
    -------
    Preprocessed

    Raises
    ------
    ValueError
        If no pixel is finite.
    """
    image = _finite(raw)
    rounding = _rounding_noise(image, raw.dtype)
    cell = parameters.background_cell_px if parameters.background == "mesh" else max(raw.shape)
    # A mesh needs a frame of cells to interpolate between; a small image is one cell.
    mesh = (max(1, round(raw.shape[0] / cell)), max(1, round(raw.shape[1] / cell)))
    level, _ = _mesh_statistics(image, mesh, rounding)
    # Without a mesh it is one number, whose subtraction changes no threshold.
    image -= _background_map(level, image.shape)
    background = float(np.median(level))
    # Of what is left: a gradient inside a cell is no noise.
    coarse = (min(mesh[0], _NOISE_CELLS), min(mesh[1], _NOISE_CELLS))
    pixel_noise = float(np.median(_mesh_statistics(image, coarse, rounding)[1]))
    defects = 0
    if parameters.hot_pixels == "replace":
        known = memory.defects(image, pixel_noise, raw.dtype) if memory else (_NONE, _NONE)
        defects = len(known[0])
        for y, x in (_sharp_pixels(image, pixel_noise), known):
            around = [image[_beside(image.shape, y, x, step)] for step in _AROUND]
            image[y, x] = np.median(around, axis=0)

    sigma = parameters.smoothing_sigma_px
    smoothed = cv2.GaussianBlur(image, (0, 0), sigma) if sigma > 0 else image.copy()
    # A Gaussian of sigma s lowers white noise to 1 / (2 sqrt(pi) s), if s is not tiny.
    floor = rounding * (min(1.0, 0.5 / (math.sqrt(math.pi) * sigma)) if sigma > 0 else 1.0)
    count = parameters.threshold_sigmas
    if parameters.threshold_statistics == "all":
        mean, std = (float(v[0, 0]) for v in cv2.meanStdDev(smoothed))
        noise, ratio = max(std, floor), np.ones((1, 1), np.float32)
        threshold = mean + count * noise
        mask = cv2.compare(smoothed, threshold, cv2.CMP_GT)
    else:
        mean_mesh, noise_mesh = _mesh_statistics(smoothed, mesh, floor)
        noise = float(np.median(noise_mesh))
        ratio = noise_mesh / np.float32(noise)
        limit = mean_mesh + count * noise_mesh
        threshold = float(np.median(limit))
        mask = cv2.compare(smoothed, _stretch_mesh(limit, smoothed.shape), cv2.CMP_GT)
    return Preprocessed(
        image=image,
        smoothed=smoothed,
        mask=cv2.min(mask, 1),
        background=background,
        pedestal=0.0 if parameters.background == "mesh" else background,
        pixel_noise=pixel_noise,
        noise=noise,
        noise_ratio=ratio,
        threshold=threshold,
        defects=defects,
    )


def _finite(raw: NDArray[np.generic]) -> Image:
    """A float32 copy in which every value is finite, and its square too."""
    image = raw.astype(np.float32, order="C")
    if raw.dtype.kind == "f":
        usable = np.abs(image) < _LARGEST
        if not usable.any():
            raise ValueError("no pixel of the image is a finite number")
        if not usable.all():
            image[~usable] = np.median(image[usable])
    return image


def _rounding_noise(image: Image, dtype: np.dtype) -> float:
    """Std of rounding to whole DN, or of a float image to 16 bits; never 0.

    Compressed black sky and simulated frames have a std of 0, which nothing may be divided by.
    """
    step = 1.0
    if dtype.kind == "f":
        # All but the wildest pixels, which a division by a bad flat field makes.
        some = cv2.resize(image, (512, 512), interpolation=cv2.INTER_NEAREST)
        low, high = np.percentile(some, (0.01, 99.99))
        step = max(float(high - low) / 65535, 1e-15)
    return step / math.sqrt(12)


def _mesh_statistics(image: Image, mesh: tuple[int, int], floor: float) -> tuple[Image, Image]:
    """Clipped mean level and std of each cell, (ny, nx) each, the stars left out.

    No std is less than `floor`, the std of rounding.
    """
    rows, columns = mesh
    samples = _SAMPLES if rows * columns > 1 else 16 * _SAMPLES
    # Nearest-neighbour resizing is an even subsample of every cell, whatever the image's size.
    size = (columns * samples, rows * samples)
    cells = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    cells = cells.reshape(rows, samples, columns, samples).transpose(0, 2, 1, 3)
    values = cells.reshape(rows * columns, -1)
    middle = _median(values)
    deviation = values - middle
    spread = 1.4826 * _median(np.abs(deviation))
    shift = np.zeros_like(spread)
    for _ in range(2):
        # The slack keeps the neighbouring grey levels when most of a cell has one value.
        inside = np.abs(deviation - shift) <= 3 * spread + np.float32(3.5 * floor)
        kept = np.where(inside, deviation, 0)
        number = inside.sum(axis=1, keepdims=True, dtype=np.float32)
        shift = kept.sum(axis=1, keepdims=True) / number
        variance = np.einsum("ij,ij->i", kept, kept)[:, None] / number - shift**2
        # 0.9866: the std that is left of a normal distribution clipped at 3 sigma
        spread = np.sqrt(np.maximum(variance, 0)) / np.float32(0.9866)
    level = (middle + shift).reshape(mesh)
    spread = np.maximum(spread, np.float32(floor)).reshape(mesh)
    if min(mesh) >= 3:
        # A cell filled by a bright star takes its neighbours' values; others keep their level,
        # since medians flatten a curved background.
        near, spread = (cv2.medianBlur(_continued(m), 3)[1:-1, 1:-1] for m in (level, spread))
        level = np.where(np.abs(level - near) <= spread, level, near)
    return level, spread


def _median(values: Image) -> Image:
    """Median along the rows, (N, 1); of an even number, the upper of the middle two."""
    middle = values.shape[1] // 2
    return np.partition(values, middle, axis=1)[:, middle : middle + 1]


def _continued(mesh: Image) -> Image:
    """A mesh with one more cell on each side, (ny + 2, nx + 2).

    It goes on by the last step, or twice the one before if that is less, in the same direction:
    a gradient or vignetting goes on, the shadow of an occulter does not.
    """
    for _ in range(2):
        ends = []
        for side in (mesh, mesh[::-1]):
            outer, inner = side[0], side[min(1, len(side) - 1)]
            first, second = outer - inner, inner - side[min(2, len(side) - 1)]
            least = np.minimum(np.abs(first), 2 * np.abs(second))
            ends.append(outer + np.where(first * second > 0, np.sign(first) * least, 0))
        mesh = np.vstack([ends[0], mesh, ends[1]]).T
    return np.ascontiguousarray(mesh)


def _background_map(level: Image, shape: tuple[int, ...]) -> Image:
    """A mesh of levels interpolated to the image's size, and continued to its border."""
    height, width = shape[0] / level.shape[0], shape[1] / level.shape[1]
    # To whole pixels: what the background rises by in one is far under the noise.
    larger = (round(shape[0] + 2 * height), round(shape[1] + 2 * width))
    top, left = round(height), round(width)
    whole = _stretch_mesh(_continued(level), larger)
    return whole[top : top + shape[0], left : left + shape[1]]


def _stretch_mesh(mesh: Image, shape: tuple[int, ...]) -> Image:
    """A mesh interpolated to the image's size; cv2.resize puts cells' centres where they are."""
    return cv2.resize(mesh, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)


def _sharp_pixels(image: Image, noise: float) -> tuple[Index, Index]:
    """Rows and columns of pixels that stand alone too sharply to be an image of a star."""
    y, x = _brighter(image, _DEFECT_SIGMAS * noise)
    for step in _AROUND:
        # One by one, since few are left after the first.
        alone = image[_beside(image.shape, y, x, step)] < _DEFECT_RATIO * image[y, x]
        y, x = y[alone], x[alone]
    return y, x


def _peaks(image: Image, limit: float) -> tuple[Index, Index]:
    """Rows and columns of the local maxima above a limit."""
    y, x = _brighter(image, limit)
    for step in _AROUND:
        highest = image[_beside(image.shape, y, x, step)] <= image[y, x]
        y, x = y[highest], x[highest]
    return y, x


def _kept(image: Image, y: Index, x: Index) -> NDArray[np.float64]:
    """What pixels keep of their value when smoothed by a Gaussian of 1 px, (N,)."""
    line = cv2.getGaussianKernel(7, 1.0).ravel()
    smoothed = np.zeros(len(y))
    for dy in range(-3, 4):
        for dx in range(-3, 4):
            place = _beside(image.shape, y, x, (dy, dx))
            smoothed += line[dy + 3] * line[dx + 3] * image[place]
    return smoothed / image[y, x]


def _brighter(image: Image, limit: float) -> tuple[Index, Index]:
    """Rows and columns of the pixels above a limit."""
    bright = cv2.findNonZero(cv2.compare(image, limit, cv2.CMP_GT))
    if bright is None:
        return _NONE, _NONE
    x, y = bright.reshape(-1, 2).astype(np.intp).T
    return y, x


def _beside(
    shape: tuple[int, ...], y: Index, x: Index, step: tuple[int, int]
) -> tuple[Index, Index]:
    """Rows and columns of the pixels one step from others."""
    return _mirrored(y + step[0], shape[0]), _mirrored(x + step[1], shape[1])


def _mirrored(index: Index, size: int) -> Index:
    """Indices of which those a few steps outside are mirrored at the border."""
    last = size - 1
    return last - np.abs(last - np.abs(index))
