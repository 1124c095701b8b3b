# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The file itself: taking results in, and answering questions about them."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.catalog.entry import describe, read_minutes, read_tracks, unicode
from ofsat_ros.catalog.night import Night
from ofsat_ros.catalog.schema import (
    CAP,
    MINUTE_DTYPE,
    PATH_DTYPE,
    TRACK_DTYPE,
    TRACK_NUMBERS,
)
from ofsat_ros.catalog.selection import Condition, Cone, Selection
from ofsat_ros.catalog.sphere import distance_to_arcs, unit_vectors
from ofsat_ros.catalog.storage import CatalogError, Storage
from ofsat_ros.results import ResultError

_SUFFIX = ".sqlite"
CATALOG = f"catalog{_SUFFIX}"

_Rows = NDArray[np.void]
_EVERYTHING = Selection()
# What to sort by, as SQL has it; the magnitude is not in the file.
_ORDER = {name: f"tracks.{name}" for name in TRACK_NUMBERS} | {
    **{"magnitude": "tracks.flux", "recording": "results.name", "folder": "results.folder"}
}
_PATH = "SELECT * FROM path WHERE result = ? AND track_id = ? ORDER BY stamp_ns"
_JOINED = "FROM tracks JOIN results ON results.id = tracks.result"


@dataclass(frozen=True)
class Result:
    """A folder of results that a catalogue has taken in; what is not told is None.

    Attributes
    ----------
    id : int
        Its number in the catalogue.
    key, content : str or None
        Hashes of all that the results depend on, and of the recording's files.
    folder : Path
    recording : tuple of str
        Paths of what was processed.
    name : str
        The last part of the first of them.
    topic, version, preset : str or None
    parameters : dict
    live, stopped : bool
        What the node says, not the last word; the run ended before the recording did.
    started_utc : str or None
    seconds : float or None
    frames, left_out : int
    first_stamp_ns, last_stamp_ns : int
        ns UTC.
    width_px, height_px : int or None
    problems : list of str
    unlocated : dict of str to int
        Detections without direction, by the reason.
    tracks : int
    """

    id: int
    key: str | None
    content: str | None
    folder: Path
    recording: tuple[str, ...]
    name: str
    topic: str | None
    version: str | None
    preset: str | None
    parameters: dict[str, Any]
    live: bool
    stopped: bool
    started_utc: str | None
    seconds: float | None
    frames: int
    left_out: int
    first_stamp_ns: int
    last_stamp_ns: int
    width_px: int | None
    height_px: int | None
    problems: list[str]
    unlocated: dict[str, int]
    tracks: int


