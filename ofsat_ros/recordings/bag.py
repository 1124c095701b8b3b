"""A bag's messages as they were recorded, whatever its storage.

Raw: ``recordings`` turns them into frames, the player publishes them as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.typesys import Stores, get_typestore

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ATTITUDE = "geometry_msgs/msg/QuaternionStamped"
SUFFIXES = (".mcap", ".db3", ".bag")

_ZSTD = b"\x28\xb5\x2f\xfd"  # never the first bytes of CDR

_REMEDIES = {
    ".mcap": "`mcap recover {file} -o recovered.mcap` saves what is whole",
    ".db3": "`sqlite3 {file} .recover | sqlite3 recovered.db3` saves what is whole",
    ".bag": "`rosbag reindex {file}` saves what is whole",
}


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


class Bag:
    """Messages of a bag as they were recorded; a context manager.

    Parameters
    ----------
    path : str or Path
        As in `open_recording`.

    Attributes
    ----------
    path : Path
    topics : dict of str to Topic
        Every topic of the bag, images or not.
    start_ns : int
        Time at which the first message was received, ns.
    problems : list of str
        What was odd at opening.

    Raises
    ------
    RecordingError
        If it cannot be read, or holds no messages.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.problems: list[str] = []
        # Also for ROS 1: the conversion to CDR goes by ROS 2's definitions, without Header.seq.
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        try:
            storage = self._storage()
            self._ros1 = storage.suffix == ".bag"
            self._reader = Rosbag1Reader(storage) if self._ros1 else Rosbag2Reader(storage)
            self._reader.open()
        except RecordingError:
            raise
        # A damaged file makes the readers raise nearly anything: their own errors, those of
        # the database and of the decompressor, struct, assertion and key errors.
        except Exception as error:
            raise self._unreadable(error) from error
        self._is_open = True
        self.topics = {
            name: Topic(about.connections[0].msgtype, about.msgcount)
            for name, about in self._reader.topics.items()
        }
        self.start_ns = int(self._reader.start_time)
        if not sum(about.count for about in self.topics.values()):
            self.close()
            raise RecordingError(
                f"{self.path} holds no messages: was the camera's topic recorded?"
                " (`ros2 topic list` shows the topics to record)"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self._reader.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield (topic, message type, time received in ns, CDR bytes) in the order of time.

        Parameters
        ----------
        topics : collection of str
            Names of topics of the bag.
        start_ns : int, optional
            Leave out what was received before.

        Raises
        ------
        RecordingError
            If the bag is damaged from some message on, or closed.
        """
        if not self._is_open:
            raise RecordingError(f"{self.path} is closed: open it again to read it")
        chosen = [about for about in self._reader.connections if about.topic in topics]
        count = 0
        try:
            for about, received_ns, data in self._read(chosen, start_ns):
                yield about.topic, about.msgtype, received_ns, data
                count += 1
        except RecordingError:
            raise
        except Exception as error:  # see __init__
            raise self._unreadable(error, f"after {count} messages") from error

    def _read(
        self, chosen: list[Connection], start_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        if not chosen:  # which the readers would take for: all
            return
        for about, received_ns, data in self._reader.messages(chosen, start=start_ns):
            if data[:4] == _ZSTD:
                raise RecordingError(
                    f"the messages in {self.path} are compressed, as only the metadata.yaml beside"
                    f" it tells: open the folder, {self.path.parent}"
                )
            if self._ros1:
                data = bytes(self._typestore.ros1_to_cdr(data, about.msgtype))
            yield about, received_ns, data

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

    def _storage(self) -> Path:
        """Return the folder or file that the reader is to open."""
        path = self.path
        if not path.exists():
            raise RecordingError(f"{path} does not exist: check the path")
        if path.is_dir():
            return path if (path / "metadata.yaml").exists() else self._only_file(path)
        if path.suffix == ".zstd":
            raise RecordingError(f"{path} is compressed as a file: open its folder, {path.parent}")
        if path.suffix not in SUFFIXES:
            raise RecordingError(
                f"{path} is no recording known here: give a rosbag2 folder, or a file that ends in"
                f" {', '.join(SUFFIXES)}"
            )
        return path

    def _only_file(self, folder: Path) -> Path:
        """Return the only storage file of a folder that has no metadata."""
        files = sorted(file for file in folder.iterdir() if file.suffix in SUFFIXES)
        if not files:
            raise RecordingError(
                f"{folder} is no bag: it has neither a metadata.yaml nor a file that ends in"
                f" {', '.join(SUFFIXES)}"
            )
        if len(files) > 1:
            raise RecordingError(
                f"{folder} has no metadata.yaml but several files: rebuild it with"
                f" `ros2 bag reindex {folder}`, or open one of"
                f" {', '.join(file.name for file in files)}"
            )
        self.problems.append(
            f"{folder} has no metadata.yaml (was the recorder killed?); read {files[0].name} alone"
        )
        return files[0]

    def _unreadable(self, error: Exception, where: str = "") -> RecordingError:
        """Return what to say about whatever a reader raised."""
        reason = f"{error}".rstrip(".") or type(error).__name__
        place = f"{self.path} {where}".rstrip()
        if isinstance(error, OSError):  # the system's fault, not the file's
            return RecordingError(f"cannot read {place}: {reason}")
        inside = [self.path, *(self.path.iterdir() if self.path.is_dir() else ())]
        files = [file for file in inside if file.suffix in _REMEDIES]
        remedy = _REMEDIES[files[0].suffix].format(file=files[0]) if files else "record it again"
        return RecordingError(
            f"cannot read {place}: {reason}. If it is cut short or damaged: {remedy}"
        )
