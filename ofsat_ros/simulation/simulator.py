"""The simulated camera: where it points, what it sees from there, and the truth of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation import rendering
from ofsat_ros.simulation.sensor import Sensor
from ofsat_ros.simulation.settings import RANGES, RSO, Pair, SimulatorSettings, check_pair
from ofsat_ros.simulation.sky import Sky

TRUTH_DTYPE = np.dtype(
    [("stamp_ns", "i8"), ("frame", "i4"), ("id", "u4")]
    + [(name, "f8") for name in ("x_px", "y_px", "vx_px_s", "vy_px_s")]
    + [(name, "f8") for name in ("snr", "flux", "length_px")]
)
STAR_DTYPE = np.dtype(
    [(name, "f8") for name in ("x_px", "y_px", "vx_px_s", "vy_px_s", "dx_px", "dy_px", "flux")]
)
_TRUTH_FORMAT = "%d,%d,%d,%.4f,%.4f,%.5f,%.5f,%.3f,%.2f,%.3f"

# px; small against an image, so that few stars outside it are drawn, yet dozens of stars each.
_TILE_PX = 256
_MAX_MOTION_PX = 20_000


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One frame and its truth.

    Attributes
    ----------
    image : numpy.ndarray
        (height, width), uint8 or uint16, DN.
    stamp_ns : int
        Middle of the exposure, UTC, ns.
    frame : int
        Number of the frame, from 0.
    truth : numpy.ndarray
        TRUTH_DTYPE, a row for each RSO whose centre is inside the image: position at
        mid-exposure, jitter included, and velocity in the image then, without it; ``flux`` in
        DN, as clouds and vignetting leave it, in the mean of this exposure; ``snr`` of a matched
        filter on this one frame, sqrt(sum s_i^2 / var_i) over the pixels that see that flux;
        ``length_px`` of its streak.  var_i has all that is random to whoever doesn't know the
        sensor: photon noise of all light and dark signal, sensor noise, rounding, the offsets'
        variance, and that of the gains times the light squared.  Left out: the levels of stars,
        sky and hot pixels, taken as known; cosmic rays; saturation.
    stars : numpy.ndarray
        STAR_DTYPE, a row for each star whose centre is inside: position at mid-exposure,
        velocity, displacement since the frame before (NaN in the first frame), flux in DN before
        clouds and vignetting.
    displacement_px : numpy.ndarray
        (2,), displacement since the frame before of a star now at the image's centre, px, jitter
        included; NaN in the first frame.
    rotation_rad : float
        Turn of the field since the frame before, x axis towards y axis; NaN in the first frame.
    """

    image: np.ndarray
    stamp_ns: int
    frame: int
    truth: np.ndarray
    stars: np.ndarray
    displacement_px: np.ndarray
    rotation_rad: float


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


class _Spot(NamedTuple):
    """What arrives of an RSO: pixels of the flat image, light in each (DN), flux (DN)."""

    pixels: np.ndarray
    signal: np.ndarray
    flux: float


