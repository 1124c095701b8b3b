# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Where a site sees a satellite, and when a pass is to be seen."""

from __future__ import annotations

import math

import astropy.units as u
import numpy as np
from astropy.coordinates import GCRS, TEME, CartesianRepresentation, EarthLocation, get_sun
from astropy.time import Time
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from sgp4.api import Satrec

from ofsat_ros.site import Site

Array = NDArray[np.float64]

NS, DAY_S = 1_000_000_000, 86_400
# Julian date of 1970-01-01.
UNIX_JD = 2_440_587.5
_LIGHT_KM_S, _EARTH_KM = 299_792.458, 6378.135

_LEAST_ELEVATION, _CULMINATION = math.radians(30), (math.radians(45), math.radians(75))
_NIGHT = math.radians(-12)
_SEARCH_DAYS, _SEARCH_STEP_S = 30, 30
# Longer than a pass that begins at the end of a day.
_OVERLAP_S = 6000.0


class Geometry:
    """Where a site sees satellites, over minutes from `start_ns`; times are in s since then."""

    def __init__(self, site: Site, start_ns: int, seconds: float) -> None:
        self.start_ns = start_ns
        middle = _astropy_time(start_ns + round(seconds / 2 * NS))
        teme = TEME(CartesianRepresentation(np.eye(3) << u.km), obstime=middle)
        self._turn = teme.transform_to(GCRS(obstime=middle)).cartesian.xyz.value
        # Over 10 s a circle of the Earth's size is a cubic to a nanometre.
        knots = np.arange(-30.0, seconds + 40.0, 10.0)
        position, _ = _location(site).get_gcrs_posvel(
            _astropy_time(start_ns) + knots * u.s  # no leap second in 2022, nor since
        )
        self.site = CubicSpline(knots, position.xyz.to_value(u.km).T)

    def orbit(self, satellite: Satrec, times_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (N, 3) each, km and km/s, axes of ICRS."""
        days, rest_ns = divmod(self.start_ns, DAY_S * NS)
        fraction = (rest_ns / NS + times_s) / DAY_S
        _, position, velocity = satellite.sgp4_array(
            np.full(len(times_s), UNIX_JD + days), fraction
        )
        return position @ self._turn.T, velocity @ self._turn.T

    def directions(self, satellite: Satrec, times_s: Array) -> Array:
        """Return the unit vectors, (N, 3) ICRS, to where the satellite is seen."""
        site = self.site(times_s)
        way = self.orbit(satellite, times_s)[0] - site
        for _ in range(2):  # the light's time changes by 1e-5 of itself, and again
            left_s = times_s - np.linalg.norm(way, axis=1) / _LIGHT_KM_S
            way = self.orbit(satellite, left_s)[0] - site
        return unit(way)

    def up(self, times_s: Array) -> Array:
        """Return the site's vertical, (N, 3), to 0.2 deg: away from the Earth's centre."""
        return unit(self.site(times_s))


def _astropy_time(stamp_ns: int) -> Time:
    return Time(stamp_ns // NS, stamp_ns % NS / NS, format="unix", scale="utc")


def _location(site: Site) -> EarthLocation:
    return EarthLocation.from_geodetic(
        site.longitude_deg * u.deg, site.latitude_deg * u.deg, site.height_m * u.m
    )


def unit(vectors: Array) -> Array:
    """Return vectors (..., 3) at the length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def find_pass(tle: tuple[str, str], site: Site) -> tuple[int, float]:
    """Return the first pass after the elements' epoch that can be seen: start (ns), length (s).

    It culminates at 45 to 75 deg and counts above 30 deg, where the satellite is in the Sun and
    the site is not.
    """
    satellite = Satrec.twoline2rv(*tle)
    epoch_s = round((satellite.jdsatepoch - UNIX_JD + satellite.jdsatepochF) * DAY_S)
    times_s = np.arange(0.0, DAY_S + _OVERLAP_S, _SEARCH_STEP_S)
    for day in range(_SEARCH_DAYS):
        start_ns = (epoch_s + day * DAY_S) * NS
        elevation, seen = _visibility(satellite, site, start_ns, times_s)
        ends = np.flatnonzero(np.diff(seen.astype(int))) + 1
        ends = ends[int(seen[0]) :]
        for first, last in zip(ends[::2], ends[1::2], strict=False):
            whole = elevation[[first - 1, last]].max() < _LEAST_ELEVATION
            if whole and _CULMINATION[0] < elevation[first:last].max() < _CULMINATION[1]:
                begin_ns = start_ns + round(times_s[first]) * NS
                return begin_ns, float(times_s[last - 1] - times_s[first])
    raise SystemExit(f"orbit: no pass to be seen in {_SEARCH_DAYS} days after the elements' epoch")


def _visibility(
    satellite: Satrec, site: Site, start_ns: int, times_s: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return elevations, rad, and whether the satellite is high, and in the Sun at night."""
    when = _astropy_time(start_ns) + times_s * u.s
    place = _location(site).get_gcrs_posvel(when)[0].xyz.to_value(u.km).T
    sun = unit(get_sun(when).cartesian.xyz.value.T)
    position, _ = Geometry(site, start_ns, 600.0).orbit(satellite, times_s)
    elevation = np.arcsin(np.sum(unit(position - place) * unit(place), axis=1))
    sunward = np.sum(position * sun, axis=1)
    lit = (sunward > 0) | (np.linalg.norm(position - sunward[:, None] * sun, axis=1) > _EARTH_KM)
    dark = np.sum(unit(place) * sun, axis=1) < math.sin(_NIGHT)
    return elevation, (elevation > _LEAST_ELEVATION) & lit & dark
