# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A folder of results as the rows that a catalogue has of it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.catalog.schema import CAP, TRACK_NUMBERS
from ofsat_ros.catalog.sphere import angles, cap_of, unit_vectors
from ofsat_ros.results import (
    DETECTION_COLUMNS,
    DETECTIONS,
    RUN,
    STAR_FIELD,
    STAR_FIELD_COLUMNS,
    TRACK_COLUMNS,
    TRACKS,
    ResultError,
    read_run,
    read_table,
)

Array = NDArray[np.float64]
Row = tuple[Any, ...]

# A path has a place at least as often: so a great circle from one to the next is off the path of
# what moves with the Earth by 2" tan(declination) at most.
_STEP = np.radians(0.5)
_MINUTE_NS = 60 * 1_000_000_000


def describe(folder: Path) -> dict[str, Any]:
    """Return a result's row, but for its folder, out of ``run.json``.

    Raises
    ------
    ResultError
        If the folder holds no results, or results without a frame.
    OSError
        If the file cannot be read.
    """
    run = read_run(folder)
    recordings = run["recording"] or []
    recordings = [recordings] if isinstance(recordings, str) else recordings
    if not run["frames"] or run["first_stamp_ns"] is None or run["last_stamp_ns"] is None:
        raise ResultError(f"{folder} is not taken in: {RUN} tells of no frame and its time")
    if run.get("segment") is not None:
        raise ResultError(f"{folder} is not taken in: it is a part that ofsat batch will join")
    if not recordings:
        raise ResultError(f"{folder / RUN} is damaged: no recording; run ofsat process again")
    same = ("key", "content", "topic", "version", "preset", "started_utc", "seconds", "frames")
    return {
        **{name: run.get(name) for name in same},
        **{"first_stamp_ns": run["first_stamp_ns"], "last_stamp_ns": run["last_stamp_ns"]},
        **{"width_px": run["width"], "height_px": run["height"]},
        **{"live": bool(run["live"]), "stopped": bool(run["stopped"])},
        "left_out": run["left_out"] or 0,
        "recording": as_json(recordings),
        "name": unicode(Path(recordings[0]).name),
        "parameters": as_json(run["parameters"] or {}),
        "problems": as_json(run["problems"] or []),
        "unlocated": as_json(run["unlocated"] or {}),
    }


def read_tracks(folder: Path) -> tuple[list[Row], list[Row]]:
    """Return the rows of its tracks, and those of their paths on the sky, but for the result.

    Raises
    ------
    ResultError
        If a table is missing or damaged.
    OSError
        If one cannot be read.
    """
    table = read_table(folder / TRACKS, TRACK_COLUMNS)
    located = _located(folder)
    nowhere = dict.fromkeys((*TRACK_NUMBERS, *CAP), float("nan"))
    tracks: list[Row] = []
    path: list[Row] = []
    for row in table:
        values = nowhere | dict(zip(table.dtype.names or (), row.tolist(), strict=True))
        values["rate_px_s"] = float(np.hypot(row["rel_vx_px_s"], row["rel_vy_px_s"]))
        if (places := located.get(values["track_id"])) is not None:
            values |= _on_sky(places)
            path += ((values["track_id"], *place) for place in places.tolist())
        tracks.append(tuple(values[name] for name in (*TRACK_NUMBERS, *CAP)))
    return tracks, path


def _located(folder: Path) -> dict[int, NDArray[np.void]]:
    """Return the path of each track that has directions: some of its detections, in order."""
    wanted = ("stamp_ns", "track_id", "ra_deg", "dec_deg")
    rows = read_table(folder / DETECTIONS, DETECTION_COLUMNS, wanted)
    known = (rows["track_id"] > 0) & np.isfinite(rows["ra_deg"] + rows["dec_deg"])
    rows = np.unique(rows[known][["track_id", "stamp_ns", "ra_deg", "dec_deg"]])
    places = rows[["stamp_ns", "ra_deg", "dec_deg"]]
    return {number: _thinned(places[own]) for number, own in _groups(rows["track_id"])}


def _thinned(rows: NDArray[np.void]) -> NDArray[np.void]:
    at = unit_vectors(rows["ra_deg"], rows["dec_deg"])
    gone = np.cumsum(angles(at[1:], at[:-1]))
    keep = np.ones(len(rows), bool)
    keep[1:] = np.diff(gone // _STEP, prepend=0) > 0
    keep[-1] = True
    return rows[keep]


def _on_sky(places: NDArray[np.void]) -> dict[str, float]:
    at = unit_vectors(places["ra_deg"], places["dec_deg"])
    middle, radius = cap_of(at)
    seconds = float(places["stamp_ns"][-1] - places["stamp_ns"][0]) / 1e9
    way_deg = float(np.degrees(angles(at[1:], at[:-1]).sum()))
    return {
        **{f"first_{name}": float(places[name][0]) for name in ("ra_deg", "dec_deg")},
        **{f"last_{name}": float(places[name][-1]) for name in ("ra_deg", "dec_deg")},
        "rate_arcsec_s": 3600 * way_deg / seconds if seconds > 0 else float("nan"),
        **dict(zip(CAP, (*middle.tolist(), np.cos(radius), np.sin(radius)), strict=True)),
    }


def read_minutes(folder: Path) -> list[Row]:
    """Return the rows of its minutes, but for the result; raises as `read_tracks`."""
    wanted = ("stamp_ns", "dt_s", "dx_px", "stars", "background", "noise")
    frames = read_table(folder / STAR_FIELD, STAR_FIELD_COLUMNS, wanted)
    fresh = np.isnan(frames["dt_s"])  # compared with no other frame
    blind = np.isnan(frames["dx_px"]) & ~fresh
    fresh_again = fresh.copy()
    fresh_again[:1] = False
    starts = frames["stamp_ns"] // _MINUTE_NS * _MINUTE_NS
    rows: list[Row] = []
    for start, own in _groups(starts):
        compared = own[~fresh[own]]
        numbers = [_median(frames["stars"][compared])]
        numbers += [_median(frames[name][own]) for name in ("noise", "background")]
        counts = [len(own), int(blind[own].sum()), int(fresh_again[own].sum())]
        rows.append((start, *counts, *numbers))
    return rows


def _groups(values: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield each value and where it stands."""
    order = np.argsort(values, kind="stable")
    each, first = np.unique(values[order], return_index=True)
    yield from zip(
        each.tolist(), np.split(order, first[1:]), strict=False
    )  # of none, one is empty


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def as_json(value: Any) -> str:
    """Return JSON that SQLite takes, which a name that is no Unicode is not."""
    return unicode(json.dumps(value, ensure_ascii=False))


def unicode(text: str) -> str:
    """Return a text with what is no Unicode written out."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
