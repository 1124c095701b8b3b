# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The guide: the tracks of each frame in, commands for a mount out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.camera import Camera
from ofsat_ros.guidance.pointing import (
    OffsetLoop,
    OwnMotion,
    axes,
    boresight_rate,
    offset_of,
    shortened,
)
from ofsat_ros.guidance.target import Sights, Target, choose, found, found_again, same_again
from ofsat_ros.parameters import GuideParameters
from ofsat_ros.timeline import AstrayError, Timeline

Array = NDArray[np.float64]

_NS = 1_000_000_000
# After disengaging, zeros are sent for so long, s.
_FAREWELL_S = 1.0
# A longer time between two commands is a hiccup, in which the mount may have stopped, s; or so
# many periods.
_LONGEST_STEP_S, _LONGEST_PERIODS = 0.5, 2.0
_ARCSEC = float(np.radians(1 / 3600))


@dataclass(frozen=True)
class Command:
    """What a mount is to do, and why.

    Attributes
    ----------
    stamp_ns : int
        The time it was made for, ns UTC.
    offset : (2,) float64
        Angle from the boresight to the target at that time, (right, down), rad; NaN if unknown.
    rate : (2,) float64
        Time derivative of the offset, rad/s; NaN if unknown.
    mount_rate : (3,) float64
        Angular velocity of the camera relative to the stars about the axes of the optical frame,
        rad/s; always finite.
    commanding : bool
        Whether the mount is to hear it: engaged, or coming to rest after that.
    target_id : int
        Track that is followed; 0: none.
    state : str
        ``waiting for camera_info``, ``searching``, ``following``, ``coasting``, ``lost``,
        ``dead-man`` or ``disengaged``.
    reason : str
        State and circumstances in a sentence.
    age_s : float
        Since the target was seen, s; NaN without one.
    limited : bool
        Whether the rate is not what the control law wants but as much as the limits allow.
    integral : (2,) float64
        Standing rate that the loop has learned, (right, down), rad/s.
    """

    stamp_ns: int
    offset: Array
    rate: Array
    mount_rate: Array
    commanding: bool
    target_id: int
    state: str
    reason: str
    age_s: float
    limited: bool
    integral: Array


