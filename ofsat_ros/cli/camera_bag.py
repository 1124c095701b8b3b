# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The bag of one camera that commands write: its images, and what gives their directions."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np

from ofsat_ros.camera import Camera
from ofsat_ros.cli.unfinished import Unfinished
from ofsat_ros.recordings import Attitude, BagWriter, RecordingError

IMAGE_TOPIC = "/camera/image_raw"
CAMERA_INFO_TOPIC, ATTITUDE_TOPIC = "/camera/camera_info", "/camera/attitude"
FRAME_ID = "camera_optical_frame"


class CameraBag(BagWriter):
    """A bag of one camera's frames; a context manager.

    Parameters
    ----------
    path, storage
        As in `BagWriter`.
    compressed : bool
        Write the images as PNG, in CompressedImage messages.

    Attributes
    ----------
    image_topic : str
    frames : int
        Images written so far.

    Raises
    ------
    RecordingError
        As `BagWriter`; so do the methods.
    """

    def __init__(self, path: Path, storage: str, compressed: bool) -> None:
        super().__init__(path, storage=storage, compression="none")
        self._compressed = compressed
        self.image_topic = f"{IMAGE_TOPIC}/compressed" if compressed else IMAGE_TOPIC
        self.frames = 0

    def add_attitudes(self, attitudes: tuple[Attitude, ...]) -> None:
        """Write attitudes, each at its own stamp."""
        for stamp_ns, attitude in attitudes:
            self.write_attitude(ATTITUDE_TOPIC, attitude, stamp_ns, FRAME_ID)

    def add_frame(self, image: np.ndarray, stamp_ns: int, camera: Camera | None) -> None:
        """Write an image, and before it the calibration if there is one."""
        if camera is not None:
            self.write_camera_info(CAMERA_INFO_TOPIC, camera, stamp_ns, FRAME_ID)
        self.write_image(self.image_topic, image, stamp_ns, FRAME_ID, compressed=self._compressed)
        self.frames += 1


def bag_folder(path: Path, force: bool) -> Unfinished:
    """Return where to make a bag, by its name, for a path.

    Raises
    ------
    RecordingError
        If something is there that is not to be replaced.
    """
    if os.path.lexists(path) and not force:
        raise RecordingError(f"{path} exists: choose another path, or --force to replace it")
    if path.name in ("", ".."):
        raise RecordingError(f"{path} is not replaced, since it is no bag: choose another path")
    return Unfinished(
        path.with_name(f"{path.name}.unfinished"), path.parent, [f"{path.name}/"], force
    )


def left(work: Unfinished | None, bag: CameraBag | None, failed: bool = False) -> str:
    """Say what there is of a bag that was not made to its end."""
    if work is None or bag is None or not bag.frames:
        return "nothing is written"
    # How many reached the disk is known of a bag alone that could be closed.
    count = "what could be written is" if failed else f"{bag.frames} frames are"
    words = f"{count} in {work.folder / bag.path.name}"
    return f"{words}, and the earlier bag is as it was" if work.kept else words


bag_output = click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="bag to make: a new folder",
)


def bag_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add ``--storage``, ``--compressed`` and ``--force`` to a command."""
    for option in (
        click.option("--force", is_flag=True, help="replace a bag of that name"),
        click.option("--compressed", is_flag=True, help="write PNG CompressedImage messages"),
        click.option(
            "--storage",
            default="mcap",
            type=click.Choice(["mcap", "sqlite3"]),
            show_default=True,
            help="what holds the bag's messages",
        ),
    ):
        command = option(command)
    return command
