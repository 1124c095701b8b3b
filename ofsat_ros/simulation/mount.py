# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How a camera turns over the sky: motions for `SphereSimulator`, and a mount that obeys commands.

An attitude is the rotation ICRS -> optical frame (x right, y down, z forward): it turns
coordinates.  A camera's angular rate w, rad/s, is that against the stars, in its own optical
frame, so that over a short time dt::

    attitude(t + dt) = exp(-[w] dt) attitude(t)

w about +y turns the boresight to the right, w about +x turns it up; a star on the boresight then
moves in the image at f (-w_y, w_x).  Times are seconds since the first exposure began.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation.settings import Pair, check_number, check_pair

# While the rate changes, over so short a time that the order of turns is of no matter: what is
# left is |w x dw/dt| dt^2 / 12, under 0.001 arcsec/s at 3 deg/s and 1 deg/s^2.
_STEP_S = 5e-3


class Motion(Protocol):
    """Where a camera looks at any time."""

    def attitudes(self, times_s: np.ndarray) -> Rotation:
        """Return the attitudes at (N,) ascending times; calls too come with ascending times."""


class Fixed:
    """A camera that keeps its attitude: it tracks the stars.

    Parameters
    ----------
    attitude : scipy.spatial.transform.Rotation
        A single one.
    """

    def __init__(self, attitude: Rotation) -> None:
        self._quaternion = attitude.as_quat()

    def attitudes(self, times_s: np.ndarray) -> Rotation:
        """Return the same attitude for each of the times."""
        return Rotation.from_quat(np.broadcast_to(self._quaternion, (len(times_s), 4)))


class SimulatedMount:
    """A mount that turns at the rate that it was last told, as far as it can.

    The rate moves straight to the commanded one, at most at the greatest acceleration, and starts
    to do so a latency after the command.  Without commands, the mount tracks the stars.

    Parameters
    ----------
    start : scipy.spatial.transform.Rotation
        Attitude at time 0, where the mount is at rest against the stars.
    max_rate_deg_s : float
        Fastest rate; of a faster command the direction is kept.
    max_acceleration_deg_s2 : float
        Fastest change of the rate.
    latency_s : float
        From a command to its effect.
    periodic_error : (float, float)
        Amplitude (arcsec) and period (s) of a sinusoidal error of the angle about the optical
        frame's y axis, as of a worm gear; it is 0 at time 0.
    timeout_s : float
        When the last command is so old, the mount goes to rest by itself, as if told so then.
        It may be changed.

    Raises
    ------
    ParameterError
        If a value is no finite number of its range.
    """

    def __init__(
        self,
        start: Rotation,
        max_rate_deg_s: float = 5.0,
        max_acceleration_deg_s2: float = 2.0,
        latency_s: float = 0.0,
        periodic_error: Pair = (0.0, 60.0),
        timeout_s: float = 1.0,
    ) -> None:
        given = {
            "max_rate_deg_s": max_rate_deg_s,
            "max_acceleration_deg_s2": max_acceleration_deg_s2,
            "latency_s": latency_s,
            "timeout_s": timeout_s,
        }
        checked = {name: check_number(name, given[name], *_RANGES[name]) for name in given}
        self._max_rate = math.radians(checked["max_rate_deg_s"])
        self._max_acceleration = math.radians(checked["max_acceleration_deg_s2"])
        self._latency_s = checked["latency_s"]
        self.timeout_s = checked["timeout_s"]
        amplitude, self._error_period_s = check_pair("periodic_error", periodic_error, 0.0, 1e6)
        if not self._error_period_s:
            raise ParameterError("periodic_error must have a period over 0 s")
        self._error_rad = math.radians(amplitude / 3600)
        self._attitude, self._rate = start, np.zeros(3)
        self._time_s = 0.0
        self._command_s, self._command = -math.inf, np.zeros(3)
        # Those whose latency is not over yet.
        self._pending: deque[tuple[float, np.ndarray]] = deque()

    @property
    def time_s(self) -> float:
        """Time up to which all is settled: the next command or attitude is of then or later."""
        return max(self._time_s, self._pending[-1][0] if self._pending else self._command_s)

    def command(self, time_s: float, rate_rad_s: Any) -> str:
        """Take a command; it holds until the next one, or until it is too old.

        Parameters
        ----------
        time_s : float
            When it arrives; not before `time_s`.
        rate_rad_s : array_like
            (3,), angular rate against the stars in the optical frame, rad/s.

        Returns
        -------
        str
            Why the command is bad, so that it counts as one to stop; empty if it is good.

        Raises
        ------
        ParameterError
            If it comes before what has already happened.
        """
        if not self.time_s <= time_s < math.inf:
            raise ParameterError(
                f"a command of {time_s:g} s cannot be taken: the mount is at {self.time_s:g} s"
            )
        rate, problem = np.array(rate_rad_s, float), ""
        if rate.shape != (3,) or not np.isfinite(rate).all():
            problem = f"the commanded rate is {rate_rad_s}, not three finite numbers: it stops"
            rate = np.zeros(3)
        speed = math.hypot(*rate)
        if speed > self._max_rate:
            rate *= self._max_rate / speed
        self._pending.append((float(time_s), rate))
        return problem

    def attitudes(self, times_s: np.ndarray) -> Rotation:
        """Return the attitudes at (N,) ascending times, none before one that was asked for.

        Raises
        ------
        ParameterError
            If a time lies before one that was asked for.
        """
        if len(times_s) and not (self._time_s <= times_s[0] and (np.diff(times_s) >= 0).all()):
            raise ParameterError(f"the mount is at {self._time_s:g} s and does not go back")
        found = []
        for time_s in times_s:
            self._advance(time_s)
            found.append(self._attitude.as_quat())
        phase = 2 * np.pi * np.asarray(times_s) / self._error_period_s
        error = self._error_rad * np.sin(phase)[:, None] * np.array([0.0, 1.0, 0.0])
        return Rotation.from_rotvec(-error) * Rotation.from_quat(np.array(found).reshape(-1, 4))

    def _advance(self, time_s: float) -> None:
        while self._time_s < time_s:
            wanted, change_s = self._wanted()
            gap = wanted - self._rate
            ramp_end_s = self._time_s + math.hypot(*gap) / self._max_acceleration
            end_s = min(time_s, change_s)
            if gap.any():
                end_s = min(end_s, ramp_end_s, self._time_s + _STEP_S)
            seconds = end_s - self._time_s
            before, self._rate = self._rate, wanted
            if end_s < ramp_end_s:
                self._rate = before + gap * seconds / (ramp_end_s - self._time_s)
            turn = Rotation.from_rotvec(-(before + self._rate) / 2 * seconds)
            self._attitude, self._time_s = turn * self._attitude, end_s

    def _wanted(self) -> tuple[np.ndarray, float]:
        """Rate that the mount strives for now, and until when."""
        while self._pending and self._pending[0][0] + self._latency_s <= self._time_s:
            self._command_s, self._command = self._pending.popleft()
        change_s = self._pending[0][0] + self._latency_s if self._pending else math.inf
        stale_s = self._command_s + self.timeout_s + self._latency_s
        if self._time_s < stale_s:
            return self._command, min(change_s, stale_s)
        return np.zeros(3), change_s


_RANGES = {
    "max_rate_deg_s": (1e-6, 360.0),
    "max_acceleration_deg_s2": (1e-6, 1e4),
    "latency_s": (0.0, 60.0),
    "timeout_s": (1e-3, 1e6),
}
