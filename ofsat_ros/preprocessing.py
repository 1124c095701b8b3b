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

# Samples per side of a mesh cell: 1,024 values give its median to 4 % of the noise.
_SAMPLES = 32
# A star's neighbour holds at least this fraction of its peak (a Gaussian of FWHM 1.4 px or more,
# anywhere on the pixel grid); a defect's neighbours hold noise.
_DEFECT_RATIO = 0.25
_DEFECT_SIGMAS = 6.0


@dataclass(frozen=True)
class Preprocessed:
    """An image ready for objects and flow.

    Attributes
    ----------
    image : (H, W) float32
        Image less its background, defects replaced, DN.
    smoothed : (H, W) float32
        The same, smoothed (I_s), DN.
    mask : (H, W) uint8
        1 where `smoothed` is above the threshold.
    background : float
        Median level of the background, DN.
    pixel_noise, noise : float
        Std of the background in `image` and in `smoothed`, DN; the median over the image.
        Never 0: at least what quantisation leaves.
    noise_ratio : (ny, nx) float32
        Noise over its median, on a mesh of equal cells; one cell when it is not local.
    threshold : float
        Threshold over the background, DN; the median over the image.
    """

    image: Image
    smoothed: Image
    mask: NDArray[np.uint8]
    background: float
    pixel_noise: float
    noise: float
    noise_ratio: Image
    threshold: float

    @property
    def filtered(self) -> Image:
        """I_f, (H, W) float32: `smoothed` where it is above the threshold, elsewhere 0."""
        return self.smoothed * self.mask


def preprocess(raw: NDArray[np.generic], parameters: Parameters) -> Preprocessed:
    """Subtract the background, smooth and threshold one image.

    Parameters
    ----------
    raw : (H, W) uint8, uint16 or float32
        The image, DN.  Values that are not finite count as background.
    parameters : Parameters
        Those of the stage ``preprocessing``.

    Returns
    -------
    Preprocessed

    Raises
    ------
    ValueError
        If no pixel is finite.
    """
    image = _finite(raw)
    cell = parameters.background_cell_px if parameters.background == "mesh" else max(raw.shape)
    # A mesh needs a frame of cells to interpolate between; a small image is one cell.
    mesh = (max(1, round(raw.shape[0] / cell)), max(1, round(raw.shape[1] / cell)))
    level, spread = _mesh_statistics(image, mesh)
    background = float(np.median(level))
    if parameters.background == "mesh":
        image -= _stretch_mesh(level, image.shape)
    quantum = _quantisation_noise(image, raw.dtype)
    pixel_noise = max(float(np.median(spread)), quantum)
    if parameters.hot_pixels == "replace":
        base = 0.0 if parameters.background == "mesh" else background
        _replace_defects(image, base, pixel_noise)

    sigma = parameters.smoothing_sigma_px
    smoothed = cv2.GaussianBlur(image, (0, 0), sigma) if sigma > 0 else image.copy()
    # A Gaussian of sigma s lowers white noise to 1 / (2 sqrt(pi) s), if s is not tiny.
    floor = quantum * (min(1.0, 0.5 / (math.sqrt(math.pi) * sigma)) if sigma > 0 else 1.0)
    count = parameters.threshold_sigmas
    if parameters.threshold_statistics == "all":
        mean, std = (float(v[0, 0]) for v in cv2.meanStdDev(smoothed))
        noise, ratio = max(std, floor), np.ones((1, 1), np.float32)
        threshold = mean + count * noise
        mask = cv2.compare(smoothed, threshold, cv2.CMP_GT)
    else:
        mean_mesh, noise_mesh = _mesh_statistics(smoothed, mesh)
        noise_mesh = np.maximum(noise_mesh, np.float32(floor))
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
        pixel_noise=pixel_noise,
        noise=noise,
        noise_ratio=ratio,
        threshold=threshold,
    )


def _finite(raw: NDArray[np.generic]) -> Image:
    """A float32 copy in which every value is finite."""
    image = raw.astype(np.float32)
    if raw.dtype.kind == "f":
        finite = np.isfinite(image)
        if not finite.any():
            raise ValueError("no pixel of the image is a finite number")
        if not finite.all():
            image[~finite] = np.median(image[finite])
    return image


def _quantisation_noise(image: Image, dtype: np.dtype) -> float:
    """Noise that even an image without any has: of rounding to whole DN, or to 16 bits if float.

    Compressed black sky and simulated frames have a std of 0, which nothing may be divided by.
    """
    low, high, _, _ = cv2.minMaxLoc(image)
    step = 1.0 if dtype.kind == "u" else max((high - low) / 65535, 1e-30)
    return step / math.sqrt(12)


def _mesh_statistics(image: Image, mesh: tuple[int, int]) -> tuple[Image, Image]:
    """Clipped mean level and std of each cell, (ny, nx) each, the stars left out."""
    rows, columns = mesh
    samples = _SAMPLES if rows * columns > 1 else 16 * _SAMPLES
    # Nearest-neighbour resizing is an even subsample of every cell, whatever the image's size.
    size = (columns * samples, rows * samples)
    cells = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    cells = cells.reshape(rows, samples, columns, samples).transpose(0, 2, 1, 3)
    values = cells.reshape(rows, columns, -1)
    level = np.median(values, axis=2, keepdims=True)
    spread = 1.4826 * np.median(np.abs(values - level), axis=2, keepdims=True)
    for _ in range(2):
        # The slack keeps neighbouring grey levels when most of a cell has one value.
        inside = np.abs(values - level) <= 3 * spread + 0.5
        number = inside.sum(axis=2, keepdims=True)
        level = np.sum(values * inside, axis=2, keepdims=True) / number
        # 0.9866: the std that is left of a normal distribution clipped at 3 sigma
        variance = np.sum((values - level) ** 2 * inside, axis=2, keepdims=True) / number
        spread = np.sqrt(variance) / 0.9866
    level, spread = level[..., 0].astype(np.float32), spread[..., 0].astype(np.float32)
    if min(mesh) >= 3:
        # A cell filled by a bright star takes its neighbours' values.
        return cv2.medianBlur(level, 3), cv2.medianBlur(spread, 3)
    return level, spread


def _stretch_mesh(mesh: Image, shape: tuple[int, ...]) -> Image:
    """A mesh interpolated to the image's size; cv2.resize puts cells' centres where they are."""
    return cv2.resize(mesh, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)


def _replace_defects(image: Image, base: float, noise: float) -> None:
    """Replace, in place, pixels that stand alone too sharply to be an image of a star."""
    bright = cv2.findNonZero(cv2.compare(image, base + _DEFECT_SIGMAS * noise, cv2.CMP_GT))
    if bright is None:
        return
    x, y = bright.reshape(-1, 2).T
    height, width = image.shape
    steps = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    around = np.stack(
        [image[np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)] for dy, dx in steps]
    )
    peak = image[y, x] - base
    defect = around.max(axis=0) - base < _DEFECT_RATIO * peak
    image[y[defect], x[defect]] = np.median(around[:, defect], axis=0)
