# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The frames of one image topic of a bag, with the calibrations and attitudes beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from ofsat_ros.camera import Camera, CameraError, rotation_of
from ofsat_ros.images import EncodingError, decode_message
from ofsat_ros.recordings.bag import ATTITUDE, CAMERA_INFO, Bag, RecordingError, TopicError
from ofsat_ros.recordings.recording import Attitude, Frame, Skipped
from ofsat_ros.recordings.storage import suffix_of

_NS = 1_000_000_000


class BagSource:
    """A bag as a `Source`; parameters as in `open_recording`."""

    def __init__(
        self,
        path: Path,
        topic: str | None,
        camera_info_topic: str | None,
        attitude_topic: str | None,
        exposure_s: float | None,
    ) -> None:
        self._bag = bag = Bag(path)
        self._exposure_s = exposure_s
        try:
            self.topic = image = _choose(bag, topic)
            self.camera_info_topic = _choose_beside(
                bag, image, CAMERA_INFO, "camera_info", camera_info_topic
            )
            self.attitude_topic = _choose_beside(bag, image, ATTITUDE, "attitude", attitude_topic)
        except RecordingError:
            bag.close()
            raise
        self.path, self.problems, self.first_ns = bag.path, bag.problems, bag.start_ns
        self.contents = bag.topics
        files = bag.path.iterdir() if bag.path.is_dir() else [bag.path]
        is_first = any(suffix_of(file) == ".bag" for file in files)
        self.kind = "ROS 1 bag" if is_first else "rosbag2"
        self.topics = {name: about.count for name, about in bag.topics.items() if about.is_image}
        self.count = self.topics[image]
        self._start_over()

    def close(self) -> None:
        """See `Source`."""
        self._bag.close()

    def frames(
        self, say: Callable[[str], None], first: int = 0
    ) -> Iterator[Frame | Skipped | None]:
        """See `Source`."""
        self._start_over()
        count = 0
        wanted = {self.topic, self.camera_info_topic, self.attitude_topic} - {""}
        for topic, msgtype, received_ns, data in self._bag.messages(wanted):
            if topic != self.topic:
                self._take_beside(topic, msgtype, data, say)
                continue
            known = count < first
            yield None if known else self._decode(count, msgtype, received_ns, data, say)
            count += 1

    @property
    def last_attitudes(self) -> tuple[Attitude, ...]:
        """See `Source`."""
        return tuple(self._attitudes)

    def _start_over(self) -> None:
        self._said_no_stamp = False
        self._camera: Camera | None = None
        self._attitudes: list[Attitude] = []
        self._said_beside: set[str] = set()

    def _take_beside(
        self, topic: str, msgtype: str, data: bytes, say: Callable[[str], None]
    ) -> None:
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
                say(f"{topic}: {error}")

    def _decode(
        self,
        number: int,
        msgtype: str,
        received_ns: int,
        data: bytes,
        say: Callable[[str], None],
    ) -> Frame | Skipped:
        name = f"frame {number} of {self.topic}"
        try:
            message = self._bag.deserialize(data, msgtype)
            image = decode_message(message)
        except (RecordingError, EncodingError) as error:
            return Skipped(name, f"{error}")
        stamp = message.header.stamp
        stamp_ns = stamp.sec * _NS + stamp.nanosec
        if stamp_ns == 0:
            stamp_ns = received_ns
            if not self._said_no_stamp:
                self._said_no_stamp = True
                say(
                    f"{name} has no stamp in its header; the time at which it was received stands"
                    " in, here and in others like it"
                )
        attitudes, self._attitudes = tuple(self._attitudes), []
        return Frame(
            image,
            stamp_ns,
            message.header.frame_id,
            number,
            self._camera,
            attitudes,
            self._exposure_s,
            str(message.encoding if hasattr(message, "encoding") else message.format).strip(),
        )


def _choose(bag: Bag, topic: str | None) -> str:
    """Return the image topic to read."""
    images = {name: about.count for name, about in bag.topics.items() if about.is_image}
    listing = ", ".join(f"{name} ({count})" for name, count in images.items())
    if not any(images.values()):
        others = ", ".join(f"{n} ({about.msgtype})" for n, about in bag.topics.items())
        raise TopicError(f"{bag.path} holds no images; its topics are {others}", bag.topics)
    if topic is None:
        filled = [name for name, count in images.items() if count]
        if len(filled) > 1:
            words = f"{bag.path} has several image topics; choose one of {listing}"
            raise TopicError(words, bag.topics)
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
