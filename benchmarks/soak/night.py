# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The sky of a long night: some frames, rendered beforehand, that come round for ever.

The simulator's camera stands still and its sky is rolled on by some px a frame, so that after the
last frame the first fits: the field drifts all night without a jump, and a frame costs a copy.
RSOs cross in every round, a cloud hides all for some frames, and some pixels are hot.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros.camera import Camera
from ofsat_ros.simulation import RSO, SimulatorSettings, SkySimulator

Image = NDArray[np.uint16]

ROUND = 256  # frames
_RSOS = 10
_SPEEDS_PX = (1.5, 6.0)  # per frame against the stars
_SCALE_ARCSEC = 5.0
_NOISE_DN = 650.0
_HOT = 2e-4
# Frames from the first that the cloud veils to the last, and those of them that show nothing.
_CLOUD, _DARK = range(170, 202), range(182, 190)
# An RSO counts where it is this far inside, px, and this strong.
_INSIDE_PX, _LEAST_SNR = 8.0, 8.0


@dataclass(frozen=True)
class Night:
    """Frames without end.

    Attributes
    ----------
    images : (ROUND, H, W) uint16
        As the simulator made them, DN.
    truth : list of (N, 2) float64
        Where the RSOs are in each, px.
    sure : list of (N,) bool
        Which of them are to be found.
    """

    images: NDArray[np.uint16]
    truth: list[NDArray[np.float64]]
    sure: list[NDArray[np.bool_]]

    @classmethod
    def load(cls, folder: Path) -> Night:
        """Read what `render` has written."""
        with np.load(folder / "truth.npz") as kept:
            rows, xy, sure = kept["frame"], kept["xy"], kept["sure"]
        images = np.load(folder / "images.npy")
        each = range(len(images))
        return cls(images, [xy[rows == n] for n in each], [sure[rows == n] for n in each])

    @property
    def drift_px(self) -> int:
        """How far the field moves in a frame: once around in a whole number of rounds."""
        return max(1, self.images.shape[2] // len(self.images))

    def image(self, number: int) -> Image:
        """Return a frame of the night."""
        kept = self.images[number % len(self.images)]
        image = np.empty_like(kept)
        shift = self.drift_px * number % kept.shape[1]
        image[:, shift:], image[:, :shift] = (
            kept[:, : kept.shape[1] - shift],
            kept[:, kept.shape[1] - shift :],
        )
        hot = np.random.default_rng(1).integers(0, kept.size, round(_HOT * kept.size))
        image.ravel()[hot] = np.minimum(image.ravel()[hot].astype(int) + 9000, 65535)
        return image

    def rsos(self, number: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return where the RSOs are in a frame, (N, 2) px, and which of them are to be found."""
        row, width = number % len(self.images), self.images.shape[2]
        xy = self.truth[row].copy()
        xy[:, 0] = (xy[:, 0] + self.drift_px * number) % width
        # Where the sky begins anew, an RSO is cut in two.
        inside = (xy[:, 0] > _INSIDE_PX) & (xy[:, 0] < width - 1 - _INSIDE_PX)
        return xy, self.sure[row] & inside


def camera_of(night: Night) -> Camera:
    """Return the camera that took a night's frames."""
    _, height, width = night.images.shape
    scale = {"pixel_scale_arcsec": _SCALE_ARCSEC}
    return SkySimulator(SimulatorSettings(width=width, height=height, **scale)).camera


def render(folder: Path, side: int, frames: int = ROUND) -> None:
    """Write the frames of one round: images of `side` px, and where their RSOs are."""
    settings = SimulatorSettings(
        width=side,
        height=side,
        frames=frames,
        pixel_scale_arcsec=_SCALE_ARCSEC,
        star_count=round(8e-4 * side * side),
        rsos=tuple(_crossing(side, frames)),
    )
    random = np.random.default_rng(2)
    images = np.empty((frames, side, side), np.uint16)
    found: list[tuple[int, float, float, bool]] = []
    for number, frame in enumerate(tqdm(SkySimulator(settings), desc="rendering", disable=None)):
        clear = _clearness(number * ROUND // frames)
        images[number] = _veiled(frame.image, clear, random)
        for row in frame.truth:
            xy = row["x_px"], row["y_px"]
            inside = min(*xy, side - 1 - xy[0], side - 1 - xy[1]) > _INSIDE_PX
            found.append((number, *xy, bool(inside and row["snr"] * clear > _LEAST_SNR)))
    np.save(folder / "images.npy", images)
    rows, x, y, sure = (np.array(column) for column in zip(*found, strict=True))
    np.savez(folder / "truth.npz", frame=rows, xy=np.stack([x, y], axis=1), sure=sure)


def _crossing(side: int, frames: int) -> Iterator[RSO]:
    """RSOs that pass near the centre one after the other, each in a direction of its own."""
    random = np.random.default_rng(3)
    for number in range(_RSOS):
        angle, speed = random.uniform(0, 2 * np.pi), random.uniform(*_SPEEDS_PX)
        step = speed * np.array([np.cos(angle), np.sin(angle)])
        middle = side * random.uniform(0.3, 0.7, 2)
        start = middle - step * (number + 0.5) * frames / _RSOS
        rate = step * _SCALE_ARCSEC
        snr = float(np.geomspace(15, 60, _RSOS)[number])
        yield RSO((float(start[0]), float(start[1])), (float(rate[0]), float(rate[1])), snr=snr)


def _clearness(number: int) -> float:
    """Share of the stars' light that the cloud leaves in a frame."""
    if number not in _CLOUD:
        return 1.0
    if number in _DARK:
        return 0.0
    ramp = _DARK.start - _CLOUD.start
    return min(abs(number - (_DARK.start if number < _DARK.start else _DARK.stop - 1)) / ramp, 1.0)


def _veiled(image: Image, clear: float, random: np.random.Generator) -> Image:
    """The frame with so much of its light, and noise as before."""
    if clear == 1.0:
        return image
    level = np.median(image)
    noise = random.normal(0, _NOISE_DN * np.sqrt(1 - clear**2), image.shape)
    veiled = level + (image - level) * clear + noise
    return np.clip(np.rint(veiled), 0, 65535).astype(np.uint16)
