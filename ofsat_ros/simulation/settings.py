# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the simulator simulates: settings, checked, and the random streams that they seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ofsat_ros.parameters import ParameterError

_NEW_YEAR_2026_NS = 1_767_225_600_000_000_000
# The position of a purpose is part of its streams' seed: add at the end only.
_PURPOSES = (
    "stars", "rsos", "photons", "sensor", "scenario", "jitter", "clouds", "gain",
    "fixed_pattern", "hot_pixels", "cosmic_rays",
)  # fmt: skip

Pair = tuple[float, float]


def check_number(name: str, value: Any, low: float, high: float, integer: bool = False) -> Any:
    """Return `value` as a float, or an int, or raise `ParameterError` if it is out of range."""
    kind = int | np.integer if integer else int | float | np.integer | np.floating
    if isinstance(value, bool) or not isinstance(value, kind) or not low <= value <= high:
        word = "an integer" if integer else "a number"
        raise ParameterError(f"{name} must be {word} within {low:g} to {high:g}, not {value!r}")
    return int(value) if integer else float(value)


def check_pair(name: str, value: Any, low: float, high: float) -> Pair:
    """Return `value` as two floats, or raise `ParameterError` if it is not two in the range."""
    if isinstance(value, str) or not isinstance(value, Iterable) or len(pair := (*value,)) != 2:
        raise ParameterError(f"{name} must be a pair of numbers, not {value!r}")
    first, second = (check_number(name, number, low, high) for number in pair)
    return first, second


@dataclass(frozen=True)
class RSO:
    """A resident space object; what is None is drawn at random by the simulator's seed.

    Attributes
    ----------
    position_px : (float, float) or None
        x, y in the image when the first exposure begins, px; it may lie outside.
    rate_arcsec_s : (float, float) or None
        Angular rate against the stars along the image's x and y at the start, arcsec/s.
    flux_percent : float or None
        Light of one exposure, summed over its pixels, in percent of full scale.
    snr : float or None
        Gives the flux by the SNR that the whole streak of the first exposure then has on plain
        sky: without stars, clouds, vignetting and hot pixels.  None: `flux_percent` counts.
    flux_amplitude, flux_period_s, flux_phase_rad : float
        An RSO that tumbles: t after the first exposure begins, its flux is that given above
        times ``1 + amplitude * sin(2 pi t / period + phase)``.

    Raises
    ------
    ParameterError
        If a value is not a finite number of its range, or if both flux and SNR are given.
    """

    position_px: Pair | None = None
    rate_arcsec_s: Pair | None = None
    flux_percent: float | None = None
    snr: float | None = None
    flux_amplitude: float = 0.0
    flux_period_s: float = 10.0
    flux_phase_rad: float = 0.0

    def __post_init__(self) -> None:
        for name, limit in (("position_px", 1e6), ("rate_arcsec_s", 1e6)):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, check_pair(name, value, -limit, limit))
        for name, (low, high) in _RSO_RANGES.items():
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, check_number(name, value, low, high))
        if self.flux_percent is not None and self.snr is not None:
            raise ParameterError(
                f"an RSO has a flux_percent ({self.flux_percent:g}) or an snr ({self.snr:g}),"
                " not both: leave one out"
            )


