# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""An orbit from angles: SGP4's mean elements by least squares, and what they leave open."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from sgp4.api import WGS72, Satrec

from benchmarks.orbit.angles import OUTLIER_SIGMAS, Angles
from benchmarks.orbit.geometry import DAY_S, NS, UNIX_JD, Array, Geometry, unit

ELEMENTS = ("n, rev/day", "e cos w", "e sin w", "i, deg", "node, deg", "arg. of latitude, deg")
_STATE = (
    "semi-major axis, km", "range, km", "place along the motion, km", "place across, km",
    "range rate, km/s", "speed along the motion, km/s", "speed across, km/s",
)  # fmt: skip
# How far off the fit's start is: part of the mean motion, 1, 1, rad, rad, rad.
_START = np.array([0.01, 2e-3, -2e-3, *np.radians([0.5, -0.5, 0.5])])
_STEPS = np.array([1e-7, *[1e-5] * 5])  # of numerical derivatives
_GM_KM3_S2 = 398_600.8
# Julian date from which sgp4init counts days.
_SGP4_JD = 2_433_281.5


@dataclass(frozen=True, eq=False)
class Fit:
    """Elements (6,) as in `ELEMENTS` but rad and rad/min, their covariance, who was left out."""

    elements: Array
    covariance: Array
    used: NDArray[np.bool_]


class Elements:
    """SGP4's mean elements as the fit varies them, of a satellite with published ones."""

    def __init__(self, satellite: Satrec, geometry: Geometry, middle_s: float) -> None:
        self._satellite = s = satellite
        start = geometry.start_ns / NS / DAY_S + UNIX_JD
        self._minutes = (start - s.jdsatepoch - s.jdsatepochF) * 1440 + middle_s / 60
        latitude = s.argpo + s.mo + s.no_kozai * self._minutes
        self.published = np.array([
            s.no_kozai, s.ecco * math.cos(s.argpo), s.ecco * math.sin(s.argpo), s.inclo, s.nodeo,
            latitude % (2 * math.pi),
        ])  # fmt: skip

    def satellite(self, elements: Array) -> Satrec:
        """Return the satellite that has them."""
        n, x, y, inclination, node, latitude = elements.tolist()
        perigee, made, s = math.atan2(y, x), Satrec(), self._satellite
        anomaly = (latitude - perigee - n * self._minutes) % (2 * math.pi)
        epoch = s.jdsatepoch - _SGP4_JD + s.jdsatepochF
        rest = (math.hypot(x, y), perigee, inclination, anomaly, n, node)
        made.sgp4init(WGS72, "i", s.satnum, epoch, s.bstar, s.ndot, s.nddot, *rest)
        return made


def fit(angles: Angles, geometry: Geometry, elements: Elements) -> Fit:
    """Fit an orbit, first to all angles, then to those that are near enough to the orbit."""
    times_s = (angles.stamps_ns - geometry.start_ns) / NS
    east, north = angles.east_north

    def off(x: Array) -> Array:
        way = geometry.directions(elements.satellite(x), times_s) - angles.sight
        return -np.stack([np.sum(way * east, 1), np.sum(way * north, 1)], -1)

    def misfit(x: Array, used: NDArray[np.bool_]) -> Array:
        # An orbit that falls to the ground on the way is far off.
        return np.nan_to_num(off(x) / angles.sigma, nan=1e6)[used].ravel()

    def slopes(x: Array, used: NDArray[np.bool_]) -> Array:
        steps = np.diag(_STEPS)
        columns = [misfit(x + h, used) - misfit(x - h, used) for h in steps]
        return np.stack(columns, -1) / (2 * steps.diagonal())

    x, used = elements.published + _START, np.ones(len(times_s), bool)
    x[0] = elements.published[0] * (1 + _START[0])
    # From afar nothing but squares leads there; from near, what is off must not count much.
    for loss in ("linear", "soft_l1", "linear"):
        x = least_squares(
            misfit, x, slopes, args=(used,), loss=loss, x_scale=_STEPS, xtol=1e-12, ftol=1e-12
        ).x
        if loss == "soft_l1":
            used = (np.abs(off(x) / angles.sigma) < OUTLIER_SIGMAS).all(1)
    weights = slopes(x, used)
    covariance = np.linalg.inv(weights.T @ weights)
    return Fit(x, covariance, used)


def compare(
    found: Fit, elements: Elements, geometry: Geometry, middle_s: float
) -> tuple[list[tuple[str, float, float, float]], float]:
    """Return rows of what, true, recovered less true and std; and the distance squared."""
    true = elements.published
    view = _axes(geometry, elements.satellite(true), middle_s)

    def state(x: Array) -> Array:
        position, velocity = geometry.orbit(elements.satellite(x), np.array([middle_s]))
        way = view @ (position[0] - geometry.site(middle_s))
        axis_km = np.cbrt(_GM_KM3_S2 / (x[0] / 60) ** 2)
        return np.array([axis_km, *way, *(view @ velocity[0])])

    slopes = np.stack([(state(true + h) - state(true - h)) for h in np.diag(_STEPS)], -1)
    slopes /= 2 * _STEPS
    off = found.elements - true
    degrees = np.array([1440 / (2 * math.pi), 1, 1, *[math.degrees(1)] * 3])
    stds = np.sqrt(np.diag(found.covariance)) * degrees
    rows = list(zip(ELEMENTS, true * degrees, off * degrees, stds, strict=True))
    stds = np.sqrt(np.diag(slopes @ found.covariance @ slopes.T))
    rows += zip(_STATE, state(true), state(found.elements) - state(true), stds, strict=True)
    return rows, float(off @ np.linalg.solve(found.covariance, off))


def _axes(geometry: Geometry, satellite: Satrec, time_s: float) -> Array:
    """Rows: along the line of sight, along the motion on the sky, across both."""
    times_s = time_s + np.array([-0.05, 0, 0.05])
    before, sight, after = geometry.directions(satellite, times_s)
    across = unit(np.cross(sight, after - before))
    return np.stack([sight, np.cross(across, sight), across])
