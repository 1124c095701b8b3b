# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Bytes of a recorded or received image -> array: the only place that knows image encodings.

It stands before the pipeline, which takes 2-D arrays only: ``recordings`` (offline) and ``nodes``
(live) call it.  Colour becomes luminance here, since a star's motion has no colour.

What is returned has native byte order, contiguous rows and shape (height, width); the type is
uint8, uint16 or float32, whichever holds the encoding without loss.  A monochrome image in native
byte order without padding is a view of the given data, read-only if the data is.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ofsat_ros.parameters import DetectorParameters

_MAX_PIXELS = DetectorParameters.max_pixels
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
# A marker begins with 0xff, before which any number of them may fill up (ITU-T T.81, B.1.1.2).
_JPEG_MARKER = re.compile(b"\xff+(.)", re.DOTALL)
# Drivers write some tens of them before the frame header; one of a colour profile has up to 255.
_MOST_JPEG_SEGMENTS = 10_000
# Of a text that came with an image, so much is quoted.
_LONGEST_QUOTE = 40
# Deflate shrinks at most 1032 times and a PNG pixel has at least one bit; JPEG shrinks less.
_MAX_PIXELS_PER_BYTE = 1032 * 8


class EncodingError(ValueError):
    """Image data does not fit its description, or cannot be decoded."""


@dataclass(frozen=True)
class _Encoding:
    """How one pixel lies in memory, and what turns it into luminance (an OpenCV code)."""

    dtype: str
    channels: int = 1
    to_gray: int | None = None


# OpenCV names a Bayer pattern by the second and third pixel of the second row; ROS by the first
# two rows from the corner.  OpenCV's BG is therefore ROS's RGGB.
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2GRAY,
    "bggr": cv2.COLOR_BayerRG2GRAY,
    "gbrg": cv2.COLOR_BayerGR2GRAY,
    "grbg": cv2.COLOR_BayerGB2GRAY,
}

_ENCODINGS = {
    "mono8": _Encoding("u1"),
    "mono16": _Encoding("u2"),
    "8UC1": _Encoding("u1"),
    "16UC1": _Encoding("u2"),
    "32FC1": _Encoding("f4"),
    "rgb8": _Encoding("u1", 3, cv2.COLOR_RGB2GRAY),
    "bgr8": _Encoding("u1", 3, cv2.COLOR_BGR2GRAY),
    "rgba8": _Encoding("u1", 4, cv2.COLOR_RGBA2GRAY),
    "bgra8": _Encoding("u1", 4, cv2.COLOR_BGRA2GRAY),
    **{f"bayer_{name}8": _Encoding("u1", 1, code) for name, code in _BAYER.items()},
    **{f"bayer_{name}16": _Encoding("u2", 1, code) for name, code in _BAYER.items()},
}


def decode_message(message: Any, max_pixels: int = _MAX_PIXELS) -> np.ndarray:
    """Return the luminance of an image message, of rclpy or of rosbags.

    Parameters
    ----------
    message : sensor_msgs Image or CompressedImage
        Whichever library made it.
    max_pixels : int
        An image of more is refused.

    Returns
    -------
    ndarray, shape (height, width), uint8, uint16 or float32
        Without a copy where the message's layout allows it.

    Raises
    ------
    EncodingError
        If the image cannot be decoded.
    """
    if hasattr(message, "format"):  # CompressedImage
        return decode_compressed(message.data, message.format, max_pixels)
    check_size(message.width, message.height, max_pixels)
    return decode_image(
        message.data,
        message.encoding,
        message.width,
        message.height,
        message.step,
        message.is_bigendian,
    )


def decode_image(
    data: Any, encoding: str, width: int, height: int, step: int, is_bigendian: bool | int
) -> np.ndarray:
    """Return the pixels of a ``sensor_msgs/Image`` as luminance.

    Colour and Bayer patterns become ``0.299 R + 0.587 G + 0.114 B`` (ITU-R BT.601); a Bayer
    pattern is interpolated bilinearly to full resolution.  Alpha is ignored.

    Parameters
    ----------
    data : bytes, bytearray, memoryview, array.array or ndarray of uint8
        Contiguous rows.  Bytes beyond the last row are ignored; the last row may lack its
        padding.
    encoding : str
        One of mono8, mono16, 8UC1, 16UC1, 32FC1, rgb8, bgr8, rgba8, bgra8 and
        bayer_{rggb,bggr,gbrg,grbg}{8,16}.
    width, height : int
        Size in px.
    step : int
        Length of a row with its padding, in bytes.
    is_bigendian : bool or int
        Byte order of 16 and 32 bit pixels.

    Returns
    -------
    ndarray, shape (height, width), uint8, uint16 or float32

    Raises
    ------
    EncodingError
        If the encoding is unknown, the size is zero, or the data is shorter than the size and the
        step say.
    """
    known = _ENCODINGS.get(encoding)
    if known is None:
        raise EncodingError(
            f"unknown encoding {_quoted(encoding)}; known are {', '.join(_ENCODINGS)}"
        )
    rows = _rows(_as_bytes(data), known, encoding, width, height, step, bool(is_bigendian))
    native = np.dtype(known.dtype)
    if known.to_gray is None:
        pixels = rows[:, :, 0]
        # OpenCV does not expect pixels that lie across word borders.
        return np.require(pixels, native, ["C_CONTIGUOUS", "ALIGNED"])
    if known.channels == 1:
        return _demosaic(np.ascontiguousarray(rows[:, :, 0], native), known.to_gray)
    return _to_gray(np.ascontiguousarray(rows, native), known.to_gray)


