# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Frames of any recording, read ahead in a thread: what stands before the pipeline offline.

A `Source` knows one kind of file; `Recording` is what they all look like from outside.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

import numpy as np
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.recordings.bag import RecordingError, Topic

# Of images that come with none: as a camera driver's would be called.
FRAME_ID = "camera_optical_frame"

_PROBLEMS_KEPT = 10
# Frames that are read while one is in work; more would only take memory.
_AHEAD = 2


# A stamp, ns UTC, and the rotation from ICRS to the optical frame then.
Attitude = tuple[int, Rotation]


def for_opencv(file: Path) -> None:
    """Refuse a name that is no Unicode: OpenCV ends the process on such a one.

    Raises
    ------
    RecordingError
    """
    try:
        f"{file}".encode()
    except UnicodeEncodeError as error:
        raise RecordingError(
            f"{file}: OpenCV cannot open a file whose path is no Unicode: rename it"
        ) from error


@dataclass(frozen=True)
class Frame:
    """One image of a recording.

    Attributes
    ----------
    image : ndarray, shape (height, width), uint8, uint16 or float32
        Luminance, native byte order.
    stamp_ns : int
        ns UTC; of a bag, the stamp of the header; else the middle of the exposure as far as it
        is known, and the recording's problems tell if it is not.
    frame_id : str
        Coordinate frame of the header.
    number : int
        Its place among the images of the recording, those that could not be decoded included.
    camera : Camera or None
        The calibration recorded before it, or in its header; None if there is none.
    attitudes : tuple of Attitude
        Those recorded since the frame before; at its stamp, if its header has one.
    exposure_s : float or None
        Length of the exposure, s; None if it is not known.
    encoding : str
        As the message has it; empty if it is of no bag.
    """

    image: np.ndarray
    stamp_ns: int
    frame_id: str
    number: int = 0
    camera: Camera | None = None
    attitudes: tuple[Attitude, ...] = ()
    exposure_s: float | None = None
    encoding: str = ""


@dataclass(frozen=True)
class Skipped:
    """A frame that cannot be given: which one it is, as in "frame 3 of /image", and why."""

    name: str
    reason: str


class Source(Protocol):
    """One kind of recording.  All that it does is done in one thread.

    Attributes
    ----------
    path : Path
    kind : str
        As in `Recording`.
    count : int
        Frames that the file's index tells of.
    contents, topics, topic, camera_info_topic, attitude_topic
        As in `Recording`.
    """

    path: Path
    kind: str
    count: int
    contents: dict[str, Topic]
    topics: dict[str, int]
    topic: str
    camera_info_topic: str
    attitude_topic: str

    @property
    def problems(self) -> list[str]:
        """What was odd at opening, and what turned out to be while reading."""

    @property
    def last_attitudes(self) -> tuple[Attitude, ...]:
        """Attitudes recorded after the last frame; complete when `frames` has ended."""

    def frames(
        self, say: Callable[[str], None], first: int = 0
    ) -> Iterator[Frame | Skipped | None]:
        """Yield every frame, or why one is skipped.

        Parameters
        ----------
        say : callable
            Takes what the user should know of this look at the recording.
        first : int
            Of frames before this one, None is yielded, and they are not decoded; the calibration
            and the attitudes recorded among them come with the first frame that is.

        Raises
        ------
        RecordingError
            If nothing more can be read.
        """

    def close(self) -> None:
        """Close the files."""


