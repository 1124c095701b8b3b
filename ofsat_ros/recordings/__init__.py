# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Recordings: frames in from bags, FITS, SER, video and images, and bags out.

It stands before the pipeline offline, as the camera does live: ``open_recording`` yields the
frames that ``Pipeline.process`` takes, whatever they are read from; a module for each kind knows
the files, and kinds.py which it is.  ``Bag`` (bag.py) gives the messages as they were recorded,
which is what the player publishes; ``BagWriter`` (bag_writer.py) writes what the simulator renders
and what the recorder hears.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ofsat_ros.recordings.bag import (
    ATTITUDE,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    Bag,
    RecordingError,
    Topic,
    TopicError,
)
from ofsat_ros.recordings.bag_writer import BagWriter, check_bag, remove_bag
from ofsat_ros.recordings.held import HeldError, hold
from ofsat_ros.recordings.kinds import source_of
from ofsat_ros.recordings.messages import header_message, message_type
from ofsat_ros.recordings.recording import Attitude, Frame, Recording
from ofsat_ros.recordings.timing import Hints, utc_ns, utc_text

__all__ = [
    "ATTITUDE",
    "CAMERA_INFO",
    "COMPRESSED_IMAGE",
    "IMAGE",
    "Attitude",
    "Bag",
    "BagWriter",
    "Frame",
    "HeldError",
    "Recording",
    "RecordingError",
    "Topic",
    "TopicError",
    "check_bag",
    "header_message",
    "hold",
    "message_type",
    "open_recording",
    "remove_bag",
    "utc_ns",
    "utc_text",
]


def open_recording(
    path: str | Path | Sequence[str | Path],
    topic: str | None = None,
    camera_info_topic: str | None = None,
    attitude_topic: str | None = None,
    fps: float | None = None,
    exposure_s: float | None = None,
    start_ns: int | None = None,
    first: int = 0,
    end: int | None = None,
) -> Recording:
    """Open a recording to read its frames.

    Parameters
    ----------
    path : str or Path, or sequence of them
        A rosbag2 folder, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``; a FITS file or a
        folder of them; a SER or video file; a folder of PNG, TIFF, JPEG or BMP pictures.  Several
        of one kind are one recording, in the order of time.
    topic : str, optional
        Image topic to read; not needed if there is only one.  Of FITS with images of several
        names, the name.
    camera_info_topic, attitude_topic : str, optional
        Topics of the calibration and of the attitude; not needed if they are ``camera_info`` and
        ``attitude`` beside the image topic, or the only ones of their types.
    fps : float, optional
        Frames per second, where the files do not give each frame its own time; of a video,
        instead of the rate at which it plays.
    exposure_s : float, optional
        Length of the exposures, s, where the headers do not tell it.
    start_ns : int, optional
        When the first exposure began, ns UTC, where the files do not give each frame its time.
    first, end : int, optional
        Read only the frames of these numbers, the latter left out.  They keep their numbers and
        their times, and what was recorded before them of calibration and attitude.

    Returns
    -------
    Recording
        To be used in a ``with`` statement.

    Raises
    ------
    RecordingError
        If there is nothing at `path`, or nothing readable, or no image topic, or several and none
        is chosen (`TopicError`), or a chosen topic is not there; or if times are needed and `fps`
        is not given.
    """
    paths = [path] if isinstance(path, str | Path) else path
    names = (topic or None, camera_info_topic or None, attitude_topic or None)
    hints = Hints(fps, exposure_s, start_ns)
    thread = ThreadPoolExecutor(1, "recording")
    try:
        files = [Path(each) for each in paths]
        source, notes = thread.submit(source_of, files, names, hints).result()
        return Recording(source, notes, thread, first, end)
    except BaseException:
        thread.shutdown()
        raise
