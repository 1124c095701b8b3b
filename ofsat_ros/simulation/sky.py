# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The sky between the sources and the telescope: clouds, and light of its own.

It stands between the light of the stars and RSOs (`rendering`) and the sensor: what a cloud lets
through, and what the sky and the clouds add.  Light is a flat array of all pixels, DN.
"""

from __future__ import annotations

import numpy as np

from ofsat_ros.simulation.settings import SimulatorSettings

# The pattern of the clouds repeats after this many of the image's longer side, so that an image
# shows no part of it twice; cells are small against the patches, so that they don't show.
_PERIOD_IMAGES = 2
_CELLS = 128
# Waves per period: the largest patches are a third of the image, the smallest 5 cells.
_WAVES = (3, 12)
# Of the amplitude against the wave number: Kolmogorov's -11/3 of the power, in two dimensions.
_SLOPE = -11 / 6
# Standard deviations of the pattern from a cloud's border to where it is thickest.
_BORDER = 0.7


class Sky:
    """Clouds and the sky's own light.

    Parameters
    ----------
    settings : SimulatorSettings
        ``sky_*`` and ``cloud_*`` count.

    Attributes
    ----------
    light : numpy.ndarray
        (height * width,), the sky's own light without clouds, DN.
    """

    def __init__(self, settings: SimulatorSettings) -> None:
        self._settings = s = settings
        along_x, along_y = s.sky_gradient_percent
        percent = s.sky_percent + _rise(along_y, s.height)[:, None] + _rise(along_x, s.width)
        self.light = percent.ravel() * s.full_scale / 100
        self._clouds = _cloud_pattern(s) if s.cloud_cover else None

    def at(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the sky at a time since the first exposure began.

        Returns
        -------
        transmission : numpy.ndarray
            (height * width,), share of the sources' light that comes through.
        light : numpy.ndarray
            (height * width,), light of sky and clouds, DN.
        """
        s = self._settings
        if self._clouds is None:
            return np.broadcast_to(1.0, self.light.shape), self.light
        cell_px = _PERIOD_IMAGES * max(s.width, s.height) / _CELLS
        drift_x, drift_y = s.cloud_drift_px_s
        columns = (np.arange(s.width) - drift_x * time_s) / cell_px
        rows = (np.arange(s.height) - drift_y * time_s) / cell_px
        cloud = _interpolated(_interpolated(self._clouds, rows).T, columns).T.ravel()
        glow = s.cloud_glow_percent / 100 * s.full_scale
        return 1 - s.cloud_opacity * cloud, self.light + glow * cloud


def _rise(percent: float, length: int) -> np.ndarray:
    """Even rise along an axis, from 0 at its darker end."""
    ramp = np.linspace(0.0, percent, length)
    return ramp - min(percent, 0.0)


def _cloud_pattern(s: SimulatorSettings) -> np.ndarray:
    """Thickness of the clouds, 0 to 1, on a square of cells that repeats without a seam."""
    white = np.fft.rfft2(s.random("clouds").standard_normal((_CELLS, _CELLS)))
    waves = np.hypot(
        np.fft.fftfreq(_CELLS, 1 / _CELLS)[:, None], np.fft.rfftfreq(_CELLS, 1 / _CELLS)
    )
    least, most = _WAVES
    amplitude = np.maximum(waves, least) ** _SLOPE * np.exp(-((waves / most) ** 2))
    pattern = np.fft.irfft2(white * np.where(waves < least, 0, amplitude))
    border = np.quantile(pattern, 1 - s.cloud_cover)
    return np.clip((pattern - border) / (_BORDER * pattern.std()), 0, 1)


def _interpolated(rows: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Rows of a pattern that repeats, at places between them, linearly."""
    below = np.floor(at).astype(np.int64)
    share = (at - below)[:, None]
    return rows[below % len(rows)] * (1 - share) + rows[(below + 1) % len(rows)] * share
