# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Bytes to arrays: every encoding, byte order and padding, and every defect by name."""

import array
import struct

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ofsat_ros.images import EncodingError, decode_compressed, decode_image, encode_png

MONO = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "32FC1": "f4"}
COLOUR = {"rgb8": "RGB", "bgr8": "BGR", "rgba8": "RGBA", "bgra8": "BGRA"}
# First two rows of the mosaic, from the top-left corner: REP 118 and the message's own comments.
BAYER = {"rggb": "RGGB", "bggr": "BGGR", "gbrg": "GBRG", "grbg": "GRBG"}
ENCODINGS = [*MONO, *COLOUR, *(f"bayer_{name}{bits}" for name in BAYER for bits in (8, 16))]
# ITU-R BT.601.
WEIGHTS = {"R": 0.299, "G": 0.587, "B": 0.114, "A": 0.0}
HEIGHT, WIDTH = 5, 7


def known_pixels(dtype, shape=(HEIGHT, WIDTH)):
    """Every byte of every pixel differs from its neighbours', so no mix-up goes unseen."""
    random = np.random.default_rng(20)
    if dtype == "f4":
        return random.normal(1000, 300, shape).astype("f4")
    return random.integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)


def padded_rows(pixels, padding, bigendian=False):
    """Lay rows out byte by byte with struct, independently of NumPy's strides; return the step."""
    code = {"uint8": "B", "uint16": "H", "float32": "f"}[pixels.dtype.name]
    order = ">" if bigendian else "<"
    rows = [struct.pack(f"{order}{row.size}{code}", *row.ravel().tolist()) for row in pixels]
    return b"".join(row + b"\xee" * padding for row in rows), len(rows[0]) + padding


@pytest.mark.parametrize("padding", [0, 1, 6])
@pytest.mark.parametrize("bigendian", [False, True])
@pytest.mark.parametrize("encoding", MONO)
def test_mono_pixels_are_exact_in_either_byte_order_and_with_padding(encoding, bigendian, padding):
    pixels = known_pixels(MONO[encoding])
    data, step = padded_rows(pixels, padding, bigendian)
    image = decode_image(data, encoding, WIDTH, HEIGHT, step, bigendian)
    np.testing.assert_array_equal(image, pixels)
    assert image.dtype == pixels.dtype
    assert image.dtype.isnative
    assert image.flags.c_contiguous
    assert image.flags.aligned


def test_byte_order_matters_to_16_bits():
    data = bytes([0x12, 0x34])
    assert decode_image(data, "mono16", 1, 1, 2, False)[0, 0] == 0x3412
    assert decode_image(data, "mono16", 1, 1, 2, True)[0, 0] == 0x1234


@pytest.mark.parametrize("encoding", MONO)
def test_tight_native_mono_is_a_view(encoding):
    data = np.frombuffer(known_pixels(MONO[encoding]).tobytes(), np.uint8)
    step = data.size // HEIGHT
    image = decode_image(data, encoding, WIDTH, HEIGHT, step, False)
    assert np.shares_memory(image, data)
    assert not image.flags.writeable


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview, "array", "ndarray"])
def test_any_buffer_of_bytes_is_taken(kind):
    raw = bytes(range(12))
    if kind == "array":
        data = array.array("B", raw)
    elif kind == "ndarray":
        data = np.frombuffer(raw, np.uint8)
    else:
        data = kind(raw)
    image = decode_image(data, "mono8", 4, 3, 4, False)
    np.testing.assert_array_equal(image, [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]])


def test_last_row_may_lack_its_padding_and_a_tail_is_ignored():
    pixels = known_pixels("u2")
    data, step = padded_rows(pixels, 6)
    for given_data in (data[:-6], data + b"tail"):
        image = decode_image(given_data, "mono16", WIDTH, HEIGHT, step, False)
        np.testing.assert_array_equal(image, pixels)


def test_pixels_across_word_borders_are_aligned():
    data = memoryview(b"\x00" + known_pixels("u2").tobytes())[1:]
    image = decode_image(data, "mono16", WIDTH, HEIGHT, 2 * WIDTH, False)
    assert image.flags.aligned
    np.testing.assert_array_equal(image, known_pixels("u2"))


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", COLOUR)
def test_colour_becomes_luminance(encoding, padding):
    channels = COLOUR[encoding]
    pixels = known_pixels("u1", (HEIGHT, WIDTH, len(channels)))
    data, step = padded_rows(pixels, padding)
    image = decode_image(data, encoding, WIDTH, HEIGHT, step, False)
    luminance = pixels @ [WEIGHTS[c] for c in channels]
    # Rounded in fixed point: half a level, and a little for the weights.
    np.testing.assert_allclose(image, luminance, rtol=0, atol=0.6)
    assert image.dtype == np.uint8


