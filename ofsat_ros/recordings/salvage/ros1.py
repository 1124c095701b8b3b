# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A ROS 1 bag from record to record: not indexed, cut anywhere, with damaged chunks.

Source of the layout: the rosbag format, version 2.0.
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import BinaryIO

from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1.reader import Header, RecordType, decompressors, normalize
from rosbags.typesys.msg import normalize_msgtype

from ofsat_ros.recordings.salvage.wreck import Channel, ChunkedWreck, Piece, Torn, WreckError

_MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
# A header holds a few fields; a message's definition, with all that it names, some KB.
_MAX_HEADER, _MAX_DEFINITION = 1 << 20, 1 << 24


class Ros1Wreck(ChunkedWreck):
    """The records of a ROS 1 bag."""

    def scan(self) -> None:
        """Find channels, pieces and tears."""
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise WreckError("it does not begin as a ROS 1 bag")
        try:
            self._records(self._file, len(_MAGIC), self._size, in_chunk=False)
        except Torn as torn:
            self._note(f"torn at byte {torn.at} of {self._size} ({torn})")

    def _records(
        self, stream: BinaryIO, at: int, end: int, in_chunk: bool, chunk: tuple[int, ...] = ()
    ) -> None:
        """Take note of the records from a byte on, of the file or of what a chunk held.

        Raises Torn if they end before the end.
        """
        while at < end:
            stream.seek(at)
            header, body, length = _head_of(stream, at, end)
            kind = header.get_uint8("op")
            if kind == RecordType.CHUNK and not in_chunk:
                self._take_chunk(at, header, body, length)
            if body + length > end:
                raise Torn(at, "it ends within a record")
            if kind == RecordType.MSGDATA:
                self._take_message(at, header, (*chunk, body, length))
            elif kind == RecordType.CONNECTION:
                self._take_connection(at, header, stream, length)
            at = body + length

    def _take_message(self, at: int, header: Header, place: tuple[int, ...]) -> None:
        try:
            piece = Piece(header.get_time("time"), header.get_uint32("conn"), place)
        except ReaderError as error:
            self._note(f"the message at byte {at} is damaged: {error}")
        else:
            self.pieces.append(piece)

    def _take_connection(self, at: int, header: Header, stream: BinaryIO, length: int) -> None:
        """Take note of a connection, whose fields are a header within the record's data."""
        fields = _LENGTH.pack(length) + stream.read(min(length, _MAX_DEFINITION))
        try:
            about = Header.read(BytesIO(fields))
            msgtype = normalize_msgtype(about.get_string("type"))
            topic = normalize(header.get_string("topic"))
            self.channels[header.get_uint32("conn")] = Channel(topic, msgtype, "ros1")
        # The library's own errors, and those of Python on damaged bytes.
        except Exception as error:  # noqa: BLE001
            self._note(f"the connection at byte {at} is damaged: {error}")

    def _take_chunk(self, at: int, header: Header, body: int, length: int) -> None:
        """Take note of the messages in a chunk; of one that is cut, if it is not compressed."""
        end = min(body + length, self._size)
        cut = body + length > self._size
        try:
            if header.get("compression") == b"none":
                self._records(self._file, body, end, in_chunk=True)
            elif not cut:
                data = self._unpack(at)
                self._records(BytesIO(data), 0, len(data), in_chunk=True, chunk=(at,))
        # Whatever a decompressor raises on damaged bytes.
        except Exception as error:  # noqa: BLE001
            if not cut:  # or it is said where the file is torn
                self._note(f"the chunk at byte {at} is damaged: {error}")

    def _unpack(self, at: int) -> bytes:
        self._file.seek(at)
        header, _, length = _head_of(self._file, at, self._size)
        compression = header.get_string("compression")
        if compression not in decompressors:
            raise WreckError(f"its compression {compression!r} is unknown")
        return decompressors[compression](self._file.read(length))


def _head_of(stream: BinaryIO, at: int, end: int) -> tuple[Header, int, int]:
    """Return the header of the record at a byte, and where its data begins and how long it is."""
    raw = stream.read(_LENGTH.size)
    if len(raw) < _LENGTH.size:
        raise Torn(at, "it ends within a record")
    if at + _LENGTH.unpack(raw)[0] + 2 * _LENGTH.size > end:
        raise Torn(at, "it ends within a record")
    if _LENGTH.unpack(raw)[0] > _MAX_HEADER:
        raise Torn(at, "what follows is no record")
    stream.seek(at)
    try:
        header = Header.read(stream)
        header.get_uint8("op")
    except Exception as error:  # the library's own, and those of Python on damaged bytes
        raise Torn(at, f"what follows is no record: {error}") from error
    (length,) = _LENGTH.unpack(stream.read(_LENGTH.size))
    return header, stream.tell(), length
