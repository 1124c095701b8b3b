# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Which recordings there are in a tree of folders."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ofsat_ros.recordings import Bag, RecordingError
from ofsat_ros.recordings.kinds import files_by_kind
from ofsat_ros.results import RUN

# By this file a folder tells that a batch was written into it.
BATCH = "batch.json"
# A folder of these is one recording; of the other kinds, each file is one.
_WHOLE = ("FITS", "picture")


@dataclass(frozen=True)
class Found:
    """A recording: a file, or a folder whose files are one.

    Attributes
    ----------
    path : Path
        Absolute, since workers may be elsewhere.
    kind : str
        ``bag``, ``FITS``, ``SER``, ``video`` or ``picture``; empty if the folder cannot be read.
    """

    path: Path
    kind: str

    @property
    def files(self) -> list[Path]:
        """Its files, in the order of their names."""
        if self.path.is_dir():
            return files_by_kind(sorted(self.path.iterdir())).get(self.kind, [])
        return [self.path]

    @property
    def name(self) -> str:
        """Its name without the suffix of a file."""
        return self.path.resolve().name if self.path.is_dir() else self.path.stem


def find_recordings(places: Sequence[Path], besides: Path) -> list[Found]:
    """Return the recordings at some paths and in all folders below them, each once.

    Of FITS files and pictures, a folder has one recording at most: what `open_recording` reads of
    it; pictures beside others are previews.  Results are not recordings, so folders that
    ``process`` or ``batch`` has made are passed over, as are hidden ones.

    Parameters
    ----------
    places : sequence of Path
        Folders and files.
    besides : Path
        A folder that is not looked into.

    Raises
    ------
    RecordingError
        If there is nothing at one of the paths, or a file that is no recording.
    """
    found: dict[Path, Found] = {}
    for place in places:
        if not place.exists():
            raise RecordingError(f"{place} does not exist: check the path")
        at = place.absolute()
        for each in _in_folder(at, besides) if at.is_dir() else _in_file(at):
            found.setdefault(each.path.resolve(), each)
    return list(found.values())


def _in_file(file: Path) -> Iterator[Found]:
    kinds = list(files_by_kind([file]))
    if not kinds:
        raise RecordingError(f"{file} is no recording known here: give folders, or recordings")
    yield Found(file, kinds[0])


def _in_folder(top: Path, besides: Path) -> Iterator[Found]:
    been = {besides.resolve()}  # links may lead in circles
    closed: list[OSError] = []
    for name, folders, files in os.walk(top, onerror=closed.append, followlinks=True):
        here = Path(name)
        if here.resolve() in been or RUN in files or BATCH in files:
            folders.clear()
            continue
        been.add(here.resolve())
        folders[:] = sorted(folder for folder in folders if not folder.startswith("."))
        yield from _directly_in(here, sorted(files))
    yield from (Found(Path(error.filename), "") for error in closed)


def _directly_in(folder: Path, names: list[str]) -> Iterator[Found]:
    by_kind = files_by_kind([folder / name for name in names])
    first = next(iter(by_kind), "")
    for kind, files in by_kind.items():
        if kind == first and (kind in _WHOLE or (kind == "bag" and _is_one(folder, files))):
            yield Found(folder, kind)
        elif kind not in _WHOLE:
            yield from (Found(file, kind) for file in files)


def _is_one(folder: Path, files: list[Path]) -> bool:
    """Whether the files of bags in a folder are one bag's."""
    if len(files) == 1 or folder / "metadata.yaml" in files:
        return True
    try:
        Bag(folder).close()
    except RecordingError:
        return False
    return True
