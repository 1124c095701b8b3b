# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A FITS file: which images are in it, which of them are whole, and their pixels."""

from __future__ import annotations

import io
import zlib
from collections import ChainMap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from ofsat_ros.images import check_size, decode_image, luminance
from ofsat_ros.recordings.bag import RecordingError
from ofsat_ros.recordings.fits.warning import silence

_BAYER = ("RGGB", "BGGR", "GBRG", "GRBG")
_MOST_PLANES = 1_000_000
_GZIP = b"\x1f\x8b"
# What is unpacked is held in memory.
_MOST_BYTES = 2 << 30


class Cards(Mapping[str, Any]):
    """A header's cards by their names; those that cannot be understood are not there.

    Each is looked at when it is asked for: most of a header's many are not.  Under a name with a
    slash behind it, as in ``DATE-OBS/``, stands the card's comment.
    """

    def __init__(self, header: Any) -> None:
        self._header = header

    def __getitem__(self, name: str) -> Any:
        keyword = name.removesuffix("/")
        try:
            values = self._header.comments if keyword != name else self._header
            value = values[keyword]
        except Exception as error:  # the library's own errors, and others'
            raise KeyError(name) from error
        if type(value).__name__ == "Undefined":  # a card without a value
            raise KeyError(name)
        return value

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys(self._header))

    def __len__(self) -> int:
        return len(dict.fromkeys(self._header))


