# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Named scenarios: settings and RSOs that show one case each."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ofsat_ros.camera import Camera
from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation.exposure import Simulator, looking_at
from ofsat_ros.simulation.mount import SimulatedMount
from ofsat_ros.simulation.plane import SkySimulator
from ofsat_ros.simulation.settings import RSO, SimulatorSettings
from ofsat_ros.simulation.sphere import SphereSimulator, Target

_STARS_PER_PX = 8e-4
# One RSO each, from easy to barely visible.
_SNRS = (60, 30, 15, 8, 5)


class _Scene(NamedTuple):
    """A scene on a plane sky."""

    summary: str
    settings: dict[str, Any]
    rsos: Callable[[SimulatorSettings], tuple[RSO, ...]]


class _Pursuit(NamedTuple):
    """A scene on the sphere, with a mount that may be told to follow an RSO."""

    summary: str
    settings: dict[str, Any]
    simulator: Callable[[SimulatorSettings], SphereSimulator]


def _standing(s: SimulatorSettings) -> tuple[RSO, ...]:
    """Five RSOs that keep the camera's rate, from easy to faint, each in its own strip."""
    places = _in_strips(s)
    return tuple(
        RSO(place, s.camera_rate_arcsec_s, flux)
        for place, flux in zip(places, (250, 160, 100, 70, 50), strict=True)
    )


def _tracked(s: SimulatorSettings) -> tuple[RSO, ...]:
    """Five RSOs that keep the camera's rate, down to barely visible, each in its own strip."""
    return tuple(
        RSO(place, s.camera_rate_arcsec_s, snr=snr)
        for place, snr in zip(_in_strips(s), _SNRS, strict=True)
    )


def _in_strips(s: SimulatorSettings) -> list[tuple[float, float]]:
    random = s.random("scenario")
    strips = random.permutation(5) + random.uniform(0.25, 0.75, 5)
    heights = random.uniform(0.1, 0.9, 5)
    return [
        (strip / 5 * s.width, height * s.height)
        for strip, height in zip(strips, heights, strict=True)
    ]


def _crossing(s: SimulatorSettings) -> tuple[RSO, ...]:
    """One RSO, on the right edge at the start and at the centre in the last frame."""
    start = complex(s.width - 0.5, 0.3 * s.height)
    seconds = (s.frames - 1) * s.period_s + s.exposure_s / 2
    centre = complex(s.width - 1, s.height - 1) / 2
    rate = (centre - start) / seconds * s.pixel_scale_arcsec + complex(*s.camera_rate_arcsec_s)
    return (RSO((start.real, start.imag), (rate.real, rate.imag), 150),)


def _various(_: SimulatorSettings) -> tuple[RSO, ...]:
    """RSOs anywhere, in any direction, from barely visible to bright."""
    return tuple(RSO(flux_percent=flux) for flux in (400, 250, 150, 100, 70, 50, 35, 25))


def _moving(slowest: float, fastest: float) -> Callable[[SimulatorSettings], tuple[RSO, ...]]:
    """Five RSOs in any direction, at speeds (px per frame against the stars) in even ratios.

    They begin inside the image, and head so that they stay there in the scenario's frames as far
    as their speed allows.
    """

    def rsos(s: SimulatorSettings) -> tuple[RSO, ...]:
        random = s.random("scenario", 1)
        size, count = np.array([s.width, s.height]), len(_SNRS)
        # Shuffled: brightness says nothing of speed.
        steps = random.permutation(np.geomspace(slowest, fastest, count))
        angles = random.uniform(0, 2 * math.pi, count)
        found = []
        for snr, step, angle in zip(_SNRS, steps, angles, strict=True):
            way = np.array([math.cos(angle), math.sin(angle)])
            half_travel = min(step * s.frames / 2, 0.35 * size.min()) * way
            room = 0.42 * size - abs(half_travel)
            start = (size - 1) / 2 - half_travel + room * random.uniform(-1, 1, 2)
            rate = step / s.period_s * s.pixel_scale_arcsec * way
            found.append(RSO(tuple(start), tuple(rate), snr=snr))
        return tuple(found)

    return rsos