@pytest.mark.parametrize("bigendian", [False, True])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", BAYER)
@pytest.mark.parametrize("lit", "RGB")
def test_bayer_of_one_colour_has_its_weight_everywhere(name, bits, lit, bigendian):
    # All pixels under one colour's filter lit alike: interpolated, that colour is uniform, so
    # the luminance is its weight, with the corner's order of the pattern right and not else.
    level = 200 if bits == 8 else 40000
    cell = np.array([c == lit for c in BAYER[name]]).reshape(2, 2)
    mosaic = (np.tile(cell, (4, 5)) * level).astype(f"u{bits // 8}")
    data, step = padded_rows(mosaic, 2, bigendian)
    image = decode_image(data, f"bayer_{name}{bits}", 10, 8, step, bigendian)
    assert image.shape == mosaic.shape
    assert image.dtype == mosaic.dtype
    # OpenCV's weights have 14 bits: one level in 8 bits, and 1e-4 of it in 16.
    np.testing.assert_allclose(image, WEIGHTS[lit] * level, rtol=1e-3, atol=1)


def test_bayer_of_grey_light_is_unchanged_at_full_resolution():
    grey = np.full((9, 11), 12345, np.uint16)
    image = decode_image(grey.tobytes(), "bayer_rggb16", 11, 9, 22, False)
    np.testing.assert_allclose(image, grey, rtol=0, atol=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((b"1234", "yuv422", 2, 2, 2, 0), r"unknown encoding 'yuv422'; known are mono8, mono16, "),
        ((b"1234", "", 2, 2, 2, 0), r"unknown encoding ''"),
        ((b"1234", "mono8", 0, 2, 2, 0), r"no pixels: width 0, height 2"),
        ((b"1234", "mono8", 2, 0, 2, 0), r"no pixels: width 2, height 0"),
        ((b"1234", "mono16", 2, 1, 3, 0), r"step of 3 bytes is too small: 2 px of mono16 take 4"),
        ((b"1234", "rgba8", 1, 1, 0, 0), r"step of 0 bytes is too small: 1 px of rgba8 take 4"),
        (
            (b"1234", "mono8", 2, 3, 2, 0),
            r"too short: 4 bytes, but 3 rows with a step of 2 bytes \(2 x 3 px of mono8\) take 6",
        ),
        ((b"", "mono8", 2, 2, 2, 0), r"empty: 0 bytes"),
        (([1, 2], "mono8", 2, 1, 2, 0), r"contiguous bytes, not list"),
        ((memoryview(b"1234")[::2], "mono8", 2, 1, 2, 0), r"contiguous bytes, not memoryview"),
        ((b"1234", "bayer_rggb8", 2, 2, 2, 0), r"Bayer image of 2 x 2 px is too small"),
    ],
)
def test_defects_are_named_with_their_numbers(arguments, message):
    with pytest.raises(EncodingError, match=message):
        decode_image(*arguments)


def test_absurd_sizes_are_refused_without_allocating():
    with pytest.raises(EncodingError, match=f"take {(2**32 - 1) ** 2}"):
        decode_image(b"1234", "mono8", 2**32 - 1, 2**32 - 1, 2**32 - 1, False)


@settings(max_examples=400, deadline=None, derandomize=True)
@given(
    encoding=st.sampled_from([*ENCODINGS, "mono32", "nonsense"]),
    width=st.integers(0, 12) | st.integers(0, 2**32 - 1),
    height=st.integers(0, 12) | st.integers(0, 2**32 - 1),
    step=st.integers(0, 60) | st.integers(0, 2**32 - 1),
    length=st.integers(0, 700),
    bigendian=st.booleans(),
)
@example(encoding="32FC1", width=1, height=2**32 - 1, step=4, length=8, bigendian=False)
def test_any_description_gives_the_right_shape_or_an_encoding_error(
    encoding, width, height, step, length, bigendian
):
    try:
        image = decode_image(bytes(length), encoding, width, height, step, bigendian)
    except EncodingError:
        return
    assert image.shape == (height, width)
    assert image.dtype in (np.uint8, np.uint16, np.float32)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    encoding=st.sampled_from(ENCODINGS),
    width=st.integers(3, 12),
    height=st.integers(3, 12),
    padding=st.integers(0, 9),
    bigendian=st.booleans(),
    tail=st.integers(-1, 9),
)
def test_a_sound_description_is_decoded_and_a_missing_byte_is_not(
    encoding, width, height, padding, bigendian, tail
):
    channels = len(COLOUR.get(encoding, "1"))
    bits = 32 if encoding == "32FC1" else 16 if encoding.endswith(("16", "16UC1")) else 8
    row = width * channels * bits // 8
    step = row + padding
    data = bytes(step * (height - 1) + row + tail)
    if tail < 0:
        with pytest.raises(EncodingError, match="too short"):
            decode_image(data, encoding, width, height, step, bigendian)
        return
    image = decode_image(data, encoding, width, height, step, bigendian)
    np.testing.assert_array_equal(image, np.zeros((height, width)))


