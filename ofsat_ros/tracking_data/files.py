# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Files of tracking data: what is in them, and how they appear whole or not at all."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.parameters import TrackingDataParameters
from ofsat_ros.tracking_data.arcs import Arc, ArcCollector
from ofsat_ros.tracking_data.iod import check_iod, iod_lines
from ofsat_ros.tracking_data.tdm import tdm_kvn, tdm_xml

# How the files of a format end, and the name of a recording's.
SUFFIXES = {"kvn": ".tdm", "xml": ".xml", "iod": ".iod"}
_ABANDONED_S = 60.0  # a file is written in some ms
TRACKING_DATA = {name: f"tracks{suffix}" for name, suffix in SUFFIXES.items()}


class TrackArcs:
    """Collects the directions of tracks, frame by frame, and writes them.

    Parameters
    ----------
    parameters : TrackingDataParameters
    formats : iterable of {"kvn", "xml", "iod"}
        What will be written: what these ask of the parameters is checked at once.
    longest : int, optional
        See below.

    Attributes
    ----------
    parameters : TrackingDataParameters
        May be replaced; what is written next obeys the new ones.
    longest : int or None
        An arc of so many directions (of ``least_detections``, if these are more) ends, and its
        track goes on in another of the same label, of whatever length; None: no arc is cut.  May
        be replaced.

    Raises
    ------
    ParameterError
        If a format cannot be written with the parameters.
    """

    def __init__(
        self,
        parameters: TrackingDataParameters,
        formats: Iterable[str] = (),
        longest: int | None = None,
    ) -> None:
        if "iod" in formats:
            check_iod(parameters)
        self.parameters, self.longest = parameters, longest
        self._collector = ArcCollector()

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take the detections of a frame; also if there are none, since its stamp tells the time.

        Parameters
        ----------
        stamp_ns : int
            Middle of the exposure, ns UTC.  If it is earlier than the last one, every arc ends.
        rows : (N,) structured array
            With fields ``track_id``, ``ra``, ``dec`` (rad), and perhaps ``sigma_ra``,
            ``sigma_dec`` (rad), ``flux`` (DN), ``snr``, as DETECTION_DTYPE has them.  Those
            without number or direction are left out.
        """
        longest = self.longest and max(self.longest, self.parameters.least_detections)
        self._collector.add(stamp_ns, rows, longest)

    @property
    def arcs(self) -> list[Arc]:
        """All that were not taken and are long enough to be written, in order of beginning."""
        return self._long_enough(self._collector.all())

    def take_ended(self, after_s: float) -> list[Arc]:
        """Return and forget the arcs that have ended, and are long enough to be written.

        Parameters
        ----------
        after_s : float
            An arc has ended if its last direction is so much older than the newest frame, or if
            a frame with an earlier stamp has come, its number has become another object's, or it
            was cut.
        """
        return self._long_enough(self._collector.take_ended(after_s))

    def take_all(self) -> list[Arc]:
        """Return and forget all arcs that are long enough to be written."""
        return self._long_enough(self._collector.take_all())

    def write(self, path: Path, format: str, force: bool = False) -> int:  # noqa: A002
        """Write `arcs` into one file, and return how many these are.

        Without any there is no file, since a message holds at least one; with `force`, an old one
        is removed.  The rest is as in `write_arcs`.
        """
        arcs = self.arcs
        if arcs:
            write_arcs(path, arcs, format, self.parameters, force)
        elif force:
            path.unlink(missing_ok=True)
        return len(arcs)

    def _long_enough(self, arcs: list[Arc]) -> list[Arc]:
        least = self.parameters.least_detections
        return [arc for arc in arcs if arc.continues or len(arc.rows) >= least]


def write_arcs(
    path: Path,
    arcs: Sequence[Arc],
    format: str,  # noqa: A002
    parameters: TrackingDataParameters,
    force: bool = False,
) -> None:
    """Write arcs into a file, which appears whole or not at all.

    Parameters
    ----------
    path : Path
        In an existing folder.
    arcs : sequence of Arc
        At least one.
    format : {"kvn", "xml", "iod"}
        CCSDS TDM as text or XML, or lines as on SeeSat-L.
    parameters : TrackingDataParameters
    force : bool
        Replace a file of that name.

    Raises
    ------
    FileExistsError
        If the file exists and `force` is not set.
    OSError
        If it cannot be written; what was there before is then still there.
    ParameterError
        If the format cannot be written with the parameters.
    """
    if format == "iod":
        text = iod_lines(arcs, parameters)
    else:
        message = {"kvn": tdm_kvn, "xml": tdm_xml}[format]
        text = message(arcs, parameters, time.time_ns())
    _write_whole(path, text, force)


def remove_parts(folder: Path) -> None:
    """Remove what writers that were killed have left half-written in a folder.

    Raises
    ------
    OSError
        If it cannot be removed.
    """
    for suffix in SUFFIXES.values():
        for part in folder.glob(f".*{suffix}.{'[0-9a-f]' * 8}.part"):
            # A younger one may be another writer's that is at work.
            if time.time() - part.stat().st_mtime > _ABANDONED_S:
                part.unlink(missing_ok=True)


def _write_whole(path: Path, text: str, force: bool) -> None:
    """Write beside the place and move into it: a reader never sees a part."""
    if not force:
        _check_free(path)
    # Process numbers do not tell apart who writes from two machines or containers.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with part.open("w", encoding="ascii", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if force:
            os.replace(part, path)
        else:
            _move_to_free(part, path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno:  # as of a disk that is full
            error.filename = f"{path}"
        raise


def _move_to_free(part: Path, path: Path) -> None:
    """Move, but never onto a file, be it one that another process writes at this moment."""
    try:
        os.link(part, path)
    except OSError:
        _check_free(path)
        # Not every file system has links; on those a file may come in between.
        os.replace(part, path)
    else:
        part.unlink()


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise FileExistsError(f"{path} exists already and is not replaced")
