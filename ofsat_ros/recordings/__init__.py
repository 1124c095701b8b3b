"""Recordings: frames in from bags, and bags out.

It stands before the pipeline offline, as the camera does live: ``open_recording`` yields the
frames that ``Pipeline.process`` takes.  ``Bag`` (bag.py) gives the messages as they were recorded,
which is what the player publishes; ``BagWriter`` (bag_writer.py) writes what the simulator renders
and what the recorder hears.  Reads rosbag2 folders and bare files (sqlite3, MCAP, compressed or
not) and ROS 1 bags.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from ofsat_ros.images import EncodingError, decode_message
from ofsat_ros.recordings.bag import COMPRESSED_IMAGE, IMAGE, Bag, RecordingError, Topic
from ofsat_ros.recordings.bag_writer import BagWriter

__all__ = [
    "COMPRESSED_IMAGE",
    "IMAGE",
    "Bag",
    "BagWriter",
    "Frame",
    "Recording",
    "RecordingError",
    "Topic",
    "open_recording",
]

_PROBLEMS_KEPT = 10
# Frames that are read while one is in work; more would only take memory.
_AHEAD = 2
_NS = 1_000_000_000


@dataclass(frozen=True)
class Frame:
    """One image of a recording.

    Attributes
    ----------
    image : ndarray, shape (height, width), uint8, uint16 or float32
        Luminance, native byte order.
    stamp_ns : int
        Stamp of the header, ns UTC.
    frame_id : str
        Coordinate frame of the header.
    number : int
        Its place among the images of the recording, those that could not be decoded included.
    """

    image: np.ndarray
    stamp_ns: int
    frame_id: str
    number: int = 0


def open_recording(path: str | Path, topic: str | None = None) -> Recording:
    """Open a recording to read its frames.

    Parameters
    ----------
    path : str or Path
        A rosbag2 folder, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.
    topic : str, optional
        Image topic to read; not needed if there is only one.

    Returns
    -------
    Recording
        To be used in a ``with`` statement.

    Raises
    ------
    RecordingError
        If there is nothing at `path`, or nothing readable, or no image topic, or several and none
        is chosen.
    """
    thread = ThreadPoolExecutor(1, "recording")
    try:
        return thread.submit(_open, path, topic, thread).result()
    except RecordingError:
        thread.shutdown()
        raise


def _open(path: str | Path, topic: str | None, thread: ThreadPoolExecutor) -> Recording:
    bag = Bag(path)
    try:
        return Recording(bag, _choose(bag, topic), thread)
    except RecordingError:
        bag.close()
        raise


class Recording:
    """The frames of one image topic; a context manager.

    Iterating yields every `Frame` in the order of the bag, each read and decoded ahead in a thread
    while the one before is in work.  A frame that cannot be decoded is left out, counted and
    named; so is the rest of a bag that is damaged from some frame on.

    Attributes
    ----------
    path : Path
    topic : str
        The topic read.
    topics : dict of str to int
        Image topics of the recording and their counts of frames.
    skipped : int
        Frames that the last iteration could not give.
    torn : str
        Why the last iteration ended before the recording's end; empty if it did not.
    problems : list of str
        What the user should know of the last iteration: why frames were skipped (the first ones),
        stamps that were missing, an index that does not agree.  Complete when it has ended.
    seconds : float
        Time that the last iteration's reading and decoding took, in its own thread, s.
    """

    def __init__(self, bag: Bag, topic: str, thread: ThreadPoolExecutor) -> None:
        self._bag = bag
        # All that the bag does is done in this one thread, which SQLite may ask for.
        self._thread: ThreadPoolExecutor | None = thread
        self._coming: deque[Future[Frame | None]] = deque()
        self.path = bag.path
        self.topic = topic
        self.topics = {name: about.count for name, about in bag.topics.items() if about.is_image}
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
        thread.submit(self._bag.close).result()
        thread.shutdown()

    def __len__(self) -> int:
        """Return the count of frames that the recording's index tells of."""
        return self.topics[self.topic]

    def __iter__(self) -> Iterator[Frame]:
        if self._thread is None:
            raise RecordingError(f"{self.path} is closed: open it again to read it")
        self._give_up()
        frames = self._read()
        coming = deque(self._thread.submit(self._next, frames) for _ in range(_AHEAD))
        self._coming = coming
        while coming and (frame := coming.popleft().result()) is not None:
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
            for _, msgtype, received_ns, data in self._bag.messages([self.topic]):
                frame = self._decode(count, msgtype, received_ns, data)
                count += 1
                if frame is not None:
                    yield frame
        except RecordingError as error:
            if not count:
                raise
            self.torn = f"{error}"
            self.problems.append(self.torn)
        if count < len(self):
            self.skipped += len(self) - count
            self.problems.append(
                f"{self.path} tells of {len(self)} images on {self.topic}, but only {count} could"
                " be read"
            )

    def _start_over(self) -> None:
        self.skipped = 0
        self.torn = ""
        self.seconds = 0.0
        self.problems = list(self._bag.problems)
        self._said_no_stamp = False

    def _decode(self, number: int, msgtype: str, received_ns: int, data: bytes) -> Frame | None:
        """Return a frame, or None and say why."""
        try:
            message = self._bag.deserialize(data, msgtype)
            image = decode_message(message)
        except (RecordingError, EncodingError) as error:
            self._skip(number, f"{error}")
            return None
        stamp = message.header.stamp
        stamp_ns = stamp.sec * _NS + stamp.nanosec
        if stamp_ns == 0:
            stamp_ns = received_ns
            self._say_no_stamp(number)
        return Frame(image, stamp_ns, message.header.frame_id, number)

    def _skip(self, number: int, reason: str) -> None:
        self.skipped += 1
        if self.skipped <= _PROBLEMS_KEPT:
            self.problems.append(f"frame {number} of {self.topic} skipped: {reason}")

    def _say_no_stamp(self, number: int) -> None:
        if self._said_no_stamp:
            return
        self._said_no_stamp = True
        self.problems.append(
            f"frame {number} of {self.topic} has no stamp in its header; the time at which it was"
            " received stands in, here and in others like it"
        )


def _choose(bag: Bag, topic: str | None) -> str:
    """Return the image topic to read."""
    images = {name: about.count for name, about in bag.topics.items() if about.is_image}
    listing = ", ".join(f"{name} ({count})" for name, count in images.items())
    if not any(images.values()):
        others = ", ".join(f"{n} ({about.msgtype})" for n, about in bag.topics.items())
        raise RecordingError(f"{bag.path} holds no images; its topics are {others}")
    if topic is None:
        filled = [name for name, count in images.items() if count]
        if len(filled) > 1:
            raise RecordingError(f"{bag.path} has several image topics; choose one of {listing}")
        return filled[0]
    name = topic if topic in bag.topics else f"/{topic}"
    if name not in images:
        kind = f"is {bag.topics[name].msgtype}" if name in bag.topics else "is not there"
        raise RecordingError(f"{bag.path}: topic {topic} {kind}; image topics are {listing}")
    if not images[name]:
        raise RecordingError(f"{bag.path}: topic {name} is empty; image topics are {listing}")
    return name
