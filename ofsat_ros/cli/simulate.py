"""``ofsat simulate``: a recording of simulated frames, with truth."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from ofsat_ros.cli.terminal import fail, say
from ofsat_ros.parameters import ParameterError
from ofsat_ros.recordings import BagWriter, RecordingError
from ofsat_ros.simulation import SCENARIOS, scenario, write_truth

IMAGE_TOPIC = "/camera/image_raw"
CAMERA_INFO_TOPIC, ATTITUDE_TOPIC = "/camera/camera_info", "/camera/attitude"
FRAME_ID = "camera_optical_frame"


@click.command("simulate")
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
def command(
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
        fail(error)
    except KeyboardInterrupt:
        write_truth(truth, rows)
        say(f"stopped; {len(rows)} frames are in {output}, their truth in {truth}")
        sys.exit(130)
    click.echo(f"{len(rows)} frames on {topic} are in {output}, their truth in {truth}")
