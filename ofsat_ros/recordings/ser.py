# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""SER files: raw frames of planetary cameras, with a time for each.

Layout: G. Hahn, H. Wilkens, "SER format description version 3" (2014): a header of 178 bytes, the
frames, and, optional, a time for each.  Its LittleEndian is 1 for little-endian pixels by the
description, and 0 by nearly all programs that write it; where the pixels tell, they decide.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ofsat_ros.images import EncodingError, decode_image, luminance
from ofsat_ros.recordings.bag import RecordingError, Topic
from ofsat_ros.recordings.recording import FRAME_ID, Attitude, Frame, Skipped
from ofsat_ros.recordings.timing import LATEST_NS, NO_START, NS, Hints

SUFFIXES = (".ser",)
MAGIC = b"LUCAM-RECORDER"

_HEADER = struct.Struct("<14s7i40s40s40s2q")
_BAYER = {8: "rggb", 9: "grbg", 10: "gbrg", 11: "bggr"}
# Cyan, yellow and magenta in the same pattern have no place in OpenCV: taken as luminance.
_SINGLE = (0, *_BAYER, 16, 17, 18, 19)
_ORDERS = {100: "rgb", 101: "bgr"}
# Times are in steps of 100 ns since 0001-01-01.
_TICKS_1970, _TICK_NS = 621_355_968_000_000_000, 100
# Days of video; more is no count.
_MOST_FRAMES = 10_000_000
# A clock's time zone is of whole quarters of an hour; recordings begin sooner after their headers.
_QUARTER_NS, _SOON_NS = 900 * NS, 300 * NS
# One order of bytes makes the image so much rougher that it is the wrong one.
_ROUGHER = 4.0


