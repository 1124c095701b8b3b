# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The order of images in files, and when each was exposed: by their headers, or by a rate."""

from __future__ import annotations

import filecmp
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ofsat_ros.recordings.bag import RecordingError

NS = 1_000_000_000
# What a header or a stamp can hold: years 1970 to 2106.
LATEST_NS = 2**32 * NS

NO_START = (
    "nothing tells when it was recorded: its times count from 1970-01-01T00:00:00; --start gives"
    " them a begin, as in --start 2026-03-01T22:15:00Z"
)

_INSTANT = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[T ](?P<clock>\d\d:\d\d(:\d\d(\.\d*)?)?)"
    r"(?P<zone>Z|[+-]\d\d(:?\d\d)?)?"
)
_NAMES_SHOWN = 5
# Files of the same time that are compared with each other.
_MOST_COPIES = 5


@dataclass(frozen=True)
class Hints:
    """What the user says of the times, where files do not tell them.

    Attributes
    ----------
    fps : float or None
        Frames per second.
    exposure_s : float or None
        Length of an exposure.
    start_ns : int or None
        When the first exposure began, ns UTC.
    """

    fps: float | None = None
    exposure_s: float | None = None
    start_ns: int | None = None

    @property
    def first_ns(self) -> int | None:
        """Stamp of the first image: the middle of its exposure."""
        if self.start_ns is None:
            return None
        return self.start_ns + round((self.exposure_s or 0) * NS / 2)

    @property
    def given(self) -> str:
        """The options by which the user gave a begin or a rate, as in "--fps 2"."""
        start = "" if self.start_ns is None else "--start"
        rate = f"--fps {self.fps:g}" if self.fps else ""
        return " and ".join(filter(None, (start, rate)))


@dataclass(frozen=True)
class Shot:
    """One image in a file, before it is read.

    Attributes
    ----------
    file : Path
    place : tuple of int
        Where in the file, if it holds several.
    stamp_ns : int or None
        Middle of the exposure, as far as it is known, ns UTC.
    exposure_s : float or None
    reason : str
        Why it cannot be given; empty if nothing is known against it.
    """

    file: Path
    place: tuple[int, ...] = ()
    stamp_ns: int | None = None
    exposure_s: float | None = None
    reason: str = ""

    @property
    def name(self) -> str:
        """Its file's name, and its place there."""
        return f"{self.file.name}{list(self.place) if self.place else ''}"


def by_name(file: Path) -> tuple[list[list[str | int]], str]:
    """Return a key that sorts files as people do: picture 2 before picture 10."""
    parts = [re.split(r"(\d+)", name.lower()) for name in (*file.parent.parts, file.stem)]
    natural = [[int(p) if p.isdecimal() else p for p in name] for name in parts]
    return natural, file.suffix


def utc_ns(text: str) -> int:
    """Return ns UTC of an ISO 8601 date and time; without a time zone it is UTC.

    Raises
    ------
    ValueError
        If it is none, or not within the years that a stamp can hold.
    """
    found = _INSTANT.fullmatch(text.strip())
    if not found:
        raise ValueError(f"{text!r} is no date and time")
    try:  # of fractions, ns and no more
        instant = np.datetime64(f"{found['date']}T{found['clock'][:18].rstrip('.')}", "ns")
    except ValueError as error:
        raise ValueError(f"{text!r} is no date and time") from error
    ns = int(instant.astype(np.int64))
    if zone := (found["zone"] or "").removeprefix("Z").replace(":", ""):
        away_s = 3600 * int(zone[1:3]) + 60 * int(zone[3:] or 0)
        ns -= (-1 if zone[0] == "-" else 1) * away_s * NS
    if not ("1970" <= text.strip()[:4] < "2106" and 0 <= ns < LATEST_NS):
        raise ValueError(f"{text} is not within the years 1970 to 2105")
    return ns


def utc_text(ns: int) -> str:
    """Return ns UTC as `utc_ns` takes it."""
    return f"{np.datetime64(ns, 'ns')}".rstrip("0").rstrip(".") + "Z"


