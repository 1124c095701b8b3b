# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat import``: any recording into a bag."""

from __future__ import annotations

import sys
from itertools import chain
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from ofsat_ros.cli.camera_bag import CameraBag, bag_folder, bag_options, bag_output, left
from ofsat_ros.cli.terminal import (
    fail,
    help_all,
    recording_options,
    say,
    spare_input,
)
from ofsat_ros.recordings import RecordingError, open_recording

_NOTES_SHOWN = 10


@click.command("import", epilog="Example: ofsat import night1/*.fits -o night1_bag")
@click.argument(
    "recordings", metavar="INPUT...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@bag_output
@recording_options
@bag_options
@help_all
def command(
    recordings: tuple[Path, ...],
    output: Path,
    storage: str,
    compressed: bool,
    force: bool,
    **options: Any,
) -> None:
    """Turn INPUT into a bag: images, with calibration and attitude where they are known.

    INPUT is what process reads: FITS, SER, a video, images, another bag; a file, or a folder of
    them.  Several INPUTs of one kind are one recording.  Colour becomes luminance.
    """
    work = bag = None
    try:
        spare_input(recordings, output)
        with (
            open_recording(recordings, **options) as recording,
            tqdm(
                total=len(recording) or None, unit=" frames", dynamic_ncols=True, disable=None
            ) as bar,
        ):
            frames = iter(recording)
            # Nothing is made, or replaced, for what cannot be read.
            first = next(frames, None)
            if first is None:
                _tell(recording.problems)
                fail("no frame could be read; nothing is written")
            if compressed and first.image.dtype.kind == "f":
                fail("PNG cannot hold these images, which are of floats: leave out --compressed")
            work = bag_folder(output, force)
            with work, CameraBag(work.folder / output.name, storage, compressed) as bag:
                for frame in chain([first], frames):
                    bag.add_attitudes(frame.attitudes)
                    bag.add_frame(frame.image, frame.stamp_ns, frame.camera)
                    work.filled = True
                    bar.update()
                bag.add_attitudes(recording.last_attitudes)
    except (RecordingError, OSError) as error:
        fail(error, f"; {left(work, bag, failed=True)}" if bag else "")
    except KeyboardInterrupt:
        say(f"stopped; {left(work, bag)}")
        sys.exit(130)
    _tell(recording.problems)
    words = f" ({recording.skipped} more could not be read)" if recording.skipped else ""
    click.echo(f"{bag.frames} frames{words} on {bag.image_topic} are in {output}")


def _tell(notes: list[str]) -> None:
    """Say what the user should know of the recording."""
    for note in notes[:_NOTES_SHOWN]:
        say(f"note: {note}")
    if len(notes) > _NOTES_SHOWN:
        say(f"note: and {len(notes) - _NOTES_SHOWN} more such notes")
