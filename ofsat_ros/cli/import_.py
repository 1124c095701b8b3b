"""``ofsat import``: any recording into a bag."""

from __future__ import annotations

import sys
from collections.abc import Generator
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from ofsat_ros.cli.camera_bag import CameraBag, bag_options
from ofsat_ros.cli.terminal import fail, help_all, recording_options, say
from ofsat_ros.recordings import Attitude, Frame, RecordingError, open_recording

_NOTES_SHOWN = 10
_Item = tuple[Frame | None, tuple[Attitude, ...]]


@click.command("import", epilog="Example: ofsat import night1/*.fits -o night1_bag")
@click.argument(
    "recordings", metavar="INPUT...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="bag to make: a new folder",
)
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
    them.  All INPUTs go into one bag, in the order of time.  Colour becomes luminance.
    """
    reading = _Reading(recordings, options)
    bag = None
    try:
        _check(recordings, output, options)
        with closing(reading.items()) as items:
            # Nothing is made, or replaced, for what cannot be read.
            first = next((item for item in items if item[0] is not None), None)
            if first is None or first[0] is None:
                reading.tell_notes()
                fail("no frame could be read; nothing is written")
            if compressed and first[0].image.dtype.kind == "f":
                fail("PNG cannot hold these images, which are of floats: leave out --compressed")
            with CameraBag(output, storage, compressed, force) as bag:
                for frame, attitudes in chain([first], items):
                    bag.add_attitudes(attitudes)
                    if frame is not None:
                        bag.add_frame(frame.image, frame.stamp_ns, frame.camera)
    except (RecordingError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        done = f"{bag.frames} frames are in {output}" if bag else "nothing is written"
        say(f"stopped; {done}")
        sys.exit(130)
    reading.tell_notes()
    words = f" ({reading.skipped} more could not be read)" if reading.skipped else ""
    click.echo(f"{bag.frames} frames{words} on {bag.image_topic} are in {output}")


def _check(recordings: tuple[Path, ...], output: Path, options: dict[str, Any]) -> None:
    """Refuse to write over what is read, or to make up times that would coincide."""
    if len(recordings) > 1 and options["fps"]:
        raise RecordingError(
            "--fps counts from the beginning of each INPUT: give one alone, or the folder of all"
        )
    target = output.resolve()
    for path in recordings:
        if target in (path.resolve(), *path.resolve().parents):
            raise RecordingError(f"{path} is read, so it cannot be the output: choose another one")


class _Reading:
    """The frames of several recordings, one after the other, under one progress bar."""

    def __init__(self, paths: tuple[Path, ...], options: dict[str, Any]) -> None:
        self._paths, self._options = paths, options
        self._notes: dict[str, None] = {}  # in their order, each once
        self._stamps: set[int] = set()
        self._frames = self.skipped = 0

    def items(self) -> Generator[_Item, None, None]:
        """Yield each frame with the attitudes before it; None with those after the last."""
        with tqdm(unit=" frames", dynamic_ncols=True, disable=None) as bar:
            for i, path in enumerate(self._paths):
                try:
                    yield from self._one(path, len(self._paths) - i, bar)
                except RecordingError as error:
                    if len(self._paths) == 1:
                        raise
                    self._notes[f"{error}"] = None

    def _one(self, path: Path, left: int, bar: tqdm) -> Generator[_Item, None, None]:
        with open_recording(path, **self._options) as recording:
            # As if those that come were as long.
            bar.total = bar.n + len(recording) * left
            for frame in recording:
                yield frame, frame.attitudes
                self._stamps.add(frame.stamp_ns)
                self._frames += 1
                bar.update()
            yield None, recording.last_attitudes
            self.skipped += recording.skipped
            self._notes |= dict.fromkeys(recording.problems)

    def tell_notes(self) -> None:
        """Say what the user should know of the recordings."""
        notes = list(self._notes)
        if same := self._frames - len(self._stamps):
            notes.insert(0, f"{same} frames have the time of another frame")
        for note in notes[:_NOTES_SHOWN]:
            say(f"note: {note}")
        if len(notes) > _NOTES_SHOWN:
            say(f"note: and {len(notes) - _NOTES_SHOWN} more such notes")
