# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a run counts, for its summary and for ``run.json``."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ofsat_ros.results import in_words

_READING = "reading, meanwhile"


class Totals:
    """Counts, times and notes, for the summary and for ``run.json``."""

    def __init__(self) -> None:
        self.frames = self.left_out = 0
        self.first_stamp_ns: int | None = None  # middle of the exposure, as in all files
        self.last_stamp_ns: int | None = None
        self.problems: list[str] = []
        self.detections: Counter[int] = Counter()  # by track; 0 stands for candidates
        self.unlocated: Counter[str] = Counter()  # detections without direction, by the reason
        self.resets = 0  # after the first frame
        self.reason = ""
        self.reading_s = 0.0  # in its own thread, beside all others
        self._sizes: Counter[tuple[int, int]] = Counter()  # of the images: height, width
        self._seconds: dict[str, float] = defaultdict(float)  # none overlap

    @contextmanager
    def timed(self, stage: str) -> Iterator[dict[str, float]]:
        """Count the time of a stage; that of its parts, which it may be told of, apart."""
        parts: dict[str, float] = {}
        start_s = time.perf_counter()
        try:
            yield parts
        finally:
            taken_s = time.perf_counter() - start_s
            for part, seconds in (*parts.items(), (stage, taken_s - sum(parts.values()))):
                self._seconds[part] += seconds

    def add_frame(self, stamp_ns: int, shape: tuple[int, int], reason: str) -> None:
        """Count a frame."""
        self.frames += 1
        self.reason = reason
        self._sizes[shape] += 1
        self.last_stamp_ns = stamp_ns
        if self.first_stamp_ns is None:
            self.first_stamp_ns = stamp_ns

    def add_profile(self, profile: dict[str, float]) -> None:
        """Count the times of another run, as `as_dict` tells them."""
        for stage, seconds in profile.items():
            if stage == _READING:
                self.reading_s += seconds
            else:
                self._seconds[stage] += seconds

    def as_dict(self) -> dict[str, Any]:
        """Return what ``run.json`` says of them."""
        same = ("frames", "left_out", "first_stamp_ns", "last_stamp_ns")
        candidates = self.detections[0]
        # Of most frames, should they differ.
        height, width = self._sizes.most_common(1)[0][0] if self._sizes else (None, None)
        return {
            **{name: getattr(self, name) for name in same},
            **{"width": width, "height": height},
            "detections": self.detections.total() - candidates,
            "candidates": candidates,
            "tracks": sum(1 for track_id in self.detections if track_id),
            "problems": self.problems,
            "unlocated": dict(self.unlocated),
            "profile": {**self._seconds, _READING: self.reading_s},
        }

    def profile(self) -> str:
        """Return a table of where the time went."""
        frames, whole_s = max(self.frames, 1), sum(self._seconds.values())
        lines = [f"{'stage':<26}{'ms per frame':>12}{'share':>8}"]
        rows = sorted(self._seconds.items(), key=lambda row: -row[1])
        rows += [("all", whole_s), (_READING, self.reading_s)]
        for stage, seconds in rows:
            name, share = stage.replace("_", " "), f"{seconds / whole_s:.1%}"
            lines.append(f"{name:<26}{1e3 * seconds / frames:>12.2f}{share:>8}")
        return "\n".join(lines)

    @property
    def counts(self) -> str:
        """What was found in how many frames, in words."""
        words = f"{in_words(self.detections)} in {self.frames} frame{'s' * (self.frames != 1)}"
        if self.left_out:
            words += f" ({self.left_out} more could not be processed)"
        return words

    def __str__(self) -> str:
        silent = not self.detections and self.reason
        return f"{self.counts}; the last frame says: {self.reason}" if silent else self.counts
