# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a watcher has heard of tracks and health, as lines of text for a terminal.

``watch`` tells it what comes, and shows its `Board.lines`.  It imports no ROS.
"""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import click
import numpy as np

from ofsat_ros.printing import printable
from ofsat_ros.tracking import COASTING

# Tracks that have ended; older ones are forgotten.
_MOST_ENDED = 100
# s; nodes say how they are once a second.
_SILENCE_S = 3.0
# Without a new frame for so many times that of the last ones, what is shown is of the past.
_INTERVALS = 4
# What comes after the node in the name of a status of ours, besides the detector's own.
_DETECTION, _BESIDE = "detection", ("guidance", "tracking data", "recording")


@dataclass
class _Line:
    """A track: its row of TRACK_DTYPE, and the stamp of the frame it was last seen in, ns."""

    row: np.void
    seen_ns: int


@dataclass(frozen=True)
class _Status:
    """What a node said of itself, and when it was heard, s."""

    warns: bool
    message: str
    values: Mapping[str, str]
    heard_s: float


class Board:
    """Tracks and health, as last heard.

    Parameters
    ----------
    topic : str
        Topic of the tracks, as resolved.
    """

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._tracks: dict[int, _Line] = {}
        self._ended: dict[int, _Line] = {}  # in the order in which they ended
        self._statuses: dict[str, _Status] = {}
        self._publishers: Sequence[str] = ()
        self._elsewhere: Sequence[str] = ()
        self._stamp_ns = 0
        self._frame_s: float | None = None  # when the last frame's tracks were heard
        self._interval_s = 0.0  # between it and the one before
        self._start_s = time.monotonic()

    def tracks(self, stamp_ns: int, rows: np.ndarray) -> None:
        """Take note of a frame's tracks, TRACK_DTYPE."""
        now_s = time.monotonic()
        if self._frame_s is not None:
            self._interval_s = now_s - self._frame_s
        self._stamp_ns, self._frame_s = stamp_ns, now_s
        known = self._ended | self._tracks
        found = {}
        for row in rows:
            number = int(row["track_id"])
            coasts = row["status"] == COASTING and number in known
            found[number] = _Line(row, known[number].seen_ns if coasts else stamp_ns)
        gone = {number: line for number, line in known.items() if number not in found}
        self._tracks, self._ended = found, dict(list(gone.items())[-_MOST_ENDED:])

    def status(self, name: str, warns: bool, message: str, values: Mapping[str, str]) -> None:
        """Take note of what a node says of itself in ``/diagnostics``."""
        if name.rpartition(": ")[2] not in (_DETECTION, *_BESIDE):
            return  # of others, who may be many and are not shown
        values = {printable(key): printable(value) for key, value in values.items()}
        self._statuses[printable(name)] = _Status(
            warns, printable(message), values, time.monotonic()
        )

    def publishers(self, nodes: Sequence[str], elsewhere: Sequence[str]) -> None:
        """Take note of which nodes publish the tracks, and of other topics with tracks."""
        self._publishers = [printable(node) for node in nodes]
        self._elsewhere = [printable(topic) for topic in elsewhere]

    def lines(self, width: int, height: int) -> list[str]:
        """Return what there is to see, in lines that fit the terminal, with its colours."""
        head = [self._title(width), *self._health(width), ""]
        return [*head, *self._table(width, height - len(head))][:height]

    def _title(self, width: int) -> str:
        left = f" ofsat watch  {' '.join(self._publishers) or self._topic}"
        right = f"{datetime.now(UTC):%H:%M:%S} UTC "
        room = max(width - len(right), 0)
        return click.style(f"{left:<{room}.{room}}{right}"[:width], reverse=True)

    def _health(self, width: int) -> Iterator[str]:
        """What the detector says of itself, and then the nodes beside it."""
        for words, colour in (*self._detector(), *self._beside()):
            for line in textwrap.wrap(words, width):
                yield click.style(line, fg=colour)

    def _detector(self) -> Iterator[tuple[str, str | None]]:
        """Sentences and their colours."""
        if not self._publishers:
            yield self._nobody(), "red"
        for node in self._publishers[:1]:
            status = self._statuses.get(f"{node}: {_DETECTION}")
            silence_s = time.monotonic() - (status.heard_s if status else self._start_s)
            if silence_s > _SILENCE_S:
                yield f"{node} says nothing for {silence_s:.0f} s", "red"
            if status is not None:
                yield from _said(status)
        if self._frame_s is not None:
            when = datetime.fromtimestamp(self._stamp_ns / 1e9, UTC)
            ago_s = time.monotonic() - self._frame_s
            yield f"last image {when:%Y-%m-%d %H:%M:%S} UTC, answered {ago_s:.1f} s ago", None

    def _nobody(self) -> str:
        words = f"nobody publishes {self._topic}: is the detector running?"
        if self._elsewhere:
            namespace = self._elsewhere[0].rpartition("/")[0]
            words += (
                f" Tracks are on {', '.join(self._elsewhere)}:"
                f" ofsat watch --namespace {namespace or '/'}"
            )
        return words

    def _beside(self) -> Iterator[tuple[str, str | None]]:
        """What the guide and others in the detector's namespace say, while they say anything."""
        namespaces = {node.rpartition("/")[0] for node in self._publishers}
        for name, status in sorted(self._statuses.items()):
            node, _, kind = name.partition(": ")
            near = node.rpartition("/")[0] in namespaces and kind in _BESIDE
            if near and time.monotonic() - status.heard_s <= _SILENCE_S:
                yield f"{node}: {status.message}", "yellow" if status.warns else None

    def _table(self, width: int, height: int) -> Iterator[str]:
        """Tracks by id, then those that have ended, the last first, as far as there is room."""
        current = [(line, False) for _, line in sorted(self._tracks.items())]
        ended = [(line, True) for line in reversed(self._ended.values())]
        columns = _columns_within(width)
        yield click.style("".join(f"{c.title:>{c.width}}" for c in columns), bold=True)
        room = max(height - 2, 0)  # under the title, and over what follows the table
        for line, over in (current + ended)[:room]:
            text = "".join(f"{c.text(line, over):>{c.width}}" for c in columns)
            colour = "yellow" if line.row["status"] == COASTING else "green"
            past = over or self._is_past()
            yield click.style(text, dim=past, fg=None if past else colour)
        if not current and not ended:
            yield "no track so far"[:width]
        elif more := max(len(current) - room, 0):
            words = f"and {more} more, for which the terminal is too low"
            yield click.style(words[:width], fg="yellow")

    def _is_past(self) -> bool:
        """Whether a frame should have come since the last."""
        patience_s = max(_SILENCE_S, _INTERVALS * self._interval_s)
        return self._frame_s is not None and time.monotonic() - self._frame_s > patience_s


