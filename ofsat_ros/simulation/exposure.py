# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How a frame is made of what a camera sees, whatever it looks at and however it moves.

It stands between the geometry, which is that of a plane (`plane`) or of the sphere (`sphere`) and
says where in the image stars and RSOs are, and the steps of an exposure: `rendering`, `sky`,
`sensor`.  Places and velocities in the image are complex numbers x + iy, px, here and below.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.simulation import rendering
from ofsat_ros.simulation.frames import STAR_DTYPE, TRUTH_DTYPE, SimulatedFrame
from ofsat_ros.simulation.sensor import Sensor
from ofsat_ros.simulation.settings import SimulatorSettings
from ofsat_ros.simulation.sky import Sky

# Side of the parts in which stars are drawn, px; small against an image, so that few stars
# outside it are drawn, yet dozens of stars each.
TILE_PX = 256
# In one exposure; far beyond what anybody wants to see, and well before memory is.
MAX_MOTION_PX = 20_000


class Seen(NamedTuple):
    """Point sources in the image during an exposure; what is not in front of it is NaN.

    Attributes
    ----------
    tracks : numpy.ndarray
        (N, subsamples) complex, places at the instants of the exposure.
    place, velocity : numpy.ndarray
        (N,) complex, at mid-exposure.
    field_velocity : numpy.ndarray
        (N,) complex, velocity of a star at the same place.
    flux : numpy.ndarray
        (N,), light of one exposure, DN.
    brightness : numpy.ndarray
        (N, subsamples), flux at the instants against the above.
    """

    tracks: np.ndarray
    place: np.ndarray
    velocity: np.ndarray
    field_velocity: np.ndarray
    flux: np.ndarray
    brightness: np.ndarray


class View(NamedTuple):
    """What a camera sees in an exposure.

    Attributes
    ----------
    stars, rsos : Seen
        All whose light may reach the image; and the RSOs, those outside the image included.
    star_steps : numpy.ndarray
        (N,) complex, displacements of the stars since the frame before.
    displacement : complex
        That of a star now at the image's centre.
    rotation_rad : float
        Turn of the field since the frame before.
    attitude : Rotation
        ICRS -> optical frame at mid-exposure, without jitter.
    """

    stars: Seen
    star_steps: np.ndarray
    rsos: Seen
    displacement: complex
    rotation_rad: float
    attitude: Rotation


class _Spot(NamedTuple):
    """What arrives of an RSO: pixels of the flat image, light in each (DN), flux (DN)."""

    pixels: np.ndarray
    signal: np.ndarray
    flux: float


