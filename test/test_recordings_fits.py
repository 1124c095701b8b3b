# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""FITS in: files of astropy's, their pixels, times and order, and how they can be bad."""

import contextlib
import gzip
import re
import sys

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time

from ofsat_ros.recordings import RecordingError, open_recording

NS = 1_000_000_000
FIRST = "2026-11-22T03:04:05.123456789"
FIRST_NS = 1_795_316_645_123_456_789
HEIGHT, WIDTH = 20, 30


def scene(number, dtype=np.uint16):
    random = np.random.default_rng(number)
    return random.integers(0, np.iinfo(np.uint16).max, (HEIGHT, WIDTH)).astype(dtype)


def isot(stamp_ns):
    return str(np.datetime64(stamp_ns, "ns"))


def write(path, data, compressed=False, **cards):
    header = fits.Header()
    for name, value in {"DATE-OBS": FIRST, "EXPTIME": 0.5, **cards}.items():
        if value is not None:
            header[name.replace("__", "-")] = value
    if compressed:
        hdus = [fits.PrimaryHDU(), fits.CompImageHDU(data, header, **COMPRESSIONS[compressed])]
    else:
        hdus = [fits.PrimaryHDU(data, header)]
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


COMPRESSIONS = {
    "rice": {"compression_type": "RICE_1"},
    "gzip": {"compression_type": "GZIP_2", "quantize_level": 0},
}


