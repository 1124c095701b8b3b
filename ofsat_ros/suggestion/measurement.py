# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the frames of a recording are like: stars, noise, motion, rate."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.camera import Camera
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.recordings import Frame

Array = NDArray[np.float64]

# Stars that tell the width of all: bright ones, a few of each frame.
_BRIGHT_SNR, _STARS_OF_A_FRAME, _LEAST_STARS = 20.0, 30, 5
# Half the side of what is cut out around a star, px.
_LEAST_REACH, _LARGEST_REACH = 8, 60
# So many pixels of the same greatest value are no chance: the sensor is full there.
_SATURATED_PIXELS = 5
_HOT_SIGMAS = 6.0
# Stars have left their places when the field has moved so far in all, px; and so many frames are
# needed for that.
_MOVED_PX, _FRAMES_TO_MOVE = 12.0, 5
_NAN = float("nan")


@dataclass(frozen=True)
class Measurement:
    """What was measured; NaN where it could not be.

    Attributes
    ----------
    frames : int
        Frames that were processed.
    width, height : int
        Of the image, px.
    interval_s, longest_gap_s : float
        Median and longest time from a frame to the next, s.
    exposure_s : float
        As the recording tells, s.
    pixel_scale_arcsec : float
        What a pixel in the middle spans, arcsec, as calibrated.
    background, pixel_noise : float
        Level and noise of the sky, DN.
    whole_numbers : bool
        The images are of integers.
    objects : float
        Objects above the threshold in a frame, median.
    stars : int
        Images of bright stars whose width was measured.
    saturated_share : float
        Share of the bright objects that are saturated.
    psf_sigma_px : float
        Sigma of the stars' images across their streaks, without the pixel's own width, px.
    streak_px : float
        Median length of the bright objects' streaks, px; 0 for points.
    field_px, field_residual_px : float
        The star field's motion from frame to frame, and the rms of the stars about it, px.
    hot_pixels : int or None
        Pixels that shine in every frame while the field moves on; None if it does not.
    seconds : float
        Time that the pipeline takes for a frame on this machine, s.
    """

    frames: int
    width: int
    height: int
    interval_s: float = _NAN
    longest_gap_s: float = _NAN
    exposure_s: float = _NAN
    pixel_scale_arcsec: float = _NAN
    background: float = _NAN
    pixel_noise: float = _NAN
    whole_numbers: bool = True
    objects: float = 0.0
    stars: int = 0
    saturated_share: float = 0.0
    psf_sigma_px: float = _NAN
    streak_px: float = _NAN
    field_px: float = _NAN
    field_residual_px: float = _NAN
    hot_pixels: int | None = None
    seconds: float = _NAN

    @property
    def fwhm_px(self) -> float:
        """Full width of the stars' images at half their height, px."""
        return math.sqrt(8 * math.log(2)) * self.psf_sigma_px


def measure(frames: Iterable[Frame]) -> Measurement:
    """Look at frames as the pipeline does with its default parameters.

    Parameters
    ----------
    frames : iterable of Frame
        Frames in the order of time; those of another size than the first one are left out.

    Raises
    ------
    ImageError
        If there is no frame that can be processed; the message says why.
    """
    pipeline, results = Pipeline(), list[FrameResult]()
    noises, widths, saturated, stamps = list[float](), list[float](), list[bool](), list[int]()
    darkest: NDArray[np.float32] | None = None
    first: Frame | None = None
    problem = ImageError("there is no frame")
    for frame in frames:
        if first is not None and frame.image.shape != first.image.shape:
            continue
        try:
            result = pipeline.process(frame.image, frame.stamp_ns)
        except ImageError as error:
            problem = error
            continue
        first = first or frame
        stamps.append(frame.stamp_ns)
        results.append(result)
        noises.append(_pixel_noise(frame.image))
        across, full = _star_widths(frame.image, result)
        widths += across
        saturated += full
        image = frame.image.astype(np.float32)
        darkest = image if darkest is None else np.minimum(darkest, image)
    if first is None or darkest is None:
        raise problem
    bright = np.concatenate([_bright(result.objects)["length"] for result in results])
    motions = [result.star_field for result in results if result.star_field is not None]
    steps = np.diff(np.array(stamps)) / 1e9
    field_px = _median([float(np.hypot(*motion.displacement)) for motion in motions])
    moved = len(motions) >= _FRAMES_TO_MOVE and len(motions) * field_px > _MOVED_PX
    noise = _median(noises)
    return Measurement(
        frames=len(results),
        width=first.image.shape[1],
        height=first.image.shape[0],
        interval_s=_median(steps),
        longest_gap_s=float(steps.max(initial=-math.inf)) if len(steps) else _NAN,
        exposure_s=_NAN if first.exposure_s is None else first.exposure_s,
        pixel_scale_arcsec=_pixel_scale(first.camera),
        background=_median([result.background for result in results]),
        pixel_noise=noise,
        whole_numbers=first.image.dtype.kind != "f",
        objects=_median([len(result.objects) for result in results]),
        stars=len(widths),
        saturated_share=float(np.mean(saturated)) if saturated else 0.0,
        psf_sigma_px=_median(widths) if len(widths) >= _LEAST_STARS else _NAN,
        streak_px=_median(bright),
        field_px=field_px,
        field_residual_px=_median([motion.residual_px for motion in motions]),
        hot_pixels=_hot_pixels(darkest, noise) if moved else None,
        seconds=_median([sum(result.seconds.values()) for result in results]),
    )