class Simulator(ABC):
    """A simulated camera: ``frame()`` exposes one frame and moves on to the next.

    Iterating yields what is left of ``settings.frames``.

    Parameters
    ----------
    settings : SimulatorSettings
        What to simulate.

    Attributes
    ----------
    settings : SimulatorSettings
        As given.
    camera : ofsat_ros.camera.Camera
        An ideal one of the settings' size and pixel scale.
    """

    def __init__(self, settings: SimulatorSettings) -> None:
        self.settings = s = settings
        self.camera = Camera.ideal(s.width, s.height, math.radians(s.pixel_scale_arcsec / 3600))
        self._centre = complex(s.width - 1, s.height - 1) / 2
        self._sky, self._sensor = Sky(s), Sensor(s)
        self._frame = 0

    def __len__(self) -> int:
        return self.settings.frames

    def __iter__(self) -> Iterator[SimulatedFrame]:
        while self._frame < self.settings.frames:
            yield self.frame()

    def frame(self) -> SimulatedFrame:
        """Expose one frame, and move on to the start of the next."""
        s, number, start = self.settings, self._frame, self._frame * self.settings.period_s
        view = self._look(start)
        light, spots = self._exposure(view, start)
        stamp = s.start_stamp_ns + round((start + s.exposure_s / 2) * 1e9)
        seen = np.flatnonzero(self._inside(view.rsos.place))
        against_stars = (view.rsos.velocity - view.rsos.field_velocity)[seen]
        frame = SimulatedFrame(
            image=self._sensor.read_out(light, number),
            stamp_ns=stamp,
            frame=number,
            truth=self._truth(view.rsos, seen, spots, light, stamp),
            relative_velocity_px_s=np.stack([against_stars.real, against_stars.imag], axis=-1),
            stars=self._star_truth(view),
            displacement_px=np.array([view.displacement.real, view.displacement.imag]),
            rotation_rad=view.rotation_rad,
            attitude=view.attitude,
        )
        self._frame = number + 1
        return frame

    @abstractmethod
    def _look(self, start_s: float) -> View:
        """Return what is seen in the exposure that begins then, and move on to the next."""

    def _instants(self) -> np.ndarray:
        """Times of the subsamples since an exposure began, s."""
        s = self.settings
        return (np.arange(s.subsamples) + 0.5) / s.subsamples * s.exposure_s

    def _jitter(self) -> complex:
        """How far all that this frame sees is shifted, px."""
        s = self.settings
        if not s.jitter_std_px:
            return 0j
        x, y = s.jitter_std_px * s.random("jitter", self._frame).standard_normal(2)
        return complex(x, y)

    def _flux_percent(self, snr: float, track: np.ndarray) -> float:
        """Return the flux that gives an SNR to a streak of this shape, (subsamples,) complex."""
        s = self.settings
        # In the image's middle, so that no border cuts it, at its own phase of the pixel.
        way = self._centre - track.mean()
        track = track + complex(round(way.real), round(way.imag))
        spot = rendering.footprint(track, np.full(s.subsamples, 1 / s.subsamples), s)
        background = float(self._sky.light.mean())
        return self._sensor.flux_for_snr(snr, *spot, background) / s.full_scale * 100

    def _exposure(self, view: View, start_s: float) -> tuple[np.ndarray, list[_Spot]]:
        """Light that arrives at the pixels in the exposure, and the RSOs' part of it."""
        s = self.settings
        light = np.zeros(s.height * s.width)
        rendering.add_sources(light, *self._points(view.stars), s)
        transmission, sky_light = self._sky.at(start_s + s.exposure_s / 2)
        spots = []
        for number, flux in enumerate(view.rsos.flux):
            rso = Seen(*(part[number : number + 1] for part in view.rsos))
            index, value = rendering.footprint(*self._points(rso), s)
            np.add.at(light, index, value)
            kept = value * transmission[index] * self._sensor.vignetting[index]
            share = kept.sum() / value.sum() if value.any() else 1.0
            spots.append(_Spot(index, kept, flux * rso.brightness.mean() * share))
        return (light * transmission + sky_light) * self._sensor.vignetting, spots

    def _points(self, sources: Seen) -> tuple[np.ndarray, np.ndarray]:
        """Places at all instants, as far as their light reaches the image, and light of each."""
        s, pad = self.settings, rendering.reach_px(self.settings) + 1
        x, y = sources.tracks.real, sources.tracks.imag
        near = (x > -pad) & (x < s.width + pad) & (y > -pad) & (y < s.height + pad)
        shares = sources.flux[:, None] / s.subsamples * sources.brightness
        return sources.tracks[near], shares[near]

    def _inside(self, place: np.ndarray) -> np.ndarray:
        x, y = place.real + 0.5, place.imag + 0.5
        return (x >= 0) & (x < self.settings.width) & (y >= 0) & (y < self.settings.height)

    def _truth(
        self, rsos: Seen, seen: np.ndarray, spots: list[_Spot], light: np.ndarray, stamp_ns: int
    ) -> np.ndarray:
        table = _motion_table(TRUTH_DTYPE, rsos.place[seen], rsos.velocity[seen])
        table["stamp_ns"], table["frame"], table["id"] = stamp_ns, self._frame, seen + 1
        table["snr"] = [self._sensor.snr(spots[i].pixels, spots[i].signal, light) for i in seen]
        table["flux"] = [spots[i].flux for i in seen]
        table["length_px"] = abs(rsos.velocity[seen]) * self.settings.exposure_s
        return table

    def _star_truth(self, view: View) -> np.ndarray:
        table = _motion_table(STAR_DTYPE, view.stars.place, view.stars.velocity)
        table["dx_px"], table["dy_px"] = view.star_steps.real, view.star_steps.imag
        table["flux"] = view.stars.flux
        return table[self._inside(view.stars.place)]


def star_flux(level: np.ndarray, settings: SimulatorSettings) -> np.ndarray:
    """Return stars' fluxes, DN, of levels that are even between 0 and 1."""
    faint, bright = settings.star_flux_percent
    # Star counts: about N(brighter than F) ~ 1/F, so 1/F is uniform.
    return settings.full_scale / 100 / (1 / bright + level * (1 / faint - 1 / bright))


def looking_at(ra_rad: float, dec_rad: float, angle_rad: float = 0.0) -> Rotation:
    """Return the attitude, ICRS -> optical frame, of a camera that looks at a place in the sky.

    Parameters
    ----------
    ra_rad, dec_rad : float
        Where its boresight points, ICRS.
    angle_rad : float
        Turn of the field in the image, x axis towards y axis; at 0, north is up and east left.
    """
    # Base axes at RA 0, dec 0: x = -Y, y = -Z, z = X of ICRS.
    base = Rotation.from_quat([0.5, -0.5, 0.5, 0.5])
    # First the sky is turned by -RA about the pole, then by -dec about the image's x axis.
    tilted = Rotation.from_rotvec([-dec_rad, 0, 0]) * base * Rotation.from_rotvec([0, 0, -ra_rad])
    return Rotation.from_rotvec([0, 0, angle_rad]) * tilted


def _motion_table(dtype: np.dtype, place: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    table: Any = np.zeros(len(place), dtype)
    table["x_px"], table["y_px"] = place.real, place.imag
    table["vx_px_s"], table["vy_px_s"] = velocity.real, velocity.imag
    return table