class SkySimulator:
    """A camera that drifts over an endless sky of stars with RSOs among them.

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
    rsos : tuple of RSO
        The RSOs of the settings, with what was left open drawn, and the flux in place of an SNR.

    Raises
    ------
    ParameterError
        If no flux gives an RSO its SNR.
    """

    def __init__(self, settings: SimulatorSettings | None = None) -> None:
        self.settings = settings = settings or SimulatorSettings()
        self.camera_rate_arcsec_s = settings.camera_rate_arcsec_s
        rsos = _drawn(settings)
        self._sky, self._sensor = Sky(settings), Sensor(settings)
        self._centre = complex(settings.width - 1, settings.height - 1) / 2
        self._pose = _Pose(0j, 0.0)
        self._last: _Pose | None = None
        self._frame = 0
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
        if motion > _MAX_MOTION_PX:
            raise ParameterError(
                f"camera_rate_arcsec_s ({rate[0]:g}, {rate[1]:g}) moves the field by"
                f" {motion:.0f} px in one exposure; stay within {_MAX_MOTION_PX} px"
            )
        self._rate = complex(*rate)

    @property
    def pointing_arcsec(self) -> Pair:
        """Where the camera points when the next exposure begins, from the start, arcsec.

        Of the mount, which knows nothing of the jitter.
        """
        return float(self._pose.pointing.real), float(self._pose.pointing.imag)

    @property
    def field_angle_rad(self) -> float:
        """Turn of the field from the start to when the next exposure begins, rad."""
        return float(self._pose.angle)

    def __len__(self) -> int:
        return self.settings.frames

    def __iter__(self) -> Iterator[SimulatedFrame]:
        while self._frame < self.settings.frames:
            yield self.frame()

    def frame(self) -> SimulatedFrame:
        """Expose one frame at the current rate, and move on to the start of the next."""
        s, number, start = self.settings, self._frame, self._frame * self.settings.period_s
        middle = self._jittered(self._after(s.exposure_s / 2))
        stars = self._stars_near(middle)
        light, spots = self._exposure(stars, start)
        stamp = s.start_stamp_ns + round((start + s.exposure_s / 2) * 1e9)
        frame = SimulatedFrame(
            image=self._sensor.read_out(light, number),
            stamp_ns=stamp,
            frame=number,
            truth=self._truth(middle, spots, light, stamp),
            stars=self._star_truth(stars, middle),
            displacement_px=self._displacement(middle),
            rotation_rad=math.nan if self._last is None else middle.angle - self._last.angle,
        )
        self._last, self._pose, self._frame = middle, self._after(s.period_s), number + 1
        return frame

    def _after(self, seconds: Any) -> _Pose:
        return self._pose.after(seconds, self._rate, self.settings.field_rotation_rad_s)

    def _jittered(self, pose: _Pose) -> _Pose:
        s = self.settings
        if not s.jitter_std_px:
            return pose
        x, y = s.jitter_std_px * s.random("jitter", self._frame).standard_normal(2)
        error = complex(x, y) * s.pixel_scale_arcsec * np.exp(-1j * pose.angle)
        return pose._replace(pointing=pose.pointing - error)

    def _exposure(self, stars: _Sources, start: float) -> tuple[np.ndarray, list[_Spot]]:
        """Light that arrives at the pixels in the exposure that begins now, and the RSOs' part."""
        s = self.settings
        seconds = self._instants()
        path, time = self._jittered(self._after(seconds)), start + seconds
        light = np.zeros(s.height * s.width)
        self._add_stars(light, self._project(stars, path, time), stars.flux)
        transmission, sky_light = self._sky.at(start + s.exposure_s / 2)
        spots = []
        for rso, track, flux in zip(
            self.rsos, self._project(self._rsos, path, time), self._rsos.flux, strict=True
        ):
            brightness = _brightness(rso, time)
            index, value = rendering.footprint(track, flux / s.subsamples * brightness, s)
            np.add.at(light, index, value)
            kept = value * transmission[index] * self._sensor.vignetting[index]
            share = kept.sum() / value.sum() if value.any() else 1.0
            spots.append(_Spot(index, kept, flux * brightness.mean() * share))
        return (light * transmission + sky_light) * self._sensor.vignetting, spots

    def _instants(self) -> np.ndarray:
        """Times of the subsamples since an exposure began, s."""
        s = self.settings
        return (np.arange(s.subsamples) + 0.5) / s.subsamples * s.exposure_s

    def _with_fluxes(self, rsos: tuple[RSO, ...], sources: _Sources) -> tuple[RSO, ...]:
        """Return the RSOs with the flux in place of the SNR."""
        s, seconds = self.settings, self._instants()
        background = float(self._sky.light.mean())
        found = []
        for rso, track in zip(
            rsos, self._project(sources, self._after(seconds), seconds), strict=True
        ):
            if rso.snr is not None:
                # In the image's middle, so that no border cuts it, at its own phase of the pixel.
                way = self._centre - track.mean()
                track = track + complex(round(way.real), round(way.imag))
                spot = rendering.footprint(track, np.full(s.subsamples, 1 / s.subsamples), s)
                flux = self._sensor.flux_for_snr(rso.snr, *spot, background)
                percent = flux / s.full_scale * 100
                rso = dataclasses.replace(rso, flux_percent=percent, snr=None)
            found.append(rso)
        return tuple(found)

    def _project(self, sources: _Sources, pose: _Pose, time: Any) -> np.ndarray:
        """Places in the image, (sources, instants), px, at poses and times since the start."""
        sky = sources.origin[:, None] + sources.rate[:, None] * np.atleast_1d(time)
        offset = (sky - pose.pointing) / self.settings.pixel_scale_arcsec
        return self._centre + np.exp(1j * np.asarray(pose.angle)) * offset

    def _velocity(self, sources: _Sources, place: np.ndarray, pose: _Pose) -> np.ndarray:
        turning = 1j * self.settings.field_rotation_rad_s * (place - self._centre)
        rate = np.exp(1j * pose.angle) * sources.rate - self._rate
        return turning + rate / self.settings.pixel_scale_arcsec

    def _inside(self, place: np.ndarray) -> np.ndarray:
        x, y = place.real + 0.5, place.imag + 0.5
        return (x >= 0) & (x < self.settings.width) & (y >= 0) & (y < self.settings.height)

    def _stars_near(self, pose: _Pose) -> _Sources:
        """Stars of every tile of sky that the exposure around `pose` may see."""
        s = self.settings
        half_motion = abs(self._rate) * s.exposure_s / s.pixel_scale_arcsec / 2
        # 2: a light's reach is of whole pixels, along both axes.
        reach = math.hypot(s.width, s.height) / 2 + 2 * (rendering.reach_px(s) + 1) + half_motion
        x, y = pose.pointing.real / s.pixel_scale_arcsec, pose.pointing.imag / s.pixel_scale_arcsec
        columns, rows = (
            range(math.floor((p - reach) / _TILE_PX), math.floor((p + reach) / _TILE_PX) + 1)
            for p in (x, y)
        )
        tiles = [_tile(column, row, s) for row in rows for column in columns]
        origin, flux = (np.concatenate(parts) for parts in zip(*tiles, strict=True))
        return _Sources(origin, np.zeros_like(origin), flux)

    def _add_stars(self, light: np.ndarray, tracks: np.ndarray, flux: np.ndarray) -> None:
        s, pad = self.settings, rendering.reach_px(self.settings) + 1
        near = (tracks.real > -pad) & (tracks.real < s.width + pad)
        near &= (tracks.imag > -pad) & (tracks.imag < s.height + pad)
        shares = np.broadcast_to(flux[:, None] / s.subsamples, near.shape)
        rendering.add_sources(light, tracks[near], shares[near], s)

    def _truth(
        self,
        pose: _Pose,
        spots: list[_Spot],
        light: np.ndarray,
        stamp_ns: int,
    ) -> np.ndarray:
        s = self.settings
        time = self._frame * s.period_s + s.exposure_s / 2
        place = self._project(self._rsos, pose, time)[:, 0]
        velocity = self._velocity(self._rsos, place, pose)
        seen = np.flatnonzero(self._inside(place))
        table = _motion_table(TRUTH_DTYPE, place[seen], velocity[seen])
        table["stamp_ns"], table["frame"], table["id"] = stamp_ns, self._frame, seen + 1
        table["snr"] = [self._sensor.snr(spots[i].pixels, spots[i].signal, light) for i in seen]
        table["flux"] = [spots[i].flux for i in seen]
        table["length_px"] = abs(velocity[seen]) * s.exposure_s
        return table

    def _star_truth(self, stars: _Sources, pose: _Pose) -> np.ndarray:
        place = self._project(stars, pose, 0.0)[:, 0]
        velocity = self._velocity(stars, place, pose)
        if self._last is None:
            step = np.full(place.shape, complex(math.nan, math.nan))
        else:
            step = place - self._project(stars, self._last, 0.0)[:, 0]
        table = _motion_table(STAR_DTYPE, place, velocity)
        table["dx_px"], table["dy_px"] = step.real, step.imag
        table["flux"] = stars.flux
        return table[self._inside(place)]

    def _displacement(self, pose: _Pose) -> np.ndarray:
        if self._last is None:
            return np.full(2, math.nan)
        sky = pose.pointing - self._last.pointing
        step = -np.exp(1j * self._last.angle) * sky / self.settings.pixel_scale_arcsec
        return np.array([step.real, step.imag])