def decode_compressed(
    data: Any,
    format: str = "",  # noqa: A002 (ROS names it)
    max_pixels: int = _MAX_PIXELS,
) -> np.ndarray:
    """Return the pixels of a ``sensor_msgs/CompressedImage`` (PNG or JPEG) as luminance.

    Parameters
    ----------
    data : bytes, bytearray, memoryview, array.array or ndarray of uint8
        The compressed image.
    format : str
        The message's field.  Drivers fill it in many ways, so it is quoted in errors, and else
        counts for one thing only: ``bayer_rggb8; png compressed`` and its like tell that a PNG
        of one channel holds a Bayer pattern.
    max_pixels : int
        An image of more, as its header tells before anything is decoded, is refused.

    Returns
    -------
    ndarray, shape (height, width), uint8 or uint16

    Raises
    ------
    EncodingError
        If the data is neither PNG nor JPEG, is cut short or damaged, or holds too many pixels.
    """
    raw = _as_bytes(data)
    width, height = _compressed_size(raw, format)
    if width * height > _MAX_PIXELS_PER_BYTE * raw.size or width * height == 0:
        raise EncodingError(
            f"compressed image of {raw.size} bytes cannot hold the {width} x {height} px that its"
            " header tells of"
        )
    check_size(width, height, max_pixels)
    is_png = raw[0] == _PNG[0]
    if is_png:
        _check_png(raw)
    try:
        image = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        said = " ".join(str(error).split())
        raise EncodingError(f"compressed image cannot be decoded: {said}") from error
    whole = image is not None and image.shape[:2] == (height, width)
    if not whole or image.dtype not in (np.uint8, np.uint16):
        raise EncodingError(
            f"compressed image ({raw.size} bytes, {width} x {height} px, format {_quoted(format)})"
            " is damaged or cut short"
        )
    pattern = _ENCODINGS.get(format.partition(";")[0].strip())
    if is_png and image.ndim == 2 and pattern and pattern.channels == 1 and pattern.to_gray:
        return _demosaic(image, pattern.to_gray)
    return luminance(image)


def luminance(image: np.ndarray, order: str = "bgr") -> np.ndarray:
    """Return an image as luminance, by the same weights as `decode_image`.

    Parameters
    ----------
    image : ndarray, shape (height, width) or (height, width, channels), uint8, uint16 or float32
        One, three or four channels; the fourth is alpha, and ignored.
    order : {"bgr", "rgb"}
        Of three or four channels.

    Returns
    -------
    ndarray, shape (height, width)
        Of the same type; the same array if it has one channel.
    """
    if image.ndim == 2 or image.shape[2] == 1:
        return image.reshape(image.shape[:2])
    code = cv2.COLOR_BGR2GRAY if order == "bgr" else cv2.COLOR_RGB2GRAY
    return _to_gray(np.ascontiguousarray(image[:, :, :3]), code)


def encode_png(image: np.ndarray) -> bytes:
    """Return an image as PNG, without loss.

    Parameters
    ----------
    image : ndarray, shape (height, width) or (height, width, 3), uint8 or uint16
        Three channels are blue, green, red.

    Raises
    ------
    EncodingError
        If PNG cannot hold such an array.
    """
    shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not shaped or image.size == 0 or image.dtype.name not in ("uint8", "uint16"):
        raise EncodingError(
            "PNG holds uint8 or uint16 arrays of shape (height, width) or (height, width, 3), not"
            f" {image.dtype} of shape {image.shape}"
        )
    native = np.ascontiguousarray(image, image.dtype.newbyteorder("="))
    done, png = cv2.imencode(".png", native)
    if not done:
        raise EncodingError(f"an image of shape {image.shape} could not be encoded as PNG")
    return png.tobytes()


