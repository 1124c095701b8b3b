# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The control law: dead reckoning of the mount, PI on the offset, limits.

Vectors of two are (right, down) in the optical frame: rad of offset, rad/s of the boresight's
rate.  As an angular velocity, (right, down) is (-down, right, 0).
"""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ofsat_ros.parameters import GuideParameters

Array = NDArray[np.float64]

# The part of the acceleration that bringing in an offset may use; the rest follows the target.
_OWN_SHARE = 0.5
# The integral is at most this part of max_rate_deg_s.
_INTEGRAL_SHARE = 0.1
_NS = 1_000_000_000


def axes(rate: Array) -> Array:
    """Return the angular velocity (3,) that moves the boresight by a rate (2,)."""
    return np.array([-rate[1], rate[0], 0.0])


def boresight_rate(omega: Array) -> Array:
    """Return by how much an angular velocity (3,) moves the boresight, (2,)."""
    return np.array([omega[1], -omega[0]])


def offset_of(sight: Array) -> Array:
    """Return the angle from the boresight to a line of sight, as (right, down), rad."""
    across = np.hypot(sight[0], sight[1])
    if across == 0:
        return np.zeros(2)
    return sight[:2] / across * np.arctan2(across, sight[2])


def shortened(vector: Array, limit: float) -> Array:
    """Return a vector that is not longer than a limit, in the same direction."""
    length = float(np.hypot(*vector))
    return vector * (limit / length) if length > limit else vector


class OwnMotion:
    """How the camera turned, by dead reckoning from the rates it was told or seen to have.

    Angles between two times count; that to the stars is not known.  Each rate holds until the
    next begins, the last for ever.
    """

    def __init__(self) -> None:
        self._from_ns = [0]
        self._rates = [np.zeros(2)]
        self._attitudes = [Rotation.identity()]

    def set_rate(self, from_ns: int, rate: Array) -> None:
        """Say at which rate (2,) the boresight moves from a time on, whatever was said before."""
        keep = bisect_right(self._from_ns, from_ns - 1)
        if not keep:  # time ran backwards
            self._from_ns, self._rates, self._attitudes = [from_ns], [rate], [Rotation.identity()]
            return
        del self._from_ns[keep:], self._rates[keep:], self._attitudes[keep:]
        if np.array_equal(rate, self._rates[-1]):
            return
        attitude = self.attitude(from_ns)
        self._from_ns.append(from_ns)
        self._rates.append(rate)
        self._attitudes.append(attitude)

    def forget(self, before_ns: int) -> None:
        """Drop what is not needed for times from `before_ns` on."""
        keep = max(0, bisect_right(self._from_ns, before_ns) - 1)
        del self._from_ns[:keep], self._rates[:keep], self._attitudes[:keep]

    def rate(self, stamp_ns: int) -> Array:
        """Return the boresight's rate at a time, (2,)."""
        return self._rates[self._index(stamp_ns)]

    def attitude(self, stamp_ns: int) -> Rotation:
        """Return the rotation from a frame fixed in space to the optical frame at a time."""
        index = self._index(stamp_ns)
        rate = self._rates[index]
        if not rate.any():
            return self._attitudes[index]
        seconds = (stamp_ns - self._from_ns[index]) / _NS
        return Rotation.from_rotvec(-axes(rate) * seconds) * self._attitudes[index]

    def turn(self, start_ns: int, end_ns: int) -> Rotation:
        """Return the rotation from the optical frame at one time to that at another."""
        return self.attitude(end_ns) * self.attitude(start_ns).inv()

    def _index(self, stamp_ns: int) -> int:
        return max(0, bisect_right(self._from_ns, stamp_ns) - 1)


class OffsetLoop:
    """PI that brings an offset to zero.

    Its proportional part is ``offset / settling_s``, and for a large offset the speed from which
    half of the acceleration still brakes in time: ``sqrt(a (2 offset - a settling_s^2))``.  The
    integral does not sum up the offset but what it differs by from a reference, which starts at
    the first offset and comes in as it should.  So it learns standing errors (drift, a mount that
    is slower than told) and no overshoot; and while the command is limited, the reference is the
    offset itself, which is the anti-windup.
    """

    def __init__(self) -> None:
        self.integral = np.zeros(2)
        self._reference: Array | None = None

    def reset(self) -> None:
        """Forget what was learned."""
        self.integral = np.zeros(2)
        self.start_anew()

    def start_anew(self) -> None:
        """Take the next offset as a new start; the integral stays."""
        self._reference = None

    def correction(self, offset: Array, parameters: GuideParameters) -> Array:
        """Return the rate that brings an offset in, rad/s."""
        return _approach(offset, parameters) + self.integral

    def learn(self, offset: Array, step_s: float, frozen: bool, given: GuideParameters) -> None:
        """Go on by a step; `frozen` if the offset tells nothing of the loop just now."""
        if frozen or self._reference is None:
            self._reference = offset
            return
        if given.integral_s == 0:
            self.integral = np.zeros(2)
            return
        self._reference = self._reference - _approach(self._reference, given) * step_s
        gain = 1 / (given.settling_s * given.integral_s)
        summed = self.integral + gain * step_s * (offset - self._reference)
        self.integral = shortened(summed, _INTEGRAL_SHARE * np.radians(given.max_rate_deg_s))


def _approach(offset: Array, parameters: GuideParameters) -> Array:
    """The rate at which an offset is to come in: linear when small, braking in time when large."""
    length = float(np.hypot(*offset))
    settling_s = parameters.settling_s
    acceleration = _OWN_SHARE * np.radians(parameters.max_acceleration_deg_s2)
    linear = acceleration * settling_s**2
    if length <= linear:
        return offset / settling_s
    return offset / length * np.sqrt(acceleration * (2 * length - linear))
