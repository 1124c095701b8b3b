# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A database of rosbag2 page by page: cut anywhere, with damaged pages, or left open.

A message is a row of the table ``messages``, which is a cell in a leaf page and a chain of
overflow pages.  Rows are told by their shape, wherever they lie, whatever became of the tree above
them.  Pages in a write-ahead log beside it go before those of the database; a rollback journal is
not applied, since it would take whole messages away.  Source of the layout: SQLite's "Database
File Format".
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from ofsat_ros.recordings.salvage.wreck import Channel, Piece, Torn, Wreck, WreckError

_MAGIC = b"SQLite format 3\0"
_HEADER = 100  # bytes before the first page's own header
_PAGE_SIZES = [1 << power for power in range(9, 17)]
_LEAF, _LEAF_HEADER = 0x0D, 8  # a page with rows of a table
_LOG_MAGICS = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")
_LOG_HEADER, _FRAME_HEADER = 32, 24
# Types of values by their numbers; from 12 on, even ones are blobs and odd ones texts.
_NULL, _BLOB, _TEXT = 0, 12, 13
_SIZES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 7: 8, 8: 0, 9: 0}
_CONSTANTS = {8: 0, 9: 1}


class _Row(NamedTuple):
    """A cell: its key, the types of its values, where each begins, what lies in the page."""

    key: int
    types: list[int]
    begins: list[int]
    size: int
    local: bytes
    overflow: int

    def integer(self, column: int) -> int:
        """Return a value of a number's type, which lies in the page."""
        kind = self.types[column]
        value = self.local[self.begins[column] : self.begins[column] + _SIZES[kind]]
        return _CONSTANTS.get(kind, int.from_bytes(value, "big", signed=True))


