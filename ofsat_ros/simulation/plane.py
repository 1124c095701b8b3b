# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A sky that is a plane: stars without end, a camera that drifts over it, RSOs at even rates."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation import rendering
from ofsat_ros.simulation.exposure import (
    MAX_MOTION_PX,
    TILE_PX,
    Seen,
    Simulator,
    View,
    looking_at,
    star_flux,
)
from ofsat_ros.simulation.settings import RANGES, RSO, Pair, SimulatorSettings, check_pair

_ARCSEC = math.radians(1 / 3600)


class _Pose(NamedTuple):
    """Where the camera points, arcsec on the sky, and the field's angle, rad.

    A point or vector (x, y) of sky and image is the complex number x + iy here and below, so
    that a turn by a is a product with exp(ia).  The members may be arrays, of poses in time.
    """

    pointing: Any
    angle: Any

    def after(self, seconds: Any, rate: complex, rotation: float) -> _Pose:
        """Pose after a time at a rate in the image's axes (arcsec/s), turning (rad/s)."""
        turn = rotation * seconds
        # The integral of exp(-i (angle + rotation t)) dt: the chord of the arc; sinc(0) is 1.
        chord = seconds * np.sinc(turn / (2 * np.pi)) * np.exp(-1j * (self.angle + turn / 2))
        return _Pose(self.pointing + rate * chord, self.angle + turn)


class _Sources(NamedTuple):
    """Point sources: place on the sky at the start (arcsec), rate (arcsec/s), flux (DN)."""

    origin: np.ndarray
    rate: np.ndarray
    flux: np.ndarray


class SkySimulator(Simulator):
    """A camera that drifts over an endless plane of stars with RSOs among them.

    ``frame()`` exposes one frame and moves on; iterating yields what is left of
    ``settings.frames``.  `camera_rate_arcsec_s` may be set between frames.

    Parameters
    ----------
    settings : SimulatorSettings, optional
        What to simulate.

    Attributes
    ----------
    settings : SimulatorSettings
        As given.
    camera : ofsat_ros.camera.Camera
        An ideal one of the settings' size and pixel scale.
    rsos : tuple of RSO
        The RSOs of the settings, with what was left open drawn, and the flux in place of an SNR.

    Raises
    ------
    ParameterError
        If no flux gives an RSO its SNR.
    """

    def __init__(self, settings: SimulatorSettings | None = None) -> None:
        super().__init__(settings := settings or SimulatorSettings())
        self.camera_rate_arcsec_s = settings.camera_rate_arcsec_s
        rsos = _drawn(settings)
        self._pose = _Pose(0j, 0.0)
        self._last: _Pose | None = None
        position = _complex([rso.position_px for rso in rsos])
        sky = (position - self._centre) * settings.pixel_scale_arcsec
        rate = _complex([rso.rate_arcsec_s for rso in rsos])
        self.rsos = self._with_fluxes(rsos, _Sources(sky, rate, np.ones(len(rsos))))
        flux = np.array([rso.flux_percent for rso in self.rsos], float) * settings.full_scale / 100
        self._rsos = _Sources(sky, rate, flux)

    @property
    def camera_rate_arcsec_s(self) -> Pair:
        """Rate of the camera against the stars along the image's x and y, arcsec/s.

        A new value holds from the next frame's exposure.

        Raises
        ------
        ParameterError
            If the value is not a pair of finite numbers, or too fast to render.
        """
        return self._rate.real, self._rate.imag

    @camera_rate_arcsec_s.setter
    def camera_rate_arcsec_s(self, rate: Pair) -> None:
        rate = check_pair("camera_rate_arcsec_s", rate, *RANGES["camera_rate_arcsec_s"])
        motion = math.hypot(*rate) * self.settings.exposure_s / self.settings.pixel_scale_arcsec
        if motion > MAX_MOTION_PX:
            raise ParameterError(
                f"camera_rate_arcsec_s ({rate[0]:g}, {rate[1]:g}) moves the field by"
                f" {motion:.0f} px in one exposure; stay within {MAX_MOTION_PX} px"
            )
        self._rate = complex(*rate)

    @property
    def pointing_arcsec(self) -> Pair:
        """Where the camera points when the next exposure begins, from the start, arcsec.

        Of the mount, which knows nothing of the jitter.
        """
        return float(self._pose.pointing.real), float(self._pose.pointing.imag)

    def _look(self, start_s: float) -> View:
        s, seconds = self.settings, self._instants()
        steady = self._after(s.exposure_s / 2)
        middle, path = self._jittered(steady), self._jittered(self._after(seconds))
        sources = self._stars_near(middle)
        stars = self._seen(sources, path, start_s + seconds, middle, 0.0)
        rsos = self._seen(self._rsos, path, start_s + seconds, middle, start_s + s.exposure_s / 2)
        brightness = [_brightness(rso, start_s + seconds) for rso in self.rsos]
        view = View(
            stars=stars,
            star_steps=self._steps(sources, stars.place),
            rsos=rsos._replace(brightness=np.reshape(brightness, rsos.tracks.shape)),
            displacement=self._displacement(middle),
            rotation_rad=math.nan if self._last is None else middle.angle - self._last.angle,
            attitude=_attitude(steady),
        )
        self._last, self._pose = middle, self._after(s.period_s)
        return view

    def _after(self, seconds: Any) -> _Pose:
        return self._pose.after(seconds, self._rate, self.settings.field_rotation_rad_s)

    def _jittered(self, pose: _Pose) -> _Pose:
        error = self._jitter() * self.settings.pixel_scale_arcsec * np.exp(-1j * pose.angle)
        return pose._replace(pointing=pose.pointing - error)

    def _with_fluxes(self, rsos: tuple[RSO, ...], sources: _Sources) -> tuple[RSO, ...]:
        """Return the RSOs with the flux in place of the SNR."""
        seconds = self._instants()
        found = []
        for rso, track in zip(
            rsos, self._project(sources, self._after(seconds), seconds), strict=True
        ):
            if rso.snr is not None:
                percent = self._flux_percent(rso.snr, track)
                rso = dataclasses.replace(rso, flux_percent=percent, snr=None)
            found.append(rso)
        return tuple(found)

    def _seen(
        self, sources: _Sources, path: _Pose, times: np.ndarray, middle: _Pose, middle_s: float
    ) -> Seen:
        tracks = self._project(sources, path, times)
        place = self._project(sources, middle, middle_s)[:, 0]
        turning = 1j * self.settings.field_rotation_rad_s * (place - self._centre)
        scale = self.settings.pixel_scale_arcsec
        rate = np.exp(1j * middle.angle) * sources.rate - self._rate
        return Seen(
            tracks=tracks,
            place=place,
            velocity=turning + rate / scale,
            field_velocity=turning - self._rate / scale,
            flux=sources.flux,
            brightness=np.broadcast_to(1.0, tracks.shape),
        )

    def _project(self, sources: _Sources, pose: _Pose, time: Any) -> np.ndarray:
        """Places in the image, (sources, instants), px, at poses and times since the start."""
        sky = sources.origin[:, None] + sources.rate[:, None] * np.atleast_1d(time)
        offset = (sky - pose.pointing) / self.settings.pixel_scale_arcsec
        return self._centre + np.exp(1j * np.asarray(pose.angle)) * offset

    def _stars_near(self, pose: _Pose) -> _Sources:
        """Stars of every tile of sky that the exposure around `pose` may see."""
        s = self.settings
        half_motion = abs(self._rate) * s.exposure_s / s.pixel_scale_arcsec / 2
        # 2: a light's reach is of whole pixels, along both axes.
        reach = math.hypot(s.width, s.height) / 2 + 2 * (rendering.reach_px(s) + 1) + half_motion
        x, y = pose.pointing.real / s.pixel_scale_arcsec, pose.pointing.imag / s.pixel_scale_arcsec
        columns, rows = (
            range(math.floor((p - reach) / TILE_PX), math.floor((p + reach) / TILE_PX) + 1)
            for p in (x, y)
        )
        tiles = [_tile(column, row, s) for row in rows for column in columns]
        origin, flux = (np.concatenate(parts) for parts in zip(*tiles, strict=True))
        return _Sources(origin, np.zeros_like(origin), flux)

    def _steps(self, stars: _Sources, place: np.ndarray) -> np.ndarray:
        if self._last is None:
            return np.full(place.shape, complex(math.nan, math.nan))
        return place - self._project(stars, self._last, 0.0)[:, 0]

    def _displacement(self, pose: _Pose) -> complex:
        if self._last is None:
            return complex(math.nan, math.nan)
        sky = pose.pointing - self._last.pointing
        return -np.exp(1j * self._last.angle) * sky / self.settings.pixel_scale_arcsec


