# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A recording in segments: where it is cut, and what a segment's run keeps for the joining.

What a run knows at a frame it has learned from the frames before: the sensor's pattern over all of
them, the tracks over some.  So a segment's run first learns the sensor from many frames, and then
processes some frames before its own, in which the tracks are born again.  Those after its own
it needs for its last word, and to show that the next segment tells the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.recordings import Recording
from ofsat_ros.results import ResultError

_FILE = "segment.npz"
_FRAME_DTYPE = np.dtype(
    [
        ("frame", "i8"),  # number in the recording
        ("stamp_ns", "i8"),
        ("height", "i4"),
        ("width", "i4"),
        ("last_id", "i8"),  # largest id of a track so far: births are told in their order
    ]
)
_ROW_DTYPE = np.dtype(
    [
        ("frame", "i8"),
        ("stamp_ns", "i8"),
        ("why", "i4"),  # index of why its direction is unknown
        ("detection", DETECTION_DTYPE),
    ]
)
_TO_THE_END = 1 << 62
# The sensor's memory is a mean over 100 of the frames, of which it takes each row every 16th time:
# twice as long ago, a frame counts for a seventh of what a new one does.
_LEARNED = 2 * 100 * 16
# A run that does not tell what the next segment's tells goes on for so many times as long.
_LONGER = 4


@dataclass(frozen=True)
class Segment:
    """A part of a recording; frames by their numbers.

    Attributes
    ----------
    first, end : int
        The frames that are its own, the latter left out.
    before, after : int
        How many beside them are processed, too: the overlap with its neighbours.
    learned : int
        Of how many frames before all those the sensor is learned.  What is older counts for
        little in what one run knows of it then.
    """

    first: int
    end: int
    before: int = 0
    after: int = _TO_THE_END
    learned: int = _LEARNED

    @property
    def start(self) -> int:
        """The first frame that is processed."""
        return max(0, self.first - self.before)

    @property
    def stop(self) -> int:
        """The frame after the last one that is processed."""
        return self.end + self.after

    def longer(self) -> Segment:
        """The segment with more frames after its own."""
        return replace(self, after=_LONGER * max(self.after, 1))


def cut(count: int, least: int, overlap: int) -> list[Segment]:
    """Cut a recording into segments of about the same length.

    Parameters
    ----------
    count : int
        Its frames.  Should it have more, they are the last segment's.
    least : int
        The fewest frames of a segment, if there are so many.
    overlap : int
        Frames on each side of a cut that both segments process: `Job.overlap`, or more.

    Returns
    -------
    list of Segment
        In their order; each frame is one's own.
    """
    parts = max(1, count // max(1, least, overlap))
    cuts = [count * part // parts for part in range(parts + 1)]
    segments = [Segment(first, end, min(first, overlap), overlap) for first, end in pairwise(cuts)]
    return [*segments[:-1], replace(segments[-1], after=_TO_THE_END)]


class SegmentRecord:
    """What the run over a segment found, to the last digit.

    Attributes
    ----------
    segment : Segment
    frames : (N,) structured array
        The frames that were processed.
    rows : (K,) structured array
        Their detections.
    about : dict
        What else the joining needs: plain values.
    """

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.about: dict[str, Any] = {"resets": [], "reasons": [""]}
        self._frames: list[tuple[int, ...]] = []
        self._rows: list[NDArray[np.void]] = []
        self._last_id = 0

    def add_frame(self, number: int, result: FrameResult) -> None:
        """Take note of a frame."""
        self._last_id = max(self._last_id, int(result.tracks["track_id"].max(initial=0)))
        self._frames.append((number, result.stamp_ns, *result.shape, self._last_id))
        if result.reset:
            self.about["resets"].append([number, result.reset])

    def add_detections(
        self, number: int, stamp_ns: int, detections: NDArray[np.void], why: str
    ) -> None:
        """Take note of the detections of a frame, and why they have no directions."""
        reasons = self.about["reasons"]
        if why not in reasons:
            reasons.append(why)
        rows = np.zeros(len(detections), _ROW_DTYPE)
        rows["frame"], rows["stamp_ns"] = number, stamp_ns
        rows["why"], rows["detection"] = reasons.index(why), detections
        self._rows.append(rows)

    def end(self, frames: Recording, notes: list[str], calibrated: bool, missing: str) -> None:
        """Take note of what is known at the end.

        Parameters
        ----------
        frames : Recording
            What was read.
        notes : list of str
            What the user was told, but for the recording's own problems and resets.
        calibrated : bool
            Whether the camera is.
        missing : str
            What the recording does not have for directions.
        """
        self.about |= {
            **{"reached": frames.reached, "notes": notes, "problems": frames.problems},
            **{"calibrated": calibrated, "missing": missing},
        }

    def write(self, folder: Path) -> None:
        """Write the tables; `about` is for ``run.json``."""
        rows = np.concatenate([np.zeros(0, _ROW_DTYPE), *self._rows])
        np.savez(folder / _FILE, frames=np.array(self._frames, _FRAME_DTYPE), rows=rows)


@dataclass
class RunOfSegment:
    """What `SegmentRecord` has written; the fields are its attributes."""

    segment: Segment
    frames: NDArray[np.void]
    rows: NDArray[np.void]
    about: dict[str, Any]
    folder: Path

    @classmethod
    def read(cls, folder: Path, segment: Segment, about: dict[str, Any] | None) -> Self:
        """Read from a folder of results.

        Raises
        ------
        ResultError
            If it holds no segment's.
        """
        try:
            with np.load(folder / _FILE, allow_pickle=False) as tables:
                frames, rows = tables["frames"], tables["rows"]
        except (OSError, ValueError, KeyError) as error:
            raise ResultError(f"{folder} holds no whole segment: {error}") from error
        if about is None or frames.dtype != _FRAME_DTYPE or rows.dtype != _ROW_DTYPE:
            raise ResultError(f"{folder} is no segment that this version has made")
        return cls(segment, frames, rows, about, folder)

    def part(self, first: int, end: int) -> Self:
        """Return it without what is of other frames."""
        tables = [
            table[(table["frame"] >= first) & (table["frame"] < end)]
            for table in (self.frames, self.rows)
        ]
        return replace(self, frames=tables[0], rows=tables[1])

    @property
    def has_ended(self) -> bool:
        """Whether it came to the recording's end."""
        return bool(self.about["reached"] < self.segment.stop)

    def settled(self, settling: int) -> NDArray[np.int64]:
        """Return the frames of which the last word was not said before its time."""
        numbers = self.frames["frame"]
        return numbers if self.has_ended else numbers[: max(0, len(numbers) - settling)]

    def last_id_before(self, number: int) -> int:
        """Return the largest id of a track that was born before a frame."""
        return int(self.frames["last_id"][self.frames["frame"] < number].max(initial=0))


def settling_frames(history_frames: int, coast_frames: int) -> int:
    """Return after how many more frames the last word on a frame is said at the latest."""
    return history_frames + coast_frames


def by_frame(rows: NDArray[np.void], numbers: ArrayLike) -> list[NDArray[np.void]]:
    """Return the rows of each of some frames; rows are in the order of their frames."""
    starts = np.searchsorted(rows["frame"], numbers, "left")
    ends = np.searchsorted(rows["frame"], numbers, "right")
    return [rows[start:end] for start, end in zip(starts, ends, strict=True)]
