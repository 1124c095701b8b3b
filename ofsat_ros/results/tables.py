# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The columns of ``detections.csv``, ``tracks.csv`` and ``star_field.csv``.

Times are int ns UTC, angles in deg, unknown is ``nan``.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.results.run import naming

DETECTIONS, TRACKS, STAR_FIELD = "detections.csv", "tracks.csv", "star_field.csv"

DETECTION_COLUMNS = (
    "stamp_ns",
    "frame",
    "track_id",
    "confirmed",
    "x_px",
    "y_px",
    "vx_px_s",
    "vy_px_s",
    "rel_vx_px_s",
    "rel_vy_px_s",
    "sigma_x_px",
    "sigma_y_px",
    "snr",
    "flux",
    "length_px",
    "angle_deg",
    "ra_deg",
    "dec_deg",
)
TRACK_COLUMNS = (
    "track_id",
    "first_stamp_ns",
    "last_stamp_ns",
    "first_frame",
    "last_frame",
    "detections",
    "first_x_px",
    "first_y_px",
    "last_x_px",
    "last_y_px",
    "vx_px_s",
    "vy_px_s",
    "rel_vx_px_s",
    "rel_vy_px_s",
    "snr",
    "flux",
    "length_px",
)
# Of a track's detections: what its line has the mean of, and what the median.
_AVERAGED, _MEDIANS = ("vx", "vy", "rel_vx", "rel_vy"), ("snr", "flux", "length")
STAR_FIELD_COLUMNS = (
    "stamp_ns",
    "frame",
    "dt_s",
    "dx_px",
    "dy_px",
    "vx_px_s",
    "vy_px_s",
    "rotation_deg",
    "scale",
    "sigma_dx_px",
    "sigma_dy_px",
    "residual_px",
    "stars",
    "objects",
    "detections",
    "background",
    "noise",
    "threshold",
    "note",
)


def detection_lines(stamp_ns: int, frame: int, detections: NDArray[np.void]) -> list[str]:
    """Return the lines of ``detections.csv`` for one frame.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the frame, ns UTC.
    frame : int
        Its number in the recording.
    detections : (K,) DETECTION_DTYPE
        Its detections; fields beyond those of the file are not read.

    Returns
    -------
    list of str
        One line each, with its newline.
    """
    lines = []
    for row in detections:
        numbers = [row[name] for name in ("x", "y", "vx", "vy", "rel_vx", "rel_vy")]
        numbers += [row[name] for name in ("sigma_x", "sigma_y", "snr", "flux", "length")]
        numbers += [math.degrees(row[name]) for name in ("angle", "ra", "dec")]
        first = [stamp_ns, frame, row["track_id"], int(row["status"] == CONFIRMED)]
        lines.append(_line(first, numbers))
    return lines


def in_words(detections: Mapping[int, int]) -> str:
    """Say how many detections there are.

    Parameters
    ----------
    detections : mapping of int to int
        Number of a track to how many are its; 0 stands for candidates.
    """
    words = f"{sum(detections.values())} RSO detections"
    tracks = sum(1 for track_id in detections if track_id)
    if tracks:
        words += f" of {tracks} track{'s' * (tracks != 1)}"
        if candidates := detections.get(0, 0):
            words += f" and {candidates} candidate{'s' * (candidates != 1)}"
    return words


