# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A bag's messages as they were recorded, whatever its storage, and whatever became of it.

Raw: ``recordings`` turns them into frames, the player publishes them as they are.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Self

import yaml
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from ofsat_ros.recordings.salvage import Channel, WreckError
from ofsat_ros.recordings.storage import SUFFIXES, Storage, suffix_of, zstd

__all__ = [
    "ATTITUDE",
    "CAMERA_INFO",
    "COMPRESSED_IMAGE",
    "IMAGE",
    "SUFFIXES",
    "Bag",
    "RecordingError",
    "Topic",
    "TopicError",
]

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ATTITUDE = "geometry_msgs/msg/QuaternionStamped"

_METADATA = "metadata.yaml"
# What damaged metadata raises; the last, if it is nested without an end.
_NOT_METADATA = (
    *(yaml.YAMLError, UnicodeDecodeError, LookupError, TypeError, ValueError),
    *(AttributeError, RecursionError),
)
_ZSTD = b"\x28\xb5\x2f\xfd"  # never the first bytes of CDR
# No image is larger; a few bytes may unpack to any number.
_MOST_BYTES = 1 << 30
# How a recorder names the files of a bag that it splits.
_SPLIT = re.compile(r"(?P<bag>.+)_(?P<number>\d+)(?:\.mcap|\.db3|\.bag)(?:\.zstd|\.active)?")


@functools.cache
def typestore() -> Typestore:
    """Return what converts messages; it compiles each type once.

    Also for ROS 1: the conversion to CDR goes by ROS 2's definitions, without Header.seq.
    """
    return get_typestore(Stores.ROS2_JAZZY)


