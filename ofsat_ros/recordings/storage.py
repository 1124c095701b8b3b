# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""One file of a bag: read by its library, and where that fails, salvaged."""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from errno import EDQUOT, EFBIG, ENOSPC
from pathlib import Path
from shutil import copyfileobj
from typing import Any

from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader

from ofsat_ros.recordings.held import temporary_folder
from ofsat_ros.recordings.salvage import Channel, Salvage, WreckError

SUFFIXES = (".mcap", ".db3", ".bag")

_BLOCK = 1 << 16
_LOG_HEADER = 32
_JOURNAL_MAGIC = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"  # of a journal whose transaction is under way

# Python has it from 3.14 on; until then it comes with rosbags.
zstd: Any = importlib.import_module(
    "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
)


def suffix_of(path: Path) -> str:
    """Return the suffix of the storage that a file is by its name; empty if it is none.

    A file may also be compressed as a whole, or be what a recorder of ROS 1 was still writing.
    """
    suffix = path.with_suffix("").suffix if path.suffix in (".zstd", ".active") else path.suffix
    return suffix if suffix in SUFFIXES else ""


class Storage:
    """The messages of one file.

    Parameters
    ----------
    path : Path
        A file that `suffix_of` knows.
    problems : list of str
        Where to add what is not whole, at opening and while reading.

    Attributes
    ----------
    channels : list of (Channel, int)
        What messages belong to, and how many each has.
    start_ns : int or None
        Time at which the first was received, ns; None if there is none.

    Raises
    ------
    WreckError
        If it is not what its name says.
    OSError
        If it cannot be read.
    """

    def __init__(self, path: Path, problems: list[str]) -> None:
        self._path, self._problems = path, problems
        self._source: _Library | Salvage
        with ExitStack() as folder:
            self._file = path
            if path.suffix == ".zstd":
                self._file = self._unpacked(folder.enter_context(temporary_folder()))
            self._source = self._open()
            self._folder = folder.pop_all()
        self.channels, self.start_ns = self._source.channels, self._source.start_ns

    def close(self) -> None:
        """Close the files, remove what was unpacked."""
        with self._folder:
            self._source.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield (channel, time received in ns, bytes) in the order of time.

        Where the library fails in the middle, what is whole after it is given, too.

        Parameters
        ----------
        topics : collection of str
        start_ns : int or None
            Leave out what was received before.
        """
        given: Counter[tuple[str, int]] = Counter()
        try:
            for channel, received_ns, data in self._source.messages(topics, start_ns):
                yield channel, received_ns, data
                given[channel.topic, received_ns] += 1
            self._expect(topics, given.total(), start_ns)
            return
        except Exception as error:
            if isinstance(self._source, Salvage):
                raise
            salvage = self._salvage(error)
            self._source.close()
            self._source = salvage
        for channel, received_ns, data in self._source.messages(topics, start_ns):
            if given[channel.topic, received_ns]:
                given[channel.topic, received_ns] -= 1
            else:
                yield channel, received_ns, data

    def _expect(self, topics: Collection[str], count: int, start_ns: int | None) -> None:
        """Raise WreckError if the library gave less than the file's index tells of."""
        told = sum(number for channel, number in self.channels if channel.topic in topics)
        if isinstance(self._source, _Library) and start_ns is None and count < told:
            raise WreckError(f"its index finds {count} of {told} messages")

    def _open(self) -> _Library | Salvage:
        if beside := _left_open(self._file):
            return self._salvage(f"{beside} is beside it: its recorder did not end")
        try:
            return _Library(self._file)
        # A damaged file makes the readers raise nearly anything: their own errors, those of
        # the database and of the decompressor, struct, assertion and key errors.
        except Exception as error:  # noqa: BLE001
            return self._salvage(error)

    def _salvage(self, why: Exception | str) -> Salvage:
        """Read without the library; say why, and what is lost."""
        found = Salvage(self._file, suffix_of(self._path))
        reason = f"{why}".rstrip(".") or type(why).__name__
        if found.tears:
            what = f"is not whole ({reason}): {'; '.join(found.tears)}. Whole messages in it:"
        else:
            what = f"is read without its index ({reason}). Messages in it, which seem to be all:"
        self._problems.append(f"{self._path.name} {what} {found.count}")
        return found

    def _unpacked(self, folder: Path) -> Path:
        """Return where the file is without its compression, as far as that is whole."""
        target = folder / self._path.stem
        torn = ""
        try:
            # Block by block: a small file may hold much.
            with zstd.open(self._path) as packed, target.open("wb") as file:
                copyfileobj(packed, file, _BLOCK)
        except EOFError:
            torn = "it ends too early"
        except zstd.ZstdError as error:
            torn = f"{error}"
        except OSError as error:
            if error.errno not in (ENOSPC, EDQUOT, EFBIG):
                raise
            raise OSError(
                error.errno,
                f"there is no room in {folder.parent} to unpack it: set TMPDIR to a folder with"
                " more of it",
            ) from error
        if torn:
            self._problems.append(f"{self._path.name} could not be unpacked to its end: {torn}")
        return target


class _Library:
    """A whole file, read by rosbags."""

    def __init__(self, path: Path) -> None:
        ros1 = suffix_of(path) == ".bag"
        self._reader = Rosbag1Reader(path) if ros1 else Rosbag2Reader(path)
        self._reader.open()
        self._channels = {
            about.id: Channel(
                about.topic,
                about.msgtype,
                "ros1" if ros1 else getattr(about.ext, "serialization_format", "cdr"),
            )
            for about in self._reader.connections
        }
        self.channels = [
            (self._channels[about.id], about.msgcount) for about in self._reader.connections
        ]
        filled = any(count for _, count in self.channels)
        self.start_ns = int(self._reader.start_time) if filled else None

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """See `Storage`."""
        chosen = [about for about in self._reader.connections if about.topic in topics]
        if chosen:  # the reader takes none for all
            for about, received_ns, data in self._reader.messages(chosen, start=start_ns):
                yield self._channels[about.id], received_ns, data


def _left_open(file: Path) -> str:
    """Return the name of what lies beside a database that was not closed; empty if nothing."""
    log = file.with_name(f"{file.name}-wal")
    if log.exists() and log.stat().st_size > _LOG_HEADER:
        return log.name
    journal = file.with_name(f"{file.name}-journal")
    if journal.exists():
        with journal.open("rb") as opened:
            if opened.read(len(_JOURNAL_MAGIC)) == _JOURNAL_MAGIC:
                return journal.name
    return ""