class SerSource:
    """A SER file as a `Source`.

    Attributes
    ----------
    first_ns : int
        Stamp of its first frame.
    """

    kind = "SER"
    topic = camera_info_topic = attitude_topic = ""
    last_attitudes: tuple[Attitude, ...] = ()

    def __init__(self, path: Path, hints: Hints) -> None:
        self.path, self._exposure_s = path, hints.exposure_s
        self.topics: dict[str, int] = {}
        self.contents: dict[str, Topic] = {}
        self.problems: list[str] = []
        try:
            size = path.stat().st_size
            self._file = path.open("rb")
        except OSError as error:
            raise RecordingError(f"cannot read {path}: {error}") from error
        try:
            self._read_header(size)
            self._stamps = self._times(size, hints)
            self.first_ns = self._stamps[0]
            self._order = self._byte_order()
        except RecordingError:
            self._file.close()
            raise

    def close(self) -> None:
        """See `Source`."""
        self._file.close()

    def frames(
        self, say: Callable[[str], None], first: int = 0
    ) -> Iterator[Frame | Skipped | None]:
        """See `Source`."""
        for number in range(self._whole):
            if number < first:
                yield None
                continue
            try:
                image = self._image(number)
            except EncodingError as error:
                yield Skipped(f"frame {number}", f"{error}")
                continue
            stamp_ns = self._stamps[number]
            yield Frame(image, stamp_ns, FRAME_ID, number, exposure_s=self._exposure_s)
        if self._whole < self.count:
            raise RecordingError(f"{self.path} is cut short after {self._whole} frames")

    def _read_header(self, size: int) -> None:
        head = self._file.read(_HEADER.size)
        if len(head) < _HEADER.size or head[: len(MAGIC)] != MAGIC:
            raise RecordingError(f"{self.path} is no SER file, or cut within its header")
        _, _, self._colour, self._flag, width, height, depth, count, *rest = _HEADER.unpack(head)
        self._local_ns, self._utc_ns = map(_ns, rest[-2:])
        self._bytes, planes = 1 if depth <= 8 else 2, 3 if self._colour in _ORDERS else 1
        known = self._colour in (*_SINGLE, *_ORDERS) and 0 < depth <= 16
        if not known or min(width, height) < 1 or max(width, height) > 1 << 20:
            raise RecordingError(
                f"{self.path}: its header makes no sense: {width} x {height} px of {depth} bits,"
                f" colour {self._colour}"
            )
        self._shape = (height, width, planes)
        self._size = width * height * planes * self._bytes
        there = (size - _HEADER.size) // self._size
        if not 0 < count <= _MOST_FRAMES:  # it is written at the end of a recording
            self.problems.append(
                f"{self.path} does not tell how many frames it has (was its program killed?): all"
                f" {there} that are whole are read"
            )
            count = there
        self.count, self._whole = count, min(count, there)
        if not self._whole:
            raise RecordingError(f"{self.path} holds no whole frame")
        if self._colour in (16, 17, 18, 19):
            self.problems.append("its colours, cyan, yellow and magenta, are taken as brightness")

    def _times(self, size: int, hints: Hints) -> list[int]:
        """Return a stamp for each frame that is whole: its own, or one made from the rate."""
        own: list[int] = []
        if size >= _HEADER.size + self.count * (self._size + 8):
            self._file.seek(_HEADER.size + self.count * self._size)
            ticks = np.frombuffer(self._file.read(8 * self.count), "<i8").tolist()
            own = [_ns(each) for each in ticks]
        told, fps = own and all(own), hints.fps
        if told:
            own = self._in_utc(own)
        if told and (not fps or len(set(own)) == self.count):
            self._say_of_times(own, hints)
            return own
        if not fps:
            raise RecordingError(
                f"{self.path} has no times of its frames: give their rate, as in --fps 20"
            )
        start_ns = hints.first_ns
        if start_ns is None:
            start_ns = self._start_ns(own[0] if told else 0, fps)
        return [start_ns + round(number * NS / fps) for number in range(self._whole)]

    def _start_ns(self, own_ns: int, fps: float) -> int:
        """Return what the file tells of its start; 0 if nothing."""
        start_ns = own_ns or self._utc_ns or self._local_ns
        words = NO_START
        if start_ns:
            words = (
                f"{self.path} has no time of its own for each frame: times count from its start,"
                f" by --fps {fps:g}"
            )
        if start_ns and not (own_ns or self._utc_ns):
            words += "; it is local time, taken for UTC: --start would give it"
        self.problems.append(words)
        return start_ns

    def _in_utc(self, own: list[int]) -> list[int]:
        """Return the frames' times in UTC: some programs write local ones, against the format."""
        zone_ns = self._local_ns - self._utc_ns
        zone_ns = round(zone_ns / _QUARTER_NS) * _QUARTER_NS
        known = self._local_ns and self._utc_ns and zone_ns
        if not known or abs(own[0] - zone_ns - self._utc_ns) > _SOON_NS:
            return own
        self.problems.append(
            f"{self.path} has its frames' times in local time, by its header {zone_ns / 3600e9:+g}"
            " h from UTC: they are turned to UTC"
        )
        return [each - zone_ns for each in own]

    def _say_of_times(self, own: list[int], hints: Hints) -> None:
        if hints.given:
            self.problems.append(f"the times are those of the file, and not from {hints.given}")
        if (same := self.count - len(set(own))) > 0:
            self.problems.append(
                f"{same} frames have the same time as another one: if the file's times are too"
                " coarse, give the rate, as in --fps 20"
            )
        self.problems.append(
            "stamps are the file's times, taken for the middle of the exposures: the format does"
            " not tell which part of it they are; stamp_reference and exposure_time_s would"
        )

    def _byte_order(self) -> str:
        """Return the order of bytes that makes the first image smooth, or else the flag's."""
        usual = ">" if self._flag else "<"
        if self._bytes == 1:
            return usual
        self._file.seek(_HEADER.size)
        first = np.frombuffer(self._file.read(self._size), "<u2").reshape(self._shape)
        rough = {
            order: _roughness(first.view(f"{order}u2"), 2 if self._colour in _BAYER else 1)
            for order in "<>"
        }
        other = ">" if usual == "<" else "<"
        if rough[usual] <= _ROUGHER * rough[other]:
            return usual
        self.problems.append(
            f"the header's byte order, {self._flag}, makes noise of the image: read with the other"
            f" one, as {'little' if other == '<' else 'big'}-endian"
        )
        return other

    def _image(self, number: int) -> np.ndarray:
        self._file.seek(_HEADER.size + number * self._size)
        data = self._file.read(self._size)
        height, width, _ = self._shape
        pattern = _BAYER.get(self._colour)
        if pattern:
            name, step = f"bayer_{pattern}{8 * self._bytes}", width * self._bytes
            return decode_image(data, name, width, height, step, self._order == ">")
        dtype = np.dtype(f"{self._order}u{self._bytes}")
        pixels = np.frombuffer(data, dtype).reshape(self._shape)
        native = pixels.astype(dtype.newbyteorder("="), copy=False)
        return luminance(native, _ORDERS.get(self._colour, "bgr"))


def _roughness(image: np.ndarray, apart: int) -> float:
    """Return the mean difference of neighbours, of the same colour."""
    values = image.astype(np.float32)
    across = np.abs(values[:, apart:] - values[:, :-apart])
    return float(across.mean()) if across.size else 0.0


def _ns(ticks: int) -> int:
    """Return ns UTC; 0 if the time makes no sense."""
    ns = (ticks - _TICKS_1970) * _TICK_NS
    return ns if 0 < ns < LATEST_NS else 0
