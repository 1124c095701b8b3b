"""Named scenarios: settings and RSOs that show one case each."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation.settings import RSO, SimulatorSettings
from ofsat_ros.simulation.simulator import SkySimulator

_STARS_PER_PX = 8e-4


class _Scene(NamedTuple):
    summary: str
    settings: dict[str, Any]
    rsos: Callable[[SimulatorSettings], tuple[RSO, ...]]


def _standing(s: SimulatorSettings) -> tuple[RSO, ...]:
    """Five RSOs that keep the camera's rate, from easy to faint, each in its own strip."""
    fluxes = (250, 160, 100, 70, 50)
    random = s.random("scenario")
    strips = random.permutation(5) + random.uniform(0.25, 0.75, 5)
    heights = random.uniform(0.1, 0.9, 5)
    return tuple(
        RSO((strip / 5 * s.width, height * s.height), s.camera_rate_arcsec_s, flux)
        for strip, height, flux in zip(strips, heights, fluxes, strict=True)
    )


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


_SCENES = {
    "geo": _Scene(
        "five stationary RSOs among streaking stars: the camera stands still on the ground",
        # The sky turns at 15.04 arcsec/s; the camera's x axis is 10 degrees off east-west.
        {"camera_rate_arcsec_s": (14.81, 2.61), "exposure_s": 2.0, "period_s": 2.5, "frames": 40},
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
}
SCENARIOS: Mapping[str, str] = {name: scene.summary for name, scene in _SCENES.items()}


def scenario(name: str, seed: int = 1, **overrides: Any) -> SkySimulator:
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
    fitted = {
        "star_count": _STARS_PER_PX * settings.width * settings.height,
        "rsos": scene.rsos(settings),
    }
    return SkySimulator(dataclasses.replace(settings, **{**fitted, **overrides}))
