# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Video in: files of OpenCV's, lossless and not, whole and cut."""

import cv2
import numpy as np
import pytest

from ofsat_ros.recordings import RecordingError, open_recording

NS = 1_000_000_000
HEIGHT, WIDTH = 48, 64
# What OpenCV writes and reads as grey, and not as colour.
GREYS = [np.uint8, np.uint16] if cv2.__version__ > "4.7" else []


def scene(number, dtype=np.uint8):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    spot = np.exp(-((x - 20 - number) ** 2 + (y - 15) ** 2) / 20)
    return (dtype(1 if dtype == np.uint8 else 256) * (20 + 200 * spot)).astype(dtype)


def write(path, codec, count=12, fps=12.5):
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, (WIDTH, HEIGHT))
    assert video.isOpened()
    for number in range(count):
        video.write(np.dstack([scene(number)] * 3))
    video.release()
    return path


@pytest.mark.parametrize(
    ("name", "codec", "lost"),
    [
        *(("a.avi", "FFV1", 1), ("a.mkv", "FFV1", 1)),  # by the way through YUV
        *(("a.avi", "MJPG", 6), ("a.MP4", "mp4v", 12)),
    ],
)
def test_frames_come_in_order_and_at_the_files_rate(tmp_path, name, codec, lost):
    with open_recording(write(tmp_path / name, codec)) as recording:
        assert (recording.kind, len(recording)) == ("video", 12)
        for _ in range(2):
            frames = list(recording)
            start, rate = recording.problems
            assert recording.skipped == 0
    assert "times count from 1970-01-01" in start
    assert "12.5 frames a second, is the one at which the video plays" in rate
    for number, frame in enumerate(frames):
        assert frame.image.dtype == np.uint8
        assert np.abs(frame.image.astype(float) - scene(number)).mean() < lost
        assert (frame.number, frame.stamp_ns) == (number, number * NS * 2 // 25)
    assert len(frames) == 12


def test_a_given_rate_and_exposure_count(tmp_path):
    path = write(tmp_path / "a.avi", "MJPG")
    with open_recording(path, fps=100.0, exposure_s=0.008) as recording:
        frames = list(recording)
        assert len(recording.problems) == 1
    assert [frame.stamp_ns for frame in frames] == [n * NS // 100 for n in range(12)]
    assert frames[0].exposure_s == 0.008


def test_grey_without_loss_comes_as_it_was(tmp_path):
    path = tmp_path / "a.mkv"
    for dtype in GREYS:
        depth = cv2.CV_8U if dtype == np.uint8 else cv2.CV_16U
        options = [cv2.VIDEOWRITER_PROP_DEPTH, depth, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
        ffv1 = cv2.VideoWriter_fourcc(*"FFV1")
        video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, ffv1, 25, (WIDTH, HEIGHT), options)
        assert video.isOpened()
        for number in range(5):
            video.write(scene(number, dtype))
        video.release()
        with open_recording(path) as recording:
            frames = list(recording)
        assert len(frames) == 5
        for number, frame in enumerate(frames):
            assert frame.image.dtype == dtype
            np.testing.assert_array_equal(frame.image, scene(number, dtype))


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "MJPG"), ("a.mkv", "FFV1")])
def test_of_a_cut_video_whole_frames_are_given(tmp_path, name, codec):
    whole = write(tmp_path / name, codec).read_bytes()
    with open_recording(tmp_path / name) as recording:
        original = [frame.image for frame in recording]
    path, counts = tmp_path / f"cut{name}", []
    for cut in np.linspace(0, len(whole) - 1, 25).astype(int):
        path.write_bytes(whole[:cut])
        try:
            with open_recording(path) as recording:
                frames = list(recording)
                assert len(frames) + recording.skipped == len(recording)
        except RecordingError:
            frames = []
        for frame in frames:
            np.testing.assert_array_equal(frame.image, original[frame.number])
        counts.append(len(frames))
    assert counts == sorted(counts)
    assert counts[-1] >= 11
    assert len(set(counts)) > 5


def test_what_is_no_video_says_so(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"nothing like it" * 100)
    with pytest.raises(RecordingError, match="is no video that OpenCV reads"):
        open_recording(tmp_path / "a.mp4")


def test_more_bits_than_opencv_gives_are_told(tmp_path, monkeypatch):
    """As of a video that an older OpenCV reads: what FFmpeg calls grey of 16 bits gives 8."""
    path = write(tmp_path / "a.mkv", "FFV1")
    name = int.from_bytes(b"Y1\x00\x10", "little")
    monkeypatch.setattr(
        "ofsat_ros.recordings.video._pixel_format", lambda _: name.to_bytes(4, "little")
    )
    monkeypatch.setattr("ofsat_ros.recordings.video._GREY_16", b"none")
    with open_recording(path, fps=1) as recording:
        assert "has 16 bits, and OpenCV gives the highest 8" in recording.problems[-1]


def test_a_begin_that_is_given_counts(tmp_path):
    path = write(tmp_path / "a.avi", "MJPG")
    start_ns = 1_795_316_645 * NS
    with open_recording(path, exposure_s=0.02, start_ns=start_ns) as recording:
        stamps = [frame.stamp_ns for frame in recording]
        (rate,) = recording.problems
    assert "the rate, 12.5 frames a second" in rate
    # The middle of the exposures.
    assert stamps == [start_ns + NS // 100 + n * NS * 2 // 25 for n in range(12)]


def test_parts_of_a_video_follow_each_other_as_people_number_them(tmp_path):
    parts = [write(tmp_path / "a_2.avi", "FFV1", 5), write(tmp_path / "a_10.avi", "FFV1", 7)]
    with open_recording(reversed(parts)) as recording:
        assert (recording.path, len(recording)) == (tmp_path, 12)
        for _ in range(2):
            frames = list(recording)
            assert recording.skipped == 0
    assert [frame.number for frame in frames] == list(range(12))
    assert [frame.stamp_ns for frame in frames] == [n * NS * 2 // 25 for n in range(12)]
    for number, frame in enumerate(frames):
        wanted = scene(number if number < 5 else number - 5)
        assert np.abs(frame.image.astype(float) - wanted).mean() < 1
    write(tmp_path / "a_11.avi", "FFV1", fps=25)
    with pytest.raises(RecordingError, match=r"different rates, 12.5 to 25 .* as in --fps 20"):
        open_recording(tmp_path.glob("a_1?.avi"))
    with pytest.raises(RecordingError, match=r"several recordings; open one of .* give the names"):
        open_recording(tmp_path)