@pytest.mark.parametrize("format_field", ["png", "mono16; png compressed ", "", "jpeg"])
@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_png_is_exact_whatever_the_format_field_says(dtype, format_field):
    pixels = known_pixels(dtype, (40, 30))
    image = decode_compressed(encode_png(pixels), format_field)
    np.testing.assert_array_equal(image, pixels)
    assert image.dtype == pixels.dtype


def test_png_holds_the_values_and_not_their_bytes_swapped():
    pixels = np.array([[0x1234, 0x0001]], np.uint16)
    np.testing.assert_array_equal(decode_compressed(encode_png(pixels)), pixels)
    swapped = pixels.astype(">u2")
    np.testing.assert_array_equal(decode_compressed(encode_png(swapped)), pixels)


@pytest.mark.parametrize("channels", ["BGR", "BGRA"])
@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_colour_png_becomes_luminance(dtype, channels):
    pixels = known_pixels(dtype, (20, 30, len(channels)))
    done, png = cv2.imencode(".png", pixels)
    assert done
    image = decode_compressed(png)
    luminance = pixels @ [WEIGHTS[c] for c in channels]
    # 14-bit weights: 1e-4 of full scale; and rounding.
    np.testing.assert_allclose(image, luminance, rtol=0, atol=0.6 + 1e-4 * np.iinfo(dtype).max)
    assert image.dtype == pixels.dtype


def smooth_scene():
    y, x = np.mgrid[0:48, 0:64]
    return (120 + 100 * np.sin(x / 12) * np.cos(y / 10)).astype(np.uint8)


@pytest.mark.parametrize("colour", [False, True])
def test_jpeg_is_near_its_original(colour):
    scene = smooth_scene()
    pixels = np.dstack([scene] * 3) if colour else scene
    done, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert done
    image = decode_compressed(jpeg, "mono8; jpeg compressed mono8")
    assert image.shape == scene.shape
    assert image.dtype == np.uint8
    # Quality 95 quantizes a smooth scene's coefficients by a few levels at most.
    np.testing.assert_allclose(image, scene.astype(float), rtol=0, atol=6)


def test_jpeg_with_fill_bytes_before_a_marker_is_read():
    jpeg = cv2.imencode(".jpg", smooth_scene())[1].tobytes()
    filled = jpeg[:2] + b"\xff" + jpeg[2:]
    np.testing.assert_array_equal(decode_compressed(filled), decode_compressed(jpeg))


# OpenCV writes what it thinks of damaged images to stderr; that is no part of these tests.
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.95, 0.5, 0.1])
def test_compressed_image_that_is_cut_short_is_an_error(suffix, kept):
    data = cv2.imencode(suffix, known_pixels("u1", (60, 80)))[1].tobytes()
    with pytest.raises(EncodingError, match=r"cut short|cannot be decoded"):
        decode_compressed(data[: int(kept * len(data))], "png")


def test_bytes_that_are_no_image_are_quoted():
    with pytest.raises(
        EncodingError, match=r"neither PNG nor JPEG: its 9 bytes begin with 47 49 46 .*'gif'"
    ):
        decode_compressed(b"GIF89a123", "gif")
    with pytest.raises(EncodingError, match="empty: 0 bytes"):
        decode_compressed(b"", "png")