class SqliteWreck(Wreck):
    """The rows of a database."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._frames: list[int] = []  # where pages are in the write-ahead log
        self._log_at: dict[int, int] = {}  # and the last version of each, by its number
        log = path.with_name(f"{path.name}-wal")
        self._log = log.open("rb") if log.exists() else None

    def close(self) -> None:
        """Close the files."""
        super().close()
        if self._log is not None:
            self._log.close()

    def scan(self) -> None:
        """Find channels, pieces and tears."""
        self._read_headers()
        found: dict[int, Piece | None] = {}
        for in_log, start in self._pages():
            page = self._read_page(in_log, start)
            for at in _cells(page):
                self._take_cell(page, (in_log, start, at), found)
        self.pieces = [piece for piece in found.values() if piece is not None]
        # A bag numbers its messages from 1 on.
        if lost := max(found, default=0) - len(self.pieces):
            self._note(f"messages that are not whole: {lost}")

    def read(self, place: tuple[int, ...]) -> bytes:
        """Return the bytes of the message at a place: (in the log, page's byte, byte in it)."""
        in_log, start, at = place
        row = self._row(self._read_page(in_log, start), at)
        return self._payload(row)[row.begins[3] :]

    def _read_headers(self) -> None:
        """Find the size of a page, and which pages are in the log."""
        self._page_size = _PAGE_SIZES[0]  # enough for the header
        if self._log is not None:
            self._read_log()
        head = self._page(1)[:_HEADER]
        if not head.startswith(_MAGIC) or len(head) < _HEADER:
            raise WreckError("it does not begin as an SQLite database")
        told = int.from_bytes(head[16:18], "big")
        self._page_size = 65536 if told == 1 else told
        if self._page_size not in _PAGE_SIZES:
            raise WreckError(f"its pages cannot have {told} bytes")
        self._usable = self._page_size - head[20]
        # No row is longer than all pages; garbage may tell so.
        self._bytes = self._size + len(self._log_at) * self._page_size
        size = int.from_bytes(head[28:32], "big") * self._page_size
        if self._size < size and not self._log_at:
            self._note(f"torn at byte {self._size} of {size}")

    def _read_log(self) -> None:
        """Find the pages in the write-ahead log, up to where an older log's begin."""
        assert self._log is not None
        head = self._log.read(_LOG_HEADER)
        size = int.from_bytes(head[8:12], "big")
        if not head.startswith(_LOG_MAGICS) or size not in _PAGE_SIZES:
            return
        self._page_size = size
        end, step = os.fstat(self._log.fileno()).st_size, _FRAME_HEADER + size
        for at in range(_LOG_HEADER, end - step + 1, step):
            self._log.seek(at)
            frame = self._log.read(_FRAME_HEADER)
            if frame[8:16] != head[16:24]:
                return
            self._frames.append(at + _FRAME_HEADER)
            self._log_at[int.from_bytes(frame[:4], "big")] = at + _FRAME_HEADER

    def _pages(self) -> Iterator[tuple[int, int]]:
        """Yield where all pages are: (in the log, byte).

        All versions of them, since a transaction in the log may have ended between a page and
        the one to which its rows went.
        """
        yield from ((0, start) for start in range(0, self._size, self._page_size))
        yield from ((1, start) for start in self._frames)

    def _read_page(self, in_log: int, start: int) -> bytes:
        """Return a page, or what there is of it."""
        file = self._log if in_log and self._log is not None else self._file
        file.seek(start)
        return file.read(self._page_size)

    def _page(self, number: int) -> bytes:
        """Return the last version of a page, or what there is of it."""
        if number in self._log_at:
            return self._read_page(1, self._log_at[number])
        return self._read_page(0, (number - 1) * self._page_size)

    def _take_cell(
        self, page: bytes, place: tuple[int, int, int], found: dict[int, Piece | None]
    ) -> None:
        """Take note of a cell if it is a message or a topic."""
        try:
            row = self._row(page, place[2])
            kinds = row.types
            if _is_message(kinds) and found.setdefault(row.key, None) is None:
                self._payload(row)
                found[row.key] = Piece(row.integer(2), row.integer(1), place)
            elif len(kinds) >= 4 and all(kind >= _TEXT and kind % 2 for kind in kinds[1:]):
                self._take_topic(row)
        except (Torn, UnicodeDecodeError):
            return  # a message that is not whole stays None

    def _take_topic(self, row: _Row) -> None:
        data = self._payload(row)
        parts = zip(row.begins[1:4], [*row.begins[2:], row.size], strict=False)
        topic, msgtype, encoding = (data[begin:end].decode() for begin, end in parts)
        if topic.startswith("/"):  # definitions of messages are as long a row of texts
            self.channels[row.key] = Channel(topic, msgtype, encoding)

    def _row(self, page: bytes, at: int) -> _Row:
        """Return the cell at a byte of a leaf page; Torn if none can be there."""
        size, at = _varint(page, at)
        key, at = _varint(page, at)
        local = page[at : at + self._local_size(size)]
        end = at + len(local)
        overflow = page[end : end + 4] if len(local) < size else b""
        types_end, begin = _varint(local, 0)
        types, begins, end = [], [], types_end
        while begin < types_end:
            kind, begin = _varint(local, begin)
            types.append(kind)
            begins.append(end)
            end += (kind - _BLOB) // 2 if kind >= _BLOB else _SIZES.get(kind, size)
        if end != size or len(local) < self._local_size(size) or size > self._bytes:
            raise Torn(at, "no row is here")
        return _Row(key, types, begins, size, local, int.from_bytes(overflow, "big"))

    def _local_size(self, size: int) -> int:
        """Return how much of a payload lies in the leaf page itself."""
        longest = self._usable - 35
        if size <= longest:
            return size
        least = (self._usable - 12) * 32 // 255 - 23
        local = least + (size - least) % (self._usable - 4)
        return local if local <= longest else least

    def _payload(self, row: _Row) -> bytes:
        """Return all of a row; Torn if its chain of pages is not whole."""
        parts, left, number = [row.local], row.size - len(row.local), row.overflow
        while left:
            page = self._page(number) if number else b""
            part = page[4 : min(self._usable, 4 + left)]
            left -= len(part)
            number = int.from_bytes(page[:4], "big")
            if not part or (left and len(page) < self._page_size):
                raise Torn(number, "the chain of pages ends")
            parts.append(part)
        if number and row.overflow:
            raise Torn(number, "the chain of pages goes on")
        return b"".join(parts)


def _is_message(kinds: list[int]) -> bool:
    """Tell whether values are: none (the key), two numbers, a blob."""
    return (
        len(kinds) == 4
        and kinds[0] == _NULL
        and all(0 < kind <= 9 and kind != 7 for kind in kinds[1:3])
        and kinds[3] >= _BLOB
        and kinds[3] % 2 == 0
    )


def _cells(page: bytes) -> Iterator[int]:
    """Yield where the cells of a leaf page begin; nothing of other pages."""
    first = _HEADER if page.startswith(_MAGIC) else 0
    if page[first : first + 1] != bytes([_LEAF]):
        return
    count = int.from_bytes(page[first + 3 : first + 5], "big")
    pointers = range(first + _LEAF_HEADER, first + _LEAF_HEADER + 2 * count, 2)
    if pointers.stop <= len(page):
        yield from (int.from_bytes(page[at : at + 2], "big") for at in pointers)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of 1 to 9 bytes, and where it ends."""
    value = 0
    for i, byte in enumerate(data[at : at + 9]):
        if i == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    raise Torn(at, "a number is cut")