class Catalog:
    """A catalogue of tracks; a context manager.

    One process may write at a time; others may read meanwhile.

    Parameters
    ----------
    path : str or Path
        The file, whose name ends in ``.sqlite``, or the folder that has it as ``catalog.sqlite``.
    write : bool
        Whether to change it; where there is none, an empty one is made.

    Attributes
    ----------
    path : Path
        The file.

    Raises
    ------
    CatalogError
        If there is none, or it cannot be used.
    """

    def __init__(self, path: str | Path, *, write: bool = False) -> None:
        path = Path(path)
        self.path = path if path.is_file() or path.suffix == _SUFFIX else path / CATALOG
        if not write and not self.path.is_file():
            raise CatalogError(
                f"there is no catalogue at {self.path}: `ofsat catalog {path} --add FOLDER` makes"
                " one of folders that ofsat process has made"
            )
        if write:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = Storage(self.path, write)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def longitude_deg(self) -> float | None:
        """Of the site by whose noons nights are told, east positive; None if it is not known."""
        (row,) = self._file.ask("SELECT max(longitude_deg) FROM site")
        return row[0]

    @longitude_deg.setter
    def longitude_deg(self, value: float) -> None:
        with self._file.change() as file:
            file.execute("DELETE FROM site")
            file.execute("INSERT INTO site VALUES (?)", (value,))

    def add(self, folder: str | Path) -> bool:
        """Take in a folder of results.

        It takes the place of another result of the same recording, which is one of the same
        content, or of the same path and time.

        Returns
        -------
        bool
            False if there was nothing to do: it is there already.

        Raises
        ------
        ResultError
            If the folder holds no results, or damaged ones.
        CatalogError
            If the catalogue cannot be written.
        OSError
            If the folder cannot be read.
        """
        folder = Path(folder).absolute().resolve()
        row = describe(folder) | {"folder": self._name_of(folder)}
        others = self._same(row)
        same = ("folder", "key", "started_utc", "seconds")
        if [[old[name] for name in same] for old in others] == [[row[name] for name in same]]:
            return False
        tracks, path = read_tracks(folder)
        minutes = read_minutes(folder)
        names = ", ".join(row)
        marks = ", ".join("?" * len(row))
        try:
            with self._file.change() as file:
                for old in others:
                    file.execute("DELETE FROM results WHERE id = ?", (old["id"],))
                result = file.execute(
                    f"INSERT INTO results ({names}) VALUES ({marks})", tuple(row.values())
                ).lastrowid
                _put(file, "tracks", ("result", *TRACK_NUMBERS, *CAP), result, tracks)
                _put(file, "path", PATH_DTYPE.names or (), result, path)
                _put(file, "minutes", MINUTE_DTYPE.names or (), result, minutes)
        except (sqlite3.IntegrityError, OverflowError) as error:
            raise ResultError(f"{folder} is damaged: {error}; run ofsat process again") from error
        return True

    def remove_missing(self, below: Path | None = None) -> int:
        """Forget results whose folders are gone, and return how many those were.

        Parameters
        ----------
        below : Path, optional
            Only those of this folder: others may be on a disk that is not there now.
        """
        gone = [
            one.id
            for one in self.results()
            if not one.folder.is_dir()
            and (below is None or below.resolve() in one.folder.resolve().parents)
        ]
        with self._file.change() as file:
            file.executemany("DELETE FROM results WHERE id = ?", [(one,) for one in gone])
        return len(gone)

    def query(
        self,
        selection: Selection = _EVERYTHING,
        *,
        sort: str = "first_stamp_ns",
        descending: bool = False,
        limit: int | None = None,
    ) -> NDArray[np.void]:
        """Return the tracks that are wanted.

        Parameters
        ----------
        selection : Selection
        sort : str
            Field of TRACK_DTYPE to go by, but ``result``; what is unknown comes last.
        descending : bool
            Highest first.
        limit : int, optional
            So many at most.

        Returns
        -------
        (K,) TRACK_DTYPE
            ``result`` is the number of a `Result`, ``recording`` its name and ``folder`` its
            folder; the other fields are those of the file, and unknown is NaN.

        Raises
        ------
        CatalogError
            If the file cannot be read.
        ValueError
            If there is no such field.
        """
        if sort not in _ORDER:
            raise ValueError(f"tracks are sorted by {', '.join(_ORDER)}, not by {sort}")
        where, needs = _where(selection.conditions())
        order = _ORDER[sort]
        downwards = descending != (sort == "magnitude")
        columns = ", ".join(f"tracks.{name}" for name in ("result", *TRACK_NUMBERS))
        sql = (
            f"SELECT {columns}, NULL, results.name, results.folder {_JOINED} WHERE {where}"
            f" ORDER BY {order} IS NULL, {order} {'DESC' if downwards else 'ASC'},"
            " tracks.result, tracks.track_id LIMIT ?"
        )
        # What only comes near a cone is not known before the rows are.
        most = -1 if limit is None or selection.cone is not None else limit
        tracks = _array(self._file.ask(sql, (*needs, most)), TRACK_DTYPE)
        if selection.cone is not None:
            tracks = tracks[self._crosses(tracks, selection.cone)][:limit]
        with np.errstate(divide="ignore", invalid="ignore"):
            tracks["magnitude"] = -2.5 * np.log10(tracks["flux"])
        tracks["magnitude"][~(tracks["flux"] > 0)] = np.nan
        return tracks

    def count(self, selection: Selection = _EVERYTHING) -> int:
        """Return how many tracks are wanted."""
        if selection.cone is not None:
            return len(self.query(selection))
        where, needs = _where(selection.conditions())
        return int(self._file.ask(f"SELECT count(*) {_JOINED} WHERE {where}", needs)[0][0])

    def why_none(self, selection: Selection) -> str:
        """Say how many tracks fit each condition alone, and what they lack."""
        ((every, located),) = self._file.ask("SELECT count(*), count(cap_x) FROM tracks")
        if not every:
            return f"{self.path} holds {len(self.results())} results, and no track"
        wanted = {name: value for name, value in vars(selection).items() if value is not None}
        alone = [Selection(**{name: value}) for name, value in wanted.items()]
        fit = [f"{self.count(one)} {next(one.conditions())[0]}" for one in alone]
        words = f"none of {every} tracks is so; each condition alone: {', '.join(fit)}"
        if located < every and wanted.keys() & {"cone", "rate_arcsec_s"}:
            words += f"; directions are known of {located}{self._why_unlocated()}"
        return words

    def paths(self, tracks: NDArray[np.void]) -> NDArray[np.void]:
        """Return the paths of tracks on the sky.

        Parameters
        ----------
        tracks : (K,) structured array
            With the fields ``result`` and ``track_id``.

        Returns
        -------
        (N,) PATH_DTYPE
            Places by result, track and time; none of tracks without directions.
        """
        rows: list[sqlite3.Row] = []
        for key in sorted(tracks[["result", "track_id"]].tolist()):
            rows += self._file.ask(_PATH, key)
        return _array(rows, PATH_DTYPE)

    def nights(self) -> list[Night]:
        """Return the nights in which recordings begin, in their order."""
        longitude = self.longitude_deg or 0.0
        stamps = self._file.ask("SELECT DISTINCT first_stamp_ns FROM results")
        return sorted({Night.of(stamp, longitude) for (stamp,) in stamps})

    def results(self, night: Night | None = None) -> list[Result]:
        """Return the results of recordings that begin in a night, or all, in their order."""
        limits = (night.first_ns, night.end_ns) if night else (-(1 << 63), (1 << 63) - 1)
        rows = self._file.ask(
            "SELECT *, (SELECT count(*) FROM tracks WHERE result = id) AS tracks FROM results"
            " WHERE first_stamp_ns >= ? AND first_stamp_ns < ? ORDER BY first_stamp_ns, id",
            limits,
        )
        return [self._result(dict(row)) for row in rows]

    def minutes(self, results: Sequence[Result]) -> NDArray[np.void]:
        """Return what the sky was like, by result and minute, (N,) MINUTE_DTYPE."""
        rows: list[sqlite3.Row] = []
        for one in results:
            rows += self._file.ask(
                "SELECT * FROM minutes WHERE result = ? ORDER BY start_ns", (one.id,)
            )
        return _array(rows, MINUTE_DTYPE)

    def _name_of(self, folder: Path) -> str:
        """The name by which the catalogue knows a folder: it may be moved along with it."""
        home = self.path.absolute().parent.resolve()
        name = f"{folder.relative_to(home) if folder.is_relative_to(home) else folder}"
        if unicode(name) != name:
            raise ResultError(
                f"{unicode(name)} is not taken in: its name is no Unicode; rename it"
            )
        return name

    def _same(self, row: dict[str, Any]) -> list[sqlite3.Row]:
        """The results that the given one takes the place of."""
        return self._file.ask(
            "SELECT id, folder, key, started_utc, seconds FROM results WHERE folder = :folder"
            " OR (topic IS :topic AND (content = :content OR (recording = :recording"
            " AND first_stamp_ns <= :last_stamp_ns AND last_stamp_ns >= :first_stamp_ns)))",
            row,
        )

    def _crosses(self, tracks: _Rows, cone: Cone) -> NDArray[np.bool_]:
        """Whether the paths of tracks cross a cone, (K,)."""
        path = self.paths(tracks)
        at = unit_vectors(path["ra_deg"], path["dec_deg"])
        whose = path[["result", "track_id"]]
        # The last place of a track leads nowhere; it is all there is of a track seen once.
        to = np.arange(len(path))
        to[:-1] += whose[1:] == whose[:-1]
        away = distance_to_arcs(unit_vectors(cone.ra_deg, cone.dec_deg), at, at[to])
        crossing = set(whose[away <= np.radians(cone.radius_deg)].tolist())
        return np.array([one in crossing for one in tracks[["result", "track_id"]].tolist()], bool)

    def _why_unlocated(self) -> str:
        reasons: Counter[str] = Counter()
        for (text,) in self._file.ask("SELECT unlocated FROM results"):
            reasons.update(json.loads(text))
        return f" ({reasons.most_common(1)[0][0]})" if reasons else ""

    def _result(self, row: dict[str, Any]) -> Result:
        for name in ("recording", "parameters", "problems", "unlocated"):
            row[name] = json.loads(row[name])
        row["folder"] = self.path.absolute().parent / row["folder"]
        row["recording"] = tuple(row["recording"])
        return Result(**row | {"live": bool(row["live"]), "stopped": bool(row["stopped"])})


def _where(conditions: Iterator[Condition]) -> tuple[str, tuple[Any, ...]]:
    """Join conditions to one, and what it needs."""
    given = list(conditions)
    where = " AND ".join(f"({sql})" for _, sql, _ in given) or "1"
    return where, tuple(value for _, _, needs in given for value in needs)


def _array(rows: list[sqlite3.Row], dtype: np.dtype) -> _Rows:
    """Return rows as an array; NULL becomes NaN."""
    return np.array([tuple(row) for row in rows], dtype)


def _put(
    file: sqlite3.Connection, table: str, names: Sequence[str], result: int | None, rows: list[Any]
) -> None:
    marks = ", ".join("?" * len(names))
    file.executemany(
        f"INSERT INTO {table} ({', '.join(names)}) VALUES ({marks})",
        ((result, *row) for row in rows),
    )
