# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""SER in: files as the description of the format has them, byte by byte."""

import struct

import numpy as np
import pytest

from ofsat_ros.recordings import RecordingError, open_recording

NS = 1_000_000_000
FIRST_NS = 1_795_316_645_123_456_700  # 2026-11-22T03:04:05.1234567
HEIGHT, WIDTH = 20, 30
# Offset, type and value of the header's fields, as the description of version 3 lists them.
FIELDS = {
    "FileID": (0, "14s", b"LUCAM-RECORDER"),
    "LuID": (14, "<i", 0),
    "ColorID": (18, "<i", 0),
    "LittleEndian": (22, "<i", 0),
    "ImageWidth": (26, "<i", WIDTH),
    "ImageHeight": (30, "<i", HEIGHT),
    "PixelDepthPerPlane": (34, "<i", 16),
    "FrameCount": (38, "<i", 3),
    "Observer": (42, "40s", b"A. Nonymous"),
    "Instrument": (82, "40s", b"camera"),
    "Telescope": (122, "40s", b"telescope"),
    "DateTime": (162, "<q", 0),
    "DateTime_UTC": (170, "<q", 0),
}


def ticks(stamp_ns):
    """Return steps of 100 ns since the year 1, by the calendar of NumPy and not by a constant."""
    days = (np.datetime64("1970-01-01") - np.datetime64("0001-01-01")).astype(int)
    return int(days) * 864_000_000_000 + stamp_ns // 100


