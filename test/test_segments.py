# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A long recording in segments: joined, they are what one run would have given."""

import pickle
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.parameters import ParameterError
from ofsat_ros.processing import Job, Segment, cut, join, joining
from ofsat_ros.recordings import IMAGE, BagWriter, RecordingError, open_recording
from ofsat_ros.results import (
    DETECTION_COLUMNS,
    STAR_FIELD_COLUMNS,
    TRACK_COLUMNS,
    ResultError,
    read_run,
    read_table,
)

WIDTH, HEIGHT, FRAMES = 128, 112, 112
CUTS = (0, 28, 56, 84, FRAMES)
OVERLAP = 20
# The last two frames before a cut, and the first after it, cannot be decoded.
DAMAGED = {54, 55, 56}
# Clouds right after that cut, and a pause that ends all tracks right after the last.
CLOUDS, PAUSE_AT, PAUSE_NS = range(58, 61), 86, 700 * 10**9
# An RSO that the second segment alone has.
OWN = range(38, 48)
FRAME_ID, START_NS = "camera_optical_frame", 1_800_000_000 * 10**9
TOPIC, INFO, ATTITUDE = "/camera/image_raw", "/camera/camera_info", "/camera/attitude"
# A shorter memory makes a shorter test: a last word is said after 8 frames.
SHORT = {"history_frames": 5, "coast_frames": 3}


def silent(_: str) -> None:
    pass


def picture(frame: int) -> np.ndarray:
    """Stars that drift, five RSOs all the time, that of the second segment, defects, clouds."""
    sensor, sky = np.random.default_rng(7), np.random.default_rng(8)
    image = np.random.default_rng([9, frame]).normal(1000, 10, (HEIGHT, WIDTH))
    rows, columns = np.arange(HEIGHT)[:, None], np.arange(WIDTH)

    def shine(x: float, y: float, peak: float) -> None:
        across, down = columns - x, rows - y
        np.add(image, peak * np.exp(-(across**2) / 2) * np.exp(-(down**2) / 2), out=image)

    if frame not in CLOUDS:
        for x, y, peak in sky.uniform((0, 0, 60), (WIDTH + 40, HEIGHT + 30, 600), (60, 3)):
            shine(x - 0.31 * frame, y - 0.23 * frame, peak)
        for number in range(5):
            x, y = 9 + 0.9 * frame - 2 * number, 12 + 19 * number + 0.05 * number * frame
            shine(x, y, 50 + 25 * number)
        if frame in OWN:
            shine(110 - 4 * (frame - OWN.start), 8 + 3 * (frame - OWN.start), 120)
    defects = sensor.integers(0, (HEIGHT, WIDTH), (40, 2))
    image[tuple(defects.T)] += sensor.uniform(5, 60, len(defects))
    return np.clip(np.rint(image), 0, 65535).astype(np.uint16)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """RSOs that are there all the time; calibration and attitude at the start alone."""
    path = tmp_path_factory.mktemp("bags") / "bag"
    with BagWriter(path) as writer:
        for number in range(FRAMES):
            stamp_ns = START_NS + 10**9 * number + PAUSE_NS * (number >= PAUSE_AT)
            if number == 0:
                camera = Camera.ideal(WIDTH, HEIGHT, np.radians(5 / 3600))
                writer.write_camera_info(INFO, camera, stamp_ns, FRAME_ID)
                for at_ns in (stamp_ns - 10**9, stamp_ns):
                    writer.write_attitude(ATTITUDE, Rotation.from_euler("x", 0.3), at_ns, FRAME_ID)
            if number in DAMAGED:
                writer.write(TOPIC, IMAGE, b"\x00\x01\x00\x00 torn", stamp_ns)
            else:
                writer.write_image(TOPIC, picture(number), stamp_ns, FRAME_ID)
    return path


@pytest.fixture(scope="module")
def job(bag: Path) -> Job:
    parameters = {**SHORT, "attitude_max_age_s": 600.0}
    return Job((f"{bag}",), parameters=parameters, formats=("kvn",))


