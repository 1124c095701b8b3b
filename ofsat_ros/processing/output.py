# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What frames gave, on its way into files: tables, tracking data, counts and notes.

The same for a run over a recording and for segments that are joined: so the one says what the
other would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.processing.totals import Totals
from ofsat_ros.results import STAR_FIELD, ResultWriter
from ofsat_ros.tracking_data import TrackArcs

# Of a camera that stamps badly, each frame may start afresh.
_RESETS_TOLD = 5


class Output:
    """Takes what frames gave, in their order.

    Parameters
    ----------
    arcs : TrackArcs or None
        Collects the tracks' directions; None if nobody wants them.
    say : callable
        Takes a line for the user.

    Attributes
    ----------
    totals : Totals
    notes : list of str
        What the user was told, but for what `add_frame` and `end` tell.
    writer : ResultWriter
        To be set before anything is added.
    """

    writer: ResultWriter

    def __init__(self, arcs: TrackArcs | None, say: Callable[[str], None]) -> None:
        self.totals = Totals()
        self.notes: list[str] = []
        self._arcs, self._say = arcs, say

    def note(self, problem: str) -> None:
        """Tell the user, now and in ``run.json``."""
        self.notes.append(problem)
        self._tell(problem)

    def _tell(self, problem: str) -> None:
        self.totals.problems.append(problem)
        self._say(f"note: {problem}")

    def add_frame(
        self, number: int, stamp_ns: int, shape: tuple[int, int], reset: str, reason: str
    ) -> None:
        """Count a frame of that number in the recording, and tell if it starts afresh."""
        totals = self.totals
        if reset and totals.frames:
            totals.resets += 1
            if totals.resets <= _RESETS_TOLD:
                self._tell(f"frame {number} starts afresh: {reset}")
        totals.add_frame(stamp_ns, shape, reason)

    def add_detections(
        self, number: int, stamp_ns: int, detections: NDArray[np.void], why: str
    ) -> None:
        """Write the detections (DETECTION_DTYPE) of a frame, and why directions are unknown."""
        if why and len(detections):
            self.totals.unlocated[why] += len(detections)
        self.writer.add_detections(stamp_ns, number, detections)
        if self._arcs is not None:
            self._arcs.add(stamp_ns, detections)
        self.totals.detections.update(detections["track_id"].tolist())

    def end(self, problems: Iterable[str]) -> None:
        """Tell what is known at the end: of the resets, and these problems of the recording."""
        if more := max(self.totals.resets - _RESETS_TOLD, 0):
            self._tell(f"{more} more frames start afresh: {STAR_FIELD} says why")
        for problem in problems:
            self._tell(problem)

    def tell_unlocated(self, calibrated: bool, missing: str) -> None:
        """Tell how many directions are unknown and why, and what the recording does not have."""
        # Most cameras are not calibrated, and nobody misses directions then.
        wanted = self._arcs is not None or calibrated
        for why, count in self.totals.unlocated.items() if wanted else ():
            self.note(f"{count} detections have no ra and dec: {why}{missing}")
