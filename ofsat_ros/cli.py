"""The ``ofsat`` command: what needs no ROS graph.

``process`` runs the same `Pipeline` as the detector node over a recording; ``evaluate`` compares
its results with truth; ``simulate`` makes a recording with truth.  Exit code 0: done; 1: the input
or output is not usable; 2: bad usage; 130: stopped by Ctrl-C, with what was done so far on disk.
The summary goes to standard output; progress, notes and errors to standard error.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NoReturn

import click
from tqdm import tqdm

from ofsat_ros import __version__
from ofsat_ros.camera import Astrometry
from ofsat_ros.evaluation import (
    EvaluationError,
    count_frames,
    read_detections,
    read_truth,
)
from ofsat_ros.evaluation import (
    evaluate as evaluate_detections,
)
from ofsat_ros.parameters import (
    DEFAULT_PRESET,
    CameraParameters,
    Description,
    ParameterError,
    Parameters,
    Table,
    TrackingDataParameters,
    preset_names,
)
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.processing import Processing
from ofsat_ros.recordings import BagWriter, RecordingError, open_recording
from ofsat_ros.results import DETECTIONS, STAR_FIELD, TRACKS, ResultWriter
from ofsat_ros.simulation import SCENARIOS, scenario, write_truth
from ofsat_ros.tracking_data import TRACKING_DATA, TrackArcs

IMAGE_TOPIC = "/camera/image_raw"
CAMERA_INFO_TOPIC, ATTITUDE_TOPIC = "/camera/camera_info", "/camera/attitude"
FRAME_ID = "camera_optical_frame"


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 99})
@click.version_option(__version__, prog_name="ofsat")
def main() -> None:
    """Find satellites and debris in recordings of a telescope camera."""


def _parameter_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add an option for each parameter of a recording's processing, from the tables."""
    tables = (Parameters, CameraParameters, TrackingDataParameters)
    for about in reversed([about for table in tables for about in table.describe()]):
        allowed = f"{about.allowed} {about.unit}".strip()
        option = click.option(
            f"--{about.name.replace('_', '-')}",
            about.name,
            type=_option_type(about),
            help=f"{about.meaning} [{about.stage}; {allowed}]",
        )
        command = option(command)
    return command


def _option_type(about: Description) -> Any:
    return click.Choice(about.choices) if about.choices else type(about.default)


@main.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    help=f"folder for {DETECTIONS}, {TRACKS} and {STAR_FIELD}",
)
@click.option("--topic", help="image topic, if the recording holds several")
@click.option("--camera-info-topic", help="topic of the calibration, if there are several")
@click.option("--attitude-topic", help="topic of the camera's attitude, if there are several")
@click.option(
    "--tdm",
    "formats",
    multiple=True,
    type=click.Choice(list(TRACKING_DATA)),
    help="also write the tracks' right ascensions and declinations: a CCSDS TDM as text (kvn) or"
    " XML, or IOD lines as on SeeSat-L; may be given several times",
)
@click.option("--preset", default=DEFAULT_PRESET, type=click.Choice(preset_names()))
@click.option(
    "--live",
    is_flag=True,
    help="write what the node would say at each frame, candidates included; without it, a track"
    " labels what it was seen as before it was confirmed",
)
@click.option("--force", is_flag=True, help="replace the results of an earlier run")
@click.option("--profile", is_flag=True, help="print a table of where the time went")
@_parameter_options
def process(
    recording: Path,
    output: Path,
    topic: str | None,
    camera_info_topic: str | None,
    attitude_topic: str | None,
    formats: tuple[str, ...],
    preset: str,
    live: bool,
    force: bool,
    profile: bool,
    **changes: Any,
) -> None:
    """Detect RSOs in RECORDING: a rosbag2 folder, a bare .mcap or .db3 file, or a ROS 1 bag."""
    try:
        given = {name: value for name, value in changes.items() if value is not None}
        parameters = Parameters.preset(preset, **_of(Parameters, given))
        astrometry = Astrometry(CameraParameters.of(_of(CameraParameters, given)))
        about = TrackingDataParameters.of(_of(TrackingDataParameters, given))
        arcs = TrackArcs(about, formats) if formats else None
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    processing = Processing(Pipeline(parameters), astrometry, arcs, live, _say)
    totals = processing.totals
    made = [DETECTIONS, TRACKS, STAR_FIELD]
    try:
        with ExitStack() as stack:
            frames = stack.enter_context(
                open_recording(recording, topic, camera_info_topic, attitude_topic)
            )
            _claim(output, [*made, *TRACKING_DATA.values()], force)
            writer = stack.enter_context(ResultWriter(output))
            try:
                processing.run(frames, writer)
            finally:
                # Also when stopped: whole, with what was done.
                made += _write_arcs(arcs, output, formats)
    except (RecordingError, OSError) as error:
        _fail(error)
    except KeyboardInterrupt:
        _say(f"stopped; {totals} so far, in {output}")
        sys.exit(130)
    if not totals.frames:
        _fail(f"no frame of {recording} could be processed")
    click.echo(f"{totals}; {', '.join(made[:-1])} and {made[-1]} are in {output}")
    if profile:
        click.echo(totals.profile())