def scene(number):
    """Return 16 bits, smooth as stars through a lens are: noise has no byte order to tell."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    spot = np.exp(-((x - 8 - number) ** 2 + (y - 9) ** 2) / 20)
    return (3000 + 40_000 * spot + 10 * x).astype(np.uint16)


def write(path, frames, stamps=(), dtype="<u2", **fields):
    header = bytearray(178)
    depth = 8 * np.dtype(dtype).itemsize
    fields = {"FrameCount": len(frames), "PixelDepthPerPlane": depth, **fields}
    for name, (offset, kind, value) in FIELDS.items():
        struct.pack_into(kind, header, offset, fields.pop(name, value))
    assert not fields
    data = b"".join(np.ascontiguousarray(frame, dtype).tobytes() for frame in frames)
    path.write_bytes(bytes(header) + data + b"".join(struct.pack("<q", t) for t in stamps))
    return path


def stamps_of(count, step_ns=50_000_000):
    return [ticks(FIRST_NS + number * step_ns) for number in range(count)]


def three(path, **options):
    return write(path, [scene(n) for n in range(3)], stamps_of(3), **options)


def test_frames_and_times_come_as_they_were(tmp_path):
    path = three(tmp_path / "a.ser")
    assert path.stat().st_size == 178 + 3 * 2 * HEIGHT * WIDTH + 3 * 8
    with open_recording(path) as recording:
        frames = list(recording)
        assert (recording.kind, len(recording), recording.skipped) == ("SER", 3, 0)
        (problem,) = recording.problems
    assert "taken for the middle of the exposures" in problem
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, scene(number))
        assert frame.image.dtype == np.uint16
        assert frame.image.dtype.isnative
        assert frame.stamp_ns == FIRST_NS + number * 50_000_000
        assert (frame.number, frame.exposure_s) == (number, None)


def test_eight_bits(tmp_path):
    frames = [(scene(n) // 256).astype(np.uint8) for n in range(3)]
    with open_recording(write(tmp_path / "a.ser", frames, stamps_of(3), "u1")) as recording:
        for frame, written in zip(recording, frames, strict=True):
            assert frame.image.dtype == np.uint8
            np.testing.assert_array_equal(frame.image, written)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("flag", [0, 1])
def test_pixels_tell_their_byte_order_where_the_header_is_wrong(tmp_path, order, flag):
    path = three(tmp_path / "a.ser", dtype=f"{order}u2", LittleEndian=flag)
    with open_recording(path) as recording:
        first, *_ = recording
        said = [words for words in recording.problems if "byte order" in words]
    np.testing.assert_array_equal(first.image, scene(0))
    # Programs write 0 for little-endian; the description has it the other way round.
    usual = (order, flag) in (("<", 0), (">", 1))
    assert len(said) == (not usual)


@pytest.mark.parametrize(("flag", "order"), [(0, "<"), (1, ">")])
def test_noise_is_read_as_programs_write_it(tmp_path, flag, order):
    noise = np.random.default_rng(1).integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
    path = write(tmp_path / "a.ser", [noise], stamps_of(1), f"{order}u2", LittleEndian=flag)
    with open_recording(path) as recording:
        (frame,) = recording
    np.testing.assert_array_equal(frame.image, noise)


@pytest.mark.parametrize(("colour", "weights"), [(100, (0.299, 0.587, 0.114)), (101, None)])
@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2"])
def test_colours_become_luminance(tmp_path, colour, weights, dtype):
    pixels = np.stack([scene(n) // (256 if dtype == "u1" else 1) for n in range(3)], -1)
    flag = int(dtype == ">u2")
    path = write(
        tmp_path / "a.ser", [pixels], stamps_of(1), dtype, ColorID=colour, LittleEndian=flag
    )
    with open_recording(path) as recording:
        (frame,) = recording
    expected = pixels @ np.array(weights or (0.114, 0.587, 0.299))
    np.testing.assert_allclose(frame.image, expected, atol=0.51 if dtype == "u1" else 1)


@pytest.mark.parametrize(
    ("colour", "red", "blue"),
    [(8, (0, 0), (1, 1)), (9, (0, 1), (1, 0)), (10, (1, 0), (0, 1)), (11, (1, 1), (0, 0))],
)
@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2"])
def test_bayer_patterns_become_luminance(tmp_path, colour, red, blue, dtype):
    mosaic = np.full((HEIGHT, WIDTH), 100, np.uint16)
    mosaic[red[0] :: 2, red[1] :: 2] = 200
    mosaic[blue[0] :: 2, blue[1] :: 2] = 0
    flag = int(dtype == ">u2")
    path = write(
        tmp_path / "a.ser", [mosaic], stamps_of(1), dtype, ColorID=colour, LittleEndian=flag
    )
    with open_recording(path) as recording:
        (frame,) = recording
    assert frame.image.dtype == (np.uint8 if dtype == "u1" else np.uint16)
    np.testing.assert_allclose(frame.image[2:-2, 2:-2], 118.5, atol=1)  # 59.8 + 58.7


@pytest.mark.parametrize("depth", [9, 12, 14])
def test_depths_between_are_two_bytes(tmp_path, depth):
    frames = [scene(0) >> (16 - depth)]
    path = write(tmp_path / "a.ser", frames, stamps_of(1), PixelDepthPerPlane=depth)
    with open_recording(path) as recording:
        (frame,) = recording
    np.testing.assert_array_equal(frame.image, frames[0])


# Times ------------------------------------------------------------------------------------------


def test_without_times_the_rate_has_to_be_given(tmp_path):
    frames = [scene(n) for n in range(3)]
    path = write(tmp_path / "a.ser", frames, DateTime_UTC=ticks(FIRST_NS))
    with pytest.raises(RecordingError, match=r"no times of its frames: .* as in --fps 20"):
        open_recording(path)
    with open_recording(path, fps=25, exposure_s=0.01) as recording:
        got = list(recording)
        assert "times count from its start, by --fps 25" in recording.problems[0]
    assert [frame.stamp_ns for frame in got] == [FIRST_NS + n * 40_000_000 for n in range(3)]
    assert got[0].exposure_s == 0.01
    path = write(tmp_path / "b.ser", frames)
    with open_recording(path, fps=25) as recording:
        assert [frame.stamp_ns for frame in recording] == [0, 40_000_000, 80_000_000]
        assert "1970" in recording.problems[0]


@pytest.mark.parametrize("bad", [0, -5, 2**62, 116_444_736_000_000_000])
def test_times_that_make_no_sense_are_none(tmp_path, bad):
    path = write(tmp_path / "a.ser", [scene(0), scene(1)], [ticks(FIRST_NS), bad])
    with pytest.raises(RecordingError, match="no times of its frames"):
        open_recording(path)


def test_own_times_count_more_than_a_rate_unless_they_repeat(tmp_path):
    with open_recording(three(tmp_path / "a.ser"), fps=1) as recording:
        assert np.diff([frame.stamp_ns for frame in recording]).tolist() == [50_000_000] * 2
        assert "not from --fps 1" in recording.problems[0]
    path = write(tmp_path / "b.ser", [scene(n) for n in range(4)], stamps_of(1) * 4)
    with open_recording(path) as recording:
        assert "3 frames have the same time" in recording.problems[0]
    with open_recording(path, fps=10) as recording:
        stamps = [frame.stamp_ns for frame in recording]
    assert stamps == [FIRST_NS + n * NS // 10 for n in range(4)]


# Torn and foreign files -------------------------------------------------------------------------


def test_of_a_cut_file_the_whole_frames_are_given(tmp_path):
    whole = write(tmp_path / "a.ser", [scene(n) for n in range(8)], stamps_of(8)).read_bytes()
    size = 2 * HEIGHT * WIDTH
    path = tmp_path / "cut.ser"
    for cut in np.linspace(0, len(whole), 40).astype(int).tolist() + [178 + 3 * size]:
        path.write_bytes(whole[:cut])
        count = min(max(cut - 178, 0) // size, 8)
        if not count:
            with pytest.raises(RecordingError, match=r"no SER file, or cut|holds no whole frame"):
                open_recording(path, fps=20)
            continue
        with open_recording(path, fps=20) as recording:
            frames = list(recording)
            assert (len(recording), recording.skipped) == (8, 8 - count)
            assert bool(recording.torn) == (count < 8)
        assert len(frames) == count
        for number, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.image, scene(number))


@pytest.mark.parametrize("count", [0, -1, 2**31 - 1])
def test_a_file_whose_program_was_killed_tells_no_count(tmp_path, count):
    path = write(tmp_path / "a.ser", [scene(n) for n in range(3)], FrameCount=count)
    path.write_bytes(path.read_bytes()[:-100])
    with open_recording(path, fps=20) as recording:
        assert len(list(recording)) == len(recording) == 2
        assert "does not tell how many frames" in recording.problems[0]


@pytest.mark.parametrize(
    "fields",
    [
        {"ColorID": 7},
        {"ImageWidth": 0},
        {"ImageHeight": -3},
        {"ImageWidth": 2**30},
        {"PixelDepthPerPlane": 32},
        {"PixelDepthPerPlane": 0},
    ],
)
def test_a_header_that_makes_no_sense_is_refused(tmp_path, fields):
    with pytest.raises(RecordingError, match="its header makes no sense"):
        open_recording(three(tmp_path / "a.ser", **fields))


def test_what_is_no_ser_file_is_refused(tmp_path):
    (tmp_path / "a.ser").write_bytes(b"nothing like it" * 100)
    with pytest.raises(RecordingError, match="is no SER file"):
        open_recording(tmp_path / "a.ser")


def test_content_tells_where_the_name_does_not_and_a_folder_has_one(tmp_path):
    three(tmp_path / "recording.tmp")
    for path in (tmp_path / "recording.tmp", tmp_path):
        with open_recording(path) as recording:
            assert recording.kind == "SER"
            assert len(list(recording)) == 3
    three(tmp_path / "b.ser")
    with pytest.raises(RecordingError, match=r"several recordings; open one of b.ser, rec"):
        open_recording(tmp_path)
    with pytest.raises(RecordingError, match="is no bag, and has no topics to choose"):
        open_recording(tmp_path / "b.ser", "/image")


@pytest.mark.parametrize("zone_h", [-5.5, 0, 1, 12.75])
@pytest.mark.parametrize("local", [False, True])
def test_local_times_of_frames_become_utc(tmp_path, zone_h, local):
    zone_ns = round(zone_h * 3600) * NS
    header = {
        "DateTime": ticks(FIRST_NS + zone_ns - 2 * NS),
        "DateTime_UTC": ticks(FIRST_NS - 2 * NS),
    }
    shift = zone_ns // 100 if local else 0
    stamps = [each + shift for each in stamps_of(3)]
    path = write(tmp_path / "a.ser", [scene(n) for n in range(3)], stamps, **header)
    with open_recording(path) as recording:
        assert [frame.stamp_ns - FIRST_NS for frame in recording] == [0, 50_000_000, 100_000_000]
        said = [words for words in recording.problems if "local time" in words]
    assert len(said) == bool(shift)
    assert not said or f"{zone_h:+g} h from UTC" in said[0]


def test_a_begin_that_is_given_counts_where_frames_have_no_times(tmp_path):
    path = write(tmp_path / "a.ser", [scene(0)] * 3, DateTime=ticks(FIRST_NS))
    with open_recording(path, fps=20) as recording:
        assert next(iter(recording)).stamp_ns == FIRST_NS
        assert "local time, taken for UTC: --start would give it" in recording.problems[0]
    start_ns = FIRST_NS + 3600 * NS
    with open_recording(path, fps=20, exposure_s=0.01, start_ns=start_ns) as recording:
        stamps = [frame.stamp_ns for frame in recording]
        assert recording.problems == []
    assert stamps == [start_ns + 5_000_000 + n * 50_000_000 for n in range(3)]
    with open_recording(three(tmp_path / "b.ser"), start_ns=start_ns) as recording:
        assert next(iter(recording)).stamp_ns == FIRST_NS
        assert recording.problems[0] == "the times are those of the file, and not from --start"


def test_several_files_come_in_the_order_of_time(tmp_path):
    later = [each + 10_000_000 for each in stamps_of(2)]
    paths = [
        write(tmp_path / "a.ser", [scene(3), scene(4)], later),
        three(tmp_path / "b.ser"),
    ]
    with open_recording(paths) as recording:
        assert (recording.path, recording.kind, len(recording)) == (tmp_path, "SER", 5)
        frames = list(recording)
        assert (recording.skipped, len(recording.problems)) == (0, 1)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, scene(number))
        assert frame.number == number
    assert np.all(np.diff([frame.stamp_ns for frame in frames]) > 0)
    # What is torn costs no other.
    data = paths[1].read_bytes()
    paths[1].write_bytes(data[: 178 + 2 * 2 * HEIGHT * WIDTH + 5])
    with pytest.raises(RecordingError, match=r"b\.ser has no times of its frames"):
        open_recording(paths)
    with pytest.raises(RecordingError, match="--fps 20 counts from the begin of one SER file"):
        open_recording(paths, fps=20)
