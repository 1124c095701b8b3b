# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Folders of pictures in, and which kind of recording a path is."""

import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from ofsat_ros.recordings import RecordingError, open_recording

NS = 1_000_000_000
FIRST_NS = 1_795_316_645 * NS  # 2026-11-22T03:04:05
HEIGHT, WIDTH = 20, 30


def scene(number, dtype=np.uint16):
    random = np.random.default_rng(number)
    return random.integers(0, 255, (HEIGHT, WIDTH)).astype(dtype) * (
        1 if dtype == np.uint8 else 200
    )


def folder_of(path, suffix, dtype, count=3):
    path.mkdir(exist_ok=True)
    for number in range(count):
        # Numbers without leading zeros, as people name them.
        assert cv2.imwrite(str(path / f"night{5 * number}{suffix}"), scene(number, dtype))
    return path


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        *((".png", np.uint8), (".png", np.uint16), (".bmp", np.uint8), (".PNG", np.uint16)),
        *((".tif", np.uint8), (".tiff", np.uint16), (".tif", np.float32)),
    ],
)
def test_pictures_come_as_they_were_at_the_given_rate(tmp_path, suffix, dtype):
    path = folder_of(tmp_path / "night", suffix, dtype)
    with open_recording(path, fps=4, exposure_s=0.2) as recording:
        frames = list(recording)
        assert (recording.kind, len(recording), recording.skipped) == ("images", 3, 0)
        (problem,) = recording.problems
    assert "times count from 1970-01-01" in problem
    for number, frame in enumerate(frames):
        assert frame.image.dtype == dtype
        np.testing.assert_array_equal(frame.image, scene(number, dtype))
        assert (frame.stamp_ns, frame.exposure_s) == (number * NS // 4, 0.2)


def test_without_times_the_rate_has_to_be_given(tmp_path):
    with pytest.raises(RecordingError, match=r"no header tells when .* as in --fps 2"):
        open_recording(folder_of(tmp_path / "night", ".png", np.uint8))


def test_colour_becomes_luminance(tmp_path):
    colour = np.full((HEIGHT, WIDTH, 3), (10, 20, 200), np.uint16)  # blue, green, red
    cv2.imwrite(str(tmp_path / "a.png"), colour)
    cv2.imwrite(str(tmp_path / "a.tif"), colour)
    for name in ("a.png", "a.tif"):
        with open_recording(tmp_path / name, fps=1) as recording:
            (frame,) = recording
        assert frame.image.dtype == np.uint16
        np.testing.assert_array_equal(frame.image, 73)  # 0.114 * 10 + 0.587 * 20 + 0.299 * 200


def photo(path, number, time=None, **tags):
    """Write a JPEG as a camera does, with EXIF."""
    names = {"fraction": 0x9291, "zone": 0x9011, "exposure": 0x829A}
    exif = Image.Exif()
    exif[0x8769] = about = {}
    if time:
        about[0x9003] = time
    for name, value in tags.items():
        about[names[name]] = value
    Image.fromarray(scene(number, np.uint8)).save(path, exif=exif, quality=95)
    return path


def test_photos_tell_when_they_were_taken(tmp_path):
    for number in range(3):
        time = f"2026:11:22 05:04:0{7 - number}"  # against the order of names
        tags = {"fraction": "125", "zone": "+02:00", "exposure": 0.5}
        photo(tmp_path / f"IMG_{number}.jpg", number, time, **tags)
    with open_recording(tmp_path, exposure_s=9.0) as recording:
        frames = list(recording)
        (problem,) = recording.problems
    assert "begin of the exposures" in problem
    middle_ns = FIRST_NS + NS // 8 + NS // 4
    assert [frame.stamp_ns for frame in frames] == [middle_ns + n * NS for n in range(3)]
    assert [frame.exposure_s for frame in frames] == [0.5] * 3
    assert [np.abs(f.image - scene(2 - n, float)).mean() < 30 for n, f in enumerate(frames)]


def test_photos_of_the_same_second_and_without_zone(tmp_path):
    for number in range(3):
        photo(tmp_path / f"{number}.jpg", number, "2026:11:22 03:04:05")
    with open_recording(tmp_path) as recording:
        assert [frame.stamp_ns for frame in recording] == [FIRST_NS] * 3
        said = "\n".join(recording.problems)
    assert "taken as UTC" in said
    assert "2 images have the same time as another one" in said
    with open_recording(tmp_path, fps=2) as recording:
        stamps = [frame.stamp_ns for frame in recording]
    assert stamps == [FIRST_NS + n * NS // 2 for n in range(3)]


def test_without_pillow_the_extra_is_named(tmp_path, monkeypatch):
    photo(tmp_path / "a.jpg", 1, "2026:11:22 03:04:05")
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(RecordingError, match=r"--fps 2, or, .* pip install 'ofsat_ros\[exif\]'"):
        open_recording(tmp_path)
    with open_recording(tmp_path, fps=1) as recording:
        assert [frame.stamp_ns for frame in recording] == [0]


def test_a_time_that_makes_no_sense_is_none(tmp_path):
    photo(tmp_path / "a.jpg", 1, "0000:00:00 00:00:00")
    with pytest.raises(RecordingError, match="no header tells when"):
        open_recording(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", "by another writer.tif"])
def test_a_torn_picture_costs_no_other(tmp_path, suffix):
    for number in range(4):
        path = tmp_path / f"night{number}{suffix}"
        if len(suffix) > 4:  # with its directory before its pixels
            Image.fromarray(scene(number, np.uint8)).save(path)
        else:
            cv2.imwrite(str(path), scene(number, np.uint8))
    with open_recording(tmp_path, fps=1) as recording:
        original = [frame.image for frame in recording]
    torn = tmp_path / f"night1{suffix}"
    whole = torn.read_bytes()
    counts = []
    for cut in np.linspace(0, len(whole) - 1, 20).astype(int):
        torn.write_bytes(whole[:cut])
        with open_recording(tmp_path, fps=1) as recording:
            frames = list(recording)
            counts.append(len(frames))
            assert len(frames) + recording.skipped == 4
            for frame in frames:
                np.testing.assert_array_equal(frame.image, original[frame.number])
                assert frame.stamp_ns == frame.number * NS  # the rate goes on over it
            if recording.skipped:
                assert f"frame 1 ({torn.name}) skipped: " in recording.problems[-1]
    assert counts[:-1] == [3] * 19  # the last byte of some may be of no use


def test_previews_beside_the_pictures_are_not_read(tmp_path):
    folder_of(tmp_path / "night", ".png", np.uint16)
    photo(tmp_path / "night" / "preview.jpg", 9)
    with open_recording(tmp_path / "night", fps=1) as recording:
        assert len(list(recording)) == 3
        assert "of the 3 PNG and 1 JPEG files, only PNG are read" in recording.problems[0]


# Which kind -------------------------------------------------------------------------------------


def test_what_is_nothing_known_is_answered_with_what_is(tmp_path):
    with pytest.raises(RecordingError, match="nowhere does not exist"):
        open_recording(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("clear")
    known = r"\.mcap, .*\.fits, .*\.ser, .*\.mp4, .*\.png"
    with pytest.raises(RecordingError, match=f"neither a metadata.yaml, .* ends in {known}"):
        open_recording(tmp_path)
    with pytest.raises(RecordingError, match=f"is no recording known here: .* ends in {known}"):
        open_recording(tmp_path / "notes.txt")


@pytest.mark.parametrize("options", [{"fps": 0}, {"fps": -1.0}, {"exposure_s": 0.0}])
def test_a_rate_or_exposure_that_is_none_is_refused(tmp_path, options):
    with pytest.raises(RecordingError, match="must be greater than 0"):
        open_recording(folder_of(tmp_path / "night", ".png", np.uint8), **options)


def test_every_page_of_a_tiff_is_a_frame(tmp_path):
    pages = [scene(number) for number in range(4)]
    assert cv2.imwritemulti(str(tmp_path / "stack.tif"), pages)
    cv2.imwrite(str(tmp_path / "stack10.tif"), scene(9))
    with open_recording(tmp_path, fps=2, start_ns=FIRST_NS) as recording:
        frames = list(recording)
        assert recording.problems == []
    for number, (frame, page) in enumerate(zip(frames, [*pages, scene(9)], strict=True)):
        np.testing.assert_array_equal(frame.image, page)
        assert frame.stamp_ns == FIRST_NS + number * NS // 2


def test_a_path_that_is_no_unicode_does_not_end_the_process(tmp_path):
    # As of a USB stick that another system has written; the surrogate is how Python holds it.
    path = folder_of(tmp_path / "night", ".png", np.uint8).rename(tmp_path / "n\udce4cht")
    with open_recording(path, fps=2) as recording:
        assert len(list(recording)) == 3
    (path / "night0.tif").write_bytes(b"")
    with pytest.raises(RecordingError, match="OpenCV cannot open a file whose path is no Unicode"):
        open_recording(path / "night0.tif", fps=2)
