# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Where a camera looks: attitudes over time, and the directions of what was detected."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ofsat_ros.camera.model import Camera, CameraError, to_radec
from ofsat_ros.parameters import CameraParameters
from ofsat_ros.timeline import AstrayError, Timeline

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_NS = 1_000_000_000
# Attitudes come out of order by less, ns; by more, they are astray, or time has run backwards.
_DISORDER_NS = 1_000_000_000
# An attitude whose stamp differs by less is that of the frame itself.
_SAME_NS = 1_000_000
# How far from 1 the norm of a quaternion may be that was sent with few digits.
_NORM_TOLERANCE = 1e-3
_KEPT = 100_000
_PART = {"middle": 0.0, "start": 0.5, "end": -0.5}


def _rotation(quaternion: ArrayLike) -> Rotation:
    # The first frames need not wait for it.
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion)


def rotation_of(x: float, y: float, z: float, w: float) -> Rotation:
    """Return the rotation that a message's quaternion stands for.

    Raises
    ------
    CameraError
        If it is not of unit length (to 0.001), and so no rotation.
    """
    norm = float(np.sqrt(x * x + y * y + z * z + w * w))
    if not abs(norm - 1) <= _NORM_TOLERANCE:
        raise CameraError(f"a quaternion of length {norm:.6g} is no rotation; it must be 1")
    return _rotation([x, y, z, w])


class Attitudes:
    """A camera's attitudes by their stamps: rotations from ICRS to the optical frame.

    Parameters
    ----------
    keep : int
        So many are remembered, those with the latest stamps.
    """

    def __init__(self, keep: int = _KEPT) -> None:
        self._keep = keep
        self._timeline = Timeline()
        self._stamps: list[int] = []
        self._quaternions: list[list[float]] = []

    def add(self, stamp_ns: int, attitude: Rotation) -> None:
        """Take an attitude; one of the same stamp replaces the former.

        They may come out of order by up to 1 s.  One whose stamp is astray (`Timeline`) is left
        out; when time has run backwards, all are forgotten.
        """
        if not self._stamps or not 0 <= self._stamps[-1] - stamp_ns <= _DISORDER_NS:
            try:
                jump_s = self._timeline.follow(stamp_ns)
            except AstrayError:
                return
            if jump_s < 0:
                self._stamps.clear()
                self._quaternions.clear()
        place = bisect_left(self._stamps, stamp_ns)
        if self._stamps[place : place + 1] != [stamp_ns]:
            self._stamps.insert(place, stamp_ns)
            self._quaternions.insert(place, [])
        self._quaternions[place] = attitude.as_quat().tolist()
        del self._stamps[: -self._keep], self._quaternions[: -self._keep]

    def at(self, stamp_ns: int, max_age_s: float) -> tuple[Rotation | None, str]:
        """Return the attitude at a time, or None and the reason in words.

        Between two attitudes the camera is taken to turn at a constant rate, the short way;
        after the newest, at the rate up to there.  That rate is taken over as long a time as
        it is carried on for, where there are attitudes: two of nearly the same time tell none.

        Parameters
        ----------
        stamp_ns : int
            ns UTC.
        max_age_s : float
            Only attitudes so near in time count, and rates between attitudes so near to each
            other.  An attitude within 1 ms counts by itself where there is no rate.
        """
        stamps, age_ns = self._stamps, round(max_age_s * _NS)
        after = bisect_left(stamps, stamp_ns)
        around = range(max(after - 1, 0), min(after + 1, len(stamps)))
        if not around:
            return None, "no attitude has come"
        nearest = min(around, key=lambda each: abs(stamps[each] - stamp_ns))
        away_ns = abs(stamps[nearest] - stamp_ns)
        pair, why = (0, 0), ""
        if after == 0:
            why = "there is no attitude from before the frame"
        elif after == len(stamps):
            pair = (self._rate_from(stamp_ns, age_ns), after - 1)
            if away_ns > age_ns:
                why = "the newest attitude is older than attitude_max_age_s"
            elif pair[0] == pair[1]:
                why = "the newest attitude has none before it, within attitude_max_age_s"
        else:
            pair = (after - 1, after)
            if max(stamp_ns - stamps[after - 1], stamps[after] - stamp_ns) > age_ns:
                why = "an attitude beside the frame is farther away than attitude_max_age_s"
        if not away_ns or (why and away_ns <= _SAME_NS):
            return _rotation(self._quaternions[nearest]), ""
        return (None, why) if why else (self._turned(*pair, stamp_ns), "")

    def _rate_from(self, stamp_ns: int, age_ns: int) -> int:
        """Return which attitude tells, with the newest, the rate that is carried on."""
        newest_ns = self._stamps[-1]
        first = bisect_left(self._stamps, newest_ns - age_ns)
        as_long = bisect_right(self._stamps, newest_ns - (stamp_ns - newest_ns)) - 1
        return max(first, as_long)

    def _turned(self, before: int, after: int, stamp_ns: int) -> Rotation:
        start_ns, end_ns = self._stamps[before], self._stamps[after]
        part = (stamp_ns - start_ns) / (end_ns - start_ns)
        first, second = (np.array(self._quaternions[each]) for each in (before, after))
        if first @ second < 0:  # the same rotation, the short way
            second = -second
        # Half of it, as accurate for small angles as for large ones.
        angle = 2 * np.arctan2(np.linalg.norm(second - first), np.linalg.norm(second + first))
        if not angle:
            return _rotation(first)
        weights = np.sin([(1 - part) * angle, part * angle])
        return _rotation(weights[0] * first + weights[1] * second)