@pytest.fixture(scope="module")
def whole(job: Job, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    job.run(folder, silent)
    return folder


@pytest.fixture(scope="module")
def parts(job: Job, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], list[Segment]]:
    segments = cut(FRAMES, FRAMES // 4, OVERLAP)
    folders = [tmp_path_factory.mktemp("part") for _ in segments]
    for folder, segment in zip(folders, segments, strict=True):
        # What a worker gets.
        sent = pickle.loads(pickle.dumps(replace(job, segment=segment)))
        sent.run(folder, silent)
    return folders, segments


@pytest.fixture(scope="module")
def joined(
    parts: tuple[list[Path], list[Segment]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp("joined")
    join(*parts, folder)
    return folder


def detections(folder: Path) -> np.ndarray:
    return read_table(folder / "detections.csv", DETECTION_COLUMNS)


def assert_same(one: Path, other: Path) -> None:
    """The same tracks by the same numbers in the same frames, at the same places."""
    a, b = detections(one), detections(other)
    for name in ("stamp_ns", "frame", "track_id", "confirmed"):
        np.testing.assert_array_equal(a[name], b[name])
    # What a track's filter remembers of frames before the overlap moves a faint spot by less.
    for name in ("x_px", "y_px", "sigma_x_px", "length_px"):
        np.testing.assert_allclose(a[name], b[name], rtol=0, atol=2e-3)
    for name in ("vx_px_s", "rel_vx_px_s", "rel_vy_px_s"):
        np.testing.assert_allclose(a[name], b[name], rtol=0, atol=1e-3)
    np.testing.assert_allclose(a["snr"], b["snr"], rtol=1e-3)
    # 2e-3 px of 5 arcsec
    for name in ("ra_deg", "dec_deg"):
        np.testing.assert_allclose(a[name], b[name], rtol=0, atol=3e-6)
    tracks = [read_table(folder / "tracks.csv", TRACK_COLUMNS) for folder in (one, other)]
    for name in ("track_id", "first_frame", "last_frame", "detections"):
        np.testing.assert_array_equal(tracks[0][name], tracks[1][name])


def test_joined_segments_are_what_one_run_gives(whole, joined):
    assert_same(whole, joined)
    tables = [
        read_table(folder / "star_field.csv", STAR_FIELD_COLUMNS) for folder in (whole, joined)
    ]
    for name in set(STAR_FIELD_COLUMNS) - {"note", "detections"}:
        np.testing.assert_array_equal(tables[0][name], tables[1][name], err_msg=name)
    assert {path.name for path in joined.iterdir()} == {path.name for path in whole.iterdir()}


def test_the_scene_has_what_may_go_wrong(whole):
    """Tracks across the first two cuts, an RSO of the second segment alone, a reset."""
    rows = detections(whole)
    tracks = {
        number: rows["frame"][rows["track_id"] == number] for number in np.unique(rows["track_id"])
    }
    for at in CUTS[1:3]:
        assert sum(frames.min() < at <= frames.max() for frames in tracks.values()) >= 3
    own = [frames for frames in tracks.values() if set(frames) <= set(OWN)]
    assert any(len(frames) >= 6 for frames in own)
    assert not any(frames.min() < PAUSE_AT <= frames.max() for frames in tracks.values())
    assert rows["frame"].max() == FRAMES - 1
    assert not DAMAGED & set(rows["frame"].tolist())


def test_directions_and_tracking_data_are_one_run_s(whole, joined):
    assert np.isfinite(detections(joined)["ra_deg"]).any()
    messages = [(folder / "tracks.tdm").read_text() for folder in (whole, joined)]
    one, other = (re.sub(r"CREATION_DATE.*", "", text).split() for text in messages)
    assert len(one) == len(other) > 100
    for a, b in zip(one, other, strict=True):
        assert a == b or float(a) == pytest.approx(float(b), abs=3e-6)


def test_the_joined_run_tells_what_one_run_tells(whole, joined):
    a, b = read_run(whole), read_run(joined)
    assert a["left_out"] == len(DAMAGED)
    assert a["frames"] == FRAMES - len(DAMAGED)
    assert [p for p in a["problems"] if "afresh" in p] == [
        f"frame {PAUSE_AT} starts afresh: time jumped ahead by 701 s"
    ]
    for run in (a, b):
        assert run.pop("seconds") > 0
        assert run.pop("profile")["tracking"] > 0
        run.pop("started_utc")
    assert a == b


def test_where_segments_do_not_tell_the_same_one_runs_on(
    parts, whole, joined, tmp_path, monkeypatch
):
    """As if nothing that the second finds were what the first goes on with."""
    folders, segments = parts
    seam, asked = joining._seam, []

    def reluctant(here, there, settling):
        asked.append(here.segment)
        if here.segment.first == segments[1].first and here.segment.after == OVERLAP:
            return None
        return seam(here, there, settling)

    monkeypatch.setattr(joining, "_seam", reluctant)
    join(folders, segments, tmp_path)
    assert [each.first for each in asked] == [0, 28, 28, 56]
    assert asked[2].stop == CUTS[2] + 4 * OVERLAP
    assert_same(whole, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in joined.iterdir()}


def test_a_seam_needs_the_same_rsos_for_long_enough(parts):
    folders, segments = parts
    here, there = (
        joining.RunOfSegment.read(folder, segment, read_run(folder)["segment"])
        for folder, segment in zip(folders[:2], segments[:2], strict=True)
    )
    found = joining._seam(here, there, 8)
    assert found is not None
    assert found.frame == CUTS[1]
    assert len(found.same) >= 3
    # One that is half a pixel off all the time is another.
    moved = replace(there, rows=there.rows.copy())
    number = next(iter(found.same))
    moved.rows["detection"]["x"][moved.rows["detection"]["track_id"] == number] += 0.5
    assert joining._seam(here, moved, 8) is None
    assert joining._seam(here, there.part(0, CUTS[1] - OVERLAP + 7), 8) is None


def test_what_is_no_whole_segment_is_refused(parts, whole, tmp_path):
    folders, segments = parts
    with pytest.raises(ResultError, match="does not hold the whole of a segment"):
        join([folders[0], whole], segments[:2], tmp_path)
    shutil.copy(folders[0] / "run.json", tmp_path)
    with pytest.raises(ResultError, match="holds no whole segment"):
        join([tmp_path], segments[:1], tmp_path)


def test_a_recording_may_be_shorter_than_it_tells_and_than_a_segment(bag, tmp_path):
    """The index tells of more frames than there are: some segments have none."""
    short = tmp_path / "short"
    with open_recording(bag, end=14) as frames, BagWriter(short) as writer:
        for frame in frames:
            writer.write_image(TOPIC, frame.image, frame.stamp_ns, FRAME_ID)
    job = Job((f"{short}",), parameters={"history_frames": 3, "coast_frames": 0})
    for name in ("one", "alone", "two", "whole"):
        (tmp_path / name).mkdir()
    job.run(tmp_path / "one", silent)
    (alone,) = cut(14, 100, 6)
    replace(job, segment=alone).run(tmp_path / "alone", silent)
    join([tmp_path / "alone"], [alone], tmp_path / "whole")
    assert (tmp_path / "whole/detections.csv").read_bytes() == (
        tmp_path / "one/detections.csv"
    ).read_bytes()
    beyond = Segment(20, 30, 6)
    run = replace(job, segment=beyond).run(tmp_path / "two", silent)
    assert (run["frames"], run["left_out"], run["stopped"]) == (0, 0, False)
    join([tmp_path / "alone", tmp_path / "two"], [alone, beyond], tmp_path / "whole")
    assert read_run(tmp_path / "whole")["frames"] == 14
    assert_same(tmp_path / "one", tmp_path / "whole")


def test_a_watch_is_told_of_every_frame_and_may_end_the_run(bag, tmp_path):
    told: list[tuple[int, int]] = []

    def watch(done: int, known: int) -> None:
        told.append((done, known))
        if done == 3:
            raise KeyError

    job = Job((f"{bag}",), segment=Segment(8, 12, before=4, after=0, learned=2))
    with pytest.raises(KeyError):
        job.run(tmp_path, silent, watch)
    # Two that are learned from, and eight.
    assert told == [(1, 10), (2, 10), (3, 10)]
    run = read_run(tmp_path)
    assert (run["stopped"], run["frames"]) == (True, 1)


@pytest.mark.parametrize(
    ("count", "least", "overlap", "firsts"),
    [
        (100, 30, 10, [0, 33, 66]),
        (100, 30, 60, [0]),
        (59, 30, 10, [0]),
        (0, 30, 10, [0]),
    ],
)
def test_cuts_leave_segments_of_about_the_same_length(count, least, overlap, firsts):
    segments = cut(count, least, overlap)
    assert [segment.first for segment in segments] == firsts
    assert segments[-1].end == count
    assert segments[-1].stop > 10**9  # should there be more than told
    for one, other in pairwise(segments):
        assert one.end == other.first
        assert (one.stop, other.start) == (one.end + overlap, one.end - overlap)


def test_the_overlap_follows_the_parameters():
    paths = ("bag",)
    assert Job(paths, parameters=SHORT).overlap == 4 * 8
    assert Job(paths).overlap == 4 * 14


def test_a_job_refuses_what_it_cannot_do():
    with pytest.raises(ParameterError, match="there is no parameter colour"):
        Job(("bag",), parameters={"colour": 1})
    with pytest.raises(ParameterError):
        Job(("bag",), preset="none")
    with pytest.raises(ValueError, match="bags of results are not joined"):
        Job(("bag",), bag=True, segment=Segment(0, 10))


def write_pictures(path: Path, images: list[np.ndarray]) -> Path:
    path.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(f"{path}/{number}.png", image)
    return path


def write_fits(path: Path, images: list[np.ndarray]) -> Path:
    from astropy.io import fits

    path.mkdir()
    for number, image in enumerate(images):
        cards = {"DATE-OBS": f"2026-01-01T00:00:{number:02}", "EXPTIME": 0.5}
        fits.PrimaryHDU(image, fits.Header(cards)).writeto(path / f"{number}.fits")
    return path


def write_video(path: Path, images: list[np.ndarray]) -> Path:
    path = path.with_suffix(".avi")
    shape = images[0].shape[::-1]
    video = cv2.VideoWriter(f"{path}", cv2.VideoWriter.fourcc(*"MJPG"), 20, shape, isColor=False)
    for image in images:
        video.write((image // 16).astype(np.uint8))
    video.release()
    return path


def write_bags(path: Path, images: list[np.ndarray]) -> list[Path]:
    """Two bags, of which the first alone has a calibration."""
    half = len(images) // 2
    for part in (0, 1):
        with BagWriter(f"{path}{part}") as writer:
            for number, image in list(enumerate(images, 1))[part * half : (part + 1) * half]:
                if number == 1:
                    camera = Camera.ideal(WIDTH, HEIGHT, 1e-4)
                    writer.write_camera_info(INFO, camera, number, FRAME_ID)
                writer.write_attitude(ATTITUDE, Rotation.identity(), number * 10**9, FRAME_ID)
                writer.write_image(TOPIC, image, number * 10**9, FRAME_ID)
    return [Path(f"{path}{part}") for part in (0, 1)]


@pytest.mark.parametrize("write", [write_pictures, write_fits, write_video, write_bags])
@pytest.mark.parametrize(("first", "end"), [(3, 7), (0, 4), (6, None), (9, 20), (8, 8)])
def test_a_part_of_a_recording_is_as_in_the_whole(
    write: Callable, first: int, end: int | None, tmp_path
):
    images = [np.full((HEIGHT, WIDTH), 100 * number, np.uint16) for number in range(10)]
    path = write(tmp_path / "frames", images)
    how = {"fps": 2.0} if write in (write_pictures, write_video) else {}
    with open_recording(path, **how) as recording:
        every = list(recording)
    with open_recording(path, **how, first=first, end=end) as recording:
        some = list(recording)
        assert len(recording) == len(some)
        assert recording.skipped == 0
        assert recording.reached == (min(end, 10) if end else 10)
    assert [frame.number for frame in some] == list(range(10))[first:end]
    attitudes = [attitude[0] for frame in every for attitude in frame.attitudes]
    for frame in some:
        same = every[frame.number]
        assert (frame.stamp_ns, f"{frame.camera}") == (same.stamp_ns, f"{same.camera}")
        np.testing.assert_array_equal(frame.image, same.image)
    if some and write is write_bags:
        assert [one[0] for one in some[0].attitudes] == attitudes[: first + 1]


def test_frames_that_are_not_asked_for_cost_and_tell_nothing(bag):
    with open_recording(bag, first=60, end=70) as recording:
        assert len(list(recording)) == 10
        assert (recording.skipped, recording.problems) == (0, [])
    with open_recording(bag, first=50, end=58) as recording:
        assert [frame.number for frame in recording] == [50, 51, 52, 53, 57]
        assert recording.skipped == len(DAMAGED)
        assert len(recording.problems) == len(DAMAGED)
    with pytest.raises(RecordingError):
        open_recording(bag / "nothing", first=3)