class ResultWriter:
    """Writes a folder of results, frame by frame; a context manager.

    What is written is on disk at the end of each frame, so that it survives whatever comes next;
    ``tracks.csv``, which sums up the tracks of the detections, is written by `close`.

    Parameters
    ----------
    folder : Path
        An existing folder; files of the same names are replaced.

    Raises
    ------
    OSError
        If a file cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._tracks: dict[int, _TrackSummary] = {}
        with ExitStack() as files:
            self._detections = files.enter_context(_start(folder / DETECTIONS, DETECTION_COLUMNS))
            self._track_file = files.enter_context(_start(folder / TRACKS, TRACK_COLUMNS))
            self._star_field = files.enter_context(_start(folder / STAR_FIELD, STAR_FIELD_COLUMNS))
            self._files = files.pop_all()

    def add_detections(self, stamp_ns: int, frame: int, detections: NDArray[np.void]) -> None:
        """Write the detections (DETECTION_DTYPE) of one frame; frames come in their order."""
        # One write: Ctrl-C leaves no part of a line.
        _write(self._detections, "".join(detection_lines(stamp_ns, frame, detections)))
        for row in detections[detections["track_id"] > 0]:
            track = self._tracks.setdefault(int(row["track_id"]), _TrackSummary())
            track.add(stamp_ns, frame, row)

    def add_star_field(self, result: FrameResult) -> None:
        """Write the star field's motion in one frame."""
        _write(self._star_field, _star_field_line(result))

    def copy_star_field(self, line: str) -> None:
        """Write a line of another ``star_field.csv``."""
        _write(self._star_field, line)

    def close(self) -> None:
        """Write the tracks and close the files."""
        if self._track_file.closed:
            return
        lines = [track.line(number) for number, track in sorted(self._tracks.items())]
        # All files are closed, and so fail again, where one could not be written.
        with naming(self._folder), self._files:
            self._track_file.write("".join(lines))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class _TrackSummary:
    """One track's detections, summed up.

    A night's recording has a million of them, so of each a few numbers are kept, and no row.
    """

    def __init__(self) -> None:
        self._ends: list[tuple[int, int, float, float]] = []  # stamp, frame, x, y: first and last
        self._numbers = array("d")

    def add(self, stamp_ns: int, frame: int, row: np.void) -> None:
        self._ends[1:] = [(stamp_ns, frame, float(row["x"]), float(row["y"]))]
        self._numbers.extend(float(row[name]) for name in (*_AVERAGED, *_MEDIANS))

    def line(self, track_id: int) -> str:
        """Its line of ``tracks.csv``: mean velocities, median brightness and length."""
        first, last = self._ends[0], self._ends[-1]
        columns = np.array(self._numbers).reshape(-1, len(_AVERAGED) + len(_MEDIANS)).T.copy()
        means, others = np.split(columns, [len(_AVERAGED)])
        numbers = [*first[2:], *last[2:]]
        numbers += [float(each.mean()) for each in means]
        numbers += [float(np.median(each)) for each in others]
        return _line([track_id, first[0], last[0], first[1], last[1], columns.shape[1]], numbers)


def _star_field_line(result: FrameResult) -> str:
    motion = result.star_field
    values = [result.dt_s]
    if motion is None:
        values += [math.nan] * 9
        stars = 0
    else:
        dx, dy = motion.displacement
        sigma = np.sqrt(np.diag(motion.covariance)[:2])
        values += [dx, dy, dx / result.dt_s, dy / result.dt_s, math.degrees(motion.rotation)]
        values += [motion.scale, *sigma, motion.residual_px]
        stars = motion.star_count
    counts = [stars, len(result.objects), len(result.detections)]
    values += [*counts, result.background, result.noise, result.threshold]
    note = (result.reset or result.reason).replace('"', "'")
    return _line([result.stamp_ns, result.frame], values, f',"{note}"')


def _start(path: Path, columns: tuple[str, ...]) -> TextIO:
    # Line-buffered: each line is on disk once it is written.
    file = path.open("w", 1, encoding="utf-8", newline="\n")
    try:
        _write(file, ",".join(columns) + "\n")
    except BaseException:
        with suppress(OSError):  # it says the same again
            file.close()
        raise
    return file


def _write(file: TextIO, text: str) -> None:
    with naming(Path(file.name)):
        file.write(text)


def _line(whole: list[int], numbers: list[float], tail: str = "") -> str:
    return ",".join([*map(str, whole), *(f"{number:.9g}" for number in numbers)]) + tail + "\n"