def _attitude(pose: _Pose) -> Rotation:
    """Return the attitude that stands for a pose on the plane.

    The plane has no place among the stars; its origin is taken to be at right ascension 0,
    declination 0, its x axis to the west and its y axis to the south.
    """
    ra, dec = -pose.pointing.real * _ARCSEC, -pose.pointing.imag * _ARCSEC
    return looking_at(ra, dec, pose.angle)


def _complex(pairs: list[Any]) -> np.ndarray:
    x, y = np.array(pairs, float).reshape(-1, 2).T
    return x + 1j * y


def _drawn(settings: SimulatorSettings) -> tuple[RSO, ...]:
    """Return the RSOs of the settings with what is None drawn."""
    random = settings.random("rsos")
    slow, fast = settings.random_speed_arcsec_s
    faint, bright = settings.random_flux_percent
    drawn = []
    for rso in settings.rsos:
        # All are drawn, used or not: giving one value leaves the other RSOs as they are.
        x, y = random.uniform(0.1, 0.9, 2) * (settings.width - 1, settings.height - 1)
        speed, angle = random.uniform(slow, fast), random.uniform(0, 2 * math.pi)
        flux = faint * (bright / faint) ** random.uniform()
        if rso.flux_percent is None and rso.snr is None:
            rso = dataclasses.replace(rso, flux_percent=flux)
        rate = rso.rate_arcsec_s or (speed * math.cos(angle), speed * math.sin(angle))
        drawn.append(
            dataclasses.replace(rso, position_px=rso.position_px or (x, y), rate_arcsec_s=rate)
        )
    return tuple(drawn)


def _brightness(rso: RSO, time_s: np.ndarray) -> np.ndarray:
    """Flux at times since the first exposure began, against its mean."""
    phase = 2 * math.pi * time_s / rso.flux_period_s + rso.flux_phase_rad
    return 1 + rso.flux_amplitude * np.sin(phase)


def _tile(column: int, row: int, s: SimulatorSettings) -> tuple[np.ndarray, np.ndarray]:
    """Places on the sky (arcsec) and fluxes (DN) of the stars of one tile."""
    # A seed's words must not be negative: 0, -1, 1, -2, ... become 0, 1, 2, 3, ...
    random = s.random("stars", *(2 * i if i >= 0 else -2 * i - 1 for i in (column, row)))
    count = random.poisson(s.star_count * TILE_PX**2 / (s.width * s.height))
    x, y, level = random.uniform(size=(3, count))
    sky = ((column + x) + 1j * (row + y)) * TILE_PX * s.pixel_scale_arcsec
    return sky, star_flux(level, s)
