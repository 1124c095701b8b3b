"""``ofsat process``: the same `Pipeline` as the detector node over a recording."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from ofsat_ros.camera import Astrometry
from ofsat_ros.cli.terminal import claim, fail, of_table, parameter_options, say
from ofsat_ros.parameters import (
    DEFAULT_PRESET,
    CameraParameters,
    ParameterError,
    Parameters,
    TrackingDataParameters,
    preset_names,
)
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.processing import Processing
from ofsat_ros.recordings import RecordingError, open_recording
from ofsat_ros.results import DETECTIONS, STAR_FIELD, TRACKS, ResultWriter
from ofsat_ros.tracking_data import TRACKING_DATA, TrackArcs


@click.command("process")
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
@parameter_options(Parameters, CameraParameters, TrackingDataParameters)
def command(
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
        parameters = Parameters.preset(preset, **of_table(Parameters, given))
        astrometry = Astrometry(CameraParameters.of(of_table(CameraParameters, given)))
        about = TrackingDataParameters.of(of_table(TrackingDataParameters, given))
        arcs = TrackArcs(about, formats) if formats else None
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    processing = Processing(Pipeline(parameters), astrometry, arcs, live, say)
    totals = processing.totals
    made = [DETECTIONS, TRACKS, STAR_FIELD]
    try:
        with ExitStack() as stack:
            frames = stack.enter_context(
                open_recording(recording, topic, camera_info_topic, attitude_topic)
            )
            claim(output, [*made, *TRACKING_DATA.values()], force)
            writer = stack.enter_context(ResultWriter(output))
            try:
                processing.run(frames, writer)
            finally:
                # Also when stopped: whole, with what was done.
                made += _write_arcs(arcs, output, formats)
    except (RecordingError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        say(f"stopped; {totals} so far, in {output}")
        sys.exit(130)
    if not totals.frames:
        fail(f"no frame of {recording} could be processed")
    click.echo(f"{totals}; {', '.join(made[:-1])} and {made[-1]} are in {output}")
    if profile:
        click.echo(totals.profile())


def _write_arcs(arcs: TrackArcs | None, output: Path, formats: tuple[str, ...]) -> list[str]:
    """Write the tracks' directions, and return the files' names; say so if there are none."""
    if arcs is None:
        return []
    made = [name for name in formats if arcs.write(output / TRACKING_DATA[name], name, force=True)]
    if not made:
        least = arcs.parameters.least_detections
        say(f"note: no tracking data is written: no track has ra and dec in {least} frames")
    return [TRACKING_DATA[name] for name in made]
