"""The order of images in files, and when each was exposed: by their headers, or by a rate."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from ofsat_ros.recordings.bag import RecordingError

NS = 1_000_000_000
# What a header or a stamp can hold: years 1970 to 2106.
LATEST_NS = 2**32 * NS

NO_START = "nothing tells when it was recorded: its times count from 1970-01-01T00:00:00"


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


def natural(name: str) -> list[str | int]:
    """Return a key that sorts names as people do: picture 2 before picture 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name.lower())]


def in_order(shots: Iterable[Shot], path: Path, fps: float | None) -> tuple[list[Shot], list[str]]:
    """Return images in the order of time, each with a stamp or a reason, and what was odd.

    The headers' times count if each has its own.  Otherwise they are made from `fps`: the order
    is that of the names then, and the first time that is known stays where it is.

    Raises
    ------
    RecordingError
        If no image has a time and there is no `fps`.
    """
    listed = sorted(shots, key=lambda shot: (natural(shot.file.name), shot.place))
    if all(shot.reason for shot in listed):
        raise RecordingError(
            f"nothing in {path} can be read: {listed[0].name}: {listed[0].reason}"
        )
    timed = [shot for shot in listed if shot.stamp_ns is not None]
    untimed = [shot for shot in listed if shot.stamp_ns is None]
    same = len(timed) - len({shot.stamp_ns for shot in timed})
    lacking = any(not shot.reason for shot in untimed)
    if fps and (same or lacking):
        return _at_rate(listed, fps)
    if not any(not shot.reason for shot in timed):
        raise RecordingError(
            f"{path}: no header tells when the images were taken: give their rate, as in --fps 2"
        )
    problems = [f"the times are those of the headers, and not from --fps {fps:g}"] if fps else []
    if same:
        problems.append(
            f"{same} images have the same time as another one: if the headers' times are too"
            " coarse, give the rate, as in --fps 2"
        )
    why = "its header tells no time; --fps would give it one"
    lost = [replace(shot, reason=shot.reason or why) for shot in untimed]
    return sorted(timed, key=lambda shot: shot.stamp_ns or 0) + lost, problems


def _at_rate(listed: list[Shot], fps: float) -> tuple[list[Shot], list[str]]:
    known = [(i, shot.stamp_ns) for i, shot in enumerate(listed) if shot.stamp_ns is not None]
    first, first_ns = known[0] if known else (0, 0)
    start_ns = max(first_ns - round(first * NS / fps), 0)
    shots = [
        replace(shot, stamp_ns=start_ns + round(i * NS / fps)) for i, shot in enumerate(listed)
    ]
    if not known:
        return shots, [NO_START]
    return shots, [
        f"the headers do not give every image its own time: times count from that of"
        f" {listed[first].name}, by --fps {fps:g}, in the order of names"
    ]