def _complex(pairs: list[Any]) -> np.ndarray:
    x, y = np.array(pairs, float).reshape(-1, 2).T
    return x + 1j * y


def _motion_table(dtype: np.dtype, place: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    table = np.zeros(len(place), dtype)
    table["x_px"], table["y_px"] = place.real, place.imag
    table["vx_px_s"], table["vy_px_s"] = velocity.real, velocity.imag
    return table


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
    count = random.poisson(s.star_count * _TILE_PX**2 / (s.width * s.height))
    x, y, level = random.uniform(size=(3, count))
    sky = ((column + x) + 1j * (row + y)) * _TILE_PX * s.pixel_scale_arcsec
    faint, bright = s.star_flux_percent
    # Star counts: about N(brighter than F) ~ 1/F, so 1/F is uniform.
    flux = s.full_scale / 100 / (1 / bright + level * (1 / faint - 1 / bright))
    return sky, flux


def write_truth(path: str | Path, frames_truth: Iterable[np.ndarray]) -> None:
    """Write the truth of many frames as ``truth.csv``.

    Parameters
    ----------
    path : str or Path
        File to write; an older one is replaced.
    frames_truth : iterable of numpy.ndarray
        TRUTH_DTYPE, one array per frame, in time order.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(",".join(TRUTH_DTYPE.names or ()) + "\n")
        for rows in frames_truth:
            # + 0: a zero of negative sign is written as a plain one.
            file.writelines(
                _TRUTH_FORMAT % tuple(value + 0 for value in row) + "\n" for row in rows.tolist()
            )
