# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The whole celestial sphere: stars all over it, RSOs by their directions, a camera that turns."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

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
    star_flux,
)
from ofsat_ros.simulation.mount import Motion
from ofsat_ros.simulation.settings import RSO, SimulatorSettings

# From mid-exposure to where velocities are taken from: so near that a rate that changes by 1 deg/s
# within a second is known to 1e-6 of it, and so far that the rounding of pixels is 1e-7 px/s.
_HALF_STEP_S = 1e-3
_MOST_CELL_RAD = math.radians(20)


@dataclass(frozen=True)
class Target:
    """An RSO of the sphere.

    Attributes
    ----------
    direction : callable
        Called with (N,) ascending times since the first exposure began, s; returns (N, 3) unit
        vectors, ICRS, to where the camera sees it.  NaN: it is not to be seen.
    flux_percent : float or None
        Light of one exposure, summed over its pixels, in percent of full scale.
    snr : float or None
        Gives the flux by the SNR that the RSO has in a frame in which it stands still, centred on
        a pixel, on plain sky: without stars, clouds, vignetting and hot pixels.

    Raises
    ------
    ParameterError
        If not exactly one of flux and SNR is given, or it is out of range.
    """

    direction: Callable[[np.ndarray], np.ndarray]
    flux_percent: float | None = None
    snr: float | None = None

    def __post_init__(self) -> None:
        if self.flux_percent is None and self.snr is None:
            raise ParameterError("a target has a flux_percent or an snr: give one")
        checked = RSO(flux_percent=self.flux_percent, snr=self.snr)
        object.__setattr__(self, "flux_percent", checked.flux_percent)
        object.__setattr__(self, "snr", checked.snr)


class SphereSimulator(Simulator):
    """A camera that turns over the celestial sphere, with RSOs by their directions.

    ``frame()`` exposes one frame and moves on; iterating yields what is left of
    ``settings.frames``.  A frame asks the motion for no time after its own exposure: what a mount
    is told after that is in time for the next frame.

    Parameters
    ----------
    settings : SimulatorSettings
        What to simulate.  The star count is that of an image's area at its centre.  The rates of
        camera and field and the RSOs are those of a plane sky: they stay as they are by default.
    targets : sequence of Target
        The RSOs; truth numbers them from 1.
    motion : Motion
        Where the camera looks.

    Attributes
    ----------
    settings : SimulatorSettings
        As given.
    camera : ofsat_ros.camera.Camera
        An ideal one of the settings' size and pixel scale.
    targets : tuple of Target
    motion : Motion
        As given.

    Raises
    ------
    ParameterError
        If settings of a plane sky are given, or no flux gives a target its SNR.
    """

    def __init__(
        self, settings: SimulatorSettings, targets: Sequence[Target], motion: Motion
    ) -> None:
        if settings.rsos or any(settings.camera_rate_arcsec_s) or settings.field_rotation_rad_s:
            raise ParameterError(
                "rsos, camera_rate_arcsec_s and field_rotation_rad_s are settings of a plane sky;"
                " on the sphere, the targets and the motion stand for them"
            )
        super().__init__(settings)
        self.targets, self.motion = tuple(targets), motion
        still = np.zeros(settings.subsamples, complex)
        percent = [
            self._flux_percent(target.snr, still) if target.snr else target.flux_percent
            for target in targets
        ]
        self._flux = np.array(percent, float) * settings.full_scale / 100
        # Of an exposure: the instants, then mid-exposure between its neighbours.
        self._half_step_s = min(_HALF_STEP_S, settings.exposure_s / 2)
        around = settings.exposure_s / 2 + self._half_step_s * np.array([-1, 0, 1])
        self._seconds = np.concatenate([self._instants(), around])
        self._last: tuple[Rotation, complex] | None = None  # at mid-exposure, and the jitter

    def _look(self, start_s: float) -> View:
        order = np.argsort(self._seconds, kind="stable")
        times, back = start_s + self._seconds[order], np.argsort(order)
        attitudes = self.motion.attitudes(times)[back]
        targets = [_checked(target.direction(times), len(times))[back] for target in self.targets]
        stars, flux = self._stars_near(attitudes)
        middle, jitter = attitudes[-2:-1], self._jitter()
        seen = self._seen(stars[:, None], flux, attitudes, jitter)
        view = View(
            stars=seen,
            star_steps=seen.place - self._last_places(stars),
            rsos=self._seen(
                np.reshape(targets, (-1, len(times), 3)), self._flux, attitudes, jitter
            ),
            displacement=self._displacement(middle, jitter),
            rotation_rad=self._rotation(middle),
            attitude=middle[0],
        )
        self._last = middle, jitter
        return view

    def _seen(
        self, directions: np.ndarray, flux: np.ndarray, attitudes: Rotation, jitter: complex
    ) -> Seen:
        """What is seen of sources, (N, times or 1, 3), at the times of an exposure."""
        directions = np.broadcast_to(directions, (len(directions), len(attitudes), 3))
        places = self._places(directions, attitudes) + jitter
        # A star that is where the source is in mid-exposure.
        star = self._places(np.repeat(directions[:, -2:-1], 3, axis=1), attitudes[-3:])
        tracks = places[:, :-3]
        return Seen(
            tracks=tracks,
            place=places[:, -2],
            velocity=(places[:, -1] - places[:, -3]) / (2 * self._half_step_s),
            field_velocity=(star[:, 2] - star[:, 0]) / (2 * self._half_step_s),
            flux=flux,
            brightness=np.broadcast_to(1.0, tracks.shape),
        )

    def _places(self, directions: np.ndarray, attitudes: Rotation) -> np.ndarray:
        """Places in the image, (N, times), of directions, (N, times, 3), without jitter."""
        sights = np.einsum("tij,ntj->nti", attitudes.as_matrix(), directions)
        x, y = self.camera.pixels(sights.reshape(-1, 3)).T
        return (x + 1j * y).reshape(sights.shape[:2])

    def _last_places(self, directions: np.ndarray) -> np.ndarray:
        """Places, (N,), of (N, 3) directions in the frame before, NaN if there is none."""
        if self._last is None:
            return np.full(len(directions), complex(math.nan, math.nan))
        attitude, jitter = self._last
        return self._places(directions[:, None], attitude)[:, 0] + jitter

    def _displacement(self, middle: Rotation, jitter: complex) -> complex:
        now = self._centre - jitter
        star = middle.inv().apply(self.camera.lines_of_sight(np.array([[now.real, now.imag]])))
        return self._centre - complex(self._last_places(star)[0])

    def _rotation(self, middle: Rotation) -> float:
        if self._last is None:
            return math.nan
        *_, z, w = (middle * self._last[0].inv()).as_quat(canonical=True)[0]
        # What is left of the turn when the boresight's own way is taken out.
        return 2 * math.atan2(z, w)

    def _stars_near(self, attitudes: Rotation) -> tuple[np.ndarray, np.ndarray]:
        """Directions, (N, 3), and fluxes of all stars that an exposure may see."""
        s = self.settings
        boresights = attitudes.as_matrix()[:, 2]
        middle = boresights[-2]
        chord = np.linalg.norm(boresights - middle, axis=1).max()
        turn = 2 * math.asin(min(1.0, chord / 2))
        motion = 2 * turn * self.camera.matrix[0, 0]
        if motion > MAX_MOTION_PX:
            raise ParameterError(
                f"the camera's motion moves the field by {motion:.0f} px in one exposure; stay"
                f" within {MAX_MOTION_PX} px"
            )
        radius = min(self._half_field_rad() + turn, math.pi)
        parts = [_stars(*cell, s) for cell in _cells(middle, radius, _bands(s))]
        directions, flux = (np.concatenate(part) for part in zip(*parts, strict=True))
        near = directions @ middle >= math.cos(radius)
        return directions[near], flux[near]

    def _half_field_rad(self) -> float:
        """Angle from the boresight to the farthest source that lights the image."""
        s = self.settings
        pad = rendering.reach_px(s) + 1 + abs(self._jitter())
        corners = [[x, y] for x in (-pad, s.width - 1 + pad) for y in (-pad, s.height - 1 + pad)]
        x, y, z = self.camera.lines_of_sight(np.array(corners, float)).T
        return float(np.arctan2(np.hypot(x, y), z).max())


