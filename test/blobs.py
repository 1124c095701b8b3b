# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Star images in plain NumPy, for tests that must not lean on the package's own simulator."""

import math

import numpy as np

# DN of `camera`.
_NOISE = {np.uint8: 3.0, np.uint16: 10.0}
_erf = np.frompyfunc(math.erf, 1, 1)


def blobs(shape, xy, flux, sigma, streak=(0.0, 0.0)):
    """Sum of pixel-integrated Gaussians at `xy` (N, 2), (H, W) float64; streaks about `xy`."""
    xy = np.reshape(xy, (-1, 2)).astype(float)
    flux = np.broadcast_to(flux, len(xy))
    parts = 1 + 3 * math.ceil(math.hypot(*streak))
    steps = (np.arange(parts) + 0.5) / parts - 0.5
    xy = (xy[:, None] + steps[:, None] * np.asarray(streak, float)).reshape(-1, 2)
    x, y = (_pixels(size, c, sigma) for size, c in zip(shape[::-1], xy.T, strict=True))
    return (y * np.repeat(flux, parts)[:, None] / parts).T @ x


def _pixels(size, centres, sigma):
    """Share of a Gaussian at each centre that falls on each pixel of a line, (N, size)."""
    edges = (np.arange(size + 1) - 0.5 - centres[:, None]) / (sigma * math.sqrt(2))
    return np.diff(_erf(edges).astype(float) / 2, axis=1)


def flux_of_snr(snr, noise, sigma):
    """Flux at which the matched filter's SNR is `snr` in white noise: F / (2 sqrt(pi) s n)."""
    return np.asarray(snr) * noise * 2 * math.sqrt(math.pi) * sigma


def flux(snr, streak=(0.0, 0.0)):
    """Flux in `camera`'s 16 bits of a PSF of 1 px; the same brightness per px along a streak."""
    return flux_of_snr(snr, _NOISE[np.uint16], 1.0) * math.sqrt(1 + math.hypot(*streak) / 3.5)


def scattered(rng, shape, spacing, margin=12):
    """Positions (N, 2), one at random in each cell, not nearer to another than half a cell."""
    y, x = (np.arange(margin, size - margin - spacing / 2, spacing) for size in shape)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) + spacing / 4
    return grid + rng.uniform(0, spacing / 2, grid.shape)


def camera(signal, rng, dtype=np.uint16, background=None, noise=None):
    """Add a background and noise and round to whole DN."""
    background = {np.uint8: 30, np.uint16: 1000}[dtype] if background is None else background
    noise = _NOISE[dtype] if noise is None else noise
    image = np.rint(signal + background + rng.normal(0, noise, signal.shape))
    return np.clip(image, 0, np.iinfo(dtype).max).astype(dtype)
