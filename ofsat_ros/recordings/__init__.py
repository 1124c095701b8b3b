"""Recordings: frames in from bags, FITS, SER, video and images, and bags out.

It stands before the pipeline offline, as the camera does live: ``open_recording`` yields the
frames that ``Pipeline.process`` takes, whatever they are read from; a module for each kind knows
the files.  ``Bag`` (bag.py) gives the messages as they were recorded, which is what the player
publishes; ``BagWriter`` (bag_writer.py) writes what the simulator renders and what the recorder
hears.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ofsat_ros.recordings import fits, pictures, ser, video
from ofsat_ros.recordings.bag import (
    ATTITUDE,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    SUFFIXES,
    Bag,
    RecordingError,
    Topic,
)
from ofsat_ros.recordings.bag_source import BagSource
from ofsat_ros.recordings.bag_writer import BagWriter, remove_bag
from ofsat_ros.recordings.messages import header_message, message_type
from ofsat_ros.recordings.recording import Attitude, Frame, Recording, Source
from ofsat_ros.recordings.storage import suffix_of

__all__ = [
    "ATTITUDE",
    "CAMERA_INFO",
    "COMPRESSED_IMAGE",
    "IMAGE",
    "Attitude",
    "Bag",
    "BagWriter",
    "Frame",
    "Recording",
    "RecordingError",
    "Topic",
    "header_message",
    "message_type",
    "open_recording",
    "remove_bag",
]


def open_recording(
    path: str | Path,
    topic: str | None = None,
    camera_info_topic: str | None = None,
    attitude_topic: str | None = None,
    fps: float | None = None,
    exposure_s: float | None = None,
) -> Recording:
    """Open a recording to read its frames.

    Parameters
    ----------
    path : str or Path
        A rosbag2 folder, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``; a FITS file or a
        folder of them; a SER or video file; a folder of PNG, TIFF, JPEG or BMP pictures.
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

    Returns
    -------
    Recording
        To be used in a ``with`` statement.

    Raises
    ------
    RecordingError
        If there is nothing at `path`, or nothing readable, or no image topic, or several and none
        is chosen, or a chosen topic is not there; or if times are needed and `fps` is not given.
    """
    thread = ThreadPoolExecutor(1, "recording")
    names = (topic or None, camera_info_topic or None, attitude_topic or None)
    try:
        source = thread.submit(_source_of, Path(path), names, fps, exposure_s).result()
        return Recording(source, thread)
    except BaseException:
        thread.shutdown()
        raise


def _source_of(
    path: Path,
    names: tuple[str | None, str | None, str | None],
    fps: float | None,
    exposure_s: float | None,
) -> Source:
    """Return what reads the kind of recording that there is at `path`."""
    for value, what in ((fps, "a rate of frames"), (exposure_s, "an exposure")):
        if value is not None and not 0 < value < 1e9:
            raise RecordingError(f"{what} must be greater than 0, not {value:g}")
    try:
        if not path.exists():
            raise RecordingError(f"{path} does not exist: check the path")
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        if any(file.name == "metadata.yaml" or suffix_of(file) for file in files):
            if fps is not None:
                raise RecordingError(f"{path} is a bag, whose images have stamps: no rate is used")
            return BagSource(path, *names, exposure_s)
        return _source_of_files(path, files, names, fps, exposure_s)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error}") from error


def _source_of_files(
    path: Path,
    files: list[Path],
    names: tuple[str | None, str | None, str | None],
    fps: float | None,
    exposure_s: float | None,
) -> Source:
    fits_files = [
        file for file in files if _ends(file, fits.SUFFIXES) or _begins(file, fits.MAGIC)
    ]
    if names[1:] != (None, None) or (names[0] and not fits_files):
        raise RecordingError(f"{path} is no bag, and has no topics to choose")
    if fits_files:
        return fits.FitsSource(path, fits_files, names[0], fps, exposure_s)
    ser_files = [file for file in files if _ends(file, ser.SUFFIXES) or _begins(file, ser.MAGIC)]
    if films := ser_files or [file for file in files if _ends(file, video.SUFFIXES)]:
        if len(films) > 1:
            listing = ", ".join(file.name for file in films)
            raise RecordingError(f"{path} has several recordings; open one of {listing}")
        film = ser.SerSource if ser_files else video.VideoSource
        return film(films[0], fps, exposure_s)
    if found := [file for file in files if _ends(file, pictures.SUFFIXES)]:
        return pictures.PictureSource(path, found, fps, exposure_s)
    known = (*SUFFIXES, *fits.SUFFIXES, *ser.SUFFIXES, *video.SUFFIXES, *pictures.SUFFIXES)
    if path.is_dir():
        raise RecordingError(
            f"{path} is no bag: it has neither a metadata.yaml nor a file that ends in"
            f" {', '.join(known)}"
        )
    raise RecordingError(
        f"{path} is no recording known here: give a rosbag2 folder, or a file that ends in"
        f" {', '.join(known)}, or a folder of FITS files or pictures"
    )


def _ends(file: Path, suffixes: tuple[str, ...]) -> bool:
    return file.name.lower().endswith(suffixes) and not file.name.startswith(".")


def _begins(file: Path, content: bytes) -> bool:
    """Whether a file of another name has this content."""
    if file.suffix in ("", ".dat", ".tmp", ".part") and file.is_file():
        with file.open("rb") as opened:
            return opened.read(len(content)) == content
    return False
