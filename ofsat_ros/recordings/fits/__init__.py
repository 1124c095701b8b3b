# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""FITS files and folders of them: images, cubes, extensions, compressed or not.

What a header means is the FITS standard's (version 4.0, 2018).  What that leaves open is settled
by custom: EXPTIME in s, ROWORDER, BAYERPAT, three planes for three colours.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.images import EncodingError
from ofsat_ros.recordings.bag import RecordingError, Topic
from ofsat_ros.recordings.fits.files import FitsFile, Picture, image_of
from ofsat_ros.recordings.fits.times import exposure, step_s
from ofsat_ros.recordings.fits.wcs import sky_map
from ofsat_ros.recordings.recording import FRAME_ID, Attitude, Frame, Skipped
from ofsat_ros.recordings.timing import Hints, Shot, in_order

__all__ = ["MAGIC", "SUFFIXES", "FitsSource"]

# Which say what a picture is for.
_TYPES = ("IMAGETYP", "FRAMETYP", "FRAME", "OBSTYPE", "IMGTYPE")
_STACKS = ("STACKCNT", "NCOMBINE")
_NO_SKY = re.compile("dark|bias|flat|^zero|^offset")

_PLAIN = (".fits", ".fit", ".fts", ".fz")
MAGIC = b"SIMPLE  ="
SUFFIXES = (*_PLAIN, *(f"{suffix}.gz" for suffix in _PLAIN))


class FitsSource:
    """FITS files as a `Source`.

    Parameters
    ----------
    path : Path
        Where they are, for messages.
    files : list of Path
    topic : str or None
        EXTNAME of the images to read, if a file has images of several names.
    hints : Hints
    """

    kind = "FITS"
    camera_info_topic = attitude_topic = ""
    last_attitudes: tuple[Attitude, ...] = ()

    def __init__(self, path: Path, files: list[Path], topic: str | None, hints: Hints) -> None:
        _need_astropy(path)
        self.path = path
        look = _Look(topic, hints)
        shots = look.without_calibration([shot for file in files for shot in look.at(file)])
        if not shots:
            raise RecordingError(
                f"{path} holds no images, only tables or empty headers, or is cut short"
            )
        self._shots, odd = in_order(shots, path, hints, look.uses_rate)
        self.topics, self.topic, self.count = look.topics, look.topic, len(self._shots)
        self.contents: dict[str, Topic] = {}
        self.problems = [*look.notes, *odd]
        self._turned = bool(look.turned_by)
        if self._turned:
            self.problems.append(
                f"by {look.turned_by}, the first row in the files is the bottom one: the images"
                " are turned over, and y = 0 is the files' last row"
            )
        self._file: FitsFile | None = None
        self._calibrated: tuple[tuple[Path, int], tuple[Camera, Rotation] | None]

    def close(self) -> None:
        """See `Source`."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def frames(
        self, say: Callable[[str], None], first: int = 0
    ) -> Iterator[Frame | Skipped | None]:
        """See `Source`."""
        said: set[str] = set()
        self._calibrated = (Path(), 0), None

        def say_once(kind: str, words: str) -> None:
            if kind not in said:
                said.add(kind)
                say(words)

        for number, shot in enumerate(self._shots):
            if number < first:
                yield None
                continue
            try:
                yield self._frame(number, shot, say_once)
            except (RecordingError, EncodingError) as error:
                yield Skipped(f"frame {number} ({shot.name})", f"{error}")

    def _frame(self, number: int, shot: Shot, say_once: Callable[[str, str], None]) -> Frame:
        if shot.reason or shot.stamp_ns is None:
            raise RecordingError(shot.reason)
        # The images of a cube come one after the other, mostly.
        if self._file is None or self._file.path != shot.file:
            self.close()
            self._file = FitsFile(shot.file)
        index, plane = shot.place or (0, 0)
        picture = self._file.pictures[index]
        image = image_of(picture.pixels(plane), picture.cards, self._turned)
        found = self._calibration(shot, picture, image.shape, say_once)
        camera: Camera | None = None
        attitudes: tuple[Attitude, ...] = ()
        if found is not None:
            camera, attitudes = found[0], ((shot.stamp_ns, found[1]),)
        return Frame(image, shot.stamp_ns, FRAME_ID, number, camera, attitudes, shot.exposure_s)

    def _calibration(
        self,
        shot: Shot,
        picture: Picture,
        shape: tuple[int, ...],
        say_once: Callable[[str, str], None],
    ) -> tuple[Camera, Rotation] | None:
        """Return what the header's world coordinates tell; the same for images of a cube."""
        key = (shot.file, picture.index)
        if self._calibrated[0] == key:
            return self._calibrated[1]
        found = None
        try:
            if (sky := sky_map(picture.own)) is not None:
                camera, attitude, words = sky.camera(shape[1], shape[0], self._turned)
                found = camera, attitude
                if words:
                    say_once("miss", f"{shot.name}: {words}; others may be alike")
        except ValueError as error:  # also of numbers that no calculation takes
            say_once("wcs", f"{shot.name} and others like it have no directions: {error}")
        self._calibrated = key, found
        return found