def night(folder, count=3, step_ns=2 * NS, name="light_{}.fits", **cards):
    """Write a folder of images whose times go against the order of their names."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        cards_then = {"DATE-OBS": isot(FIRST_NS + number * step_ns), **cards}
        write(folder / name.format(count - 1 - number), scene(number), **cards_then)
    return folder


def only_frame(path, **options):
    with open_recording(path, **options) as recording:
        (frame,) = recording
        assert recording.skipped == 0
    return frame


# Pixels -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.fits", "a.FIT", "a.fts", "a.fits.gz", "a.fz", "a"])
@pytest.mark.parametrize("compressed", [False, "rice"])
def test_sixteen_bits_come_as_they_were(tmp_path, name, compressed):
    # Unsigned values stand in the file as signed ones, with a BZERO of 32768.
    path = write(tmp_path / name, scene(1), compressed)
    with open_recording(path) as recording:
        (frame,) = recording
        assert recording.kind == "FITS"
        assert (len(recording), recording.topic, recording.topics) == (1, "", {})
    assert frame.image.dtype == np.uint16
    assert frame.image.dtype.isnative
    assert frame.image.flags.c_contiguous
    np.testing.assert_array_equal(frame.image, scene(1))
    assert frame.frame_id == "camera_optical_frame"
    assert (frame.camera, frame.attitudes) == (None, ())


@pytest.mark.parametrize(
    ("stored", "given"),
    [
        (scene(1, np.uint8), np.uint8),
        (scene(1).astype(np.int16), np.float32),  # may be negative
        (scene(1).astype(np.int32) * 70_000, np.float32),
        (scene(1).astype(np.uint32) * 60_000, np.float32),
        (scene(1, np.float32) / 7, np.float32),
        (scene(1, np.float64) / 7, np.float32),
    ],
    ids=lambda value: str(getattr(value, "dtype", "")),
)
@pytest.mark.parametrize("compressed", [False, "gzip"])
def test_other_types_keep_their_values(tmp_path, stored, given, compressed):
    frame = only_frame(write(tmp_path / "a.fits", stored, compressed))
    assert frame.image.dtype == given
    assert frame.image.dtype.isnative
    np.testing.assert_array_equal(frame.image, stored.astype(given))


def test_scaled_integers_and_blank_ones(tmp_path):
    path = write(tmp_path / "a.fits", np.array([[1, 2], [3, -99]], np.int16), BLANK=-99)
    with fits.open(path, mode="update", do_not_scale_image_data=True) as hdus:
        hdus[0].header["BSCALE"], hdus[0].header["BZERO"] = 0.5, 10.0
    frame = only_frame(path)
    assert frame.image.dtype == np.float32
    np.testing.assert_array_equal(frame.image, [[10.5, 11.0], [11.5, np.nan]])


@pytest.mark.parametrize("compressed", [False, "rice"])
def test_a_cube_is_a_recording(tmp_path, compressed):
    cube = np.stack([scene(number) for number in range(5)])
    path = write(tmp_path / "a.fits", cube, compressed)
    with open_recording(path) as recording:
        frames = list(recording)
        assert len(recording) == 5
        assert "without a gap, every 0.5 s" in recording.problems[-1]
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, scene(number))
        assert frame.number == number
        assert frame.stamp_ns == FIRST_NS + number * NS // 2 + NS // 4
        assert frame.exposure_s == 0.5


@pytest.mark.parametrize(
    ("cards", "fps", "step_s"),
    [
        ({"CTYPE3": "TIME", "CDELT3": 0.75}, None, 0.75),
        ({"KCT": 0.6}, None, 0.6),
        ({"KCT": 0.6}, 2.5, 0.4),
        ({"EXPTIME": None}, 2.5, 0.4),
    ],
)
def test_images_of_a_cube_are_as_far_apart_as_its_header_or_the_user_says(
    tmp_path, cards, fps, step_s
):
    cube = np.stack([scene(number) for number in range(4)])
    path = write(tmp_path / "a.fits", cube, **cards)
    with open_recording(path, fps=fps) as recording:
        stamps = [frame.stamp_ns for frame in recording]
        assert not [words for words in recording.problems if "gap" in words or "--fps" in words]
    np.testing.assert_array_equal(np.diff(stamps), step_s * NS)


def test_a_cube_whose_header_tells_only_its_begin_needs_a_rate(tmp_path):
    cube = np.stack([scene(number) for number in range(4)])
    path = write(tmp_path / "a.fits", cube, EXPTIME=None)
    with pytest.raises(RecordingError, match="give their rate, as in --fps 2"):
        open_recording(path)


def test_three_planes_are_colours_unless_they_are_times(tmp_path):
    cube = np.stack([np.full((HEIGHT, WIDTH), value, np.uint16) for value in (100, 200, 50)])
    frame = only_frame(write(tmp_path / "a.fits", cube))
    assert frame.image.dtype == np.uint16
    np.testing.assert_array_equal(frame.image, 153)  # 0.299 * 100 + 0.587 * 200 + 0.114 * 50
    with open_recording(write(tmp_path / "b.fits", cube, CTYPE3="TIME", CDELT3=1.0)) as recording:
        assert [frame.image[0, 0] for frame in recording] == [100, 200, 50]


def test_axes_of_length_1_are_nothing(tmp_path):
    frame = only_frame(write(tmp_path / "a.fits", scene(1)[None, None]))
    np.testing.assert_array_equal(frame.image, scene(1))


@pytest.mark.parametrize("rows", ["TOP-DOWN", "BOTTOM-UP", None])
def test_bayer_patterns_become_luminance(tmp_path, rows):
    # The pattern begins at the top row of the picture, wherever that is in the file.
    mosaic = np.full((HEIGHT, WIDTH), 1000, np.uint16)
    mosaic[::2, ::2] = 4000  # red
    mosaic[1::2, 1::2] = 0  # blue
    stored = mosaic[::-1] if rows == "BOTTOM-UP" else mosaic
    frame = only_frame(write(tmp_path / "a.fits", stored, BAYERPAT="RGGB", ROWORDER=rows))
    assert frame.image.dtype == np.uint16
    # 0.299 * 4000 + 0.587 * 1000, in integers
    np.testing.assert_allclose(frame.image[2:-2, 2:-2], 1783, atol=1)


@pytest.mark.parametrize(
    ("rows", "turned"), [("BOTTOM-UP", True), ("TOP-DOWN", False), (None, False)]
)
def test_the_first_row_is_the_top_one_unless_the_header_says_otherwise(tmp_path, rows, turned):
    with open_recording(write(tmp_path / "a.fits", scene(1), ROWORDER=rows)) as recording:
        (frame,) = recording
        said = [words for words in recording.problems if "turned over" in words]
    np.testing.assert_array_equal(frame.image, scene(1)[::-1] if turned else scene(1))
    assert len(said) == turned


# Several images in a file, several files --------------------------------------------------------


def test_extensions_are_a_recording(tmp_path):
    hdus = [fits.PrimaryHDU()]
    for number in range(3):
        header = fits.Header({"DATE-OBS": isot(FIRST_NS + number * NS), "EXPTIME": 0.5})
        hdus.append(fits.ImageHDU(scene(number), header))
    hdus.append(fits.BinTableHDU.from_columns([fits.Column("X", "D", array=[1.0, 2.0])]))
    fits.HDUList(hdus).writeto(tmp_path / "a.fits")
    with open_recording(tmp_path / "a.fits") as recording:
        frames = list(recording)
    assert [frame.stamp_ns for frame in frames] == [FIRST_NS + NS // 4 + n * NS for n in range(3)]
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, scene(number))


def mosaic(path, names):
    hdus = [fits.PrimaryHDU(header=fits.Header({"DATE-OBS": FIRST, "EXPTIME": 0.5}))]
    hdus += [fits.ImageHDU(scene(n), name=name) for n, name in enumerate(names)]
    fits.HDUList(hdus).writeto(path)
    return path


def test_of_images_of_several_names_one_has_to_be_chosen(tmp_path):
    path = mosaic(tmp_path / "a.fits", ["CHIP1", "CHIP2"])
    with pytest.raises(RecordingError, match=r"choose one as the topic: CHIP1 \(1\), CHIP2 \(1\)"):
        open_recording(path)
    with pytest.raises(RecordingError, match=r"no images named CHIP3; there are CHIP1 \(1\)"):
        open_recording(path, "CHIP3")
    with open_recording(path, "CHIP2") as recording:
        (frame,) = recording
        assert (recording.topic, recording.topics) == ("CHIP2", {"CHIP1": 1, "CHIP2": 1})
    np.testing.assert_array_equal(frame.image, scene(1))
    assert frame.stamp_ns == FIRST_NS + NS // 4  # as the primary header has it


def test_of_science_errors_and_flags_science_is_read(tmp_path):
    frame = only_frame(mosaic(tmp_path / "a.fits", ["ERR", "SCI", "DQ"]))
    np.testing.assert_array_equal(frame.image, scene(1))


def test_a_folder_is_read_in_the_order_of_its_headers_times(tmp_path):
    folder = night(tmp_path / "night", 12)
    (folder / "notes.txt").write_text("clear")
    (folder / "preview.png").write_bytes(b"")
    with open_recording(folder) as recording:
        frames = list(recording)
        assert len(recording) == 12
        assert recording.skipped == 0
        problem, beside = recording.problems
    assert "half of the exposure is added" in problem
    assert beside == f"not read, as they are beside the FITS files of {folder}: 1 picture file"
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, scene(number))
        assert frame.stamp_ns == FIRST_NS + 2 * number * NS + NS // 4
        assert (frame.number, frame.exposure_s) == (number, 0.5)


def test_without_times_the_order_is_that_of_people_and_the_rate_has_to_be_given(tmp_path):
    for number in (1, 2, 10):
        write(tmp_path / f"light{number}.fits", scene(number), **{"DATE-OBS": None})
    with pytest.raises(RecordingError, match=r"no header tells when .* as in --fps 2"):
        open_recording(tmp_path)
    with open_recording(tmp_path, fps=4) as recording:
        frames = list(recording)
        (problem,) = recording.problems
    assert "1970-01-01" in problem
    assert [frame.stamp_ns for frame in frames] == [0, NS // 4, NS // 2]
    for number, frame in zip((1, 2, 10), frames, strict=True):
        np.testing.assert_array_equal(frame.image, scene(number))


def test_times_in_whole_seconds_are_told_and_the_rate_helps(tmp_path):
    folder = tmp_path / "night"
    folder.mkdir()
    for number in range(6):
        cards = {"DATE-OBS": f"2026-11-22T03:04:0{5 + number // 3}"}
        write(folder / f"{number}.fits", scene(number), **cards)
    with open_recording(folder) as recording:
        assert len({frame.stamp_ns for frame in recording}) == 2
        assert "4 images have the same time as another one" in recording.problems[-1]
        assert "--fps" in recording.problems[-1]
    with open_recording(folder, fps=3) as recording:
        stamps = [frame.stamp_ns for frame in recording]
        assert "times count from that of 0.fits, by --fps 3" in recording.problems[-1]
    first_ns = FIRST_NS // NS * NS + NS // 4
    assert stamps == [first_ns + round(number * NS / 3) for number in range(6)]


def test_good_times_count_more_than_a_rate(tmp_path):
    with open_recording(night(tmp_path / "night"), fps=1.0) as recording:
        np.testing.assert_array_equal(np.diff([f.stamp_ns for f in recording]), 2 * NS)
        assert "not from --fps 1" in recording.problems[-1]


def test_one_image_without_a_time_is_left_out_and_named(tmp_path):
    folder = night(tmp_path / "night")
    write(folder / "flat.fits", scene(9), **{"DATE-OBS": None})
    with open_recording(folder) as recording:
        assert [frame.number for frame in recording] == [0, 1, 2]
        assert recording.skipped == 1
        assert "(flat.fits) skipped: its header tells no time" in recording.problems[-1]


# Times ------------------------------------------------------------------------------------------

MJD = 61366.12783707705  # of FIRST, to the nanosecond or so


@pytest.mark.parametrize(
    ("cards", "middle_s"),
    [
        ({}, 0.25),
        ({"EXPTIME": None, "EXPOSURE": 3.0}, 1.5),
        ({"EXPTIME": None}, 0.0),
        ({"DATE-AVG": "2026-11-22T03:04:06.123456789"}, 1.0),
        ({"DATE-OBS": None, "DATE-BEG": FIRST}, 0.25),
        ({"DATE-OBS": "2026-11-22T03:00:00", "DATE-BEG": FIRST}, 0.25),
        ({"DATE-OBS": None, "DATE-END": FIRST}, -0.25),
        ({"DATE-END": "2026-11-22T03:04:07.123456789", "EXPTIME": None}, 1.0),
        ({"DATE-OBS": FIRST + "Z"}, 0.25),
        ({"DATE-OBS": (FIRST, "UTC of the middle of the exposure")}, 0.0),
        ({"DATE-OBS": (FIRST, "end of exposure")}, -0.25),
        ({"DATE-OBS": (FIRST, "start; DATE-END has the end")}, 0.25),
        ({"DATE-OBS": "2026-11-22", "TIME-OBS": "03:04:05.123456789"}, 0.25),
        ({"DATE-OBS": "2026-11-22", "UT": "03:04:05.123456789"}, 0.25),
        ({"DATE-OBS": FIRST, "TIMESYS": "UTC"}, 0.25),
    ],
)
def test_the_stamp_is_the_middle_of_the_exposure(tmp_path, cards, middle_s):
    frame = only_frame(write(tmp_path / "a.fits", scene(1), **cards))
    assert frame.stamp_ns == FIRST_NS + round(middle_s * NS)


@pytest.mark.parametrize(
    "cards",
    [{"MJD-OBS": MJD}, {"MJD-OBS": MJD, "DATE-OBS": "2026-11-22"}, {"JD": MJD + 2400000.5}],
)
def test_days_are_times_too(tmp_path, cards):
    cards = {"DATE-OBS": None, "EXPTIME": None, **cards}
    frame = only_frame(write(tmp_path / "a.fits", scene(1), **cards))
    # A double holds days to 1 us, Julian ones to 40 us.
    assert frame.stamp_ns == pytest.approx(FIRST_NS, abs=50_000 if "JD" in cards else 2000)


@pytest.mark.parametrize("scale", ["TAI", "TT", "TDB", "GPS"])
def test_other_time_scales_become_utc(tmp_path, scale):
    time = Time(FIRST, format="isot", scale="utc", precision=9)
    theirs = time.tai - 19 * u.s if scale == "GPS" else getattr(time, scale.lower())
    assert theirs.isot != FIRST
    cards = {"DATE-OBS": theirs.isot, "TIMESYS": scale, "EXPTIME": None}
    frame = only_frame(write(tmp_path / "a.fits", scene(1), **cards))
    assert frame.stamp_ns == pytest.approx(FIRST_NS, abs=2)


def test_a_date_of_the_last_century_is_written_otherwise(tmp_path):
    cards = {"DATE-OBS": "31/12/98", "TIME-OBS": "23:59:59.5", "EXPTIME": None}
    frame = only_frame(write(tmp_path / "a.fits", scene(1), **cards))
    assert isot(frame.stamp_ns) == "1998-12-31T23:59:59.500000000"


@pytest.mark.parametrize("text", ["tonight", "2026-13-41T03:04:05", "1777-01-01T00:00:00", "", 7])
def test_a_time_that_makes_no_sense_is_none(tmp_path, text):
    path = write(tmp_path / "a.fits", scene(1), **{"DATE-OBS": text})
    with pytest.raises(RecordingError, match="give their rate"):
        open_recording(path)
    with open_recording(path, fps=1) as recording:
        (frame,) = recording
        said = " ".join(recording.problems)
    assert frame.stamp_ns == 0
    assert ("makes no sense" in said) == bool(text)


def test_the_exposure_can_be_given_where_headers_have_none(tmp_path):
    path = write(tmp_path / "a.fits", scene(1), EXPTIME=None)
    with open_recording(path) as recording:
        assert "--exposure would give their middle" in recording.problems[0]
        (frame,) = recording
    assert (frame.stamp_ns, frame.exposure_s) == (FIRST_NS, None)
    frame = only_frame(path, exposure_s=4.0)
    assert (frame.stamp_ns, frame.exposure_s) == (FIRST_NS + 2 * NS, 4.0)
    frame = only_frame(write(tmp_path / "b.fits", scene(1)), exposure_s=4.0)
    assert (frame.stamp_ns, frame.exposure_s) == (FIRST_NS + NS // 4, 0.5)


# Torn and foreign files -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plain", "rice", "gz"])
def test_of_a_cut_cube_the_whole_images_are_given(tmp_path, kind):
    cube = np.stack([scene(number) for number in range(8)])
    whole = write(tmp_path / "whole.fits", cube, compressed="rice" if kind == "rice" else False)
    data = whole.read_bytes()
    plain = len(data)
    if kind == "gz":
        data = gzip.compress(data, 1)
    path = tmp_path / ("cut.fits.gz" if kind == "gz" else "cut.fits")
    seen = set()
    for cut in np.linspace(0, len(data), 40).astype(int):
        path.write_bytes(data[:cut])
        frames = []
        with contextlib.suppress(RecordingError), open_recording(path) as recording:
            frames = list(recording)
            assert len(frames) + recording.skipped == 8
            assert bool(recording.skipped) == any("skipped" in p for p in recording.problems)
        for frame in frames:
            np.testing.assert_array_equal(frame.image, scene(frame.number))
        if kind == "plain":  # what is there is given
            data_start = plain - -(-cube.nbytes // 2880) * 2880
            assert len(frames) == min(max(cut - data_start, 0) // (2 * HEIGHT * WIDTH), 8)
        seen.add(len(frames))
    assert {0, 8} < seen
    assert len(seen) > 5


def test_a_bad_file_in_a_folder_costs_no_other(tmp_path):
    folder = night(tmp_path / "night")
    (folder / "broken.fits").write_bytes(b"not FITS at all" * 400)
    (folder / "empty.fits").write_bytes(b"")
    whole = (folder / "light_1.fits").read_bytes()
    (folder / "light_1.fits").write_bytes(whole[:3000])
    with open_recording(folder) as recording:
        assert len(recording) == 5
        assert [frame.stamp_ns for frame in recording] == [
            FIRST_NS + NS // 4,
            FIRST_NS + 4 * NS + NS // 4,
        ]
        assert recording.skipped == 3
        said = "\n".join(recording.problems)
    assert "(light_1.fits) skipped: the file is cut short" in said
    assert "(broken.fits) skipped: " in said
    assert "(empty.fits) skipped: " in said


@pytest.mark.parametrize("content", [b"", b"nonsense" * 1000, b"SIMPLE  =" + b"\xff" * 5000])
def test_a_file_that_is_none_says_so(tmp_path, content):
    path = tmp_path / "a.fits"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"nothing in .*a.fits can be read"):
        open_recording(path)


def test_a_file_without_images_says_so(tmp_path):
    table = fits.BinTableHDU.from_columns([fits.Column("X", "D", array=[1.0, 2.0])])
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "a.fits")
    with pytest.raises(RecordingError, match=r"holds no images, only tables .*, or is cut short"):
        open_recording(tmp_path / "a.fits")


def test_topics_are_not_for_fits_calibrations(tmp_path):
    with pytest.raises(RecordingError, match="is no bag, and has no topics"):
        open_recording(write(tmp_path / "a.fits", scene(1)), camera_info_topic="/camera_info")


def test_without_astropy_the_extra_is_named(tmp_path, monkeypatch):
    path = write(tmp_path / "a.fits", scene(1))
    monkeypatch.setitem(sys.modules, "astropy", None)
    with pytest.raises(RecordingError, match=r"pip install 'ofsat_ros\[fits\]'"):
        open_recording(path)


def test_a_second_look_is_the_same(tmp_path):
    with open_recording(night(tmp_path / "night")) as recording:
        first, again = list(recording), list(recording)
        assert len(recording.problems) == 1
    assert [frame.stamp_ns for frame in first] == [frame.stamp_ns for frame in again]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.image, other.image)


# What real folders hold --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cards", "kinds"),
    [
        ([{"IMAGETYP": "DARK"}, {"IMAGETYP": "Bias Frame"}], "1 Bias Frame, 1 DARK"),
        ([{"FRAMETYP": "Flat"}, {"FRAME": "Dark"}], "1 Dark, 1 Flat"),
        ([{"STACKCNT": 12}, {"IMAGETYP": "FLATDARK"}], "1 FLATDARK, 1 stack"),
    ],
)
def test_darks_and_their_like_are_left_out_and_said(tmp_path, cards, kinds):
    folder = night(tmp_path / "night", IMAGETYP="Light Frame")
    for number, others in enumerate(cards):
        write(folder / f"_{len(cards) - number}.fits", scene(9), **others)
    with open_recording(folder) as recording:
        assert [frame.image[0, 0] for frame in recording] == [scene(n)[0, 0] for n in range(3)]
        (said,) = [words for words in recording.problems if "no single frames of the sky" in words]
        assert (len(recording), recording.skipped) == (3, 0)
    assert said.endswith(f": {kinds} (first _1.fits)")


def test_darks_alone_are_read(tmp_path):
    folder = night(tmp_path / "night", IMAGETYP="DARK")
    with open_recording(folder) as recording:
        assert len(list(recording)) == 3


def test_a_time_with_a_zone_is_turned_to_utc(tmp_path):
    cards = {"DATE-OBS": "2026-11-22T05:34:05.123456789+02:30", "EXPTIME": None}
    assert only_frame(write(tmp_path / "a.fits", scene(1), **cards)).stamp_ns == FIRST_NS


@pytest.mark.parametrize(
    ("cards", "said"),
    [
        ({"DATE-OBS": (FIRST, "local time")}, "DATE-OBS is local time; it is taken for UTC"),
        ({"TIMESYS": "LOCAL"}, "DATE-OBS is local time; it is taken for UTC"),
        ({"MJD-OBS": MJD - 2 / 24}, r"2 h later than MJD-OBS; .* --stamp-offset-s -7200"),
        ({"JD": MJD + 2400000.5 + 0.25}, r"6 h earlier than JD; .* --stamp-offset-s 21600"),
        ({"DATE-OBS": (FIRST, "UTC, by the local clock")}, ""),
        ({"MJD-OBS": MJD, "DATE-AVG": "2026-11-22T03:04:05.4"}, ""),
    ],
)
def test_what_may_be_local_time_is_said(tmp_path, cards, said):
    with open_recording(write(tmp_path / "a.fits", scene(1), **cards)) as recording:
        (frame,) = recording
        words = " ".join(recording.problems)
    assert abs(frame.stamp_ns - FIRST_NS) < NS
    assert re.search(said, words)
    assert ("--stamp-offset-s" in words) == bool(said)


@pytest.mark.parametrize(
    ("name", "value", "comment"),
    [
        ("EXPOINUS", 500_000, "Exposure time in us"),
        ("EXPTIME", 500, "exposure time in ms"),
        ("EXPTIME", 0.5, "[s] Exposure duration"),
        ("EXPOSURE", 0.5, "Exposure time in seconds"),
    ],
)
def test_exposures_have_the_unit_of_their_comments(tmp_path, name, value, comment):
    cards = {"EXPTIME": None, name: (value, comment)}
    assert only_frame(write(tmp_path / "a.fits", scene(1), **cards)).exposure_s == 0.5


def test_cards_that_cannot_be_understood_are_not_there(tmp_path):
    path = write(tmp_path / "a.fits", scene(1), GAIN=7)
    card = b"GAIN    =                    7"
    assert card in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(card, b"CRVAL1  = 'unfinished         "))
    assert only_frame(path).stamp_ns == FIRST_NS + NS // 4


def test_several_sets_of_the_same_exposures_are_said(tmp_path):
    folder = night(tmp_path / "night")
    night(folder, name="solved_{}.fits", SOLVED=True)
    with open_recording(folder) as recording:
        said = recording.problems[-1]
    assert said.startswith("3 images have the same time as another one, ")
    assert "keep one of them in the folder" in said


def test_files_of_several_folders_are_one_recording(tmp_path):
    first = night(tmp_path / "first")
    second = night(tmp_path / "second", 6)  # of the same times in part
    files = [*second.glob("light_[012].fits"), first]
    with open_recording(files) as recording:
        frames = list(recording)
        assert recording.path == tmp_path
    assert [frame.stamp_ns for frame in frames] == [
        FIRST_NS + NS // 4 + 2 * number * NS for number in range(6)
    ]
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, scene(number))


def test_a_begin_that_is_given_counts_where_headers_tell_none(tmp_path):
    for number in range(3):
        write(tmp_path / f"{number}.fits", scene(number), **{"DATE-OBS": None})
    with open_recording(tmp_path, fps=2, exposure_s=0.2, start_ns=FIRST_NS) as recording:
        stamps = [frame.stamp_ns for frame in recording]
        assert recording.problems == []
    assert stamps == [FIRST_NS + NS // 10 + number * NS // 2 for number in range(3)]
    with open_recording(night(tmp_path / "night"), fps=3, start_ns=1) as recording:
        assert "not from --start and --fps 3" in recording.problems[-1]