def _tumbling(s: SimulatorSettings) -> tuple[RSO, ...]:
    """Moving RSOs, each with its own amplitude, period and phase of the flux."""
    random = s.random("scenario", 2)
    return tuple(
        dataclasses.replace(
            rso,
            flux_amplitude=random.uniform(0.4, 0.9),
            flux_period_s=s.period_s * random.uniform(3, 12),
            flux_phase_rad=random.uniform(0, 2 * math.pi),
        )
        for rso in _moving(3, 12)(s)
    )


def _pursued(
    angle_rad: Callable[[np.ndarray], np.ndarray],
) -> Callable[[SimulatorSettings], SphereSimulator]:
    """One RSO on a great circle through the field, its angle along it by the time, and a mount.

    It starts left behind of the image's centre, so that it passes near by it if nobody commands
    the mount, which then tracks the stars.
    """

    def simulator(s: SimulatorSettings) -> SphereSimulator:
        random = s.random("scenario", 3)
        ra, dec = random.uniform(0, 2 * math.pi), math.asin(random.uniform(-0.9, 0.9))
        turn, aside = random.uniform(0, 2 * math.pi), random.uniform(-0.1, 0.1)
        way = np.array([math.cos(turn), math.sin(turn)])
        start = (-0.35 * way + aside * way[::-1] * (-1, 1)) * min(s.width, s.height)
        start += (np.array([s.width, s.height]) - 1) / 2
        camera = Camera.ideal(s.width, s.height, math.radians(s.pixel_scale_arcsec / 3600))
        attitude = looking_at(ra, dec)
        first, second = attitude.inv().apply(camera.lines_of_sight(np.stack([start, start + way])))
        pole = np.cross(first, second)
        ahead = np.cross(pole / np.linalg.norm(pole), first)

        def direction(times_s: np.ndarray) -> np.ndarray:
            angle = angle_rad(times_s)[:, None]
            return np.cos(angle) * first + np.sin(angle) * ahead

        mount = SimulatedMount(
            attitude,
            max_rate_deg_s=5,
            max_acceleration_deg_s2=2,
            latency_s=0.05,
            periodic_error=(8, 40),
        )
        return SphereSimulator(s, [Target(direction, snr=50)], mount)

    return simulator


def _drifting(times_s: np.ndarray) -> np.ndarray:
    return np.radians(0.2) * times_s


def _passing(times_s: np.ndarray) -> np.ndarray:
    """Angle of a pass: 0.1 deg/s at its ends, 0.6 deg/s in its middle, the culmination."""
    slow, fast, seconds = math.radians(0.1), math.radians(0.6), 90
    swing = np.sin(2 * math.pi * times_s / seconds) * seconds / (2 * math.pi)
    return slow * times_s + (fast - slow) / 2 * (times_s - swing)


# The telescope of the guide's scenarios: quick, and with a wide field.
_GUIDED = {"pixel_scale_arcsec": 10.0, "exposure_s": 0.05, "period_s": 0.1}

# The camera of "geo": the sky turns at 15.04 arcsec/s; its x axis is 10 degrees off east-west.
_AT_REST = {"camera_rate_arcsec_s": (14.81, 2.61), "exposure_s": 2.0, "period_s": 2.5}

