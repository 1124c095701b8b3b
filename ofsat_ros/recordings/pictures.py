# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Folders of pictures: PNG, TIFF, JPEG and BMP."""

from __future__ import annotations

import importlib.util
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ofsat_ros.images import EncodingError, decode_compressed, luminance
from ofsat_ros.recordings.bag import RecordingError, Topic
from ofsat_ros.recordings.recording import FRAME_ID, Attitude, Frame, Skipped, for_opencv
from ofsat_ros.recordings.timing import NS, Hints, Shot, in_order, utc_ns

_KINDS = {
    **{".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"},
    **{".jpg": "JPEG", ".jpeg": "JPEG", ".bmp": "BMP"},
}
SUFFIXES = tuple(_KINDS)

# Tags of EXIF 2.32 (CIPA DC-008): time, its fraction and its distance from UTC, exposure time.
_ORIGINAL, _FRACTION, _OFFSET, _EXPOSURE = 0x9003, 0x9291, 0x9011, 0x829A
_EXIF = 0x8769
_TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)")
_ZONE = re.compile(r"[+-]\d\d:\d\d")
_SELF_CHECKING = (b"\x89PNG", b"\xff\xd8\xff")


class PictureSource:
    """Picture files as a `Source`.

    Parameters
    ----------
    path : Path
        Where they are, for messages.
    files : list of Path
    hints : Hints
    """

    kind = "images"
    topic = camera_info_topic = attitude_topic = ""
    last_attitudes: tuple[Attitude, ...] = ()

    def __init__(self, path: Path, files: list[Path], hints: Hints) -> None:
        self.path = path
        self.topics: dict[str, int] = {}
        self.contents: dict[str, Topic] = {}
        self.problems: list[str] = []
        files = self._of_one_kind(files)
        shots = [shot for file in files for shot in self._look(file, hints.exposure_s)]
        if not hints.fps and not _has_pillow():
            raise RecordingError(
                f"{path}: give the rate of the pictures, as in --fps 2, or, for their own times,"
                " pip install 'ofsat_ros[exif]' (on Debian and Ubuntu apt install python3-pil)"
            )
        self._shots, odd = in_order(shots, path, hints)
        self.problems += odd
        self.count = len(self._shots)

    def close(self) -> None:
        """See `Source`."""

    def frames(
        self, say: Callable[[str], None], first: int = 0
    ) -> Iterator[Frame | Skipped | None]:
        """See `Source`."""
        for number, shot in enumerate(self._shots):
            if number < first:
                yield None
                continue
            name = f"frame {number} ({shot.name})"
            if shot.reason or shot.stamp_ns is None:
                yield Skipped(name, shot.reason)
                continue
            try:
                image = _decoded(shot.file, *shot.place)
            except (OSError, EncodingError) as error:
                yield Skipped(name, f"{error}")
                continue
            yield Frame(image, shot.stamp_ns, FRAME_ID, number, exposure_s=shot.exposure_s)

    def _of_one_kind(self, files: list[Path]) -> list[Path]:
        """Return the files of the most frequent kind: others are previews, or results."""
        kinds = Counter(_KINDS[file.suffix.lower()] for file in files)
        ((most, count), *others) = kinds.most_common()
        if others:
            words = ", ".join(f"{number} {kind}" for kind, number in others)
            self.problems.append(f"of the {count} {most} and {words} files, only {most} are read")
        return [file for file in files if _KINDS[file.suffix.lower()] == most]

    def _look(self, file: Path, exposure_s: float | None) -> list[Shot]:
        """Return the pictures of a file: of TIFF, there may be several."""
        pages = _pages(file)
        if pages > 1:
            return [Shot(file, (page,), exposure_s=exposure_s) for page in range(pages)]
        return [self._look_at_tags(file, exposure_s)]

    def _look_at_tags(self, file: Path, exposure_s: float | None) -> Shot:
        tags = _exif(file)
        found = _TIME.match(str(tags.get(_ORIGINAL, "")))
        own_s = float(tags.get(_EXPOSURE, 0) or 0)
        exposure_s = own_s if 0 < own_s < 1e5 else exposure_s
        if not found:
            return Shot(file, exposure_s=exposure_s)
        digits = re.match(r"\d{1,9}", str(tags.get(_FRACTION, "")))
        zone = _ZONE.match(str(tags.get(_OFFSET, "")))
        text = "{}-{}-{}T{}".format(*found.groups()) + (f".{digits[0]}" if digits else "")
        try:
            stamp_ns = utc_ns(text + (zone[0] if zone else ""))
        except ValueError:
            return Shot(file, exposure_s=exposure_s)
        if not zone:
            self._say_once(
                "the pictures do not tell their time zone: their times are taken as UTC"
            )
        self._say_once(
            "stamps are the pictures' own times, taken for the begin of the exposures; half of an"
            " exposure that is known is added"
        )
        return Shot(file, (), stamp_ns + round((exposure_s or 0) * NS / 2), exposure_s)

    def _say_once(self, words: str) -> None:
        if words not in self.problems:
            self.problems.append(words)


def _decoded(file: Path, page: int = 0) -> np.ndarray:
    if page:
        return _page(file, page)
    data = file.read_bytes()
    if data.startswith(_SELF_CHECKING):
        return decode_compressed(data, file.suffix)
    if data[:2] == b"BM" and len(data) < int.from_bytes(data[2:6], "little"):
        raise EncodingError("the file is cut short")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise EncodingError(f"it cannot be decoded: {error}") from error
    if image is None:
        raise EncodingError("it is damaged, cut short, or no picture that OpenCV reads")
    return _as_luminance(image)


def _page(file: Path, page: int) -> np.ndarray:
    try:
        done, images = cv2.imreadmulti(f"{file}", page, 1, flags=cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise EncodingError(f"it cannot be decoded: {error}") from error
    if not (done and images):
        raise EncodingError("it is damaged, or cut short")
    return _as_luminance(images[0])


def _pages(file: Path) -> int:
    """Return how many pictures a TIFF file has; 1 if it is another one, or damaged."""
    if _KINDS[file.suffix.lower()] != "TIFF":
        return 1
    for_opencv(file)
    try:
        return max(cv2.imcount(f"{file}"), 1)
    except cv2.error:
        return 1


def _as_luminance(image: np.ndarray) -> np.ndarray:
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        image = image.astype(np.float32)
    return luminance(image)


def _exif(file: Path) -> dict[int, Any]:
    """Return what the camera wrote into a picture; empty if nothing, or nothing can read it."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of tags that are damaged
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            with Image.open(file) as picture:
                return dict(picture.getexif().get_ifd(_EXIF))
        except (OSError, SyntaxError, ValueError, UnidentifiedImageError):
            return {}
        # Whether it is too large is said where its pixels are read.
        except Image.DecompressionBombError:
            return {}


def _has_pillow() -> bool:
    return importlib.util.find_spec("PIL") is not None
