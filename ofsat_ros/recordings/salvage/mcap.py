# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""MCAP from record to record: without footer and index, cut anywhere, with damaged chunks.

Every record tells its length, so one that is damaged inside costs itself only; where a length is
damaged the rest is found again at the next chunk.  Source of the layout: the MCAP format
specification, version 0.
"""

from __future__ import annotations

import re
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rosbags.rosbag2.storage_mcap import DECOMPRESSORS
from rosbags.typesys.msg import normalize_msgtype

from ofsat_ros.recordings.salvage.wreck import Channel, ChunkedWreck, Piece, Torn, WreckError

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 2, 3, 4, 5, 6
_LAST_KNOWN = 15
_HEAD = struct.Struct("<BQ")  # what a record is, and its length
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, time received, time published
_CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, size, checksum, length of a name
# Definitions are texts of some KB; a longer one is garbage that memory may not hold.
_MAX_DEFINITION = 1 << 24
# A chunk's beginning, as far as it is the same for all: what it is, and its compression's name.
_CHUNK_PATTERN = re.compile(
    rb"(?=(\x06.{36}(?:\x00\x00\x00\x00|\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)))", re.DOTALL
)
_BLOCK = 1 << 22
_OVERLAP = 64  # longer than the pattern


class _Chunk(NamedTuple):
    """What a chunk tells of itself; begin and length are those of its data in the file."""

    compression: str
    begin: int
    length: int
    size: int
    checksum: int


class McapWreck(ChunkedWreck):
    """The records of an MCAP file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._schemas: dict[int, str] = {}
        self._unresolved: dict[int, tuple[int, str, str]] = {}

    def scan(self) -> None:
        """Find channels, pieces and tears."""
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise WreckError("it does not begin as an MCAP file")
        at: int | None = len(_MAGIC)
        while at is not None:
            try:
                self._records(self._file, at, self._size, in_chunk=False)
                at = None
            except Torn as torn:
                self._note(f"torn at byte {torn.at} of {self._size} ({torn})")
                at = self._next_chunk(torn.at + 1)
        for key, (schema, topic, encoding) in self._unresolved.items():
            if schema in self._schemas:
                self.channels[key] = Channel(topic, self._schemas[schema], encoding)

    def _records(
        self, stream: BinaryIO, at: int, end: int, in_chunk: bool, chunk: tuple[int, ...] = ()
    ) -> None:
        """Take note of the records from a byte on, of the file or of what a chunk held.

        Raises Torn if they end before the end, or without a footer.
        """
        while not (in_chunk and at == end):
            stream.seek(at)
            if at + _HEAD.size > end:
                raise Torn(at, "it ends within a record" if at < end else "it has no end")
            kind, length = _HEAD.unpack(stream.read(_HEAD.size))
            body = at + _HEAD.size
            if kind == _FOOTER and not in_chunk:
                return
            if not 0 < kind <= _LAST_KNOWN:
                raise Torn(at, "what follows is no record")
            if kind == _CHUNK and not in_chunk:
                self._take_chunk(at, cut=body + length > end)
            if body + length > end:
                raise Torn(at, "it ends within a record")
            if kind == _MESSAGE:
                self._take_message(stream, body, length, chunk)
            elif kind in (_SCHEMA, _CHANNEL):
                self._take_definition(stream, at, kind, length)
            at = body + length

    def _take_message(
        self, stream: BinaryIO, body: int, length: int, chunk: tuple[int, ...]
    ) -> None:
        if length < _MESSAGE_HEAD.size:
            raise Torn(body - _HEAD.size, "a message is shorter than its head")
        channel, _, received_ns, _ = _MESSAGE_HEAD.unpack(stream.read(_MESSAGE_HEAD.size))
        place = (*chunk, body + _MESSAGE_HEAD.size, length - _MESSAGE_HEAD.size)
        self.pieces.append(Piece(received_ns, channel, place))

    def _take_definition(self, stream: BinaryIO, at: int, kind: int, length: int) -> None:
        if length > _MAX_DEFINITION:
            raise Torn(at, "what follows is no record")
        body = BytesIO(stream.read(length))
        try:
            if kind == _SCHEMA:
                (key,) = struct.unpack("<H", body.read(2))
                self._schemas[key] = normalize_msgtype(_text(body))
            else:
                key, schema = struct.unpack("<HH", body.read(4))
                self._unresolved[key] = schema, _text(body), _text(body)
        except (struct.error, UnicodeDecodeError, ValueError) as error:
            self._note(f"the definition at byte {at} is damaged ({error})")

    def _take_chunk(self, at: int, cut: bool) -> None:
        """Take note of the messages in a chunk; of one that is cut, if it is not compressed."""
        try:
            about = self._chunk_head(at)
            if about.compression:
                data = self._unpack(at)
                self._records(BytesIO(data), 0, len(data), in_chunk=True, chunk=(at,))
                return
            if not cut:
                _check(about, self._file.read(about.length))
            end = min(about.begin + about.length, self._size)
            self._records(self._file, about.begin, end, in_chunk=True)
        # Whatever a decompressor raises on damaged bytes.
        except Exception as error:  # noqa: BLE001
            if not cut:  # or it is said where the file is torn
                self._note(f"the chunk at byte {at} is damaged: {error}")

    def _chunk_head(self, at: int) -> _Chunk:
        """Return what the chunk at a byte tells of itself; its data is read next."""
        self._file.seek(at + _HEAD.size)
        _, _, size, checksum, name = _CHUNK_HEAD.unpack(self._file.read(_CHUNK_HEAD.size))
        compression = self._file.read(min(name, 4)).decode()  # "zstd" is the longest
        (length,) = struct.unpack("<Q", self._file.read(8))
        return _Chunk(compression, self._file.tell(), min(length, self._size), size, checksum)

    def _unpack(self, at: int) -> bytes:
        about = self._chunk_head(at)
        if about.compression not in DECOMPRESSORS:
            raise WreckError(f"its compression {about.compression!r} is unknown")
        unpacked = DECOMPRESSORS[about.compression](self._file.read(about.length), about.size)
        _check(about, unpacked)
        return unpacked

    def _next_chunk(self, at: int) -> int | None:
        """Return where the next whole chunk begins that tells the same length twice."""
        while at < self._size:
            self._file.seek(at)
            block = self._file.read(_BLOCK + _OVERLAP)
            for found in _CHUNK_PATTERN.finditer(block):
                begin = at + found.start()
                name = len(found[1]) - _HEAD.size - _CHUNK_HEAD.size
                length = int.from_bytes(found[1][1:9], "little")
                self._file.seek(begin + len(found[1]))
                (packed,) = struct.unpack("<Q", self._file.read(8).ljust(8, b"\0"))
                whole = length == _CHUNK_HEAD.size + name + 8 + packed
                if whole and begin + _HEAD.size + length <= self._size:
                    return begin
            at += _BLOCK
        return None


def _check(about: _Chunk, data: bytes) -> None:
    """Raise WreckError if a chunk does not hold what it tells."""
    if len(data) != about.size:
        raise WreckError(f"it holds {len(data)} bytes and tells of {about.size}")
    if about.checksum and zlib.crc32(data) != about.checksum:
        raise WreckError("its checksum is wrong")


def _text(body: BytesIO) -> str:
    (length,) = struct.unpack("<I", body.read(4))
    return body.read(length).decode()