def _said(status: _Status) -> Iterator[tuple[str, str | None]]:
    """A detector's status as sentences and their colours."""
    yield status.message, "yellow" if status.warns else "green"
    values = _Values(status.values)
    counts = (f"{values.get(f'frames_{what}')} {what}" for what in ("dropped", "lost", "failed"))
    yield (
        f"{values.get('frames_processed')} frames  {values.number('rate_hz', 1)} Hz"
        f"  latency {values.number('latency_s', 0, 1e3)} ms  {'  '.join(counts)}",
        None,
    )
    if "stars" in status.values:
        yield (
            f"{values.get('stars')} stars  moving ({values.number('star_motion_x_px_s', 2)},"
            f" {values.number('star_motion_y_px_s', 2)}) px/s"
            f"  residual {values.number('star_residual_px', 2)} px"
            f"  noise {values.number('noise_dn', 1)} DN",
            None,
        )


@dataclass(frozen=True)
class _Values:
    """Values of a status; what is missing or unknown is a dash."""

    of: Mapping[str, str]

    def get(self, key: str) -> str:
        return self.of.get(key, "-")

    def number(self, key: str, digits: int, scale: float = 1.0) -> str:
        try:
            return _number(float(self.of[key]) * scale, digits)
        except (KeyError, ValueError):
            return "-"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


@dataclass(frozen=True)
class _Column:
    """A column of the table; `text` makes it of a track and whether that has ended."""

    title: str
    width: int
    text: Callable[[_Line, bool], str]


def _state(line: _Line, over: bool) -> str:
    return "ended" if over else "coasting" if line.row["status"] == COASTING else "confirmed"


def _of(name: str, digits: int, scale: float = 1.0) -> Callable[[_Line, bool], str]:
    return lambda line, _: _number(float(line.row[name]) * scale, digits)


def _speed(prefix: str) -> Callable[[_Line, bool], str]:
    def text(line: _Line, _: bool) -> str:
        return _number(math.hypot(line.row[f"{prefix}vx"], line.row[f"{prefix}vy"]), 2)

    return text


def _angle(line: _Line, _: bool) -> str:
    degrees = math.degrees(math.atan2(line.row["vy"], line.row["vx"]))
    return f"{degrees:.0f}°" if math.isfinite(degrees) else "-"


def _seen(line: _Line, _: bool) -> str:
    return f"{datetime.fromtimestamp(line.seen_ns / 1e9, UTC):%H:%M:%S}"


# In the order of what an observer asks first: a narrow terminal shows as many as fit.
_COLUMNS = (
    _Column("id", 4, lambda line, _: str(line.row["track_id"])),
    _Column("state", 10, _state),
    _Column("x px", 8, _of("x", 1)),
    _Column("y px", 8, _of("y", 1)),
    _Column("px/s", 8, _speed("")),
    _Column("angle", 7, _angle),
    _Column("rel px/s", 10, _speed("rel_")),
    _Column("SNR", 6, _of("snr", 1)),
    _Column("seen UTC", 10, _seen),
    _Column("for s", 8, _of("age", 1)),
    _Column("hits", 7, lambda line, _: str(line.row["hits"])),
    _Column("misses", 8, lambda line, _: str(line.row["misses"])),
    _Column("RA deg", 11, _of("ra", 4, 180 / math.pi)),
    _Column("Dec deg", 10, _of("dec", 4, 180 / math.pi)),
)


def _columns_within(width: int) -> list[_Column]:
    columns: list[_Column] = []
    for column in _COLUMNS:
        width -= column.width
        if width < 0:
            break
        columns.append(column)
    return columns
