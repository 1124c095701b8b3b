# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat process``: the same `Pipeline` as the detector node over a recording."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from ofsat_ros.cli.terminal import (
    fail,
    help_all,
    in_words,
    job_options,
    recording_argument,
    recording_options,
    say,
    spare_existing,
    spare_input,
)
from ofsat_ros.cli.unfinished import Unfinished
from ofsat_ros.parameters import (
    ParameterError,
)
from ofsat_ros.processing import SOURCE, Job, Run, Totals, Watch
from ofsat_ros.recordings import RecordingError
from ofsat_ros.report import REPORT, write_report, write_video
from ofsat_ros.results import DETECTIONS, RUN, STAR_FIELD, TRACKS, ResultError, write_run
from ofsat_ros.results.bag import BAG
from ofsat_ros.tracking_data import TRACKING_DATA

# Where the files are while they are made, in the folder that they are for.
UNFINISHED = "unfinished"


@click.command(
    "process",
    epilog="Example: ofsat process night1 -o night1_found --bag --tdm kvn",
)
@recording_argument
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    help=f"folder for the tables, and {RUN}: how they were made",
)
@recording_options
@click.option(
    "--video",
    type=click.Path(dir_okay=False, path_type=Path),
    help="also write the frames with what was found, to FILE.mp4 or .gif",
)
@job_options
@click.option("--force", is_flag=True, help="replace the results of an earlier run")
@click.option("--profile", is_flag=True, help="print a table of where the time went")
@click.option("--json", "as_json", is_flag=True, help=f"print {RUN} instead of words")
@help_all
def command(
    paths: tuple[Path, ...],
    output: Path,
    report: bool | None,
    video: Path | None,
    bag: bool,
    formats: tuple[str, ...],
    preset: str,
    live: bool,
    force: bool,
    profile: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Detect RSOs in RECORDING: a bag, FITS, SER, video, images; a file, a folder, or several."""
    given = {name: value for name, value in options.items() if value is not None}
    if video is not None and video.suffix.lower() not in (".mp4", ".gif"):
        raise click.BadParameter(f"{video} ends neither in .mp4 nor in .gif", param_hint="--video")
    source = {name: given.pop(name, None) for name in SOURCE}
    recording = tuple(f"{path}" for path in paths)
    try:
        job = Job(recording, source, preset, given, formats, bag, live)
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    run = job.start(say)
    totals, about = run.totals, run.about
    work: Unfinished | None = None
    try:
        with run, _work_folder(paths, output, bag, video, force) as work:
            try:
                with _bar(run) as watch:
                    run.into(work.folder, watch)
            finally:
                # Also when stopped: whole, with what was done.
                work.filled = totals.frames > 0
        if totals.frames:
            about["files"] += _write_report(output, report, video)
            write_run(output, about)
    except (RecordingError, OSError) as error:
        there = work is not None and work.folder.is_dir() and totals.frames
        fail(error, f"; {_left(totals, work)}" if there else "")
    except KeyboardInterrupt:
        say(f"stopped; {_left(totals, work, about['stopped'], hint=True)}")
        sys.exit(130)
    if not totals.frames:
        fail(f"no frame of {run.frames.path} could be processed")
    if as_json:
        click.echo(json.dumps(about, indent=2, ensure_ascii=False))
        return
    *first, last = (name for name in about["files"] if name != f"{video}")
    film = f", the video is {video}" if video else ""
    click.echo(f"{totals}; {', '.join(first)} and {last} are in {output}{film}")
    if profile:
        click.echo(totals.profile())


@contextmanager
def _bar(run: Run) -> Iterator[Watch]:
    """Show how far a run is, where somebody watches."""
    known = len(run.frames) or None
    with tqdm(total=known, unit=" frames", dynamic_ncols=True, disable=None) as bar:

        def watch(done: int, _: int) -> None:
            bar.update(done - bar.n)

        yield watch


def _work_folder(
    paths: tuple[Path, ...], output: Path, bag: bool, video: Path | None, force: bool
) -> Unfinished:
    """Return where to make the results, or refuse if others are in their place."""
    if video is not None:
        spare_input(paths, video)
        spare_existing(video, force)
    names = [DETECTIONS, TRACKS, STAR_FIELD, *TRACKING_DATA.values(), REPORT]
    # A folder of that name is another's, unless it is a bag.
    if bag or (output / BAG / "metadata.yaml").exists():
        names.append(f"{BAG}/")
    names.append(RUN)  # the last one: what is there without it is not whole
    for name in names:
        spare_input(paths, output / name)
    return Unfinished(output / UNFINISHED, output, names, force)


def _left(
    totals: Totals, work: Unfinished | None, stopped: bool = True, hint: bool = False
) -> str:
    """Say what is there of a run that did not end, and what is still to be had of it."""
    if work is None or not totals.frames:
        return "no frame was processed"
    words = f"{totals.counts}{' so far' * stopped}, in {work.folder}"
    if work.kept:
        words += "; the earlier results are as they were"
    return f"{words}; `ofsat report {work.folder}` makes a page of it" if hint else words


def _write_report(output: Path, report: bool | None, video: Path | None) -> list[str]:
    """Write report and video, out of the other files, and return their names."""
    made = []
    try:
        if report is not False:
            made.append(write_report(output, say=say).name)
    except (ModuleNotFoundError, ResultError, OSError) as error:
        # A report that nobody has asked for is written where it can be.
        if report:
            fail(error)
        say(f"note: no report is written: {in_words(error)}")
    try:
        if video is not None:
            made.append(f"{write_video(output, video)}")
    except (ModuleNotFoundError, ResultError, RecordingError, OSError) as error:
        fail(error)
    return made