class _Look:
    """A first look at every file: which images there are, when they were taken, how they lie.

    Attributes
    ----------
    topics : dict of str to int
        Names of images, if they have any, and their counts.
    topic : str
        The name that is read, if there are several.
    turned_by : str
        What says that the first row is the bottom one; empty if nothing does.
    notes : list of str
        What was assumed.
    uses_rate : bool
        Whether the user's rate is that of the images of a cube.
    """

    def __init__(self, topic: str | None, hints: Hints) -> None:
        self._wanted, self._hints = topic, hints
        self._types: dict[Path, str] = {}  # of files that show no sky, or several frames of it
        self.topics: dict[str, int] = {}
        self.topic = self.turned_by = ""
        self.uses_rate = False
        self.notes: list[str] = []
        self._has_wcs = False

    def at(self, path: Path) -> list[Shot]:
        """Return the images of a file; one with the reason if it cannot be read."""
        try:
            file = FitsFile(path)
        except RecordingError as error:
            return [Shot(path, reason=f"{error}")]
        with file:
            pictures = self._chosen(path, list(file.pictures.values()))
            return [shot for picture in pictures for shot in self._shots(path, picture)]

    def without_calibration(self, shots: list[Shot]) -> list[Shot]:
        """Leave out darks and their like, unless there is nothing else."""
        frames = [shot for shot in shots if shot.file not in self._types]
        if all(shot.reason for shot in frames):
            return shots
        if len(frames) < len(shots):
            counts = Counter(self._types.values())
            listing = ", ".join(f"{count} {kind}" for kind, count in counts.items())
            self.notes.append(
                f"left out, as by their headers they are no single frames of the sky: {listing}"
                f" ({'first' if len(self._types) > 1 else 'it is'} {next(iter(self._types)).name})"
            )
        return frames

    def _chosen(self, path: Path, pictures: list[Picture]) -> list[Picture]:
        """Return the images of one camera: in a file with several, those of the same name."""
        names: dict[str, int] = {}
        for picture in pictures:
            names[picture.name] = names.get(picture.name, 0) + picture.planes
        if len(names) < 2:
            return pictures
        for name, count in names.items():
            self.topics[name] = self.topics.get(name, 0) + count
        listing = ", ".join(f"{name or '(no name)'} ({count})" for name, count in names.items())
        wanted = self._wanted or ("SCI" if "SCI" in names else None)
        if wanted is None:
            raise RecordingError(
                f"{path} has images of several names; choose one as the topic: {listing}"
            )
        if wanted not in names:
            raise RecordingError(f"{path} has no images named {wanted}; there are {listing}")
        self.topic = wanted
        return [picture for picture in pictures if picture.name == wanted]

    def _shots(self, path: Path, picture: Picture) -> Iterator[Shot]:
        self._see_rows(picture)
        if kind := _no_sky(picture):
            self._types[path] = kind
        when, notes = exposure(picture.cards, self._hints.exposure_s)
        apart_s: float | None = 0.0
        if picture.planes > 1:
            apart_s, assumed = step_s(picture.cards, self._hints.fps, when.seconds)
            notes += [assumed] if assumed else []
            self.uses_rate |= bool(self._hints.fps)
        self.notes += [note for note in notes if note not in self.notes]
        for plane in range(picture.planes):
            stamp_ns = when.stamp_ns if picture.planes == 1 else None
            if picture.planes > 1 and apart_s:
                stamp_ns = when.of_plane(plane, picture.planes, apart_s)
            place = (picture.index, plane) if picture.planes > 1 or picture.index else ()
            reason = "" if plane < picture.whole else "the file is cut short"
            yield Shot(path, place, stamp_ns, when.seconds, reason)

    def _see_rows(self, picture: Picture) -> None:
        """Find out whether the first row is the bottom one: by a WCS, or else by ROWORDER."""
        if self._has_wcs:
            return
        try:
            sky = sky_map(picture.own)
        except ValueError:
            sky = None  # said when the frame is read
        if sky is not None:
            self._has_wcs = True
            self.turned_by = "their WCS" if sky.is_mirrored else ""
        elif str(picture.cards.get("ROWORDER", "")).upper().startswith("BOTTOM"):
            self.turned_by = "ROWORDER"


def _no_sky(picture: Picture) -> str:
    """Return what a picture is if it is no single frame of the sky; empty if it is."""
    kinds = (str(picture.cards.get(name, "")).strip() for name in _TYPES)
    if kind := next((kind for kind in kinds if _NO_SKY.search(kind.lower())), ""):
        return kind
    counts = (picture.cards.get(name) for name in _STACKS)
    return "stack" if any(isinstance(count, int) and count > 1 for count in counts) else ""


def _need_astropy(path: Path) -> None:
    try:
        import astropy  # noqa: F401
    except ImportError:
        raise RecordingError(
            f"{path} is FITS, which astropy reads: pip install 'ofsat_ros[fits]', or on Debian"
            " and Ubuntu apt install python3-astropy"
        ) from None
