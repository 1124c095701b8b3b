# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a camera sees of a pass: rendered into a bag, and processed by the command."""

from __future__ import annotations

import io
import math
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from sgp4.api import Satrec

from benchmarks.orbit.geometry import NS, Array, Geometry, unit
from ofsat_ros.cli import main as ofsat
from ofsat_ros.cli.camera_bag import ATTITUDE_TOPIC, CAMERA_INFO_TOPIC, FRAME_ID, IMAGE_TOPIC
from ofsat_ros.recordings import BagWriter
from ofsat_ros.simulation import Fixed, Motion, SimulatorSettings, SphereSimulator, Target
from ofsat_ros.site import Site
from ofsat_ros.tracking_data import TRACKING_DATA

_ATTITUDE_PERIOD_S = 0.1
_LAG_S, _WANDER_RAD, _WANDER_S = 0.2, math.radians(0.05), (40.0, 31.0)


@dataclass(frozen=True)
class Case:
    """A satellite, how the camera moves, and how often it looks."""

    satellite: str
    tle: tuple[str, str]
    camera: str
    bursts: int
    frames: int
    site: Site
    snr: float = 25.0
    exposure_s: float = 0.2
    side_px: int = 1024
    stamp_error_s: float = 0.0
    seed: int = 1

    @property
    def settings(self) -> SimulatorSettings:
        """The camera."""
        return SimulatorSettings(
            width=self.side_px,
            height=self.side_px,
            pixel_scale_arcsec=8.0,
            exposure_s=self.exposure_s,
            period_s=0.5,
            frames=self.frames,
            subsamples=24,
            star_count=400.0 * (self.side_px / 1024) ** 2,
            star_flux_percent=(5.0, 500.0),
            noise_mean_percent=1.0,
            noise_std_percent=0.05,
            sky_percent=2.0,
            electrons_per_dn=1.0,
        )

    def __str__(self) -> str:
        return f"{self.satellite}, {self.camera}"


class Tracking:
    """A mount that follows a satellite on two axes, one vertical: late, and with a wander."""

    def __init__(self, geometry: Geometry, satellite: Satrec, offset_s: float) -> None:
        self._geometry, self._satellite, self._offset_s = geometry, satellite, offset_s

    def attitudes(self, times_s: Array) -> Rotation:
        """Return the attitudes at times since the burst's begin."""
        times_s = times_s + self._offset_s
        sight = self._geometry.directions(self._satellite, times_s - _LAG_S)
        phases = 2 * np.pi * times_s[:, None] / np.array([*_WANDER_S, np.inf])
        wander = Rotation.from_rotvec(_WANDER_RAD * np.sin(phases))
        return wander * _upright(sight, self._geometry.up(times_s))


def _upright(sight: Array, up: Array) -> Rotation:
    """Return the attitudes of cameras that look along `sight`, (N, 3), and have `up` up."""
    right = unit(np.cross(sight, up))
    return Rotation.from_matrix(np.stack([right, np.cross(sight, right), sight], axis=1))


def _motion(case: Case, geometry: Geometry, satellite: Satrec, offset_s: float) -> Motion:
    if case.camera == "tracking":
        return Tracking(geometry, satellite, offset_s)
    middle = np.array([offset_s + case.frames * case.settings.period_s / 2])
    sight = geometry.directions(satellite, middle)
    return Fixed(_upright(sight, geometry.up(middle))[0])


def record(case: Case, geometry: Geometry, seconds: float, bag: Path) -> int:
    """Render the bursts into a bag; return in how many frames the satellite is."""
    satellite = Satrec.twoline2rv(*case.tle)
    burst_s, seen = case.frames * case.settings.period_s, 0
    with BagWriter(bag) as writer:
        for number, offset_s in enumerate(np.linspace(0, seconds - burst_s, case.bursts)):
            offset_ns = round(offset_s * NS)
            offset_s, start_ns = offset_ns / NS, geometry.start_ns + offset_ns
            settings = replace(case.settings, start_stamp_ns=start_ns, seed=case.seed + number)
            target = Target(partial(_later, geometry, satellite, offset_s), snr=case.snr)
            motion = _motion(case, geometry, satellite, offset_s)
            sky = SphereSimulator(settings, [target], motion)
            # From before the burst until after it, none at the middle of an exposure.
            clock_s = np.arange(-0.33, burst_s + 0.3, _ATTITUDE_PERIOD_S)
            for time_s, attitude in zip(clock_s, motion.attitudes(clock_s), strict=True):
                stamp_ns = start_ns + round(time_s * NS)
                writer.write_attitude(ATTITUDE_TOPIC, attitude, stamp_ns, FRAME_ID)
            for frame in sky:
                early_s = settings.exposure_s / 2 - case.stamp_error_s
                stamp_ns = frame.stamp_ns - round(early_s * NS)
                writer.write_camera_info(CAMERA_INFO_TOPIC, sky.camera, stamp_ns, FRAME_ID)
                writer.write_image(IMAGE_TOPIC, frame.image, stamp_ns, FRAME_ID)
                seen += len(frame.truth)
    return seen


def _later(geometry: Geometry, satellite: Satrec, offset_s: float, times_s: Array) -> Array:
    return geometry.directions(satellite, times_s + offset_s)


def process(case: Case, folder: Path) -> Path:
    """Run the command over the bag; return the tracking data message."""
    results = folder / "results"
    command = ["process", f"{folder / 'bag'}", "--output", f"{results}", "--no-report"]
    command += ["--tdm", "kvn"]
    command += ["--stamp-reference", "start", "--exposure-time-s", f"{case.settings.exposure_s}"]
    # The bursts are minutes apart, and in other parts of the sky.
    command += ["--max-gap-s", "10"]
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as told:
        ofsat(command, None, None, False)
    path = results / TRACKING_DATA["kvn"]
    if not path.exists():
        raise SystemExit(f"orbit: {case}: ofsat process has found nothing: {told.getvalue()}")
    return path