@dataclass(frozen=True)
class SimulatorSettings:
    """What is simulated.

    Attributes
    ----------
    width, height : int
        Size of the image, px.
    bit_depth : int
        8 gives uint8 images, 9 to 16 uint16; full scale is ``2**bit_depth - 1`` DN.
    pixel_scale_arcsec : float
        Side of a pixel on the sky, arcsec.
    exposure_s, period_s : float
        Length of an exposure, and from the start of one to the start of the next, s.
    frames : int
        Number of frames when the simulator is iterated.
    subsamples : int
        Instants that an exposure is integrated over.  A streak is smooth while its length is
        under about two PSF sigmas times this.
    psf_sigma_px : float
        Sigma of the Gaussian point spread function, px.
    camera_rate_arcsec_s : (float, float)
        Rate of the camera against the stars along the image's x and y at the first frame,
        arcsec/s: (0, 0) is tracking at star rate, an RSO's own rate is tracking that RSO.
    field_rotation_rad_s : float
        Rate at which the field turns about the image's centre, x axis towards y axis, rad/s.
    star_count : float
        Mean number of stars in the image.
    star_flux_percent : (float, float)
        Faintest and brightest star; light of one exposure, percent of full scale.
    noise_mean_percent, noise_std_percent : float
        Mean level and standard deviation of the white Gaussian noise, percent of full scale.
    electrons_per_dn : float
        With photon noise, electrons per DN: the light's variance in DN^2 is light / this.
        0: no photon noise.
    rsos : tuple of RSO
        The RSOs; truth numbers them from 1.
    random_speed_arcsec_s : (float, float)
        Least and greatest speed of an RSO whose rate is drawn; any direction is as likely.
    random_flux_percent : (float, float)
        Least and greatest flux of an RSO whose flux is drawn, even in its logarithm.
    sky_percent : float
        Light of the sky in every pixel, in percent of full scale, on top of the noise's mean; it
        has photon noise, and vignetting and gain act on it.
    sky_gradient_percent : (float, float)
        How much more light the sky has at the right (bottom) border than at the left (top), or
        if negative the reverse; nothing is taken from the darker side.
    cloud_cover : float
        Share of the sky that is under clouds.  Their pattern fits itself to the image's size.
    cloud_opacity : float
        Share of the light of stars and RSOs that the thickest cloud takes.
    cloud_glow_percent : float
        Light that the thickest cloud adds to a pixel, percent of full scale.
    cloud_drift_px_s : (float, float)
        Rate of the clouds along the image's x and y, px/s, whatever the camera does.
    vignetting : float
        Share of all light that is lost in the image's corners; it grows with the square of the
        distance from the centre.
    gain_std : float
        Standard deviation of the pixels' gains around 1, fixed in the sensor.
    fixed_pattern_std_percent : float
        Standard deviation of the pixels' offsets, fixed in the sensor, percent of full scale.
    hot_pixel_fraction : float
        Share of the pixels that are hot, fixed in the sensor.
    hot_pixel_percent : (float, float)
        Least and greatest dark signal of a hot pixel, percent of full scale, even in its
        logarithm; it has photon noise.
    cosmic_ray_count : float
        Mean number of cosmic rays in a frame: half hit one pixel, half leave a short track.
    cosmic_ray_percent : (float, float)
        Least and greatest signal of a cosmic ray per pixel of its path, percent of full scale,
        even in its logarithm.
    jitter_std_px : float
        Standard deviation, along x and along y, of the pointing's error in each frame, px.  It
        shifts stars and RSOs alike, is new in each frame, and holds during the exposure.
    start_stamp_ns : int
        UTC when the first exposure begins, ns.
    seed : int
        Seed of everything that is random.

    Raises
    ------
    ParameterError
        If a value is of the wrong type or out of range; the message names the range.
    """

    width: int = 512
    height: int = 512
    bit_depth: int = 16
    pixel_scale_arcsec: float = 5.0
    exposure_s: float = 1.0
    period_s: float = 1.0
    frames: int = 60
    subsamples: int = 10
    psf_sigma_px: float = 1.0
    camera_rate_arcsec_s: Pair = (0.0, 0.0)
    field_rotation_rad_s: float = 0.0
    star_count: float = 150.0
    star_flux_percent: Pair = (20.0, 2000.0)
    noise_mean_percent: float = 5.0
    noise_std_percent: float = 1.0
    electrons_per_dn: float = 0.0
    rsos: tuple[RSO, ...] = ()
    random_speed_arcsec_s: Pair = (5.0, 30.0)
    random_flux_percent: Pair = (30.0, 300.0)
    sky_percent: float = 0.0
    sky_gradient_percent: Pair = (0.0, 0.0)
    cloud_cover: float = 0.0
    cloud_opacity: float = 0.8
    cloud_glow_percent: float = 0.0
    cloud_drift_px_s: Pair = (0.0, 0.0)
    vignetting: float = 0.0
    gain_std: float = 0.0
    fixed_pattern_std_percent: float = 0.0
    hot_pixel_fraction: float = 0.0
    hot_pixel_percent: Pair = (5.0, 100.0)
    cosmic_ray_count: float = 0.0
    cosmic_ray_percent: Pair = (5.0, 100.0)
    jitter_std_px: float = 0.0
    start_stamp_ns: int = _NEW_YEAR_2026_NS
    seed: int = 1

    def __post_init__(self) -> None:
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        for name, (low, high) in RANGES.items():
            value, default = getattr(self, name), defaults[name]
            if isinstance(default, tuple):
                value = check_pair(name, value, low, high)
            else:
                value = check_number(name, value, low, high, isinstance(default, int))
            object.__setattr__(self, name, value)
        for name in _LEAST_AND_GREATEST:
            low, high = getattr(self, name)
            if low > high:
                raise ParameterError(f"{name} must be (least, greatest), not ({low:g}, {high:g})")
        if self.exposure_s > self.period_s:
            raise ParameterError(
                f"exposure_s ({self.exposure_s:g}) must not exceed period_s ({self.period_s:g}):"
                " shorten the exposure or lengthen the period"
            )
        if not isinstance(self.rsos, Sequence) or not all(isinstance(r, RSO) for r in self.rsos):
            raise ParameterError(f"rsos must be a sequence of RSO, not {self.rsos!r}")
        object.__setattr__(self, "rsos", tuple(self.rsos))

    @property
    def full_scale(self) -> int:
        """Greatest value of a pixel, DN."""
        return 2**self.bit_depth - 1

    def random(self, purpose: str, first: int = 0, second: int = 0) -> np.random.Generator:
        """Return the random stream of a purpose and of two numbers that are not negative."""
        # Always four words: numpy pads shorter seeds with zeros and would make some equal.
        words = (self.seed, _PURPOSES.index(purpose), first, second)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))