def in_order(
    shots: Iterable[Shot], path: Path, hints: Hints, uses_rate: bool = False
) -> tuple[list[Shot], list[str]]:
    """Return images in the order of time, each with a stamp or a reason, and what was odd.

    The headers' times count if each has its own.  Otherwise they are made from the rate that the
    user gives: the order is that of the names then, and, unless the user gives the begin too, the
    first time that is known stays where it is.  Copies of a file are left out.  With
    `uses_rate`, the rate is in use already, between the images of a file.

    Raises
    ------
    RecordingError
        If no image has a time and there is no rate.
    """
    listed = sorted(shots, key=lambda shot: (by_name(shot.file), shot.place))
    listed, problems = _without_copies(listed)
    fps = hints.fps
    if all(shot.reason for shot in listed):
        raise RecordingError(
            f"nothing in {path} can be read: {listed[0].name}: {listed[0].reason}"
        )
    timed = [shot for shot in listed if shot.stamp_ns is not None]
    untimed = [shot for shot in listed if shot.stamp_ns is None]
    same = len(timed) - len({shot.stamp_ns for shot in timed})
    lacking = any(not shot.reason for shot in untimed)
    if fps and (same or lacking):
        shots, assumed = _at_rate(listed, fps, hints.first_ns)
        return shots, problems + assumed
    if not any(not shot.reason for shot in timed):
        raise RecordingError(
            f"{path}: no header tells when the images were taken: give their rate, as in --fps 2"
        )
    if hints.given and not uses_rate:
        problems.append(f"the times are those of the headers, and not from {hints.given}")
    if same:
        first, second = _of_the_same_time(timed)
        problems.append(
            f"{same} images have the same time as another one, {second.name} that of"
            f" {first.name}: if it is the same exposure (solved, calibrated, stacked), keep one of"
            " them in the folder; if the headers' times are too coarse, give the rate, as in"
            " --fps 2"
        )
    why = "its header tells no time; --fps would give it one"
    lost = [replace(shot, reason=shot.reason or why) for shot in untimed]
    return sorted(timed, key=lambda shot: shot.stamp_ns or 0) + lost, problems


def _without_copies(listed: list[Shot]) -> tuple[list[Shot], list[str]]:
    """Leave out images with a time that are, byte by byte, in a file before, too."""
    same: dict[tuple[int, tuple[int, ...]], list[Shot]] = {}
    for shot in listed:
        if shot.stamp_ns is not None:
            same.setdefault((shot.stamp_ns, shot.place), []).append(shot)
    copies = {
        shot
        for shots in same.values()
        if len(shots) <= _MOST_COPIES  # more of them are of a clock that is too coarse
        for i, shot in enumerate(shots)
        if any(_are_alike(before.file, shot.file) for before in shots[:i])
    }
    if not copies:
        return listed, []
    files = dict.fromkeys(shot.file.name for shot in listed if shot in copies)
    kept = [shot for shot in listed if shot not in copies]
    return kept, [f"left out, as copies of other files: {names(list(files))}"]


def _are_alike(file: Path, other: Path) -> bool:
    try:
        return file.samefile(other) or filecmp.cmp(file, other, shallow=False)
    except OSError:
        return False


def _of_the_same_time(timed: list[Shot]) -> tuple[Shot, Shot]:
    """Return the first two images that have the same time."""
    before: dict[int | None, Shot] = {}
    for shot in timed:
        if shot.stamp_ns in before:
            return before[shot.stamp_ns], shot
        before[shot.stamp_ns] = shot
    raise AssertionError("all times differ")


def names(files: Sequence[str]) -> str:
    """List the first names, and say how many more there are."""
    more = len(files) - _NAMES_SHOWN
    return ", ".join(files[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _at_rate(listed: list[Shot], fps: float, begin_ns: int | None) -> tuple[list[Shot], list[str]]:
    known = [(i, shot.stamp_ns) for i, shot in enumerate(listed) if shot.stamp_ns is not None]
    first, first_ns = known[0] if known else (0, 0)
    start_ns = max(first_ns - round(first * NS / fps), 0) if begin_ns is None else begin_ns
    shots = [
        replace(shot, stamp_ns=start_ns + round(i * NS / fps)) for i, shot in enumerate(listed)
    ]
    if begin_ns is not None:
        return shots, []
    if not known:
        return shots, [NO_START]
    return shots, [
        f"the headers do not give every image its own time: times count from that of"
        f" {listed[first].name}, by --fps {fps:g}, in the order of names"
    ]