_SCENES: dict[str, _Scene | _Pursuit] = {
    "geo": _Scene(
        "five stationary RSOs among streaking stars: the camera stands still on the ground",
        {**_AT_REST, "frames": 40},
        _standing,
    ),
    "sidereal": _Scene(
        "the camera tracks the stars; one RSO crosses from the right edge to the centre",
        {"frames": 80},
        _crossing,
    ),
    "survey": _Scene(
        "eight RSOs of many brightnesses in any direction, over a slowly drifting field",
        {"camera_rate_arcsec_s": (2.0, -1.0), "frames": 60},
        _various,
    ),
    "empty": _Scene(
        "stars that streak a little and nothing else: whatever is found is a false alarm",
        {"camera_rate_arcsec_s": (-9.0, 6.0), "frames": 60},
        lambda _: (),
    ),
    "fast": _Scene(
        "the camera tracks the stars; RSOs streak at 10 to 60 px a frame",
        {"exposure_s": 0.5, "subsamples": 30, "frames": 8},
        _moving(10, 60),
    ),
    "slow": _Scene(
        "the camera tracks the stars; RSOs creep at 0.5 to 2 px a frame",
        {"frames": 10},
        _moving(0.5, 2),
    ),
    "hot_pixels": _Scene(
        "stationary RSOs among streaking stars, hot pixels, uneven gains and offsets",
        {
            **_AT_REST,
            "frames": 10,
            "sky_percent": 10,
            "hot_pixel_fraction": 1e-3,
            "gain_std": 0.02,
            "fixed_pattern_std_percent": 0.4,
        },
        _tracked,
    ),
    "vignetting": _Scene(
        "moving RSOs over a sky that is brighter below and darker in the corners",
        {
            "frames": 8,
            "sky_percent": 10,
            "sky_gradient_percent": (-1, 7),
            "vignetting": 0.25,
            "gain_std": 0.01,
        },
        _moving(3, 12),
    ),
    "clouds": _Scene(
        "moving RSOs and stars that fade behind drifting clouds",
        {
            "frames": 10,
            "cloud_cover": 0.4,
            "cloud_opacity": 0.9,
            "cloud_glow_percent": 3,
            "cloud_drift_px_s": (7, 4),
        },
        _moving(3, 12),
    ),
    "cosmic_rays": _Scene(
        "moving RSOs, and each frame with some 20 cosmic rays",
        {"frames": 10, "cosmic_ray_count": 20},
        _moving(3, 12),
    ),
    "tumbling": _Scene(
        "moving RSOs whose brightness varies within 3 to 12 frames",
        {"frames": 10},
        _tumbling,
    ),
    "jitter": _Scene(
        "moving RSOs, and a mount that shakes by 0.7 px",
        {"frames": 10, "jitter_std_px": 0.7},
        _moving(3, 12),
    ),
    "ugly": _Scene(
        "moving RSOs with all of it at once: defects, clouds, cosmic rays, tumbling, jitter",
        {
            "frames": 10,
            "sky_percent": 10,
            "sky_gradient_percent": (-1, 7),
            "vignetting": 0.15,
            "gain_std": 0.01,
            "fixed_pattern_std_percent": 0.4,
            "hot_pixel_fraction": 5e-4,
            "cosmic_ray_count": 10,
            "cloud_cover": 0.2,
            "cloud_opacity": 0.5,
            "cloud_glow_percent": 2,
            "cloud_drift_px_s": (7, 4),
            "jitter_std_px": 0.4,
        },
        _tumbling,
    ),
    "guide_drift": _Pursuit(
        "an RSO drifts at 0.2 deg/s across a sidereal field; the mount obeys",
        {**_GUIDED, "frames": 300},
        _pursued(_drifting),
    ),
    "guide_leo": _Pursuit(
        "as in a LEO pass, an RSO's rate rises from 0.1 to 0.6 deg/s and falls; the mount obeys",
        {**_GUIDED, "frames": 900},
        _pursued(_passing),
    ),
}
SCENARIOS: Mapping[str, str] = {name: scene.summary for name, scene in _SCENES.items()}


def scenario(name: str, seed: int = 1, **overrides: Any) -> Simulator:
    """Return the simulator of a named scenario.

    Parameters
    ----------
    name : str
        One of `SCENARIOS`.
    seed : int
        Seed of everything that is random.
    **overrides
        Values of `SimulatorSettings` that differ from the scenario's.  Unless given, ``rsos``
        and ``star_count`` fit themselves to the size, rates and number of frames.

    Returns
    -------
    SkySimulator or SphereSimulator
        Of the two, the latter for a scenario whose name begins with ``guide``: its `motion` is a
        `SimulatedMount` that tracks the stars until it is commanded.

    Raises
    ------
    ParameterError
        On an unknown scenario or setting, or a bad value.
    """
    if name not in _SCENES:
        raise ParameterError(f"there is no scenario {name!r}; there are {', '.join(SCENARIOS)}")
    known = [field.name for field in dataclasses.fields(SimulatorSettings)]
    for key in overrides:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"; did you mean {near[0]}?" if near else f"; there are {', '.join(known)}"
            raise ParameterError(f"there is no setting {key!r} of the simulator{hint}")
    scene = _SCENES[name]
    settings = SimulatorSettings(**{**scene.settings, **overrides, "seed": seed})
    fitted: dict[str, Any] = {"star_count": _STARS_PER_PX * settings.width * settings.height}
    if isinstance(scene, _Scene):
        fitted["rsos"] = scene.rsos(settings)
    settings = dataclasses.replace(settings, **{**fitted, **overrides})
    return SkySimulator(settings) if isinstance(scene, _Scene) else scene.simulator(settings)