def test_compressed_image_may_not_tell_of_more_than_its_bytes_can_hold():
    png = bytearray(encode_png(known_pixels("u1", (8, 8))))
    png[16:24] = struct.pack(">II", 30000, 30000)
    with pytest.raises(EncodingError, match=r"cannot hold the 30000 x 30000 px"):
        decode_compressed(bytes(png))
    jpeg = bytearray(cv2.imencode(".jpg", known_pixels("u1", (8, 8)))[1].tobytes())
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = struct.pack(">HH", 65000, 65000)
    with pytest.raises(EncodingError, match=r"cannot hold the 65000 x 65000 px"):
        decode_compressed(bytes(jpeg))


def test_jpeg_without_a_frame_header_is_damaged():
    with pytest.raises(EncodingError, match="no frame header"):
        decode_compressed(b"\xff\xd8\xff\xe0\x00\x04ab\xff\xd9")


def test_a_black_png_is_not_taken_for_an_absurd_one():
    # The most that deflate can shrink.
    black = np.zeros((2000, 2000), np.uint8)
    np.testing.assert_array_equal(decode_compressed(encode_png(black)), black)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    suffix=st.sampled_from([".png", ".jpg"]),
    at=st.floats(0, 1, exclude_max=True),
    patch=st.binary(min_size=1, max_size=6),
)
def test_damaged_bytes_give_an_image_or_an_encoding_error(suffix, at, patch):
    data = bytearray(cv2.imencode(suffix, smooth_scene())[1].tobytes())
    start = int(at * len(data))
    data[start : start + len(patch)] = patch
    try:
        image = decode_compressed(bytes(data))
    except EncodingError:
        return
    assert image.ndim == 2
    assert image.dtype in (np.uint8, np.uint16)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), np.float32),
        np.zeros((4, 4, 2), np.uint8),
        np.zeros((0, 4), np.uint8),
        np.zeros(4, np.uint8),
    ],
)
def test_png_refuses_what_it_cannot_hold(image):
    with pytest.raises(EncodingError, match=f"not {image.dtype} of shape"):
        encode_png(image)


def test_png_with_a_flipped_bit_anywhere_is_refused_before_it_is_decoded(capfd):
    png = encode_png(known_pixels("u2", (20, 30)))
    for at in range(8, len(png)):
        broken = bytearray(png)
        broken[at] ^= 16
        with pytest.raises(EncodingError):
            decode_compressed(bytes(broken))
    assert not capfd.readouterr().err


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", BAYER)
def test_png_of_a_bayer_pattern_is_interpolated_as_the_raw_image_is(name, bits):
    mosaic = known_pixels(f"u{bits // 8}", (12, 16))
    encoding = f"bayer_{name}{bits}"
    raw = decode_image(mosaic.tobytes(), encoding, 16, 12, mosaic.strides[0], False)
    compressed = decode_compressed(encode_png(mosaic), f"{encoding}; png compressed ")
    np.testing.assert_array_equal(compressed, raw)


def test_format_that_tells_of_a_bayer_pattern_does_not_touch_colour_or_jpeg():
    colour = known_pixels("u1", (12, 16, 3))
    png, jpeg = (cv2.imencode(kind, colour)[1].tobytes() for kind in (".png", ".jpg"))
    for data in (png, jpeg):
        named = decode_compressed(data, "bayer_rggb8; jpeg compressed bgr8")
        np.testing.assert_array_equal(named, decode_compressed(data))


def test_more_than_max_pixels_is_refused_before_it_is_decoded(monkeypatch):
    png = encode_png(np.zeros((30, 40), np.uint8))
    assert decode_compressed(png, max_pixels=1200).shape == (30, 40)
    monkeypatch.setattr(cv2, "imdecode", None)
    for data in (png, cv2.imencode(".jpg", np.zeros((30, 40), np.uint8))[1].tobytes()):
        with pytest.raises(EncodingError, match=r"too many pixels: 40 x 30, .* allows 1199"):
            decode_compressed(data, max_pixels=1199)


@pytest.mark.parametrize("filling", [b"\xff", b"\xff\xe0\x00\x02", b"\xff\xe0\x00\x00"])
def test_jpeg_of_nothing_but_markers_is_refused_at_once(filling):
    # Megabytes of them, read one by one, would hold the node up for seconds.
    with pytest.raises(EncodingError, match="no frame header"):
        decode_compressed(b"\xff\xd8\xff\xe0\x00\x02" + filling * 1_000_000 + b"\xff\xd9")


def test_what_comes_with_an_image_is_quoted_in_part():
    with pytest.raises(EncodingError, match=r"^unknown encoding '(x{40})\.\.\.'; known are mono8"):
        decode_image(b"1234", "x" * 100_000, 2, 2, 2, False)
