# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Which kind of recording there is at a path, and what reads it."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from ofsat_ros.recordings import fits, pictures, ser, video
from ofsat_ros.recordings.bag import SUFFIXES, RecordingError
from ofsat_ros.recordings.bag_source import BagSource
from ofsat_ros.recordings.recording import Source
from ofsat_ros.recordings.ser import SerSource
from ofsat_ros.recordings.series import Series, TimedSource, common_folder
from ofsat_ros.recordings.storage import suffix_of
from ofsat_ros.recordings.timing import Hints, by_name, names

# Of a folder with files of several kinds, the first one is read.
_SUFFIXES = {
    "bag": SUFFIXES,
    "FITS": fits.SUFFIXES,
    "SER": ser.SUFFIXES,
    "video": video.SUFFIXES,
    "picture": pictures.SUFFIXES,
}
_MAGIC = {"FITS": fits.MAGIC, "SER": ser.MAGIC}
_ALL = ", ".join(suffix for suffixes in _SUFFIXES.values() for suffix in suffixes)
# What of other names may be looked into, in a folder: unfinished files, and solved ones.
_UNTOLD = ("", ".dat", ".tmp", ".part", ".new")
_CONVERT = "other formats (XISF, a camera's raw files) have to be converted to FITS first"
# How deep, and how far, recordings are looked for in the folders below one that holds none.
_DEEPEST, _MOST_FOLDERS, _MOST_TOLD = 3, 1000, 8

Names = tuple[str | None, str | None, str | None]


@dataclass(frozen=True)
class _Found:
    """What there is to read at a path that the user gave, and what else there is."""

    path: Path
    kind: str
    files: list[Path]
    note: str = ""


def source_of(paths: Sequence[Path], topics: Names, hints: Hints) -> tuple[Source, list[str]]:
    """Return what reads the recording at a path, or at several, and what is left out.

    Parameters
    ----------
    paths : sequence of Path
        At least one.
    topics : tuple
        Those of images, calibration and attitude, as in `open_recording`.
    hints : Hints

    Raises
    ------
    RecordingError
        As `open_recording`.
    """
    for value, what in ((hints.fps, "a rate of frames"), (hints.exposure_s, "an exposure")):
        if value is not None and not 0 < value < 1e9:
            raise RecordingError(f"{what} must be greater than 0, not {value:g}")
    if not paths:
        raise RecordingError("no recording is given")
    path = paths[0]
    try:
        found = []
        for path in dict.fromkeys(paths):
            found.append(_find(path))
        path = common_folder(list(dict.fromkeys(paths)))
        source = _source_of(path, found, topics, hints)
    except OSError as error:
        where, reason = error.filename or path, error.strerror or error
        raise RecordingError(f"cannot read {where}: {reason}") from error
    return source, [each.note for each in found if each.note]


def _find(path: Path) -> _Found:
    if not path.exists():
        raise RecordingError(f"{path} does not exist: check the path")
    if not path.is_dir():
        if not path.is_file():
            raise RecordingError(f"{path} is no file but a pipe or a device: copy it into a file")
        kind = _kind_of(path, [path.suffix.lower()])
        if not kind:
            raise RecordingError(
                f"{path} is no recording known here: give a rosbag2 folder, or a file that ends in"
                f" {_ALL}, or a folder of FITS files or pictures; {_CONVERT}"
            )
        return _Found(path, kind, [path])
    files = files_by_kind(sorted(path.iterdir()))
    if not files:
        raise RecordingError(_nothing_in(path))
    kind, *others = files
    beside = [_counted(other, files[other]) for other in others]
    beside += [f"{what} in {folder}" for folder, what in _below(path, kind, 1).items()]
    note = f"not read, as they are beside the {kind} files of {path}: {'; '.join(beside)}"
    return _Found(path, kind, files[kind], note if beside else "")


