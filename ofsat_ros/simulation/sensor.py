# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The sensor behind the telescope: vignetting, its pixels' defects, its noise.

It is the last step of a frame: from the light that arrives to the image, and to the SNR that a
signal has in it.  What is fixed in the sensor is drawn once, by the seed.  Light is a flat array
of all pixels, row after row, DN.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation.settings import Pair, SimulatorSettings

# Of the cosmic rays that graze the sensor; those that leave a longer track are rare.
_MEAN_TRACK_PX = 4.0
_TRACK_STEP_PX = 0.1


class Sensor:
    """A sensor with its defects.

    Parameters
    ----------
    settings : SimulatorSettings
        Noise, vignetting, gains, fixed pattern, hot pixels and cosmic rays count.

    Attributes
    ----------
    vignetting : numpy.ndarray
        (height * width,), share of the light that reaches each pixel.
    """

    def __init__(self, settings: SimulatorSettings) -> None:
        self._settings = s = settings
        self.vignetting = _vignetting(s)
        count = s.width * s.height
        self._gain: float | np.ndarray = 1.0
        if s.gain_std:
            gain = 1 + s.gain_std * s.random("gain").standard_normal(count)
            self._gain = np.maximum(gain, 0)
        self._offset: float | np.ndarray = 0.0
        if s.fixed_pattern_std_percent:
            std = s.fixed_pattern_std_percent * s.full_scale / 100
            self._offset = std * s.random("fixed_pattern").standard_normal(count)
        self._dark = np.zeros(count)
        if s.hot_pixel_fraction:
            random = s.random("hot_pixels")
            hot = np.flatnonzero(random.uniform(size=count) < s.hot_pixel_fraction)
            level = _even_in_logarithm(s.hot_pixel_percent, random.uniform(size=len(hot)))
            self._dark[hot] = level * s.full_scale / 100

    def read_out(self, light: np.ndarray, frame: int) -> np.ndarray:
        """Return the image, (height, width), of the light that arrives in a frame."""
        s, percent = self._settings, self._settings.full_scale / 100
        level = _with_photon_noise(light * self._gain + self._dark, frame, s) + self._offset
        level += s.noise_mean_percent * percent
        level += (
            s.noise_std_percent * percent * s.random("sensor", frame).standard_normal(level.size)
        )
        _add_cosmic_rays(level, frame, s)
        image = np.rint(level).clip(0, s.full_scale).reshape(s.height, s.width)
        return image.astype(np.uint8 if s.bit_depth == 8 else np.uint16)

    def snr(self, index: np.ndarray, signal: np.ndarray, light: np.ndarray) -> float:
        """Return the SNR of a matched filter, sqrt(sum s_i^2 / var_i), in a frame.

        Parameters
        ----------
        index, signal : numpy.ndarray
            (M,), pixels that a source lights, and by how much, DN; one may come several times.
        light : numpy.ndarray
            (height * width,), all light that arrives, that of the source included.
        """
        pixels, signal = _per_pixel(index, signal)
        return self._matched_filter(signal, light[pixels], self._dark[pixels])

    def flux_for_snr(
        self, snr: float, index: np.ndarray, share: np.ndarray, background: float
    ) -> float:
        """Return the flux, DN, that gives a source an SNR over an even background.

        Parameters
        ----------
        snr : float
            What is wanted.
        index, share : numpy.ndarray
            (M,), pixels that the source lights, and the shares of its light.
        background : float
            Light of the background in each pixel, DN.

        Raises
        ------
        ParameterError
            If no flux does, as the gains' noise grows with it or all light misses the image.
        """
        _, shares = _per_pixel(index, share)
        # The SNR grows as flux^a, with a of 1 for faint sources and 1/2 under their own photon
        # noise: each step leaves at most half of the error in the logarithm.
        flux = float(self._settings.full_scale)
        for _ in range(100):
            reached = self._matched_filter(flux * shares, background + flux * shares, 0.0)
            if abs(reached / snr - 1) < 1e-9:
                return flux
            if not reached or flux > 1e12:
                break
            flux *= snr / reached
        raise ParameterError(
            f"no flux gives an RSO an snr of {snr:g}: lower it, its rate or gain_std"
            f" ({self._settings.gain_std:g})"
        )

    def _matched_filter(
        self, signal: np.ndarray, light: np.ndarray, dark: np.ndarray | float
    ) -> float:
        s = self._settings
        fixed, random = s.fixed_pattern_std_percent / 100, s.noise_std_percent / 100
        variance = np.full(len(signal), (random * s.full_scale) ** 2 + 1 / 12)
        variance += (fixed * s.full_scale) ** 2 + (s.gain_std * light) ** 2
        if s.electrons_per_dn:
            variance += (light + dark) / s.electrons_per_dn
        return math.sqrt(np.sum(signal**2 / variance))


def _vignetting(s: SimulatorSettings) -> np.ndarray:
    x, y = np.arange(s.width) - (s.width - 1) / 2, np.arange(s.height) - (s.height - 1) / 2
    square = y[:, None] ** 2 + x**2
    return (1 - s.vignetting * square / square.max()).ravel()


def _even_in_logarithm(limits: Pair, uniform: Any) -> Any:
    low, high = limits
    return low * (high / low) ** uniform


def _per_pixel(index: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels, each once, and the sums of their values."""
    pixels, inverse = np.unique(index, return_inverse=True)
    return pixels, np.bincount(inverse, value, len(pixels))


def _with_photon_noise(light: np.ndarray, frame: int, s: SimulatorSettings) -> np.ndarray:
    level = light.copy()
    if s.electrons_per_dn:
        # Whether the end of a wing is 1e-17 or 0 differs between machines, and with it how many
        # random numbers are drawn: so none are for less than this.
        lit = np.flatnonzero(light > 1e-6)
        electrons = s.random("photons", frame).poisson(light[lit] * s.electrons_per_dn)
        level[lit] = electrons / s.electrons_per_dn
    return level


def _add_cosmic_rays(level: np.ndarray, frame: int, s: SimulatorSettings) -> None:
    """Add the signals of a frame's cosmic rays, (height * width,), which changes.

    They are particles in the sensor, not light: no PSF spreads them.
    """
    if not s.cosmic_ray_count:
        return
    random = s.random("cosmic_rays", frame)
    for _ in range(random.poisson(s.cosmic_ray_count)):
        x, y = random.uniform(-0.5, (s.width - 0.5, s.height - 0.5))
        turn = np.exp(2j * np.pi * random.uniform())
        length = random.exponential(_MEAN_TRACK_PX) * (random.uniform() < 0.5)
        signal = _even_in_logarithm(s.cosmic_ray_percent, random.uniform()) * s.full_scale / 100
        # A track of many points, each with its share of the signal per pixel times the length.
        track = complex(x, y) + turn * np.arange(0, max(length, _TRACK_STEP_PX), _TRACK_STEP_PX)
        columns, rows = (np.rint(part).astype(np.int64) for part in (track.real, track.imag))
        inside = (columns >= 0) & (columns < s.width) & (rows >= 0) & (rows < s.height)
        hit = rows[inside] * s.width + columns[inside]
        np.add.at(level, hit, signal * max(length, 1) / len(track))
