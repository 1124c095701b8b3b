# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the salvage of every storage has in common."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

_TEARS_KEPT = 5


class WreckError(Exception):
    """A file is not what its name says, or ends before anything that could be read."""


class Torn(Exception):  # noqa: N818 (it never leaves the salvage)
    """From a byte on there are no records."""

    def __init__(self, at: int, why: str) -> None:
        super().__init__(why)
        self.at = at


@dataclass(frozen=True)
class Channel:
    """What a message belongs to.

    Attributes
    ----------
    topic : str
    msgtype : str
        As ``sensor_msgs/msg/Image``.
    encoding : str
        "cdr", or "ros1" for messages as ROS 1 serializes them.
    """

    topic: str
    msgtype: str
    encoding: str


class Piece(NamedTuple):
    """A whole message: when it was received, ns; the key of its channel; where it is."""

    received_ns: int
    channel: int
    place: tuple[int, ...]


class Wreck:
    """A file to be salvaged; a storage's subclass finds its messages with ``scan``."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._size = os.fstat(self._file.fileno()).st_size
        self.channels: dict[int, Channel] = {}
        self.pieces: list[Piece] = []
        self.tears: list[str] = []

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def scan(self) -> None:
        """Find channels, pieces and tears."""
        raise NotImplementedError

    def read(self, place: tuple[int, ...]) -> bytes:
        """Return the bytes of the message at a place."""
        raise NotImplementedError

    def _note(self, what: str) -> None:
        """Take note of something that is not whole."""
        if len(self.tears) < _TEARS_KEPT:
            self.tears.append(what.rstrip("."))
        elif len(self.tears) == _TEARS_KEPT:
            self.tears.append("and so on")


class ChunkedWreck(Wreck):
    """A file of records, many of them in chunks that may be compressed.

    The place of a message is (byte, length) in the file, or (chunk, byte, length) in the chunk
    that begins at the byte ``chunk``.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._chunk_at, self._chunk = -1, b""

    def read(self, place: tuple[int, ...]) -> bytes:
        """Return the bytes of the message at a place."""
        *chunk, at, length = place
        if not chunk:
            self._file.seek(at)
            return self._file.read(length)
        if self._chunk_at != chunk[0]:  # messages of a chunk mostly follow each other
            self._chunk_at, self._chunk = chunk[0], self._unpack(chunk[0])
        return self._chunk[at : at + length]

    def _unpack(self, at: int) -> bytes:
        """Return what is in the chunk at a byte."""
        raise NotImplementedError
