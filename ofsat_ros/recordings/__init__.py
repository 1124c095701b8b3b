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
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera, CameraError, rotation_of
from ofsat_ros.images import EncodingError, decode_message
from ofsat_ros.recordings.bag import (
    ATTITUDE,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    Bag,
    RecordingError,
    Topic,
)
from ofsat_ros.recordings.bag_writer import BagWriter

__all__ = [
    "ATTITUDE",
    "CAMERA_INFO",
    "COMPRESSED_IMAGE",
    "IMAGE",
    "Attitude",
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


# A stamp, ns UTC, and the rotation from ICRS to the optical frame then.
Attitude = tuple[int, Rotation]


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
    camera : Camera or None
        The calibration recorded before it; None if there is none.
    attitudes : tuple of Attitude
        Those recorded since the frame before.
    """

    image: np.ndarray
    stamp_ns: int
    frame_id: str
    number: int = 0
    camera: Camera | None = None
    attitudes: tuple[Attitude, ...] = ()


def open_recording(
    path: str | Path,
    topic: str | None = None,
    camera_info_topic: str | None = None,
    attitude_topic: str | None = None,
) -> Recording:
    """Open a recording to read its frames.

    Parameters
    ----------
    path : str or Path
        A rosbag2 folder, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.
    topic : str, optional
        Image topic to read; not needed if there is only one.
    camera_info_topic, attitude_topic : str, optional
        Topics of the calibration and of the attitude; not needed if they are ``camera_info`` and
        ``attitude`` beside the image topic, or the only ones of their types.

    Returns
    -------
    Recording
        To be used in a ``with`` statement.

    Raises
    ------
    RecordingError
        If there is nothing at `path`, or nothing readable, or no image topic, or several and none
        is chosen, or a chosen topic is not there.
    """
    thread = ThreadPoolExecutor(1, "recording")
    try:
        chosen = (topic, camera_info_topic, attitude_topic)
        return thread.submit(_open, path, chosen, thread).result()
    except RecordingError:
        thread.shutdown()
        raise


def _open(
    path: str | Path, chosen: tuple[str | None, str | None, str | None], thread: ThreadPoolExecutor
) -> Recording:
    bag = Bag(path)
    try:
        image = _choose(bag, chosen[0])
        info = _choose_beside(bag, image, CAMERA_INFO, "camera_info", chosen[1])
        attitude = _choose_beside(bag, image, ATTITUDE, "attitude", chosen[2])
        return Recording(bag, image, info, attitude, thread)
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
    camera_info_topic, attitude_topic : str
        Those read with it; empty if there is none.
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

    def __init__(
        self,
        bag: Bag,
        topic: str,
        camera_info_topic: str,
        attitude_topic: str,
        thread: ThreadPoolExecutor,
    ) -> None:
        self._bag = bag
        # All that the bag does is done in this one thread, which SQLite may ask for.
        self._thread: ThreadPoolExecutor | None = thread
        self._coming: deque[Future[Frame | None]] = deque()
        self.path = bag.path
        self.topic = topic
        self.camera_info_topic, self.attitude_topic = camera_info_topic, attitude_topic
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
            wanted = {self.topic, self.camera_info_topic, self.attitude_topic} - {""}
            for topic, msgtype, received_ns, data in self._bag.messages(wanted):
                if topic != self.topic:
                    self._take_beside(topic, msgtype, data)
                    continue
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
        self._camera: Camera | None = None
        self._attitudes: list[Attitude] = []
        self._said_beside: set[str] = set()

    @property
    def last_attitudes(self) -> tuple[Attitude, ...]:
        """Attitudes recorded after the last frame; complete when the iteration has ended."""
        return tuple(self._attitudes)

    def _take_beside(self, topic: str, msgtype: str, data: bytes) -> None:
        """Take note of a calibration or an attitude; say the first reason why one is useless."""
        try:
            message = self._bag.deserialize(data, msgtype)
            if msgtype == CAMERA_INFO:
                self._camera = None  # if the new one is useless, the old one is, too
                self._camera = Camera.from_message(message)
            else:
                q, stamp = message.quaternion, message.header.stamp
                stamp_ns = stamp.sec * _NS + stamp.nanosec
                self._attitudes.append((stamp_ns, rotation_of(q.x, q.y, q.z, q.w)))
        except (RecordingError, CameraError) as error:
            if topic not in self._said_beside:
                self._said_beside.add(topic)
                self.problems.append(f"{topic}: {error}")

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
        attitudes, self._attitudes = tuple(self._attitudes), []
        return Frame(image, stamp_ns, message.header.frame_id, number, self._camera, attitudes)

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


def _choose_beside(bag: Bag, image: str, msgtype: str, name: str, wanted: str | None) -> str:
    """Return the topic of a type that belongs to an image topic; empty if there is none."""
    found = [topic for topic, about in bag.topics.items() if about.msgtype == msgtype]
    if wanted is not None:
        wanted = wanted if wanted in bag.topics else f"/{wanted.lstrip('/')}"
        if wanted not in found:
            listing = ", ".join(found) or "none"
            raise RecordingError(f"{bag.path}: {wanted} is no {msgtype} topic; there is {listing}")
        return wanted
    beside = f"{_namespace(image)}/{name}"
    if beside in found:
        return beside
    others = {_namespace(topic) for topic, about in bag.topics.items() if about.is_image}
    if len(found) == 1 and _namespace(found[0]) in others - {_namespace(image)}:
        bag.problems.append(
            f"{found[0]} is beside another image topic than {image}, and is not used: choose it"
            f" as the topic of the {name} if it is this camera's"
        )
        return ""
    if len(found) > 1:
        bag.problems.append(
            f"several topics are {msgtype}, and none is {beside}; none is used: {', '.join(found)}"
        )
    return found[0] if len(found) == 1 else ""


def _namespace(topic: str) -> str:
    return topic.removesuffix("/compressed").rpartition("/")[0]
