# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The tables of a folder of results, as arrays.

What reads them again, the report and the catalogue, does so here.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.results.run import ResultError

_WHOLE = {
    *("stamp_ns", "first_stamp_ns", "last_stamp_ns", "frame", "first_frame", "last_frame"),
    *("track_id", "confirmed", "stars", "objects", "detections"),
}


def read_table(
    path: Path, columns: tuple[str, ...], wanted: Sequence[str] | None = None
) -> NDArray[np.void]:
    """Read a table that ``ResultWriter`` wrote; a last line that was cut off is left out.

    Parameters
    ----------
    path : Path
    columns : tuple of str
        Those that the file must have.
    wanted : sequence of str, optional
        Those to read, in the file's order; all by default.

    Returns
    -------
    (N,) structured array
        Fields by the columns' names: counts, frames and stamps int64, notes str, the rest float64.

    Raises
    ------
    ResultError
        If there is no such file, or it is not what it should be.
    OSError
        If it cannot be read.
    """
    names = [name for name in columns if wanted is None or name in wanted]
    dtype = np.dtype([(name, _kind(name)) for name in names])
    if not path.is_file():
        raise ResultError(f"{path.parent} holds no {path.name}: run ofsat process again")
    # What a crash has left at the end may be anything.
    with path.open(encoding="utf-8", errors="replace") as file, warnings.catch_warnings():
        if file.readline().rstrip("\n").split(",") != list(columns):
            raise ResultError(f"{path} has other columns than this version writes: process again")
        warnings.filterwarnings("ignore", "loadtxt: input contained no data")
        try:
            return np.loadtxt(
                _whole_lines(file),
                dtype,
                comments=None,
                delimiter=",",
                quotechar='"',
                usecols=[columns.index(name) for name in names] if wanted is not None else None,
                ndmin=1,
            )
        except ValueError as error:
            what = f"{error}".partition(";")[0]
            raise ResultError(f"{path} is damaged: {what}; run ofsat process again") from error


def _whole_lines(file: TextIO) -> Iterator[str]:
    return (line for line in file if line.endswith("\n"))


def _kind(name: str) -> str:
    return "O" if name == "note" else "i8" if name in _WHOLE else "f8"