def _checked(directions: np.ndarray, count: int) -> np.ndarray:
    directions = np.asarray(directions, float)
    if directions.shape != (count, 3):
        raise ParameterError(
            f"a target's direction gave an array of shape {directions.shape}, not ({count}, 3)"
        )
    return directions


# The sphere is cut into bands of equal height in declination, and these into cells that are about
# as wide as they are high: so all have nearly the same area, and none is special at the poles.


def _bands(s: SimulatorSettings) -> int:
    side = TILE_PX * math.radians(s.pixel_scale_arcsec / 3600)
    return math.ceil(math.pi / min(side, _MOST_CELL_RAD))


def _cells(centre: np.ndarray, radius: float, bands: int) -> Iterator[tuple[int, int, int]]:
    """Band and number of each cell that a circle touches, and the bands in all."""
    dec, ra = math.asin(max(-1.0, min(1.0, centre[2]))), math.atan2(centre[1], centre[0])
    height = math.pi / bands
    half_width = math.pi
    if abs(dec) + radius < math.pi / 2:
        half_width = math.asin(math.sin(radius) / math.cos(dec))
    lowest, highest = (math.floor((dec + way + math.pi / 2) / height) for way in (-radius, radius))
    for band in range(max(lowest, 0), min(highest, bands - 1) + 1):
        cells = _cells_of(band, bands)
        first, last = (
            math.floor((ra + way) / (2 * math.pi) * cells) for way in (-half_width, half_width)
        )
        for cell in range(first, min(last, first + cells - 1) + 1):
            yield band, cell % cells, bands


def _cells_of(band: int, bands: int) -> int:
    middle = (band + 0.5) * math.pi / bands - math.pi / 2
    return max(1, round(2 * bands * math.cos(middle)))


def _stars(
    band: int, cell: int, bands: int, s: SimulatorSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Directions, (N, 3), and fluxes (DN) of the stars of one cell."""
    cells, low = _cells_of(band, bands), band * math.pi / bands - math.pi / 2
    low_z, high_z = math.sin(low), math.sin(low + math.pi / bands)
    area_px = (
        2 * math.pi / cells * (high_z - low_z) / math.radians(s.pixel_scale_arcsec / 3600) ** 2
    )
    random = s.random("stars", band, cell)
    count = random.poisson(s.star_count * area_px / (s.width * s.height))
    along, up, level = random.uniform(size=(3, count))
    ra, z = 2 * math.pi / cells * (cell + along), low_z + (high_z - low_z) * up
    across = np.sqrt(np.maximum(1 - z**2, 0))
    return np.stack([across * np.cos(ra), across * np.sin(ra), z], axis=-1), star_flux(level, s)