def _as_bytes(data: Any) -> np.ndarray:
    """Return a (N,) uint8 view of any contiguous buffer."""
    try:
        raw = np.frombuffer(data, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise EncodingError(
            f"image data must be contiguous bytes, not {type(data).__name__}: {error}"
        ) from error
    if not raw.size:
        raise EncodingError("image data is empty: 0 bytes")
    return raw


def _rows(
    raw: np.ndarray,
    known: _Encoding,
    encoding: str,
    width: int,
    height: int,
    step: int,
    bigendian: bool,
) -> np.ndarray:
    """Return a (height, width, channels) view of `raw` in its own byte order."""
    if width <= 0 or height <= 0:
        raise EncodingError(f"image has no pixels: width {width}, height {height}")
    dtype = np.dtype(known.dtype).newbyteorder(">" if bigendian else "<")
    pixel = dtype.itemsize * known.channels
    row = int(width) * pixel
    if step < row:
        raise EncodingError(
            f"step of {step} bytes is too small: {width} px of {encoding} take {row} bytes a row"
        )
    need = int(step) * (int(height) - 1) + row
    if raw.size < need:
        raise EncodingError(
            f"image data is too short: {raw.size} bytes, but {height} rows with a step of {step}"
            f" bytes ({width} x {height} px of {encoding}) take {need}"
        )
    shape = (int(height), int(width), known.channels)
    return np.ndarray(shape, dtype, raw, strides=(int(step), pixel, dtype.itemsize))


def _to_gray(image: np.ndarray, code: int) -> np.ndarray:
    return cv2.cvtColor(image, code).reshape(image.shape[:2])


def _demosaic(mosaic: np.ndarray, code: int) -> np.ndarray:
    if min(mosaic.shape) < 3:
        raise EncodingError(
            f"a Bayer image of {mosaic.shape[1]} x {mosaic.shape[0]} px is too small: colours are"
            " interpolated over 3 x 3 px"
        )
    return _to_gray(mosaic, code)


def check_size(width: int, height: int, max_pixels: int = _MAX_PIXELS) -> None:
    """Raise EncodingError if an image has more pixels than `max_pixels`."""
    if width * height > max_pixels:
        raise EncodingError(
            f"too many pixels: {width} x {height}, where max_pixels allows {max_pixels}"
        )


def _quoted(text: str) -> str:
    return repr(text if len(text) <= _LONGEST_QUOTE else f"{text[:_LONGEST_QUOTE]}...")


def _compressed_size(raw: np.ndarray, format_field: str) -> tuple[int, int]:
    """Return width and height as the header of a PNG or JPEG tells them."""
    head = raw[:24].tobytes()
    if head.startswith(_PNG) and len(head) == 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if head.startswith(_JPEG):
        return _jpeg_size(raw.tobytes())
    raise EncodingError(
        f"compressed image is neither PNG nor JPEG: its {raw.size} bytes begin with"
        f" {head[:8].hex(' ')} (format {_quoted(format_field)})"
    )


def _check_png(raw: np.ndarray) -> None:
    """Raise unless every chunk of a PNG is there and has its checksum (ISO/IEC 15948, 5.3).

    OpenCV would decode what a damaged one holds as far as it goes, or take memory for a size that
    is not true, and say so past the log.
    """
    png, at, kind = raw.data, len(_PNG), b""
    while kind != b"IEND":
        length, kind = int.from_bytes(png[at : at + 4], "big"), bytes(png[at + 4 : at + 8])
        end = at + 12 + length
        if end > len(png):
            raise EncodingError(
                f"PNG image of {len(png)} bytes is cut short: its chunk at byte {at} ends at {end}"
            )
        if zlib.crc32(png[at + 4 : end - 4]) != int.from_bytes(png[end - 4 : end], "big"):
            raise EncodingError(
                f"PNG image of {len(png)} bytes is damaged: its chunk at byte {at} does not have"
                " its checksum"
            )
        at = end


def _jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Return width and height from a JPEG's frame header (ITU-T T.81, B.2.2)."""
    # Some versions of OpenCV fill the missing part of a JPEG with grey and say nothing.
    if b"\xff\xd9" not in jpeg:
        raise EncodingError(f"JPEG image of {len(jpeg)} bytes is cut short: it has no end marker")
    at = 2
    for _ in range(_MOST_JPEG_SEGMENTS):
        marker = _JPEG_MARKER.match(jpeg, at)
        if marker is None or marker.end() + 7 > len(jpeg):
            break
        at, kind = marker.end(), marker[1][0]
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = (int.from_bytes(jpeg[i : i + 2], "big") for i in (at + 3, at + 5))
            return width, height
        at += int.from_bytes(jpeg[at : at + 2], "big")
    raise EncodingError(f"JPEG image of {len(jpeg)} bytes is damaged: it has no frame header")
