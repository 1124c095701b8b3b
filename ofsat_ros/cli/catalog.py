# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat catalog``: questions about the tracks of many recordings."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.catalog import (
    TRACK_DTYPE,
    Catalog,
    CatalogError,
    Cone,
    Night,
    Selection,
)
from ofsat_ros.cli.terminal import Instant, fail, help_all, in_words, say, seldom_option
from ofsat_ros.printing import printable
from ofsat_ros.recordings import utc_text
from ofsat_ros.report import REPORT
from ofsat_ros.results import RUN, ResultError, read_run

_SHOWN = 40
_COLUMNS = [name for name in TRACK_DTYPE.names or () if name != "result"]
# Sorted by them, most come first.
_MOST_FIRST = {"snr", "flux", "rate_px_s", "rate_arcsec_s", "detections", "length_px"}
# Heads of the table on a terminal, and their widths.
_TABLE = (
    *(("first seen, UTC", 23), ("RSO", 5), ("frames", 6), ("SNR", 6), ("mag", 7)),
    *(("px/s", 8), ("arcsec/s", 9), ("RA deg", 9), ("DEC deg", 8)),
)


class _Span(click.ParamType):
    """A lowest and a highest value, either of which may be missing."""

    name = "LOW..HIGH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        low, dots, high = f"{value}".partition("..")
        try:
            limits = float(low or "-inf"), float(high or "inf")
        except ValueError:
            limits = (math.nan, math.nan)
        if not dots or not limits[0] <= limits[1]:
            self.fail(f"{value!r} is no range: give it as 5..20, 5.. or ..20", param, ctx)
        return limits


@click.command(
    "catalog", epilog="Example: ofsat catalog found --cone 83.6 22.0 2 --snr 8.. --sort snr"
)
@click.argument("place", metavar="CATALOG", type=click.Path(path_type=Path))
@click.option("--from", "from_ns", type=Instant(), metavar="UTC", help="seen then or later")
@click.option("--to", "to_ns", type=Instant(), metavar="UTC", help="seen then or before")
@click.option("--night", metavar="DATE", help="recorded in the night that begins on that day")
@click.option(
    "--cone", nargs=3, type=float, metavar="RA DEC RADIUS", help="path crosses it; degrees, ICRS"
)
@click.option("--px-s", "rate_px_s", type=_Span(), help="rate against the stars, px/s")
@click.option("--arcsec-s", "rate_arcsec_s", type=_Span(), help="rate on the sky, arcsec/s")
@click.option("--snr", type=_Span(), help="median SNR")
@click.option("--magnitude", type=_Span(), help="instrumental: -2.5 log of the flux in DN")
@click.option("--recording", metavar="TEXT", help="part of the recording's path")
@click.option("--sort", type=click.Choice(_COLUMNS), metavar="COLUMN", help="a column of --csv")
@click.option("--limit", type=click.IntRange(min=0), help=f"rows; of a table, default {_SHOWN}")
@click.option("--csv", "form", flag_value="csv", help="print all columns, as CSV")
@click.option("--json", "form", flag_value="json", help="print all columns, as JSON")
@click.option(
    "--add",
    "folders",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="take in the results in DIR and below it; repeatable",
)
@seldom_option("--prune", is_flag=True, help="forget results whose folders are gone")
@click.option("--report", is_flag=True, help=f"write {REPORT} and a page for each night")
@seldom_option(
    "--longitude",
    type=click.FloatRange(-180, 360),
    help="of the site, degrees east: nights are by its noon from now on",
)
@help_all
def command(place: Path, **options: Any) -> None:
    """List tracks of CATALOG, which ofsat batch makes, or --add: a folder or its .sqlite file."""
    changes = {name: options.pop(name) for name in ("folders", "prune", "report", "longitude")}
    form, limit, sort = (options.pop(name) for name in ("form", "limit", "sort"))
    bad = 0
    try:
        write = bool(changes["folders"] or changes["prune"] or changes["longitude"] is not None)
        with Catalog(place, write=write) as catalog:
            bad = _change(catalog, **changes)
            wanted = _selection(catalog, **options)
            if not (write or changes["report"]) or form or wanted != Selection():
                _answer(catalog, wanted, sort or "first_stamp_ns", limit, form)
    except BrokenPipeError:
        raise  # click knows it
    except (CatalogError, ResultError, ModuleNotFoundError, OSError) as error:
        fail(error)
    if bad:
        sys.exit(1)


def _selection(
    catalog: Catalog, cone: tuple[float, float, float] | None, night: str | None, **others: Any
) -> Selection:
    try:
        where = Cone(*cone) if cone else None
        began = None
        if night is not None:
            of = Night.parse(night, catalog.longitude_deg or 0.0)
            began = of.first_ns, of.end_ns
    except ValueError as error:
        raise click.UsageError(f"{error}") from error
    return Selection(cone=where, began=began, **others)


def _change(
    catalog: Catalog, folders: tuple[Path, ...], prune: bool, report: bool, longitude: float | None
) -> int:
    """Do what is to be done to a catalogue, say so, and return how much of it could not be."""
    bad = 0
    if longitude is not None:
        catalog.longitude_deg = longitude
        click.echo(f"nights of {catalog.path} are by the noon of longitude {longitude:g}")
    if folders:
        taken = there = 0
        for folder in _found(folders):
            try:
                if catalog.add(folder):
                    taken += 1
                else:
                    there += 1
            except (ResultError, OSError) as error:
                bad += 1
                say(f"note: {in_words(error)}")
        if not taken + there + bad:
            bad = 1
            say(f"note: there is no {RUN} in {', '.join(map(str, folders))} or below")
        click.echo(f"{taken} results are taken in, {there} were there, {bad} are left out")
    if prune:
        click.echo(f"{catalog.remove_missing()} results are forgotten: their folders are gone")
    if report:
        from ofsat_ros.report.archive import NIGHTS, write_pages  # heavy

        home = catalog.path.parent
        write_pages(catalog, home)
        click.echo(f"{REPORT} and {NIGHTS} are in {home}")
    return bad


def _found(folders: tuple[Path, ...]) -> list[Path]:
    """Return the folders of results in and below some, those that were made last at the end."""
    found = {run.parent.resolve() for folder in folders for run in folder.rglob(RUN)}
    # What is inside results are those of a run that was stopped over them.
    whole = [folder for folder in found if not found.intersection(folder.parents)]
    return sorted(whole, key=lambda folder: (_made(folder), folder))


def _made(folder: Path) -> str:
    try:
        return read_run(folder)["started_utc"] or ""
    except (ResultError, OSError):
        return ""  # which is told when it is taken in


def _answer(
    catalog: Catalog, wanted: Selection, sort: str, limit: int | None, form: str | None
) -> None:
    most = _SHOWN if limit is None and not form else limit
    tracks = catalog.query(wanted, sort=sort, descending=sort in _MOST_FIRST, limit=most)
    if not len(tracks):
        say(catalog.why_none(wanted) if most != 0 else "no row is wanted")
    if form == "csv":
        rows = csv.writer(sys.stdout, lineterminator="\n")
        rows.writerow(_COLUMNS)
        rows.writerows(_row(track) for track in tracks)
    elif form == "json":
        named = [dict(zip(_COLUMNS, _row(track), strict=True)) for track in tracks]
        click.echo(json.dumps([_nulled(row) for row in named], indent=2, ensure_ascii=False))
    elif len(tracks):
        for line in _table(tracks):
            click.echo(line)
        if len(tracks) == most and (every := catalog.count(wanted)) > most:
            click.echo(f"{len(tracks)} of {every} tracks: --limit, --csv or --json show more")


def _row(track: np.void) -> list[Any]:
    values = (track[name] for name in _COLUMNS)
    return [value.item() if isinstance(value, np.generic) else value for value in values]


def _nulled(row: dict[str, Any]) -> dict[str, Any]:
    """JSON knows no NaN."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.items()
    }


def _table(tracks: NDArray[np.void]) -> Iterator[str]:
    yield "  ".join(f"{name:>{width}}" for name, width in _TABLE) + "  recording"
    for track in tracks:
        cells = [utc_text(int(track["first_stamp_ns"]))[:23].removesuffix("Z")]
        cells += [f"{track['track_id']}", f"{track['detections']}"]
        numbers = ("snr", "magnitude", "rate_px_s", "rate_arcsec_s", "first_ra_deg")
        for name, form in zip(
            (*numbers, "first_dec_deg"), (".1f", ".2f", ".4g", ".4g", ".4f", "+.4f"), strict=True
        ):
            cells.append(f"{track[name]:{form}}" if np.isfinite(track[name]) else "-")
        row = "  ".join(f"{cell:>{w}}" for cell, (_, w) in zip(cells, _TABLE, strict=True))
        yield f"{row}  {printable(track['recording'])}"