class Astrometry:
    """Turns stamps into times, and pixels of a frame into directions.

    Parameters
    ----------
    parameters : CameraParameters

    Attributes
    ----------
    parameters : CameraParameters
        May be set.
    camera : Camera or None
        May be set; without one all directions are unknown.
    """

    def __init__(self, parameters: CameraParameters) -> None:
        self.parameters = parameters
        self.camera: Camera | None = None
        self._attitudes = Attitudes()

    def add_attitude(self, stamp_ns: int, attitude: Rotation) -> None:
        """Take an attitude: the rotation from ICRS to the optical frame, and its stamp, ns UTC."""
        self._attitudes.add(stamp_ns, attitude)

    def middle_ns(self, stamp_ns: int) -> int:
        """Return the middle of the exposure, ns UTC, of the image with a stamp."""
        about = self.parameters
        shift_s = about.stamp_offset_s + _PART[about.stamp_reference] * about.exposure_time_s
        return stamp_ns + round(shift_s * _NS)

    def locate(self, rows: NDArray[np.void], stamp_ns: int) -> str:
        """Fill in the directions of detections or tracks, as far as they are known.

        Parameters
        ----------
        rows : (N,) DETECTION_DTYPE or TRACK_DTYPE
            Reads x, y, sigma_x, sigma_y; sets sight, ra, dec, sigma_ra (the std along the
            equator: of ra times cos dec) and sigma_dec.  The stds are those of the position in
            the image only: what calibration and attitude are wrong by is not in them.
        stamp_ns : int
            Middle of the exposure, ns UTC.

        Returns
        -------
        str
            Why directions are unknown, in words; empty if all are known.
        """
        for name in ("sight", "ra", "dec", "sigma_ra", "sigma_dec"):
            rows[name] = np.nan
        if self.camera is None:
            return "the camera is not calibrated"
        attitude, why = self._attitudes.at(stamp_ns, self.parameters.attitude_max_age_s)
        if not len(rows):
            return why
        sight, slopes = self.camera.sights_with_jacobians(_columns(rows, "x", "y"))
        rows["sight"] = sight
        if attitude is None:
            return why
        rows["ra"], rows["dec"] = to_radec(sight, attitude)
        spread = _along_sky(slopes, rows["ra"], rows["dec"], attitude)
        spread *= _columns(rows, "sigma_x", "sigma_y")[:, None, :]
        rows["sigma_ra"], rows["sigma_dec"] = np.hypot(spread[:, :, 0], spread[:, :, 1]).T
        if np.isnan(sight[:, 0]).any():
            return "the calibration's distortion cannot be inverted at some of the pixels"
        return ""

    def radec_rates(self, rows: NDArray[np.void], stamp_ns: int) -> Array:
        """Return angular rates against the stars, rad/s, from rows' rel_vx and rel_vy.

        Parameters
        ----------
        rows : (N,) DETECTION_DTYPE or TRACK_DTYPE
        stamp_ns : int
            Middle of the exposure, ns UTC.

        Returns
        -------
        (N, 2) float64
            Of right ascension, times cos dec, and of declination; NaN where unknown.
        """
        attitude, _ = self._attitudes.at(stamp_ns, self.parameters.attitude_max_age_s)
        if self.camera is None or attitude is None:
            return np.full((len(rows), 2), np.nan)
        sight, slopes = self.camera.sights_with_jacobians(_columns(rows, "x", "y"))
        spread = _along_sky(slopes, *to_radec(sight, attitude), attitude)
        rates: Array = spread @ _columns(rows, "rel_vx", "rel_vy")[:, :, None]
        return rates[:, :, 0]


def _columns(rows: NDArray[np.void], *names: str) -> Array:
    return np.array([rows[name] for name in names]).T


def _along_sky(slopes: Array, ra: Array, dec: Array, attitude: Rotation) -> Array:
    """Return derivatives along east and north by pixel coordinates, (N, 2, 2), rad/px.

    At a pole, east is that of the right ascension that is stated there.
    """
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    east = [-sin_ra, cos_ra, np.zeros(len(ra))]
    north = [-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec]
    east_north = np.array([east, north]).transpose(2, 0, 1)
    along: Array = east_north @ (attitude.as_matrix().T @ slopes)
    return along