class Recording:
    """The frames of a recording; a context manager.

    Iterating yields every `Frame` in the order of the recording, each read and decoded ahead in a
    thread while the one before is in work.  A frame that cannot be decoded is left out, counted
    and named; so is the rest of a recording that is damaged from some frame on.  Of a recording
    that was opened from a frame on, or up to one, the others are not there.

    Attributes
    ----------
    path : Path
        Of several, the folder that they are in.
    kind : str
        ``rosbag2``, ``ROS 1 bag``, ``FITS``, ``SER``, ``video`` or ``images``.
    topic : str
        The topic read; empty if the recording is no bag.
    camera_info_topic, attitude_topic : str
        Those read with it; empty if there is none.
    contents : dict of str to Topic
        All topics of the recording; empty if it is no bag.
    topics : dict of str to int
        Image topics of the recording and their counts of frames; empty if it is no bag.
    skipped : int
        Frames that the last iteration could not give.
    torn : str
        Why the last iteration ended before the recording's end; empty if it did not.
    reached : int
        Number after that of the last frame that the last iteration came to; where it came to the
        recording's end, the count of all frames, also those of which only the index tells.
    seconds : float
        Time that the last iteration's reading and decoding took, in its own thread, s.
    """

    def __init__(
        self,
        source: Source,
        notes: list[str],
        thread: ThreadPoolExecutor,
        first: int = 0,
        end: int | None = None,
    ) -> None:
        self._source, self._notes = source, notes
        self._first, self._end = first, end
        # All that the source does is done in this one thread, which SQLite may ask for.
        self._thread: ThreadPoolExecutor | None = thread
        self._coming: deque[Future[Frame | None]] = deque()
        self.path, self.kind, self.topics = source.path, source.kind, source.topics
        self.contents, self.topic = source.contents, source.topic
        self.camera_info_topic = source.camera_info_topic
        self.attitude_topic = source.attitude_topic
        self._start_over()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; a second call does nothing."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._give_up()
        thread.submit(self._source.close).result()
        thread.shutdown()

    def __len__(self) -> int:
        """Return the count of frames that the recording's index tells of."""
        count = self._source.count
        return max(0, (count if self._end is None else min(count, self._end)) - self._first)

    @property
    def problems(self) -> list[str]:
        """What the user should know of the recording and of the last iteration.

        Why frames were skipped (the first ones), stamps that were missing, an index that does
        not agree.  Complete when the iteration has ended.
        """
        return [*self._source.problems, *self._notes, *self._said]

    @property
    def last_attitudes(self) -> tuple[Attitude, ...]:
        """Attitudes recorded after the last frame; complete when the iteration has ended."""
        return self._source.last_attitudes

    def __iter__(self) -> Iterator[Frame]:
        if self._thread is None:
            raise RecordingError(f"{self.path} is closed: open it again to read it")
        self._give_up()
        frames = self._read()
        coming = deque(self._thread.submit(self._next, frames) for _ in range(_AHEAD))
        self._coming = coming
        while coming and (frame := _result(coming.popleft())) is not None:
            coming.append(self._thread.submit(self._next, frames))
            yield frame

    def _give_up(self) -> None:
        """Read no further ahead; an iteration that is under way ends."""
        while self._coming:
            self._coming.pop().cancel()

    def _next(self, frames: Iterator[Frame]) -> Frame | None:
        start_s = time.perf_counter()
        frame = next(frames, None)
        self.seconds += time.perf_counter() - start_s
        return frame

    def _read(self) -> Iterator[Frame]:
        self._start_over()
        count = 0
        try:
            for given in self._source.frames(self._said.append, self._first):
                count += 1
                self.reached = count
                if isinstance(given, Frame):
                    yield given
                elif given is not None:
                    self._skip(given)
                if count == self._end:
                    return
        except RecordingError as error:
            if not count:
                raise
            self.torn = f"{error}"
            self._said.append(self.torn)
        told = self._source.count
        self.reached = max(count, told)
        if count < told:
            self.skipped += len(self) - max(0, count - self._first)
            on = f" on {self.topic}" if self.topic else ""
            self._said.append(
                f"{self.path} tells of {told} images{on}, but only {count} could be read"
            )

    def _start_over(self) -> None:
        self.skipped = self.reached = 0
        self.torn = ""
        self.seconds = 0.0
        self._said: list[str] = []

    def _skip(self, frame: Skipped) -> None:
        self.skipped += 1
        if self.skipped <= _PROBLEMS_KEPT:
            self._said.append(f"{frame.name} skipped: {frame.reason}")


def _result(coming: Future[Frame | None]) -> Frame | None:
    try:
        return coming.result()
    except RuntimeError as error:
        # Ctrl-C may hit the future's own lock, which then is not there to be released.
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise
