# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat batch``: many recordings on many cores or machines, and a catalogue of their tracks."""

from __future__ import annotations

import sys
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import click
from tqdm import tqdm

from ofsat_ros.batch import (
    BATCH,
    RESULTS,
    Batch,
    Cluster,
    ClusterError,
    Order,
    Outcome,
    Place,
    Settings,
    find_recordings,
)
from ofsat_ros.catalog import CATALOG, Catalog, CatalogError
from ofsat_ros.cli.terminal import (
    fail,
    help_all,
    in_words,
    job_options,
    recording_options,
    say,
    seldom_option,
)
from ofsat_ros.parameters import (
    ParameterError,
)
from ofsat_ros.recordings import RecordingError
from ofsat_ros.report import REPORT
from ofsat_ros.report.archive import NIGHTS, write_pages
from ofsat_ros.results import ResultError

_SOURCE = ("topic", "camera_info_topic", "attitude_topic", "fps", "exposure_s", "start_ns")
# Without a terminal, how often it is told how far it is.
_LINE_EVERY_S = 30.0
_SOME_FAILED = 3


@click.command("batch", epilog="Example: ofsat batch /archive/2026 -o /archive/found")
@click.argument(
    "places", metavar="DIR...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    help=f"folder for results, {CATALOG} and pages; or of a batch, to go on with it",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    metavar="COUNT",
    help="processes to work with here; default: one a core",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="work on the cluster of this Dask scheduler, as tls://host:8786",
)
@seldom_option(
    "--segment-frames",
    type=click.IntRange(min=0),
    default=500,
    metavar="COUNT",
    help="where there are more workers than recordings, cut these into segments of at least so"
    " many frames; 0: never; default: 500",
)
@recording_options
@job_options
@help_all
def command(
    places: tuple[Path, ...],
    output: Path,
    workers: int | None,
    scheduler: str | None,
    segment_frames: int,
    report: bool | None,
    bag: bool,
    formats: tuple[str, ...],
    preset: str,
    live: bool,
    **options: Any,
) -> None:
    """Process all recordings in DIR... and catalogue their tracks; given again, go on with it."""
    if scheduler and workers:
        raise click.UsageError("--workers is for this machine: a scheduler has workers of its own")
    source = {name: options.pop(name) for name in _SOURCE}
    given = {name: value for name, value in options.items() if value is not None}
    settings = Settings(source, preset, given, formats, bag, live, segment_frames)
    try:
        settings.check()
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    batch: Batch | None = None
    screen: _Screen | None = None
    try:
        with ExitStack() as stack:
            place = stack.enter_context(Place(output))
            found = find_recordings(places, besides=output)
            if not found:
                raise RecordingError(f"there is no recording in {' '.join(map(str, places))}")
            order = Order(f"{output.resolve()}", place.run, 1, report)
            catalog = stack.enter_context(Catalog(output / CATALOG, write=True))
            screen = stack.enter_context(_Screen(catalog, output, len(found), bool(report)))
            batch = Batch(place, found, settings, order, screen.finished)
            with Cluster(order, scheduler, workers) as cluster:
                batch.run(cluster, screen.show)
            failed = [outcome for outcome in batch.outcomes if outcome.state == "failed"]
            screen.catch_up()
            pages = _write_pages(catalog, output, failed)
    except (RecordingError, ClusterError, CatalogError, ModuleNotFoundError, OSError) as error:
        fail(error, f"; {screen}" if screen else "")
    except KeyboardInterrupt:
        far = f"; {screen}; run the same command again to go on" if screen else ""
        say(f"stopped{far}")
        sys.exit(130)
    for outcome in failed:
        say(_failure(outcome))
    click.echo(f"{screen}; {', '.join([RESULTS, CATALOG, *pages])} and {BATCH} are in {output}")
    if len(failed) == len(found):
        sys.exit(1)
    sys.exit(_SOME_FAILED if failed else 0)


class _Screen:
    """What the user sees and the catalogue learns of a batch at work; a context manager.

    Parameters
    ----------
    catalog : Catalog
    output : Path
    count : int
        Recordings in all.
    report : bool
        Whether each result is to have a page.
    """

    def __init__(self, catalog: Catalog, output: Path, count: int, report: bool) -> None:
        self._catalog, self._output, self._count = catalog, output, count
        self._report = report
        self._late: list[Path] = []
        self._states: Counter[str] = Counter()
        self._bar: tqdm[Any] = tqdm(unit=" frames", dynamic_ncols=True, disable=None)
        self._begun_s = self._told_s = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __str__(self) -> str:
        done, skipped, failed = (self._states[each] for each in ("done", "skipped", "failed"))
        words = f"{done + skipped + failed} of {self._count} recordings"
        parts = [f"{done} done"]
        parts += [f"{skipped} skipped, done before"] * bool(skipped)
        parts += [f"{failed} failed"] * bool(failed)
        return f"{words}: {', '.join(parts)}"

    def finished(self, outcome: Outcome) -> None:
        """Count a recording, and add what was found in it to the catalogue."""
        self._states[outcome.state] += 1
        if outcome.state == "failed":
            say(_failure(outcome))
            return
        folder = self._output / outcome.folder
        if self._report and not (folder / REPORT).is_file():
            say(f"note: {folder} was done before, without a page: `ofsat report {folder}`")
        try:
            self._add(folder)
        except CatalogError:
            self._late.append(folder)  # somebody looks into the file: work goes on

    def catch_up(self) -> None:
        """Add what the catalogue could not take in at its time; raises CatalogError."""
        for folder in self._late:
            self._add(folder)

    def _add(self, folder: Path) -> None:
        try:
            self._catalog.add(folder)
        except (ResultError, OSError) as error:
            say(f"note: {CATALOG} is without {folder}: {in_words(error)}")

    def show(self, done: int, total: float) -> None:
        """Tell how many frames are done, and of how many."""
        if not self._bar.disable:
            self._bar.total = round(total) or None
            self._bar.n = done
            self._bar.set_postfix_str(f"{self}", refresh=False)
            self._bar.refresh()
        elif time.monotonic() - self._told_s > _LINE_EVERY_S:
            self._told_s = time.monotonic()
            left_s = (self._told_s - self._begun_s) * (total / done - 1) if done else 0.0
            left = f", {tqdm.format_interval(left_s)} left" if done else ""
            say(f"{self}; {done} of about {total:.0f} frames{left}")


def _failure(outcome: Outcome) -> str:
    where = "" if outcome.recording in outcome.reason else f"{outcome.recording}: "
    return f"failed: {where}{outcome.reason}"


def _write_pages(catalog: Catalog, output: Path, failed: list[Outcome]) -> list[str]:
    """Write the page of each night and that of the archive, and return what to name of them."""
    catalog.remove_missing(output / RESULTS)
    try:
        write_pages(catalog, output, {outcome.recording: outcome.reason for outcome in failed})
    except ModuleNotFoundError as error:
        say(f"note: no page is written: {error}")
        return []
    return [REPORT, NIGHTS]
