# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The times of frames: which follow one another, and which are astray.

Stands wherever frames come in one after the other: before the pipeline, the guide and the tracking
data, so that all of them leave out the same frames.  A clock that is set, a driver that forgets a
stamp, a frame that comes twice, late, or from another camera: a single stamp that does not go on
where the others ended is not believed, and costs its own frame only.  When the next frame goes on
from there, time has jumped indeed: a recording begins anew, the clock was set, the camera paused.
Then both frames count.
"""

from __future__ import annotations

from collections import deque

_NS = 1_000_000_000
# What is farther ahead than this many of the longest of the last intervals, and than a pause of a
# camera that is being looked after, is not believed at once.
_LONGEST, _KEPT, _LEAST_NS = 10, 100, 60 * _NS


class AstrayError(ValueError):
    """A frame that is to be left out for its stamp; the message says why."""


class Timeline:
    """Judges the stamps of frames in the order in which they come."""

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._astray_ns: int | None = None
        self._intervals: deque[int] = deque(maxlen=_KEPT)

    def awaits(self, stamp_ns: int) -> bool:
        """Whether this stamp, just refused, will be believed if the next goes on from it."""
        return self._astray_ns == stamp_ns

    def follow(self, stamp_ns: int) -> float:
        """`judge` the stamp of the next frame, and `take` it."""
        jump_s = self.judge(stamp_ns)
        self.take(stamp_ns)
        return jump_s

    def judge(self, stamp_ns: int) -> float:
        """Say whether a frame is the next one.

        Parameters
        ----------
        stamp_ns : int
            Its stamp, ns.

        Returns
        -------
        float
            0 if the frame follows the one before; if time has jumped from that to the frame that
            was left out meanwhile, by how much, s: below 0 if backwards.

        Raises
        ------
        AstrayError
            If it has the stamp of the frame before; or if it is earlier, or later by over a minute
            and ten times the longest of the last intervals, unless it goes on from a frame that
            was left out just before for that.
        """
        if self._newest_ns is None:
            return 0.0
        step_ns = stamp_ns - self._newest_ns
        if not step_ns:
            raise AstrayError("it has the same stamp as the frame before")
        if self._goes_on(self._newest_ns, stamp_ns):
            return 0.0
        astray_ns, self._astray_ns = self._astray_ns, stamp_ns
        if astray_ns is None or not self._goes_on(astray_ns, stamp_ns):
            raise AstrayError(_words(step_ns))
        return (astray_ns - self._newest_ns) / _NS

    def take(self, stamp_ns: int) -> None:
        """Take a frame as the one that the next is judged by."""
        # A pause that proved to be one may come again.
        if self._newest_ns is not None and stamp_ns > self._newest_ns:
            self._intervals.append(stamp_ns - self._newest_ns)
        self._newest_ns, self._astray_ns = stamp_ns, None

    def _goes_on(self, before_ns: int, stamp_ns: int) -> bool:
        longest_ns = _LONGEST * max(self._intervals, default=1 << 62)
        return 0 < stamp_ns - before_ns <= max(longest_ns, _LEAST_NS)


def _words(step_ns: int) -> str:
    where = "after" if step_ns > 0 else "before"
    return (
        f"its stamp is {abs(step_ns) / _NS:g} s {where} that of the frame before, and is not"
        " believed until the next frame goes on from there"
    )
