"""``ofsat process``: the same `Pipeline` as the detector node over a recording."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from ofsat_ros import __version__
from ofsat_ros.camera import Astrometry
from ofsat_ros.cli.terminal import (
    fail,
    help_all,
    in_words,
    of_table,
    parameter_options,
    recording_argument,
    recording_options,
    say,
    spare_input,
)
from ofsat_ros.cli.unfinished import Unfinished
from ofsat_ros.parameters import (
    DEFAULT_PRESET,
    CameraParameters,
    DetectorParameters,
    ParameterError,
    Parameters,
    TrackingDataParameters,
    preset_names,
)
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.processing import Processing, Totals
from ofsat_ros.recordings import Recording, RecordingError, open_recording
from ofsat_ros.report import REPORT, write_report, write_video
from ofsat_ros.results import (
    DETECTIONS,
    RUN,
    STAR_FIELD,
    TRACKS,
    ResultError,
    ResultWriter,
    write_run,
)
from ofsat_ros.results.bag import BAG, ResultBag
from ofsat_ros.tracking_data import TRACKING_DATA, TrackArcs

# Where the files are while they are made, in the folder that they are for.
UNFINISHED = "unfinished"
# Options with which the same frames are opened again.
_SOURCE = ("topic", "camera_info_topic", "attitude_topic", "fps", "exposure_s", "start_ns")


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
    "--report/--no-report",
    default=None,
    help=f"with or without {REPORT}; default: with, if its extra is there",
)
@click.option(
    "--video",
    type=click.Path(dir_okay=False, path_type=Path),
    help="also write the frames with what was found, to FILE.mp4 or .gif",
)
@click.option(
    "--bag", is_flag=True, help=f"also write the bag {BAG}, that plays beside the recording"
)
@click.option(
    "--tdm",
    "formats",
    multiple=True,
    type=click.Choice(list(TRACKING_DATA)),
    help="also write angles: CCSDS TDM (text or XML) or IOD lines; repeatable",
)
@click.option(
    "--preset",
    default=DEFAULT_PRESET,
    type=click.Choice(preset_names()),
    metavar="NAME",
    help=f"set of parameters: {', '.join(preset_names())}; default: {DEFAULT_PRESET}",
)
@click.option(
    "--live", is_flag=True, help="write what the node says at each frame, not the last word on it"
)
@click.option("--force", is_flag=True, help="replace the results of an earlier run")
@click.option("--profile", is_flag=True, help="print a table of where the time went")
@click.option("--json", "as_json", is_flag=True, help=f"print {RUN} instead of words")
@parameter_options(Parameters, CameraParameters, TrackingDataParameters)
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
    try:
        parameters = Parameters.preset(preset, **of_table(Parameters, given))
        astrometry = Astrometry(CameraParameters.of(of_table(CameraParameters, given)))
        about = TrackingDataParameters.of(of_table(TrackingDataParameters, given))
        arcs = TrackArcs(about, formats) if formats else None
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    start_s, started = time.monotonic(), datetime.now(UTC).isoformat(timespec="seconds")
    processing = Processing(Pipeline(parameters), astrometry, arcs, live, say)
    totals = processing.totals
    work: Unfinished | None = None
    made = [DETECTIONS, TRACKS, STAR_FIELD, *([f"{BAG}/"] if bag else [])]
    run: dict[str, Any] = {
        **{"version": __version__, "preset": preset, "live": live, "started_utc": started},
        "parameters": parameters.as_dict() | astrometry.parameters.as_dict() | about.as_dict(),
        **{"stopped": True, "files": made},
    }
    try:
        with ExitStack() as stack:
            source = {name: options[name] for name in _SOURCE}
            frames = stack.enter_context(open_recording(paths, **source))
            work = stack.enter_context(_work_folder(paths, output, bag, video, force))
            writer = stack.enter_context(ResultWriter(work.folder))
            scale = DetectorParameters().marker_scale
            results = stack.enter_context(ResultBag(work.folder, scale)) if bag else None
            try:
                processing.run(frames, writer, results)
                run["stopped"] = False
            finally:
                # Also when stopped: whole, with what was done.
                work.filled = totals.frames > 0
                made += _write_arcs(arcs, work.folder, formats, processing.note)
                run |= source | _origin(paths, frames) | totals.as_dict()
                run["seconds"] = time.monotonic() - start_s
                write_run(work.folder, run)
        if totals.frames:
            made += _write_report(output, report, video)
            write_run(output, run)
    except (RecordingError, OSError) as error:
        there = work is not None and work.folder.is_dir() and totals.frames
        fail(error, f"; {_left(totals, work)}" if there else "")
    except KeyboardInterrupt:
        say(f"stopped; {_left(totals, work, run['stopped'], hint=True)}")
        sys.exit(130)
    if not totals.frames:
        fail(f"no frame of {frames.path} could be processed")
    if as_json:
        click.echo(json.dumps(run, indent=2, ensure_ascii=False))
        return
    *first, last = (name for name in made if name != f"{video}")
    film = f", the video is {video}" if video else ""
    click.echo(f"{totals}; {', '.join(first)} and {last} are in {output}{film}")
    if profile:
        click.echo(totals.profile())


def _work_folder(
    paths: tuple[Path, ...], output: Path, bag: bool, video: Path | None, force: bool
) -> Unfinished:
    """Return where to make the results, or refuse if others are in their place."""
    if video is not None:
        spare_input(paths, video)
        if video.exists() and not force:
            raise RecordingError(f"{video} exists: choose another name, or --force to replace it")
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
    words = f"{totals}{' so far' * stopped}, in {work.folder}"
    if work.kept:
        words += "; the earlier results are as they were"
    return f"{words}; `ofsat report {work.folder}` makes a page of it" if hint else words


def _origin(paths: tuple[Path, ...], frames: Recording) -> dict[str, Any]:
    """Return what was opened; None where there is none."""
    topics = (frames.topic, frames.camera_info_topic, frames.attitude_topic)
    names = dict(zip(_SOURCE, (topic or None for topic in topics), strict=False))
    where = [f"{path.resolve()}" for path in paths]
    return {"recording": where if len(where) > 1 else where[0], **names}


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


def _write_arcs(
    arcs: TrackArcs | None, output: Path, formats: tuple[str, ...], note: Callable[[str], None]
) -> list[str]:
    """Write the tracks' directions, and return the files' names; say so if there are none."""
    if arcs is None:
        return []
    made = [name for name in formats if arcs.write(output / TRACKING_DATA[name], name, force=True)]
    if not made:
        least = arcs.parameters.least_detections
        note(f"no tracking data is written: no track has ra and dec in {least} frames")
    return [TRACKING_DATA[name] for name in made]