class RecordingError(Exception):
    """A recording cannot be read or written; the message says what is wrong and what to do."""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its message type (as ``sensor_msgs/msg/Image``) and message count."""

    msgtype: str
    count: int

    @property
    def is_image(self) -> bool:
        """Whether its messages are images that can be decoded."""
        return self.msgtype in (IMAGE, COMPRESSED_IMAGE)


class TopicError(RecordingError):
    """A bag has no image topic, or several and none is chosen.

    Attributes
    ----------
    topics : dict of str to Topic
        All that it has.
    """

    def __init__(self, message: str, topics: dict[str, Topic]) -> None:
        super().__init__(message)
        self.topics = topics


class Bag:
    """Messages of a bag as they were recorded; a context manager.

    A file that is torn, half written or damaged gives every message that is whole.

    Parameters
    ----------
    path : str or Path
        As in `open_recording`.

    Attributes
    ----------
    path : Path
    topics : dict of str to Topic
        Every topic of the bag, images or not; counts are those that its metadata tells of, if
        that is more than there is.
    start_ns : int
        Time at which the first message was received, ns.
    problems : list of str
        What was odd at opening, and what turned out not to be whole while reading.

    Raises
    ------
    RecordingError
        If it cannot be read, or holds no messages.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.problems: list[str] = []
        self._typestore = typestore()
        self._storages: list[Storage] = []
        self._said: set[str] = set()  # topics with a damaged message
        self._is_open = True
        try:
            files, told = self._files()
            self._open(files)
            self.topics = _topics(self._storages, told)
            self.start_ns = self._start_ns()
        except OSError as error:
            self.close()
            raise self._unreadable(error) from error
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; a second call does nothing."""
        self._is_open = False
        while self._storages:
            self._storages.pop().close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield (topic, message type, time received in ns, CDR bytes) in the order of time.

        What is not whole is left out and told in `problems`.

        Parameters
        ----------
        topics : collection of str
            Names of topics of the bag.
        start_ns : int, optional
            Leave out what was received before.

        Raises
        ------
        RecordingError
            If the bag can no longer be read, or is closed.
        """
        if not self._is_open:
            raise RecordingError(f"{self.path} is closed: open it again to read it")
        count = 0
        try:
            for storage in self._storages:
                for channel, received_ns, data in storage.messages(topics, start_ns):
                    cdr = self._as_cdr(channel, received_ns, data)
                    if cdr is not None:
                        yield channel.topic, channel.msgtype, received_ns, cdr
                        count += 1
        except (OSError, WreckError) as error:
            raise self._unreadable(error, f"after {count} messages") from error

    def _as_cdr(self, channel: Channel, received_ns: int, data: bytes) -> bytes | None:
        """Return a message as ROS 2 serializes it; None if it is damaged, which is said."""
        try:
            if data[:4] == _ZSTD:
                data = _unpacked(data)
            if channel.encoding == "ros1":
                data = bytes(self._typestore.ros1_to_cdr(data, channel.msgtype))
        # Damaged bytes: the decompressor's own error, struct, key, index errors and others.
        except Exception as error:  # noqa: BLE001
            if channel.topic not in self._said:
                self._said.add(channel.topic)
                self.problems.append(f"{channel.topic}: a damaged message is left out: {error}")
            return None
        return data

    def deserialize(self, data: bytes, msgtype: str) -> Any:
        """Return a message of `messages` as an object with the message's fields.

        Raises
        ------
        RecordingError
            If the bytes are no such message.
        """
        try:
            # Of a memoryview, the pixels become a view; of bytes, a copy.
            return self._typestore.deserialize_cdr(memoryview(data), msgtype)
        except Exception as error:  # damaged bytes: struct, Unicode, index errors and others
            reason = f"{error}" or type(error).__name__
            raise RecordingError(f"the message is damaged: {reason}") from error

    def _files(self) -> tuple[list[Path], dict[str, Topic]]:
        """Return the files to read, in their order, and the topics that the metadata tells of."""
        path = self.path
        if not path.exists():
            raise RecordingError(f"{path} does not exist: check the path")
        if path.is_dir():
            return self._told_files() or (self._found_files(), {})
        if not suffix_of(path):
            raise RecordingError(
                f"{path} is no recording known here: give a rosbag2 folder, or a file that ends in"
                f" {', '.join(SUFFIXES)}"
            )
        return [path], {}

    def _told_files(self) -> tuple[list[Path], dict[str, Topic]] | None:
        """Return what the metadata of a folder tells; None if there is nothing to go by."""
        try:
            told = yaml.safe_load((self.path / _METADATA).read_text())
            told = told["rosbag2_bagfile_information"]
            files = [self.path / PurePath(name).name for name in told["relative_file_paths"]]
            topics = {
                about["topic_metadata"]["name"]: Topic(
                    about["topic_metadata"]["type"], int(about["message_count"])
                )
                for about in told["topics_with_message_count"]
            }
        except FileNotFoundError:
            self.problems.append(f"{self.path} has no {_METADATA} (was the recorder killed?)")
            return None
        except _NOT_METADATA as error:
            reason = f"{error}".partition("\n")[0]
            self.problems.append(f"{self.path / _METADATA} is damaged and not used: {reason}")
            return None
        missing = [file.name for file in files if not file.exists()]
        if missing:
            self.problems.append(
                f"{self.path / _METADATA} tells of files that are missing: {', '.join(missing)}"
            )
        there = [file for file in files if file.exists() and suffix_of(file)]
        return (there, topics) if there else None

    def _found_files(self) -> list[Path]:
        """Return the files of a folder if they are one bag's, by their names."""
        files = [file for file in sorted(self.path.iterdir()) if suffix_of(file)]
        # A recorder that was killed may have left a file beside its half-written compression.
        files = [file for file in files if file.with_suffix("") not in files]
        if not files:
            raise RecordingError(
                f"{self.path} is no bag: it has neither a {_METADATA} nor a file that ends in"
                f" {', '.join(SUFFIXES)}"
            )
        if len(files) == 1:
            return files
        parts = [(_SPLIT.fullmatch(file.name), file) for file in files]
        numbers = {file: int(part["number"]) for part, file in parts if part}
        if len(numbers) < len(files) or len({part["bag"] for part, _ in parts if part}) > 1:
            raise RecordingError(
                f"{self.path} holds several files, and nothing tells that they are one bag: open"
                f" one of {', '.join(file.name for file in files)}"
            )
        return sorted(files, key=numbers.__getitem__)

    def _open(self, files: list[Path]) -> None:
        """Open the files; those that are none of a bag are left out and said."""
        reasons = []
        for file in files:
            try:
                self._storages.append(Storage(file, self.problems))
            except WreckError as error:
                reasons.append(f"{error}" if file == self.path else f"{file.name}: {error}")
        if not self._storages:
            reasons = [*self.problems, *reasons]
            raise RecordingError(f"cannot read {self.path}: {'; '.join(reasons)}")
        self.problems.extend(f"cannot read {reason}" for reason in reasons)

    def _start_ns(self) -> int:
        starts = [about.start_ns for about in self._storages if about.start_ns is not None]
        if starts:
            return min(starts)
        why = "; ".join(self.problems) or (
            "was the camera's topic recorded? (`ros2 topic list` shows the topics to record)"
        )
        raise RecordingError(f"{self.path} holds no messages: {why}")

    def _unreadable(self, error: Exception, where: str = "") -> RecordingError:
        reason = f"{error}".rstrip(".") or type(error).__name__
        return RecordingError(f"cannot read {f'{self.path} {where}'.rstrip()}: {reason}")


def _unpacked(data: bytes) -> bytes:
    unpacker = zstd.ZstdDecompressor()
    unpacked: bytes = unpacker.decompress(data, _MOST_BYTES)
    if not unpacker.eof:
        raise ValueError(f"it is cut short, or unpacks to more than {_MOST_BYTES >> 30} GiB")
    return unpacked


def _topics(storages: list[Storage], told: dict[str, Topic]) -> dict[str, Topic]:
    """Return all topics of some files and of the metadata, by their names."""
    found: dict[str, Topic] = {}
    for channel, count in (pair for storage in storages for pair in storage.channels):
        before = found.get(channel.topic, Topic(channel.msgtype, 0))
        found[channel.topic] = Topic(before.msgtype, before.count + count)
    for name, about in told.items():
        there = found.get(name, Topic(about.msgtype, 0))
        found[name] = Topic(there.msgtype, max(there.count, about.count))
    return dict(sorted(found.items()))