class Picture:
    """An image HDU: one image, or a cube of them.

    Attributes
    ----------
    index : int
        Which HDU.
    name : str
        EXTNAME; empty if there is none.
    own : Cards
        Its own cards.
    cards : Mapping
        Its own cards, and where it has none, the primary HDU's.
    planes : int
        Images in it.
    whole : int
        How many of them, the first ones, the file holds to their end.
    """

    def __init__(self, index: int, hdu: Any, primary: Any, size: int) -> None:
        self.index, self._hdu = index, hdu
        self.own = Cards(hdu.header)
        self.cards: Mapping[str, Any] = self.own
        if index:
            # A chain may be written to, which nobody does.
            self.cards = ChainMap(self.own, Cards(primary))  # type: ignore[arg-type]
        name = str(self.own.get("EXTNAME", "")).strip()
        # What compressing software calls an image that has no name.
        self.name = "" if name == "COMPRESSED_IMAGE" else name
        lengths = [length for length in hdu.shape[:-2] if length > 1]
        # Three planes are red, green, blue, unless the third axis is said to be time.
        self.is_colour = lengths == [3] and "TIM" not in str(self.cards.get("CTYPE3", "")).upper()
        self.planes = 1 if self.is_colour else int(np.prod(lengths, dtype=int))
        if self.planes > _MOST_PLANES:
            raise ValueError(f"a header tells of {self.planes} images")
        self.whole = self._whole(size)

    def _whole(self, size: int) -> int:
        about = self._hdu.fileinfo()
        if size >= about["datLoc"] + about["datSpan"] or _is_tiled(self._hdu):
            return self.planes  # where tiles lie is known only when they are read
        each = abs(self._hdu.header["BITPIX"]) // 8 * int(np.prod(self._hdu.shape)) // self.planes
        return min(max(size - about["datLoc"], 0) // max(each, 1), self.planes)

    def pixels(self, plane: int) -> np.ndarray:
        """Return an image as it lies in the file: (height, width) or (3, height, width)."""
        shape = self._hdu.shape
        check_size(shape[-1], shape[-2])
        leading: list[Any] = list(np.unravel_index(plane, shape[:-2])) if len(shape) > 2 else []
        if self.is_colour:
            leading = [slice(None) if length == 3 else 0 for length in shape[:-2]]
        try:
            with silence():
                pixels = self._hdu.section[
                    (*map(_whole_number, leading), slice(None), slice(None))
                ]
        # A damaged file makes the library raise nearly anything.
        except Exception as error:
            raise RecordingError(f"its pixels cannot be read: {_words(error)}") from error
        return np.asarray(pixels)


class FitsFile:
    """A FITS file, compressed or not; a context manager.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    pictures : dict of int to Picture
        By the number of the HDU.

    Raises
    ------
    RecordingError
        If it is no FITS file, or cut in its first header.
    """

    def __init__(self, path: Path) -> None:
        from astropy.io import fits

        self.path = path
        self._stream = self._hdus = None
        try:
            with silence():
                self._stream = stream = _unzipped(path)
                size = stream.seek(0, io.SEEK_END)
                stream.seek(0)
                # Without memory maps: a file that is cut short would end the process.
                self._hdus = hdus = fits.open(stream, memmap=False)
                self.pictures = {
                    index: Picture(index, hdu, hdus[0].header, size)
                    for index, hdu in enumerate(hdus)
                    if _is_picture(hdu)
                }
        except Exception as error:  # see Picture.pixels
            self.close()
            if isinstance(error, OSError) and error.errno:
                raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
            raise RecordingError(f"{path} is no whole FITS file: {_words(error)}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close it; a second call does nothing."""
        for opened in (self._hdus, self._stream):
            if opened is not None:
                opened.close()


def image_of(stored: np.ndarray, cards: Mapping[str, Any], turned: bool) -> np.ndarray:
    """Return what a FITS image holds as luminance.

    Parameters
    ----------
    stored : ndarray, shape (height, width) or (3, height, width)
    cards : Mapping
        The header.
    turned : bool
        Whether the first row becomes the last one.

    Returns
    -------
    ndarray, shape (height, width), uint8, uint16 or float32
        Every value that these types hold, in native byte order; else as float32.
    """
    kind = stored.dtype.kind + str(stored.dtype.itemsize)
    stored = stored.astype({"u1": np.uint8, "u2": np.uint16}.get(kind, np.float32), copy=False)
    pattern = str(cards.get("BAYERPAT", "")).strip().upper()
    # The pattern is that of the first row on the screen.
    bottom_up = bool(turned and cards.get("ROWORDER"))
    if stored.ndim == 3:
        stored = luminance(np.moveaxis(stored, 0, 2), "rgb")
    elif pattern in _BAYER and stored.dtype != np.float32:
        stored = _demosaiced(stored[::-1] if bottom_up else stored, pattern)
        turned = turned and not bottom_up
    return np.ascontiguousarray(stored[::-1] if turned else stored)


def _demosaiced(mosaic: np.ndarray, pattern: str) -> np.ndarray:
    height, width = mosaic.shape
    size = mosaic.dtype.itemsize
    pixels = np.ascontiguousarray(mosaic, mosaic.dtype.newbyteorder("<"))
    name = f"bayer_{pattern.lower()}{8 * size}"
    return decode_image(pixels.reshape(-1).view(np.uint8), name, width, height, size * width, 0)


def _is_picture(hdu: Any) -> bool:
    return bool(hdu.is_image and len(hdu.shape) > 1 and min(hdu.shape) > 0)


def _is_tiled(hdu: Any) -> bool:
    return type(hdu).__name__ == "CompImageHDU"


def _whole_number(place: Any) -> Any:
    return place if isinstance(place, slice) else int(place)


def _unzipped(path: Path) -> BinaryIO:
    """Open a file; of one in gzip, what it holds, and if it is cut short, what is there of it."""
    with path.open("rb") as file:
        if file.read(2) != _GZIP:
            return path.open("rb")
        file.seek(0)
        content, decompress = io.BytesIO(), zlib.decompressobj(31)
        while block := file.read(1 << 16):
            try:
                content.write(decompress.decompress(block))
            except zlib.error:
                break
            if content.tell() > _MOST_BYTES:
                raise ValueError(f"it unpacks to more than {_MOST_BYTES >> 30} GiB: gunzip it")
    return content


def _words(error: Exception) -> str:
    return f"{error}".rstrip(".") or type(error).__name__
