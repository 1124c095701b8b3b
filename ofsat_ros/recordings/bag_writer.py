# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Images and messages into a new rosbag2 folder."""

from __future__ import annotations

import re
import signal
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import TypesysError
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.images import EncodingError, decode_image, encode_png
from ofsat_ros.recordings.bag import (
    ATTITUDE,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    SUFFIXES,
    RecordingError,
    typestore,
)
from ofsat_ros.recordings.messages import header_message, message_type, serialized

_STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
_COMPRESSIONS = {
    "none": CompressionMode.NONE,
    "message": CompressionMode.MESSAGE,
    "file": CompressionMode.FILE,
    "chunk": CompressionMode.STORAGE,
}
_FLUSH_EVERY_S = 1.0
# Names of files of messages, of those that lie beside an open database, and of half-made ones.
_STORED = re.compile(
    rf"({'|'.join(map(re.escape, SUFFIXES))})(-journal|-wal|-shm|\.zstd(\.tmp)?)?$"
)
# What image publishers offer: any subscriber can have it, and nothing is kept for late ones.
_FOREVER = QosTime(9223372036, 854775807)
_QOS = Qos(
    QosHistory.KEEP_LAST,
    10,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


class BagWriter:
    """Writes a rosbag2 folder; a context manager.

    The bag is closed, and so is readable, also when an exception or Ctrl-C ends the ``with``; no
    message is cut by it.  If the process is killed, all but the messages of the last second can
    still be read.

    Parameters
    ----------
    path : str or Path
        Folder to make.
    storage : {"mcap", "sqlite3"}
    compression : {"none", "message", "file", "chunk"}
        What zstd compresses; chunk is for MCAP only.
    force : bool
        Replace a bag that exists at `path`; anything else there is never removed.

    Raises
    ------
    RecordingError
        If something exists at `path`, or it cannot be made, or an argument is not one of these.
    """

    def __init__(
        self,
        path: str | Path,
        storage: str = "mcap",
        compression: str = "none",
        force: bool = False,
    ) -> None:
        self.path = Path(path)
        plugin = _pick(storage, _STORAGES, "storage")
        mode = _pick(compression, _COMPRESSIONS, "compression")
        if (storage, compression) == ("sqlite3", "chunk"):
            raise RecordingError(
                "only mcap is compressed by chunk: use message or file for sqlite3"
            )
        if self.path.exists() or self.path.is_symlink():
            if not force:
                raise RecordingError(
                    f"{path} exists: choose another path, or --force (force=True) to replace it"
                )
            remove_bag(self.path)
        self._connections: dict[str, Connection] = {}
        self._flushed_s = time.monotonic()
        typestore()  # which takes a while, and Ctrl-C might come
        try:
            with _uninterrupted():
                self._writer: Writer | None = Writer(self.path, version=9, storage_plugin=plugin)
                self._writer.set_compression(mode, CompressionFormat.ZSTD)
                self._writer.open()
        except (OSError, sqlite3.Error, WriterError) as error:
            raise RecordingError(f"cannot write {self.path}: {_reason(error)}") from error
        except KeyboardInterrupt:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Finish the files; a second call does nothing."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
        except (OSError, sqlite3.Error) as error:
            with suppress(Exception):  # it says the same again
                writer.abort()
            raise RecordingError(f"cannot finish {self.path}: {_reason(error)}") from error

    def write(self, topic: str, msgtype: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Write a serialized message.

        Parameters
        ----------
        topic : str
        msgtype : str
            As ``sensor_msgs/msg/Image``; the same for every message of a topic.
        data : bytes or memoryview
            CDR, as received.
        stamp_ns : int
            Time at which it was received, ns.

        Raises
        ------
        RecordingError
            If the type is unknown or not the topic's, or the bag is closed, or the disk is full.
        """
        if self._writer is None:
            raise RecordingError(f"{self.path} is closed: nothing more can be written to it")
        if not 0 <= stamp_ns < 2**63:  # or the index could not be written at the end
            raise RecordingError(f"{topic}: a bag cannot hold the time {stamp_ns} ns")
        try:
            connection = self._connections.get(topic)
            if connection is None:
                connection = self._writer.add_connection(
                    topic, msgtype, typestore=typestore(), offered_qos_profiles=[_QOS]
                )
                self._connections[topic] = connection
            if connection.msgtype != msgtype:
                raise RecordingError(f"{topic} holds {connection.msgtype}, not {msgtype}")
            with _uninterrupted():
                self._writer.write(connection, int(stamp_ns), data)
                self._flush()
        except TypesysError as error:
            raise RecordingError(f"{msgtype} is no message type known here: {error}") from error
        except (OSError, sqlite3.Error) as error:
            raise RecordingError(f"cannot write {self.path}: {_reason(error)}") from error

    def _flush(self) -> None:
        """Have the file hold what was written; not at each message, which would be slow."""
        now_s = time.monotonic()
        if now_s - self._flushed_s < _FLUSH_EVERY_S or self._writer is None:
            return
        self._flushed_s = now_s
        storage = self._writer.storage
        if isinstance(storage, McapWriter):
            storage.close_chunk()
            storage.bio.flush()
        elif isinstance(storage, Sqlite3Writer):
            storage.conn.commit()

    def write_image(
        self,
        topic: str,
        image: np.ndarray,
        stamp_ns: int,
        frame_id: str,
        encoding: str | None = None,
        compressed: bool = False,
    ) -> None:
        """Write an image.

        Parameters
        ----------
        topic : str
        image : ndarray, shape (height, width) or (height, width, 3)
            uint8, uint16 or float32; three channels are uint8 blue, green, red.
        stamp_ns : int
            Stamp of the header, and time received, ns.
        frame_id : str
            Coordinate frame.
        encoding : str, optional
            Name of the encoding if it is not mono8, mono16, 32FC1 or bgr8.
        compressed : bool
            Write PNG in a CompressedImage.

        Raises
        ------
        RecordingError
            As `write`, or if no encoding fits the array.
        """
        name = encoding or _encoding_of(image)
        fields = _png_fields(image, name) if compressed else _raw_fields(image, name)
        msgtype = COMPRESSED_IMAGE if compressed else IMAGE
        self._write_stamped(topic, msgtype, stamp_ns, frame_id, fields)

    def write_camera_info(self, topic: str, camera: Camera, stamp_ns: int, frame_id: str) -> None:
        """Write a camera's calibration as sensor_msgs/CameraInfo; raises as `write_image`."""
        k = camera.matrix
        fields = {
            "width": camera.width,
            "height": camera.height,
            "distortion_model": camera.model,
            "d": np.array(camera.distortion, float),
            "k": k.ravel(),
            "r": np.eye(3).ravel(),
            "p": np.column_stack([k, np.zeros(3)]).ravel(),
        }
        self._write_stamped(topic, CAMERA_INFO, stamp_ns, frame_id, fields)

    def write_attitude(self, topic: str, attitude: Rotation, stamp_ns: int, frame_id: str) -> None:
        """Write the rotation ICRS -> optical frame; raises as `write_image`."""
        x, y, z, w = attitude.as_quat().tolist()
        quaternion = message_type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
        self._write_stamped(topic, ATTITUDE, stamp_ns, frame_id, {"quaternion": quaternion})

    def write_message(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Write a message of a `message_type` at a time, ns; raises as `write`."""
        self.write(topic, message.__msgtype__, serialized(message), stamp_ns)

    def _write_stamped(
        self, topic: str, msgtype: str, stamp_ns: int, frame_id: str, fields: dict[str, Any]
    ) -> None:
        """Write a message with a header, at the time of its stamp."""
        header = header_message(stamp_ns, frame_id)
        self.write_message(topic, message_type(msgtype)(header=header, **fields), stamp_ns)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Have Ctrl-C wait: half a message would spoil those around it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # where Ctrl-C never comes
        return
    came: list[int] = []
    # SIGTERM and the end of the terminal, too, where they do what Ctrl-C does.
    usual = {
        number: signal.signal(number, lambda number, _: came.append(number))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is signal.default_int_handler
    }
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


def _reason(error: Exception) -> str:
    """Return what an error says, without numbers of the operating system."""
    return f"{getattr(error, 'strerror', None) or error}"


def _pick(word: str, known: dict[str, Any], what: str) -> Any:
    if word not in known:
        raise RecordingError(f"{what} must be one of {', '.join(known)}, not {word!r}")
    return known[word]


def remove_bag(path: Path) -> None:
    """Remove a bag's folder, and never anything else; raises as `check_bag`."""
    for file in check_bag(path):
        file.unlink()
    path.rmdir()


def check_bag(path: Path) -> list[Path]:
    """Return the files of a bag's folder, one that its recorder did not finish included.

    Raises
    ------
    RecordingError
        If it is no bag, or holds something beside it.
    """
    is_folder = path.is_dir() and not path.is_symlink()
    inside = sorted(path.iterdir()) if is_folder else []
    foreign = [file.name for file in inside if not _is_of_bag(file)]
    # What was not finished is known by its name: the folder's own.
    known = (path / "metadata.yaml").exists() or all(
        file.name.startswith((f"{path.name}.", "metadata.")) for file in inside
    )
    if not is_folder or not known or foreign:
        why = f"it also holds {', '.join(foreign)}" if known and foreign else "it is no bag"
        raise RecordingError(f"{path} is not replaced, since {why}: remove it yourself")
    return inside


def _is_of_bag(path: Path) -> bool:
    return path.is_file() and (
        path.name in ("metadata.yaml", "metadata.yaml.tmp") or bool(_STORED.search(path.name))
    )


def _encoding_of(image: np.ndarray) -> str:
    name = {
        (2, "uint8"): "mono8",
        (2, "uint16"): "mono16",
        (2, "float32"): "32FC1",
        (3, "uint8"): "bgr8",
    }.get((image.ndim, image.dtype.name))
    if name is None or 0 in image.shape or image.shape[2:] not in ((), (3,)):
        raise RecordingError(f"no encoding for an {image.dtype} image of shape {image.shape}")
    return name


def _raw_fields(image: np.ndarray, encoding: str) -> dict[str, Any]:
    """Return the fields of an Image, all but the header."""
    pixels = np.ascontiguousarray(image, image.dtype.newbyteorder("<"))
    fields = {
        "height": image.shape[0],
        "width": image.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": pixels.reshape(-1).view(np.uint8),
    }
    try:
        holds = decode_image(**fields).dtype
    except EncodingError as error:
        raise RecordingError(f"{image.dtype} image of shape {image.shape}: {error}") from error
    if holds.name != image.dtype.name:
        raise RecordingError(f"{encoding} does not hold {image.dtype} pixels")
    return fields


def _png_fields(image: np.ndarray, encoding: str) -> dict[str, Any]:
    """Return the fields of a CompressedImage, all but the header."""
    try:
        png = encode_png(image)
    except EncodingError as error:
        raise RecordingError(f"{error}") from error
    # As image_transport's PNG publisher fills the field.
    return {"format": f"{encoding}; png compressed ", "data": np.frombuffer(png, np.uint8)}
