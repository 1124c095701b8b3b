"""The ``ofsat`` command: what needs no ROS graph.

``process`` runs the same `Pipeline` as the detector node over a recording; ``evaluate`` compares
its results with truth; ``simulate`` makes a recording with truth.  Exit code 0: done; 1: the input
or output is not usable; 2: bad usage; 130: stopped by Ctrl-C, with what was done so far on disk.
The summary goes to standard output; progress, notes and errors to standard error.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import click
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros import __version__
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
    Description,
    ParameterError,
    Parameters,
    preset_names,
)
from ofsat_ros.pipeline import ImageError, Pipeline
from ofsat_ros.recordings import BagWriter, Recording, RecordingError, open_recording
from ofsat_ros.results import DETECTIONS, STAR_FIELD, TRACKS, ResultWriter, in_words
from ofsat_ros.simulation import SCENARIOS, scenario, write_truth
from ofsat_ros.tracking import Settled

IMAGE_TOPIC = "/camera/image_raw"
FRAME_ID = "camera_optical_frame"


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 99})
@click.version_option(__version__, prog_name="ofsat")
def main() -> None:
    """Find satellites and debris in recordings of a telescope camera."""


def _parameter_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add an option for each pipeline parameter, from the table."""
    for about in reversed(list(Parameters.describe())):
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
    preset: str,
    live: bool,
    force: bool,
    profile: bool,
    **changes: Any,
) -> None:
    """Detect RSOs in RECORDING: a rosbag2 folder, a bare .mcap or .db3 file, or a ROS 1 bag."""
    try:
        given = {name: value for name, value in changes.items() if value is not None}
        parameters = Parameters.preset(preset, **given)
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    totals = _Totals()
    try:
        with ExitStack() as stack:
            frames = stack.enter_context(open_recording(recording, topic))
            _claim(output, force)
            writer = stack.enter_context(ResultWriter(output))
            _process(frames, Pipeline(parameters), writer, totals, live)
    except (RecordingError, OSError) as error:
        _fail(error)
    except KeyboardInterrupt:
        _say(f"stopped; {totals} so far, in {output}")
        sys.exit(130)
    if not totals.frames:
        _fail(f"no frame of {recording} could be processed")
    click.echo(f"{totals}; {DETECTIONS}, {TRACKS} and {STAR_FIELD} are in {output}")
    if profile:
        click.echo(totals.profile())


class _Totals:
    """Counts and times for the summary."""

    def __init__(self) -> None:
        self.frames = self.left_out = 0
        self.detections: Counter[int] = Counter()
        self.reason = ""
        self.reading_s = 0.0  # in its own thread, beside all others
        self._seconds: dict[str, float] = defaultdict(float)  # none overlap

    @contextmanager
    def timed(self, stage: str) -> Iterator[dict[str, float]]:
        """Count the time of a stage; that of its parts, which it may be told of, apart."""
        parts: dict[str, float] = {}
        start_s = time.perf_counter()
        try:
            yield parts
        finally:
            taken_s = time.perf_counter() - start_s
            for part, seconds in (*parts.items(), (stage, taken_s - sum(parts.values()))):
                self._seconds[part] += seconds

    def profile(self) -> str:
        """Return a table of where the time went."""
        frames, whole_s = max(self.frames, 1), sum(self._seconds.values())
        lines = [f"{'stage':<26}{'ms per frame':>12}{'share':>8}"]
        rows = sorted(self._seconds.items(), key=lambda row: -row[1])
        rows += [("all", whole_s), ("reading, meanwhile", self.reading_s)]
        for stage, seconds in rows:
            name, share = stage.replace("_", " "), f"{seconds / whole_s:.1%}"
            lines.append(f"{name:<26}{1e3 * seconds / frames:>12.2f}{share:>8}")
        return "\n".join(lines)

    def __str__(self) -> str:
        words = f"{in_words(self.detections)} in {self.frames} frames"
        if self.left_out:
            words += f" ({self.left_out} more could not be processed)"
        if not self.detections and self.reason:
            words += f"; the last frame says: {self.reason}"
        return words


def _process(
    frames: Recording, pipeline: Pipeline, writer: ResultWriter, totals: _Totals, live: bool
) -> None:
    refused = 0
    # Numbers in the recording, which count those that could not be decoded, by the pipeline's.
    numbers: dict[int, int] = {}

    def write(stamp_ns: int, frame: int, detections: NDArray[np.void]) -> None:
        writer.add_detections(stamp_ns, frame, detections)
        totals.detections.update(detections["track_id"].tolist())

    def write_settled(settled: list[Settled]) -> None:
        for last in settled:
            number = numbers.pop(last.frame)
            if not live:
                write(last.stamp_ns, number, last.detections)

    coming = iter(tqdm(frames, unit=" frames", dynamic_ncols=True, disable=None))
    try:
        while True:
            with totals.timed("waiting for frames"):
                frame = next(coming, None)
            if frame is None:
                break
            number = frame.number
            try:
                with totals.timed("other") as stages:
                    result = pipeline.process(frame.image, frame.stamp_ns)
                    stages |= result.seconds
            except ImageError as error:
                refused += 1
                if refused == 1:
                    _say(f"note: frame {number} is left out, and others like it: {error}")
                continue
            if result.reset and totals.frames:
                _say(f"note: frame {number} starts afresh: {result.reset}")
            numbers[result.frame] = number
            with totals.timed("writing"):
                writer.add_star_field(replace(result, frame=number))
                if live:
                    write(result.stamp_ns, number, result.detections)
                write_settled(result.settled)
            totals.frames += 1
            totals.reason = result.reason
    finally:
        # Also when stopped or torn off: what was seen is not lost.
        with totals.timed("the last frames' last word"):
            write_settled(pipeline.finish())
        totals.reading_s = frames.seconds
    totals.left_out = refused + frames.skipped
    for problem in frames.problems:
        _say(f"note: {problem}")


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
                bag.write_image(
                    topic, frame.image, frame.stamp_ns, FRAME_ID, compressed=compressed
                )
                rows.append(frame.truth)
        write_truth(truth, rows)
    except (RecordingError, OSError) as error:
        _fail(error)
    except KeyboardInterrupt:
        write_truth(truth, rows)
        _say(f"stopped; {len(rows)} frames are in {output}, their truth in {truth}")
        sys.exit(130)
    click.echo(f"{len(rows)} frames on {topic} are in {output}, their truth in {truth}")


def _claim(folder: Path, force: bool) -> None:
    """Make the folder for the results, or refuse to overwrite those that it holds."""
    folder.mkdir(parents=True, exist_ok=True)
    old = [name for name in (DETECTIONS, TRACKS, STAR_FIELD) if (folder / name).exists()]
    if old and not force:
        raise RecordingError(
            f"{folder} already holds {', '.join(old)}; choose another folder, or --force to"
            " replace them"
        )


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
