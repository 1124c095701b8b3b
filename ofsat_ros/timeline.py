"""The times of frames: which follow one another, and which are astray.

Stands wherever frames come in one after the other: before the pipeline, the guide and the tracking
data, so that all of them leave out the same frames.  A clock that is set, a driver that forgets a
stamp, a frame that comes twice, late, or from another camera: a single stamp that does not go on
where the others ended is not believed, and costs its own frame only.  When the next frame goes on
from there, time has jumped indeed: a recording begins anew, the clock was set, the camera paused.
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

    def follow(self, stamp_ns: int) -> float:
        """Take the next frame.

        Parameters
        ----------
        stamp_ns : int
            Its stamp, ns.

        Returns
        -------
        float
            0 if the frame follows the one before; if time has jumped between the two, by how much,
            s: below 0 if backwards.

        Raises
        ------
        AstrayError
            If it has the stamp of the frame before; or if it is earlier, or later by over a minute
            and ten times the longest of the last intervals, unless it goes on from a frame that
            was left out just before for that.
        """
        if self._newest_ns is None:
            self._newest_ns = stamp_ns
            return 0.0
        step_ns = stamp_ns - self._newest_ns
        if not step_ns:
            raise AstrayError("it has the same stamp as the frame before")
        jumped = not self._goes_on(self._newest_ns, stamp_ns)
        if jumped:
            astray_ns, self._astray_ns = self._astray_ns, stamp_ns
            if astray_ns is None or not self._goes_on(astray_ns, stamp_ns):
                raise AstrayError(_words(step_ns))
        # A pause that proved to be one may come again.
        if step_ns > 0:
            self._intervals.append(step_ns)
        self._newest_ns, self._astray_ns = stamp_ns, None
        return step_ns / _NS if jumped else 0.0

    def _goes_on(self, before_ns: int, stamp_ns: int) -> bool:
        longest_ns = _LONGEST * max(self._intervals, default=1 << 62)
        return 0 < stamp_ns - before_ns <= max(longest_ns, _LEAST_NS)


def _words(step_ns: int) -> str:
    where = "after" if step_ns > 0 else "before"
    return (
        f"its stamp is {abs(step_ns) / _NS:g} s {where} that of the frame before, and is not"
        " believed until the next frame goes on from there"
    )
