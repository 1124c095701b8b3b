# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The last word on each frame, held back until it is known what becomes of its tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ofsat_ros.history import History
from ofsat_ros.tracking.rows import Settled, settled_rows
from ofsat_ros.tracking.track import Track


class LastWord:
    """Says of each frame once, in their order, which RSOs it shows.

    A frame's rows are made when it leaves the history, whose motions they need.  A track that was
    born of it may yet turn out to be a star, or chance; so they wait.
    """

    def __init__(self) -> None:
        self._waiting: list[Settled] = []
        self._next = 0

    def take(self, history: History, count: int, tracks: Sequence[Track]) -> None:
        """Write down what is known of the history's oldest frames, this many, that were not."""
        for frame in list(history)[:count]:
            if frame.number < self._next:
                continue
            self._next = frame.number + 1
            seen = [track for track in tracks if frame.number in track.hits]
            seen.sort(key=lambda track: track.track_id)
            rows = settled_rows(seen, frame, history)
            self._waiting.append(Settled(frame.number, frame.stamp_ns, rows))

    def withdraw(self, track_id: int) -> None:
        """Take back what was to be said of a track."""
        self._waiting = [
            replace(one, detections=one.detections[one.detections["track_id"] != track_id])
            if np.any(one.detections["track_id"] == track_id)
            else one
            for one in self._waiting
        ]

    def said(self, before: int | None = None) -> list[Settled]:
        """Say the word on the frames before that number, or on all that wait."""
        due = [one for one in self._waiting if before is None or one.frame < before]
        self._waiting = self._waiting[len(due) :]
        return due