@main.command()
@click.argument("results", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--live", is_flag=True, help="count only what the node could know: from the third frame on"
)
@click.option("--candidates", is_flag=True, help="count unconfirmed detections too")
@click.option("--json", "as_json", is_flag=True, help="print JSON instead of a table")
@click.option("--list", "listed", is_flag=True, help="also list every miss and false alarm")
def evaluate(
    results: Path, truth: Path, live: bool, candidates: bool, as_json: bool, listed: bool
) -> None:
    """Compare RESULTS, a folder made by process, with the file TRUTH.

    Recall by SNR, precision, false alarms per frame, errors of position and velocity.
    """
    try:
        evaluation = evaluate_detections(
            read_truth(truth),
            read_detections(results),
            frames=count_frames(results),
            live=live,
            candidates=candidates,
        )
    except (EvaluationError, OSError) as error:
        _fail(error)
    if as_json:
        click.echo(json.dumps(evaluation.as_dict(), indent=2))
        return
    click.echo(str(evaluation))
    if listed:
        for row in evaluation.rows("missed", "false alarm"):
            click.echo(row)


@main.command()
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="bag to make: a new folder; its truth is written beside it as OUTPUT.truth.csv",
)
@click.option("--scenario", "name", default="sidereal", type=click.Choice(list(SCENARIOS)))
@click.option("--seed", default=1, show_default=True, help="seed of everything that is random")
@click.option("--frames", type=int, help="number of frames, if not the scenario's")
@click.option(
    "--size", type=(int, int), metavar="WIDTH HEIGHT", help="size in px, if not the scenario's"
)
@click.option("--bit-depth", type=click.IntRange(8, 16), help="bits per pixel")
@click.option("--storage", default="mcap", type=click.Choice(["mcap", "sqlite3"]))
@click.option("--compressed", is_flag=True, help="write PNG CompressedImage messages")
@click.option("--force", is_flag=True, help="replace a bag of that name")
def simulate(
    output: Path,
    name: str,
    seed: int,
    frames: int | None,
    size: tuple[int, int] | None,
    bit_depth: int | None,
    storage: str,
    compressed: bool,
    force: bool,
) -> None:
    """Make a bag of simulated frames, with the truth of what is in them."""
    changes: dict[str, Any] = {"frames": frames, "bit_depth": bit_depth}
    if size:
        changes.update(width=size[0], height=size[1])
    try:
        sky = scenario(name, seed, **{k: v for k, v in changes.items() if v is not None})
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    truth = Path(f"{output}.truth.csv")
    topic = IMAGE_TOPIC + ("/compressed" if compressed else "")
    rows = []
    try:
        with BagWriter(output, storage=storage, compression="none", force=force) as bag:
            for frame in tqdm(sky, total=len(sky), unit=" frames", disable=None):
                stamp_ns = frame.stamp_ns
                bag.write_camera_info(CAMERA_INFO_TOPIC, sky.camera, stamp_ns, FRAME_ID)
                bag.write_attitude(ATTITUDE_TOPIC, frame.attitude, stamp_ns, FRAME_ID)
                bag.write_image(topic, frame.image, stamp_ns, FRAME_ID, compressed=compressed)
                rows.append(frame.truth)
        write_truth(truth, rows)
    except (RecordingError, OSError) as error:
        _fail(error)
    except KeyboardInterrupt:
        write_truth(truth, rows)
        _say(f"stopped; {len(rows)} frames are in {output}, their truth in {truth}")
        sys.exit(130)
    click.echo(f"{len(rows)} frames on {topic} are in {output}, their truth in {truth}")


def _write_arcs(arcs: TrackArcs | None, output: Path, formats: tuple[str, ...]) -> list[str]:
    """Write the tracks' directions, and return the files' names; say so if there are none."""
    if arcs is None:
        return []
    made = [name for name in formats if arcs.write(output / TRACKING_DATA[name], name, force=True)]
    if not made:
        least = arcs.parameters.least_detections
        _say(f"note: no tracking data is written: no track has ra and dec in {least} frames")
    return [TRACKING_DATA[name] for name in made]


def _of(table: type[Table], given: dict[str, Any]) -> dict[str, Any]:
    """Return those of the given values that are a table's."""
    names = {about.name for about in table.describe()}
    return {name: value for name, value in given.items() if name in names}


def _claim(folder: Path, files: list[str], force: bool) -> None:
    """Make the folder for the results, or refuse to overwrite those that it holds."""
    folder.mkdir(parents=True, exist_ok=True)
    old = [name for name in files if (folder / name).exists()]
    if old and not force:
        raise RecordingError(
            f"{folder} already holds {', '.join(old)}; choose another folder, or --force to"
            " replace them"
        )
    # What is not made this time must not stay beside what is.
    for name in old:
        (folder / name).unlink()


def _fail(error: Exception | str) -> NoReturn:
    if isinstance(error, OSError) and error.strerror:
        error = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    _say(f"ofsat: {error}")
    sys.exit(1)


def _say(line: str) -> None:
    """One line on standard error, beside the progress bar."""
    tqdm.write(line, file=sys.stderr)


if __name__ == "__main__":
    main()
