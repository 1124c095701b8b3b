# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What is whole in a file of a bag that its library cannot read: torn, half written, damaged.

It stands beside the libraries' readers, and is slower: ``Salvage`` looks through the whole file at
opening, from record to record, whatever its index says.  A module a storage finds the messages,
and reads one by its place.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from ofsat_ros.recordings.salvage.mcap import McapWreck
from ofsat_ros.recordings.salvage.ros1 import Ros1Wreck
from ofsat_ros.recordings.salvage.sqlite import SqliteWreck
from ofsat_ros.recordings.salvage.wreck import Channel, WreckError

__all__ = ["Channel", "Salvage", "WreckError"]

_WRECKS = {".mcap": McapWreck, ".db3": SqliteWreck, ".bag": Ros1Wreck}


class Salvage:
    """The messages of a file that are whole.

    Parameters
    ----------
    path : Path
    suffix : str
        Which storage it is: one of .mcap, .db3, .bag.

    Attributes
    ----------
    channels : list of (Channel, int)
        What messages belong to, and how many of each are whole.
    count : int
        How many messages are whole.
    start_ns : int or None
        Time at which the first of them was received, ns; None if there is none.
    tears : list of str
        What is not whole, and where; the first ones.

    Raises
    ------
    WreckError
        If it is no such file.
    OSError
        If it cannot be read.
    """

    def __init__(self, path: Path, suffix: str) -> None:
        self._wreck = _WRECKS[suffix](path)
        try:
            self._wreck.scan()
        except BaseException:
            self._wreck.close()
            raise
        known = self._wreck.channels
        self._pieces = sorted(
            (piece for piece in self._wreck.pieces if piece.channel in known),
            key=lambda piece: piece.received_ns,
        )
        counts = dict.fromkeys(known, 0)
        for piece in self._pieces:
            counts[piece.channel] += 1
        self.channels = [(about, counts[key]) for key, about in known.items()]
        self.count = len(self._pieces)
        self.start_ns = self._pieces[0].received_ns if self._pieces else None
        self.tears = self._wreck.tears
        if nameless := len(self._wreck.pieces) - self.count:
            self.tears.append(f"messages whose topic is not in it: {nameless}")

    def close(self) -> None:
        """Close the file."""
        self._wreck.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield (channel, time received in ns, bytes) in the order of time.

        Parameters
        ----------
        topics : collection of str
        start_ns : int, optional
            Leave out what was received before.

        Raises
        ------
        WreckError
            If the file has changed since it was opened.
        """
        for received_ns, channel, place in self._pieces:
            about = self._wreck.channels[channel]
            if about.topic in topics and (start_ns is None or received_ns >= start_ns):
                yield about, received_ns, self._read(place)

    def _read(self, place: tuple[int, ...]) -> bytes:
        try:
            return self._wreck.read(place)
        except OSError:
            raise
        except Exception as error:  # of the decompressor, and those of Python on damaged bytes
            raise WreckError(f"it has changed while it was read: {error}") from error
