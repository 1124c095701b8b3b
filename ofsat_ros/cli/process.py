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
    claim,
    fail,
    help_all,
    in_words,
    of_table,
    parameter_options,
    recording_argument,
    recording_options,
    say,
)
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
            _claim(output, bag, video, force)
            writer = stack.enter_context(ResultWriter(output))
            scale = DetectorParameters().marker_scale
            results = stack.enter_context(ResultBag(output, scale)) if bag else None
            try:
                processing.run(frames, writer, results)
                run["stopped"] = False
            finally:
                # Also when stopped: whole, with what was done.
                made += _write_arcs(arcs, output, formats, processing.note)
                run |= source | _origin(paths, frames) | processing.totals.as_dict()
                run["seconds"] = time.monotonic() - start_s
                write_run(output, run)
        if processing.totals.frames:
            made += _write_report(output, report, video)
            write_run(output, run)
    except (RecordingError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        say(_stopped(processing.totals, output, done=not run["stopped"]))
        sys.exit(130)
    if not processing.totals.frames:
        fail(f"no frame of {frames.path} could be processed")
    if as_json:
        click.echo(json.dumps(run, indent=2, ensure_ascii=False))
        return
    *first, last = (name for name in made if name != f"{video}")
    film = f", the video is {video}" if video else ""
    click.echo(f"{processing.totals}; {', '.join(first)} and {last} are in {output}{film}")
    if profile:
        click.echo(processing.totals.profile())


def _claim(output: Path, bag: bool, video: Path | None, force: bool) -> None:
    """Make way for all that is written, or refuse."""
    if video is not None and video.exists() and not force:
        raise RecordingError(f"{video} exists: choose another name, or --force to replace it")
    files = [DETECTIONS, TRACKS, STAR_FIELD, *TRACKING_DATA.values(), REPORT, RUN]
    # A folder of that name is another's, unless it is a bag.
    if bag or (output / BAG / "metadata.yaml").exists():
        files.append(BAG)
    claim(output, files, force)


def _stopped(totals: Totals, output: Path, done: bool) -> str:
    """Say what is there after Ctrl-C, and what is still to be had of it."""
    if not totals.frames:
        return "stopped; no frame was processed"
    far = "" if done else " so far"
    return f"stopped; {totals}{far}, in {output}; `ofsat report {output}` makes a page of it"


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