class Guide:
    """Follows one target.

    Parameters
    ----------
    parameters : GuideParameters, optional
        May be assigned at any time; another choice of the target takes effect at once.

    Notes
    -----
    The dead-man: without a frame that shows the target, for `stale_after_s` since the middle of
    the last one's exposure, or with a clock that differs from the stamps by more than that, or
    disengaged, the commanded rate decays evenly to zero.  It takes `decay_s`, or longer if
    `max_acceleration_deg_s2` does not allow that: the rate over it.  Until then the rate goes on
    with what was last known of the target.  Frames in which the track only coasts tell where it
    is expected, as long as that agrees with our own reckoning, but not that it is alive.
    """

    def __init__(self, parameters: GuideParameters | None = None) -> None:
        self._parameters = parameters or GuideParameters()
        self.engaged = self._parameters.engaged
        self._own = OwnMotion()
        self._loop = OffsetLoop()
        self._camera: Camera | None = None
        self._sights: Sights | None = None
        self._timeline = Timeline()
        self._target: Target | None = None
        self._lost_why = ""
        self._now_ns: int | None = None
        self._rate = np.zeros(2)
        self._limited = False
        self._commanding = False
        self._decay_from: float | None = None
        self._farewell_ns: int | None = None

    @property
    def parameters(self) -> GuideParameters:
        """The choices."""
        return self._parameters

    @parameters.setter
    def parameters(self, given: GuideParameters) -> None:
        before, self._parameters = self._parameters, given
        if (given.target, given.target_id) == (before.target, before.target_id):
            return
        target = self._target
        if given.target == "id" and target is not None and target.track_id == given.target_id:
            return
        self._forget("another target was asked for")
        if self._sights is not None:
            self._choose(self._sights)

    def engage(self, on: bool) -> None:
        """Begin or cease to command the mount."""
        if on != self.engaged:
            self._loop.reset()
        self.engaged = on

    def update(self, stamp_ns: int, tracks: NDArray[np.void], camera: Camera | None) -> None:
        """Take the tracks of a frame.

        Parameters
        ----------
        stamp_ns : int
            Middle of its exposure, ns UTC.  A frame whose stamp is astray (`Timeline`) is left
            out; time that has run backwards ends what was followed.
        tracks : (N,) TRACK_DTYPE
            What is NaN in position, velocity or line of sight (`sight`) is taken as not there, as
            is what cannot be.
        camera : Camera or None
            None: not calibrated; nothing is followed.
        """
        try:
            jump_s = self._timeline.follow(stamp_ns)
        except AstrayError:
            return
        if jump_s < 0:
            self._forget(f"the frames' time ran backwards by {-jump_s:.3g} s")
        self._camera = camera
        if camera is None:
            self._sights = None
            self._forget("the camera is not calibrated")
            return
        self._sights = sights = Sights.of(stamp_ns, tracks, camera)
        self._follow(sights, camera)
        self._see_own_motion(sights)
        target = self._target
        self._own.forget(min(stamp_ns, target.stamp_ns) if target else stamp_ns)

    def command(self, now_ns: int) -> Command:
        """Return what the mount is to do now; to be called evenly.

        Parameters
        ----------
        now_ns : int
            ns UTC, of the clock that stamps the images.  If it runs backwards, the target is
            forgotten.
        """
        step_s = self._step_s(now_ns)
        fresh = self._target is not None and abs(self._age_s(now_ns)) <= self._stale_s
        offset = rate = np.full(2, np.nan)
        if self._target is not None and fresh:
            sight, omega = self._target.at(now_ns, self._own)
            offset, rate = offset_of(sight), boresight_rate(omega) - self._own.rate(now_ns)
        if self.engaged and not self._commanding:
            # As the mount moves just now: it is taken over without a jerk.
            self._rate = self._own.rate(now_ns) if fresh else np.zeros(2)
            self._commanding = True
        # A limit that was lowered holds at once, whatever the acceleration's.
        self._rate = shortened(self._rate, np.radians(self._parameters.max_rate_deg_s))
        if self.engaged and fresh and self._target is not None:
            self._steer(self._target, now_ns, step_s)
        else:
            self._decay(step_s)
        self._say_farewell(now_ns)
        if self._commanding:
            # What the integral makes up for is what the mount does not do, or the target more.
            learned = self._loop.integral if self._decay_from is None else 0.0
            self._own.set_rate(now_ns + self._latency_ns, self._rate - learned)
        state, reason = self._words(now_ns, fresh, offset)
        return Command(
            stamp_ns=now_ns,
            offset=offset,
            rate=rate,
            mount_rate=axes(self._rate),
            commanding=self._commanding,
            target_id=self._target.track_id if self._target else 0,
            state=state,
            reason=reason,
            age_s=self._age_s(now_ns),
            limited=self._limited,
            integral=self._loop.integral,
        )

    @property
    def seen_rate(self) -> Array:
        """Rate of the boresight against the stars, as the target shows it, (2,) rad/s; or NaN.

        That of the last half second or so: it is fitted over several frames.
        """
        sights = self._sights
        row = self._seen_row(sights)
        return np.full(2, np.nan) if sights is None or row is None else sights.seen_rate[row]

    def _seen_row(self, sights: Sights | None) -> int | None:
        """The row that tells our own motion: the target's, else the first there is."""
        if sights is None or not len(sights.tracks):
            return None
        row = sights.row(self._target.track_id) if self._target else None
        return 0 if row is None else row

    def _see_own_motion(self, sights: Sights) -> None:
        """While another drives the mount, the images alone tell how it moves."""
        row = self._seen_row(sights)
        if not self._commanding and row is not None and np.isfinite(sights.seen_rate[row]).all():
            self._own.set_rate(sights.stamp_ns, sights.seen_rate[row])

    def _follow(self, sights: Sights, camera: Camera) -> None:
        target = self._target
        if target is None:
            self._choose(sights)
            return
        lost_s = (sights.stamp_ns - target.seen_ns) / _NS
        # The longer ago, the wider is what its path may lead to: in an hour, half of the sky.
        known = lost_s <= max(self._parameters.reacquire_s, self._stale_s)
        row = same_again(target, sights, self._own, camera, self._stale_s) if known else None
        if row is not None:
            if not target.present:
                self._loop.start_anew()
            self._target = found_again(target, sights, row, self._own)
            return
        if lost_s <= target.patience_s(self._parameters):
            self._target = replace(target, present=False)
            return
        self._forget(f"track {target.track_id} was lost {lost_s:.1f} s ago")
        self._choose(sights)

    def _choose(self, sights: Sights) -> None:
        row = choose(sights, self._parameters)
        if row is not None:
            self._target = found(sights, row)

    def _forget(self, why: str) -> None:
        self._target, self._lost_why = None, why
        self._loop.reset()

    def _steer(self, target: Target, now_ns: int, step_s: float) -> None:
        """Set the rate that follows the target."""
        given = self._parameters
        sight, omega = target.at(now_ns + self._latency_ns, self._own)
        offset = offset_of(sight)
        wanted = boresight_rate(omega) + self._loop.correction(offset, given)
        within = shortened(wanted, np.radians(given.max_rate_deg_s))
        change = np.radians(given.max_acceleration_deg_s2) * step_s
        self._rate = self._rate + shortened(within - self._rate, change)
        self._limited = not np.allclose(self._rate, wanted, rtol=1e-6, atol=1e-12)
        unseen = target.coasting or not target.present
        self._loop.learn(offset, step_s, self._limited or unseen, given)
        self._decay_from = None

    def _decay(self, step_s: float) -> None:
        given = self._parameters
        speed = float(np.hypot(*self._rate))
        if self._decay_from is None:
            self._decay_from = speed
        slope = np.radians(given.max_acceleration_deg_s2)
        if given.decay_s:
            slope = min(slope, self._decay_from / given.decay_s)
        self._rate = shortened(self._rate, max(0.0, speed - slope * step_s))
        self._limited = False
        self._loop.start_anew()

    def _say_farewell(self, now_ns: int) -> None:
        """Cease to command, a moment after the rate has come to zero."""
        if self.engaged or not self._commanding or self._rate.any():
            self._farewell_ns = None
        elif self._farewell_ns is None:
            self._farewell_ns = now_ns
        elif now_ns - self._farewell_ns > _FAREWELL_S * _NS:
            self._commanding = False

    def _step_s(self, now_ns: int) -> float:
        """Time since the last command; what does not outlive time running backwards ends."""
        before_ns, self._now_ns = self._now_ns, now_ns
        if before_ns is None:
            return 0.0
        step_s = (now_ns - before_ns) / _NS
        if step_s < 0:
            self._forget(f"the clock ran backwards by {-step_s:.3g} s")
            self._farewell_ns = None
        longest_s = max(_LONGEST_STEP_S, _LONGEST_PERIODS / self._parameters.command_hz)
        return min(max(step_s, 0.0), longest_s)

    def _age_s(self, now_ns: int) -> float:
        return (now_ns - self._target.seen_ns) / _NS if self._target else float("nan")

    @property
    def _stale_s(self) -> float:
        return self._parameters.stale_after_s

    @property
    def _latency_ns(self) -> int:
        return round(self._parameters.mount_latency_s * _NS)

    def _words(self, now_ns: int, fresh: bool, offset: Array) -> tuple[str, str]:
        state, reason = self._target_words(now_ns, fresh, offset)
        if self.engaged:
            return state, f"{state}: {reason}"
        return "disengaged", f"disengaged; {state}: {reason}"

    def _target_words(self, now_ns: int, fresh: bool, offset: Array) -> tuple[str, str]:
        target = self._target
        if self._camera is None:
            return "waiting for camera_info", "without it no pixel is a direction"
        if target is None:
            return "searching", self._why_none()
        name, age_s = f"track {target.track_id}", self._age_s(now_ns)
        if target.was_id:
            name += f" (re-acquired, was {target.was_id})"
        if not target.present:
            return "lost", f"{name} was seen {age_s:.1f} s ago"
        if not fresh and age_s < 0:
            return "dead-man", f"{name} is stamped {-age_s:.1f} s ahead of the clock"
        if not fresh:
            return "dead-man", f"{name} was not seen for {age_s:.1f} s"
        at = f"{name}, {np.hypot(*offset) / _ARCSEC:.1f} arcsec off"
        if target.coasting:
            return "coasting", f"{at}, not seen for {age_s:.1f} s"
        return "following", at

    def _why_none(self) -> str:
        given = self._parameters
        by_id = given.target == "id"
        wanted = f"track {given.target_id} is not there" if by_id else "there is no track"
        return f"{self._lost_why}; {wanted}" if self._lost_why else wanted
