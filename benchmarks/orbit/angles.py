# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Angles of a tracking data message, and how far they are off."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sgp4.api import Satrec

from benchmarks.orbit.geometry import NS, Array, Geometry, unit

ARCSEC = math.radians(1 / 3600)
OUTLIER_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class Angles:
    """Directions with stamps: stamps (N,) ns UTC; the others (N, 2), rad, in columns ra, dec.

    `sigma` has that of ra times cos dec; `segment` numbers the message's segments.
    """

    stamps_ns: NDArray[np.int64]
    radec: Array
    sigma: Array
    segment: NDArray[np.int64]

    def __getitem__(self, chosen: NDArray[np.generic]) -> Angles:
        parts = (self.stamps_ns, self.radec, self.sigma, self.segment)
        return Angles(*(part[chosen] for part in parts))

    @cached_property
    def sight(self) -> Array:
        """Unit vectors (N, 3)."""
        ra, dec = self.radec.T
        return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)

    @cached_property
    def east_north(self) -> tuple[Array, Array]:
        """Unit vectors along which `sigma` is, (N, 3) each."""
        ra, _ = self.radec.T
        east = np.stack([-np.sin(ra), np.cos(ra), np.zeros(len(ra))], -1)
        return east, np.cross(self.sight, east)


_LINE = re.compile(r"(ANGLE_1|ANGLE_2|COMMENT SIGMA)(?: =)? (\d{4}-\S+) (\S+) ?(\S+)?")


def read_tdm(path: Path) -> Angles:
    """Read the angles of a message as text, with the stds that stand in its comments."""
    rows: dict[tuple[int, int], list[float]] = {}
    segment = 0
    for line in path.read_text(encoding="ascii").splitlines():
        segment += line == "META_START"
        found = _LINE.fullmatch(line)
        if not found:
            continue
        what, epoch, first, second = found.groups()
        row = rows.setdefault((segment, _stamp_ns(epoch)), [math.nan] * 4)
        if what == "COMMENT SIGMA":
            row[2:] = float(first) * ARCSEC, float(second) * ARCSEC
        else:
            row[what == "ANGLE_2"] = math.radians(float(first))
    keys, values = np.array(list(rows), np.int64), np.array(list(rows.values()))
    return Angles(keys[:, 1], values[:, :2], values[:, 2:], keys[:, 0])


def _stamp_ns(epoch: str) -> int:
    since = datetime.fromisoformat(epoch).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return since // timedelta(microseconds=1) * 1000


@dataclass(frozen=True, eq=False)
class Offsets:
    """How far angles are off: (N, 2) along the satellite's motion and across it, arcsec."""

    off: Array
    sigma: Array
    rate: Array  # (N,), of the satellite against the stars, arcsec/s

    @property
    def near(self) -> NDArray[np.bool_]:
        """Which are not outliers; from the medians, lest a bias make outliers of all."""
        off = self.off - np.median(self.off, axis=0)
        return (np.abs(off) < OUTLIER_SIGMAS * self.sigma).all(1)

    @property
    def bias(self) -> Array:
        """Means (2,) without outliers, as all that follows, arcsec."""
        return self.off[self.near].mean(0)

    @property
    def rms(self) -> Array:
        """Root mean squares (2,), arcsec."""
        return _rms(self.off[self.near])

    @property
    def stated(self) -> Array:
        """Root mean squares (2,) of the stated stds, arcsec."""
        return _rms(self.sigma[self.near])

    @property
    def time_s(self) -> float:
        """By what error of the time the bias along the motion would come."""
        return float(self.bias[0] / self.rate[self.near].mean())


def _rms(values: Array) -> Array:
    return np.sqrt(np.mean(np.square(values), axis=0))


def offsets(angles: Angles, geometry: Geometry, satellite: Satrec) -> Offsets:
    """Compare angles with the directions to a satellite."""
    times_s = (angles.stamps_ns - geometry.start_ns) / NS
    step_s = 0.05
    before, true, after = (
        geometry.directions(satellite, times_s + s) for s in (-step_s, 0, step_s)
    )
    along = unit(after - before)
    axes = np.stack([along, np.cross(true, along)], axis=1)
    off = np.sum((angles.sight - true)[:, None] * axes, axis=2)
    on_sky = np.stack(angles.east_north, axis=1)
    spread = np.sum(axes[:, :, None] * on_sky[:, None], axis=3) * angles.sigma[:, None]
    rate = np.linalg.norm(after - before, axis=1) / (2 * step_s)
    return Offsets(off / ARCSEC, np.linalg.norm(spread, axis=2) / ARCSEC, rate / ARCSEC)
