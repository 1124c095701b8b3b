# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How the light of point sources falls on the pixels.

It is the first step of a frame; `sky` and `sensor` act on what it gives.  Light is here and there
a flat array of all pixels, row after row, in DN without noise.
"""

from __future__ import annotations

import math

import numpy as np

from ofsat_ros.simulation.settings import SimulatorSettings

# Light beyond 5 sigma is 6e-7 of a source in each axis, under 1 DN for all but absurd fluxes.
_PSF_REACH_SIGMAS = 5
_PATCH_PIXELS_AT_ONCE = 2_000_000

# The last bits of SciPy's are others, and the same settings are to give the same bytes.
_erf = np.frompyfunc(math.erf, 1, 1)


def reach_px(settings: SimulatorSettings) -> int:
    """Return how far from a source's own pixel its light goes, px."""
    return math.ceil(_PSF_REACH_SIGMAS * settings.psf_sigma_px)


def footprint(
    places: np.ndarray, flux: np.ndarray, settings: SimulatorSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels that point sources light, and by how much.

    Parameters
    ----------
    places : numpy.ndarray
        (N,) complex, x + iy in the image, px.
    flux : numpy.ndarray
        (N,), DN.
    settings : SimulatorSettings
        Size of the image and of the PSF.

    Returns
    -------
    index : numpy.ndarray
        (M,) int64, pixels of the flat image; one may come several times.
    light : numpy.ndarray
        (M,), DN.
    """
    s = settings
    columns, across = _profile(places.real, s)
    rows, down = _profile(places.imag, s)
    inside = ((rows >= 0) & (rows < s.height))[:, :, None]
    inside = inside & ((columns >= 0) & (columns < s.width))[:, None, :]
    index = rows[:, :, None] * s.width + columns[:, None, :]
    light = (flux[:, None] * down)[:, :, None] * across[:, None, :]
    return index[inside], light[inside]


def _profile(centre: np.ndarray, s: SimulatorSettings) -> tuple[np.ndarray, np.ndarray]:
    """Pixels along one axis near each centre, and the share of the light that each gets.

    The PSF is integrated over the pixel, by erf, not sampled at its centre: so flux is conserved
    and the centroid right at every subpixel phase, for a PSF narrower than a pixel too.
    """
    reach = reach_px(s)
    nearest = np.rint(centre)[:, None]
    edges = nearest + np.arange(-reach, reach + 2) - 0.5
    sigmas = (edges - centre[:, None]) / (s.psf_sigma_px * math.sqrt(2))
    share = np.diff(_erf(sigmas).astype(float)) / 2
    return (nearest + np.arange(-reach, reach + 1)).astype(np.int64), share


def add_sources(
    light: np.ndarray, places: np.ndarray, flux: np.ndarray, settings: SimulatorSettings
) -> None:
    """Add the light of point sources, so many at once that memory stays bounded.

    Parameters are those of `footprint`, and `light`, (height * width,), which changes.
    """
    step = max(1, _PATCH_PIXELS_AT_ONCE // (2 * reach_px(settings) + 1) ** 2)
    for first in range(0, len(places), step):
        part = slice(first, first + step)
        np.add.at(light, *footprint(places[part], flux[part], settings))