_RSO_RANGES: dict[str, Pair] = {
    "flux_percent": (0.0, 1e6),
    "snr": (1e-3, 1e4),
    "flux_amplitude": (0.0, 1.0),
    "flux_period_s": (1e-3, 1e6),
    "flux_phase_rad": (-10.0, 10.0),
}
_LEAST_AND_GREATEST = (
    "star_flux_percent", "random_speed_arcsec_s", "random_flux_percent",
    "hot_pixel_percent", "cosmic_ray_percent",
)  # fmt: skip
RANGES: dict[str, Pair] = {
    "width": (16, 16384),
    "height": (16, 16384),
    "bit_depth": (8, 16),
    "pixel_scale_arcsec": (0.001, 3600.0),
    "exposure_s": (1e-6, 3600.0),
    "period_s": (1e-6, 86400.0),
    "frames": (1, 10**7),
    "subsamples": (1, 1000),
    "psf_sigma_px": (0.2, 20.0),
    "camera_rate_arcsec_s": (-1e6, 1e6),
    "field_rotation_rad_s": (-10.0, 10.0),
    "star_count": (0.0, 1e5),
    "star_flux_percent": (1e-3, 1e6),
    "noise_mean_percent": (0.0, 100.0),
    "noise_std_percent": (0.0, 100.0),
    "electrons_per_dn": (0.0, 1e6),
    "random_speed_arcsec_s": (0.0, 1e6),
    "random_flux_percent": (1e-3, 1e6),
    "sky_percent": (0.0, 100.0),
    "sky_gradient_percent": (-100.0, 100.0),
    "cloud_cover": (0.0, 1.0),
    "cloud_opacity": (0.0, 1.0),
    "cloud_glow_percent": (0.0, 100.0),
    "cloud_drift_px_s": (-1e4, 1e4),
    "vignetting": (0.0, 1.0),
    "gain_std": (0.0, 0.5),
    "fixed_pattern_std_percent": (0.0, 100.0),
    "hot_pixel_fraction": (0.0, 1.0),
    "hot_pixel_percent": (1e-3, 1e6),
    "cosmic_ray_count": (0.0, 1e4),
    "cosmic_ray_percent": (1e-3, 1e6),
    "jitter_std_px": (0.0, 100.0),
    "start_stamp_ns": (0, 2**62),
    "seed": (0, 2**31 - 1),
}
