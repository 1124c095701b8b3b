# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat simulate``: a recording of simulated frames, with truth."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from ofsat_ros.cli.camera_bag import CameraBag, bag_folder, bag_options, bag_output, left
from ofsat_ros.cli.terminal import fail, say
from ofsat_ros.parameters import ParameterError
from ofsat_ros.recordings import RecordingError
from ofsat_ros.simulation import SCENARIOS, scenario, write_truth


@click.command(
    "simulate", epilog="Example: ofsat simulate -o my_sky --scenario geo --seed 7 --frames 60"
)
@bag_output
@click.option(
    "--scenario",
    "name",
    default="sidereal",
    show_default=True,
    type=click.Choice(list(SCENARIOS)),
    metavar="NAME",
    help=", ".join(SCENARIOS),
)
@click.option("--seed", default=1, show_default=True, help="seed of everything that is random")
@click.option("--frames", type=int, help="number of frames, if not the scenario's")
@click.option(
    "--size", type=(int, int), metavar="WIDTH HEIGHT", help="size in px, if not the scenario's"
)
@click.option("--bit-depth", type=click.IntRange(8, 16), help="bits per pixel")
@bag_options
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
    """Make a bag of simulated frames, and beside it their truth as OUTPUT.truth.csv."""
    changes: dict[str, Any] = {"frames": frames, "bit_depth": bit_depth}
    if size:
        changes.update(width=size[0], height=size[1])
    try:
        sky = scenario(name, seed, **{k: v for k, v in changes.items() if v is not None})
    except ParameterError as error:
        raise click.UsageError(str(error)) from error
    truth = Path(f"{output}.truth.csv")
    work = bag = None
    rows: list[Any] = []
    try:
        work = bag_folder(output, force)
        with work, CameraBag(work.folder / output.name, storage, compressed) as bag:
            for frame in tqdm(sky, total=len(sky), unit=" frames", disable=None):
                bag.add_attitudes(((frame.stamp_ns, frame.attitude),))
                bag.add_frame(frame.image, frame.stamp_ns, sky.camera)
                rows.append(frame.truth)
                work.filled = True
        write_truth(truth, rows)
    except (RecordingError, OSError) as error:
        fail(error, f"; {left(work, bag, failed=True)}" if bag else "")
    except KeyboardInterrupt:
        words = left(work, bag)
        if rows and work and not work.kept:  # or the truth there is of the earlier bag
            write_truth(truth, rows)
            words += f", their truth in {truth}"
        say(f"stopped; {words}")
        sys.exit(130)
    click.echo(f"{len(rows)} frames on {bag.image_topic} are in {output}, their truth in {truth}")