def _median(values: list[float] | Array) -> float:
    return float(np.median(values)) if len(values) else _NAN


def _pixel_scale(camera: Camera | None) -> float:
    """What a pixel spans around the principal point, arcsec."""
    if camera is None:
        return _NAN
    slopes = camera.jacobians(camera.matrix[None, :2, 2])[0]
    return math.degrees(math.sqrt(np.linalg.det(slopes.T @ slopes)) ** 0.5) * 3600


def _pixel_noise(image: NDArray[np.generic]) -> float:
    """Std of a pixel, DN: of differences in a row, which no gradient adds to, stars left out."""
    pixels = image.astype(np.float32)
    values = ((pixels[:, 2:] - pixels[:, :-2]) / math.sqrt(2)).ravel()
    values = values[np.isfinite(values)][:: max(1, values.size // 100_000)]
    spread = 1.4826 * float(np.median(np.abs(values))) if values.size else _NAN
    for _ in range(3):
        # The slack keeps the neighbouring grey levels where most differences are 0.
        inside = np.abs(values) <= 3 * spread + 1
        spread = float(np.std(values[inside])) if inside.any() else _NAN
    return spread


def _bright(objects: NDArray[np.void]) -> NDArray[np.void]:
    """Those of a frame's objects that are surely stars or RSOs, and whole."""
    return objects[(objects["snr"] >= _BRIGHT_SNR) & ~objects["edge"]]


def _star_widths(
    image: NDArray[np.generic], result: FrameResult
) -> tuple[list[float], list[bool]]:
    """Widths of a frame's bright stars, px, and of which of them are saturated."""
    highest = image.max()
    full = highest if np.count_nonzero(image == highest) >= _SATURATED_PIXELS else math.inf
    widths, saturated = [], []
    for star in _bright(result.objects)[:_STARS_OF_A_FRAME]:
        size = math.sqrt(star["area"] / math.pi) + star["length"] / 2
        reach = int(np.clip(2 * size + 4, _LEAST_REACH, _LARGEST_REACH))
        x, y = round(star["x"]), round(star["y"])
        cut = image[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1]
        saturated.append(bool(cut.max() >= full))
        if saturated[-1] or cut.shape != (2 * reach + 1, 2 * reach + 1):
            continue
        offset = np.array([star["x"] - x, star["y"] - y])
        width = _width(cut.astype(float), offset, star["length"], star["angle"])
        if math.isfinite(width):
            widths.append(width)
    return widths, saturated


def _width(cut: Array, offset: Array, length: float, angle: float) -> float:
    """Sigma of a star's image across its streak, px; NaN if it has none.

    Of the light's second moment under a Gaussian window that is made as wide as the star: for a
    Gaussian of variance s^2 under a window of variance v it is m = v s^2 / (v + s^2).
    """
    reach = len(cut) // 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    dx, dy = x - offset[0], y - offset[1]
    along = dx * math.cos(angle) + dy * math.sin(angle)
    across = dy * math.cos(angle) - dx * math.sin(angle)
    border = np.concatenate([cut[0], cut[-1], cut[1:-1, 0], cut[1:-1, -1]])
    light = cut - np.median(border)
    # The ends of a streak are as wide in all directions.
    middle = np.abs(along) <= max(length / 4, 2.0)
    across, light = across[middle], light[middle]
    variance, place = 4.0, 0.0
    for _ in range(20):
        weight = np.exp(-((across - place) ** 2) / (2 * variance)) * light
        total = weight.sum()
        if total <= 0:
            return _NAN
        place = float((weight * across).sum() / total)
        moment = float((weight * (across - place) ** 2).sum() / total)
        if not 0 < moment < 0.95 * variance or abs(place) > reach / 2:
            return _NAN
        variance = float(np.clip(moment * variance / (variance - moment), 0.1, reach**2))
    # A pixel is a square of side 1.
    return math.sqrt(max(variance - 1 / 12, 0.01))


def _hot_pixels(darkest: NDArray[np.float32], noise: float) -> int:
    """How many pixels stand out of those around them in the darkest that was seen of each."""
    return int(np.count_nonzero(darkest - cv2.medianBlur(darkest, 5) > _HOT_SIGMAS * noise))
