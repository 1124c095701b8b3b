"""Result files: the columns of ``detections.csv`` and ``star_field.csv``, and their writer.

Stands after the pipeline: the command ``ofsat process`` and the recorder node write through here,
so that a file reads the same whoever made it.  Times are int ns UTC, angles in deg, unknown is
``nan``.
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.pipeline import FrameResult

DETECTIONS, STAR_FIELD = "detections.csv", "star_field.csv"

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


class ResultWriter:
    """Writes a folder of results, frame by frame; a context manager.

    What is written is on disk at the end of each frame, so that it survives whatever comes next.

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
        with ExitStack() as files:
            self._detections = files.enter_context(_start(folder / DETECTIONS, DETECTION_COLUMNS))
            self._star_field = files.enter_context(_start(folder / STAR_FIELD, STAR_FIELD_COLUMNS))
            self._files = files.pop_all()

    def add(self, result: FrameResult) -> None:
        """Write what one frame gave."""
        lines = detection_lines(result.stamp_ns, result.frame, result.detections)
        # One write: Ctrl-C leaves no part of a line.
        self._detections.write("".join(lines))
        self._star_field.write(_star_field_line(result))

    def close(self) -> None:
        """Close the files."""
        self._files.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


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
    file.write(",".join(columns) + "\n")
    return file


def _line(whole: list[int], numbers: list[float], tail: str = "") -> str:
    return ",".join([*map(str, whole), *(f"{number:.9g}" for number in numbers)]) + tail + "\n"