def _source_of(path: Path, found: list[_Found], topics: Names, hints: Hints) -> Source:
    kind = found[0].kind
    for other in found:
        if other.kind != kind:
            raise RecordingError(
                f"these are of several kinds, {found[0].path} ({kind}) and {other.path}"
                f" ({other.kind}): give recordings of one kind, or a folder"
            )
    if kind == "bag":
        if hints.fps or hints.start_ns is not None:
            raise RecordingError(
                f"{path} is a bag, whose images have stamps: {hints.given} is of no use"
            )
        return _series(
            lambda file: BagSource(file, *topics, hints.exposure_s), [each.path for each in found]
        )
    # A file may be named, and be in a folder that is, too.
    files = list({file.resolve(): file for each in found for file in each.files}.values())
    if topics[1:] != (None, None) or (topics[0] and kind != "FITS"):
        raise RecordingError(f"{path} is no bag, and has no topics to choose")
    if kind == "FITS":
        return fits.FitsSource(path, files, topics[0], hints)
    if kind == "picture":
        return pictures.PictureSource(path, files, hints)
    for each in found:
        if len(each.files) > 1:
            raise RecordingError(
                f"{each.path} has several recordings; open one of"
                f" {', '.join(file.name for file in each.files)}; or give the names of those that"
                " are one recording"
            )
    if kind == "video":
        files.sort(key=by_name)
        return video.VideoSource(path, files, hints)
    if len(files) > 1 and hints.given:
        raise RecordingError(
            f"{hints.given} counts from the begin of one SER file: give one at a time, or several"
            " with times of their own"
        )
    return _series(lambda file: SerSource(file, hints), files)


def _series(opened: Callable[[Path], TimedSource], files: list[Path]) -> Source:
    """Return what reads one file after the other; of one file, its own source."""
    sources: list[TimedSource] = []
    try:
        for file in files:
            sources.append(opened(file))
        return Series(sources) if len(sources) > 1 else sources[0]
    except BaseException:
        for source in sources:
            source.close()
        raise


def files_by_kind(files: list[Path]) -> dict[str, list[Path]]:
    """Return a folder's files that can be read by their kinds, the first to be read first."""
    found: dict[str, list[Path]] = {kind: [] for kind in _SUFFIXES}
    for file in files:
        if file.name.startswith(".") or not (kind := _kind_of(file, _UNTOLD)):
            continue
        # A link to nowhere is to be told; who opens a pipe or a device might wait for ever.
        if file.is_file() or not file.exists():
            found[kind].append(file)
    return {kind: of_kind for kind, of_kind in found.items() if of_kind}


def _kind_of(file: Path, untold: Collection[str]) -> str:
    """Return the kind of a file by its name, or, of the untold suffixes, by its content."""
    if file.name == "metadata.yaml" or suffix_of(file):
        return "bag"
    name, suffix = file.name.lower(), file.suffix.lower()
    for kind, suffixes in _SUFFIXES.items():
        if name.endswith(suffixes):
            return kind
    if suffix in untold and file.is_file():
        with file.open("rb") as opened:
            first = opened.read(max(map(len, _MAGIC.values())))
        return next((kind for kind, magic in _MAGIC.items() if first.startswith(magic)), "")
    return ""


def _counted(kind: str, files: list[Path]) -> str:
    return f"{len(files)} {kind} file{'s' * (len(files) > 1)}"


def _below(folder: Path, wanted: str = "", deepest: int = _DEEPEST) -> dict[Path, str]:
    """Return the folders below one that hold recordings, or of the wanted kind, and what."""
    found: dict[Path, str] = {}
    depth = len(folder.parts)
    for number, (name, folders, files) in enumerate(os.walk(folder)):
        here = Path(name)
        folders[:] = sorted(each for each in folders if not each.startswith("."))
        if len(here.parts) - depth >= deepest:
            folders.clear()
        there = files_by_kind([here / file for file in files]) if number else {}
        if kind := next((kind for kind in there if wanted in ("", kind)), ""):
            found[here] = _counted(kind, there[kind])
            if kind == "bag":
                found[here] = "a bag"
        if len(found) == _MOST_TOLD or number == _MOST_FOLDERS:
            break
    return found


def _nothing_in(folder: Path) -> str:
    """Say that there is nothing to read in a folder itself, and what to do."""
    if below := _below(folder):
        listing = ", ".join(f"{name} ({what})" for name, what in below.items())
        return (
            f"{folder} holds no recording itself, but folders in it do: give one of them, or"
            f" several of one kind: {listing}"
        )
    inside = [each.name for each in folder.iterdir() if not each.name.startswith(".")]
    if not inside:
        return f"{folder} is empty: there is nothing to read"
    return (
        f"{folder} holds no recording: neither a metadata.yaml, as bags have, nor a file that ends"
        f" in {_ALL}; it holds {names(sorted(inside))}; {_CONVERT}"
    )
