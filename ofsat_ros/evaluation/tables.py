# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The tables that are compared, and the files they come from."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.results import DETECTIONS, STAR_FIELD

Table = NDArray[np.void]

TRUTH_DTYPE = np.dtype(
    [("stamp_ns", "i8"), ("frame", "i8"), ("id", "U64")]
    + [(name, "f8") for name in ("x_px", "y_px", "vx_px_s", "vy_px_s", "snr", "length_px")]
    + [("edge", "?")]
)
DETECTIONS_DTYPE = np.dtype(
    [("stamp_ns", "i8"), ("frame", "i8"), ("track_id", "i8"), ("confirmed", "?")]
    + [(name, "f8") for name in ("x_px", "y_px", "vx_px_s", "vy_px_s", "snr")]
)
# What need not be in a file or array, and its value then.
_OPTIONAL: dict[str, Any] = {
    **{"track_id": 0, "confirmed": True, "length_px": 0.0, "edge": False},
    **{"vx_px_s": math.nan, "vy_px_s": math.nan, "snr": math.nan},
}


class EvaluationError(ValueError):
    """Truth or detections that cannot be used; the message says what is wrong, where."""


def read_truth(path: str | Path) -> Table:
    """Read a ``truth.csv``.

    Returns
    -------
    (N,) TRUTH_DTYPE
        An empty cell is NaN; columns of other names are left out.

    Raises
    ------
    EvaluationError
        If the file lacks a column, or a cell is not what its column needs.
    OSError
        If it cannot be read.
    """
    return _read(Path(path), TRUTH_DTYPE, "the truth of a sequence")


def read_detections(path: str | Path) -> Table:
    """Read a ``detections.csv``, or that of a folder of results; else as `read_truth`.

    Returns
    -------
    (K,) DETECTIONS_DTYPE
    """
    path = Path(path)
    return _read(path / DETECTIONS if path.is_dir() else path, DETECTIONS_DTYPE, "detections")


def count_frames(folder: str | Path) -> int | None:
    """Return the number of frames that a folder's results are of, or None if they do not say.

    That is one more than the frames other than frame 0 in its ``star_field.csv``, which has a
    line for every frame that was processed; it raises as `read_truth`.
    """
    path = Path(folder) / STAR_FIELD
    if not path.exists():
        return None
    return 1 + int(np.count_nonzero(_read(path, np.dtype([("frame", "i8")]), "frames")["frame"]))


def detection_table(detections: Sequence[Table], stamps_ns: Sequence[int]) -> Table:
    """Return one table of the detections of each frame, as `evaluate` takes it.

    Parameters
    ----------
    detections : sequence of (K,) structured arrays
        For each frame, with the fields ``x``, ``y`` (px), ``vx``, ``vy`` (px/s), ``track_id`` and
        ``status`` (1: confirmed); ``snr`` may be absent.
    stamps_ns : sequence of int
        Stamps of the frames, ns UTC.
    """
    tables = [np.zeros(0, DETECTIONS_DTYPE)]
    for frame, (found, stamp_ns) in enumerate(zip(detections, stamps_ns, strict=True)):
        table = np.zeros(len(found), DETECTIONS_DTYPE)
        table["frame"], table["stamp_ns"] = frame, stamp_ns
        table["track_id"], table["confirmed"] = found["track_id"], found["status"] == 1
        table["x_px"], table["y_px"] = found["x"], found["y"]
        table["vx_px_s"], table["vy_px_s"] = found["vx"], found["vy"]
        table["snr"] = found["snr"] if "snr" in (found.dtype.names or ()) else math.nan
        tables.append(table)
    return np.concatenate(tables)


def as_table(given: Table, dtype: np.dtype, what: str) -> Table:
    """Return the fields of a dtype, those that may be absent filled in."""
    table = np.zeros(len(given), dtype)
    for name in dtype.names or ():
        if name in (given.dtype.names or ()):
            table[name] = given[name]
        elif name in _OPTIONAL:
            table[name] = _OPTIONAL[name]
        else:
            raise EvaluationError(f"the table of {what} has no field {name}")
    return table


def _read(path: Path, dtype: np.dtype, what: str) -> Table:
    """Read those columns of a CSV file that a dtype names."""
    if path.is_dir():
        raise EvaluationError(f"{path} is a folder; give the CSV file that holds {what}")
    with path.open(encoding="utf-8-sig", newline="") as file:
        lines = csv.reader(file)
        header = next(lines, [])
        absent = [n for n in dtype.names or () if n not in header and n not in _OPTIONAL]
        if absent:
            raise EvaluationError(
                f"{path}, line 1: no column {', '.join(absent)}; is this the file of {what}?"
            )
        columns = [(n, header.index(n)) for n in dtype.names or () if n in header]
        readers = [(n, i, _cell_reader(n, dtype[n])) for n, i in columns]
        rows = []
        for cells in lines:
            if len(cells) != len(header):
                raise EvaluationError(
                    f"{path}, line {lines.line_num}: {len(cells)} cells under {len(header)}"
                    " columns; was the file cut off?"
                )
            where = f"{path}, line {lines.line_num}, column "
            rows.append(tuple(read(cells[i], where + n) for n, i, read in readers))
    given = np.array(rows, [(n, dtype[n]) for n, _ in columns])
    return as_table(given, dtype, what)


def _cell_reader(name: str, dtype: np.dtype) -> Callable[[str, str], Any]:
    """Return the function that turns a cell into a value, or says where it is bad."""
    kind = dtype.kind
    if kind == "U":
        return lambda text, _: text
    may_be_unknown = kind == "f" and name in _OPTIONAL
    need = {"i": "a whole number", "f": "a number", "b": "0 or 1"}[kind]

    def read(text: str, where: str) -> Any:
        try:
            value = float(text or "nan") if kind == "f" else int(text)
        except ValueError:
            value = None
        bad = value is None or (kind == "b" and value not in (0, 1))
        bad |= name == "frame" and value is not None and value < 0
        bad |= kind == "f" and value is not None and not may_be_unknown and math.isnan(value)
        if bad:
            raise EvaluationError(f"{where}: it must be {need}, not {text!r}; correct the cell")
        return value

    return read
