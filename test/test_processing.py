# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Directions and times of ``ofsat process``: calibration and attitude from the recording."""

import csv
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from command import ofsat
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.recordings import BagWriter
from ofsat_ros.simulation import scenario, write_truth

SIZE = {"width": 200, "height": 160}
FRAMES = 12
# 5 arcsec/px, as the scenario has them.
SCALE_RAD = np.radians(5 / 3600)
FRAME_ID = "camera_optical_frame"
IMAGE, INFO, ATTITUDE = "/camera/image_raw", "/camera/camera_info", "/camera/attitude"


def attitude_at(stamp_ns: int, start_ns: int) -> Rotation:
    """A camera that turns about its boresight, near declination 60 deg."""
    seconds = (stamp_ns - start_ns) / 1e9
    return Rotation.from_euler("zxz", [2e-3 * seconds, np.radians(30), 1.0])


def write_bag(
    path: Path,
    calibrated: bool = True,
    attitudes: bool = True,
    shift_ns: int = 0,
    size: tuple[int, int] = (SIZE["width"], SIZE["height"]),
) -> list:
    """A recording whose attitudes lie between its frames; its image stamps may be shifted."""
    frames = list(scenario("survey", 1, frames=FRAMES, **SIZE))
    start_ns = frames[0].stamp_ns
    with BagWriter(path) as bag:
        for frame in frames:
            stamp_ns = frame.stamp_ns
            if calibrated:
                bag.write_camera_info(INFO, Camera.ideal(*size, SCALE_RAD), stamp_ns, FRAME_ID)
            if attitudes:
                for at_ns in (stamp_ns - 600_000_000, stamp_ns - 200_000_000):
                    bag.write_attitude(ATTITUDE, attitude_at(at_ns, start_ns), at_ns, FRAME_ID)
            bag.write_image(IMAGE, frame.image, stamp_ns + shift_ns, FRAME_ID)
    write_truth(f"{path}.truth.csv", [frame.truth for frame in frames])
    return frames


def process(bag: Path, output: Path, *options: object) -> tuple[Result, list[dict]]:
    done = ofsat("process", bag, "-o", output, *options)
    assert done.exit_code == 0, done.output
    with (output / "detections.csv").open(encoding="utf-8") as file:
        return done, list(csv.DictReader(file))


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "bag"
    write_bag(path)
    return path


@pytest.fixture(scope="module")
def plain(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, list[dict]]:
    """The recording, processed without any option."""
    return process(bag, tmp_path_factory.mktemp("plain"))


def gnomonic(x: float, y: float) -> np.ndarray:
    """Line of sight of a pixel of an ideal camera, by hand."""
    offset = np.array([x - (SIZE["width"] - 1) / 2, y - (SIZE["height"] - 1) / 2]) * SCALE_RAD
    vector = np.array([*offset, 1.0])
    return vector / np.linalg.norm(vector)


def test_each_detection_has_the_direction_of_its_pixel_at_mid_exposure(plain):
    done, rows = plain
    assert done.stderr == ""
    assert len(rows) > 3 * FRAMES
    start_ns = min(int(row["stamp_ns"]) for row in rows)
    for row in rows:
        ra, dec = np.radians([float(row["ra_deg"]), float(row["dec_deg"])])
        icrs = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
        sight = attitude_at(int(row["stamp_ns"]), start_ns).apply(icrs)
        expected = gnomonic(float(row["x_px"]), float(row["y_px"]))
        # Nine digits in the file are 2e-8 rad of the angles, and 1e-7 px.
        assert np.linalg.norm(sight - expected) < 5e-8


def test_the_last_word_and_the_live_one_have_the_same_directions(bag, plain, tmp_path):
    """Confirmed rows of both: the attitude is carried on live, and the camera turns evenly."""
    _, late = plain
    _, live = process(bag, tmp_path, "--live")
    known = {(row["frame"], row["track_id"]): row for row in late}
    shared = [row for row in live if row["confirmed"] == "1"]
    assert len(shared) > FRAMES
    for row in shared:
        for name in ("ra_deg", "dec_deg"):
            other = known[row["frame"], row["track_id"]]
            assert float(row[name]) == pytest.approx(float(other[name]), abs=2e-6)


@pytest.mark.parametrize(("reference", "shift"), [("start", -0.5), ("end", 0.5), ("middle", 0.0)])
def test_stamps_are_turned_into_the_middle_of_the_exposure(plain, reference, shift, tmp_path):
    """A driver that stamps start or end of 1 s, whose clock is 0.25 s behind."""
    shifted = tmp_path / "bag"
    write_bag(shifted, shift_ns=round((shift - 0.25) * 1e9))
    options = ("--stamp-reference", reference, "--exposure-time-s", 1, "--stamp-offset-s", 0.25)
    _, rows = process(shifted, tmp_path / "shifted", *options)
    assert rows == plain[1]


@pytest.mark.parametrize(
    ("kinds", "note"),
    [
        ({"calibrated": False, "attitudes": False}, ""),
        ({"calibrated": False}, ""),
        (
            {"attitudes": False},
            "detections have no ra and dec: no attitude has come; the recording has no topic"
            " attitude (geometry_msgs/QuaternionStamped)",
        ),
        ({"size": (100, 80)}, "camera_info is for images of 100x80, not of 200x160"),
    ],
    ids=["nothing", "no calibration", "no attitude", "another size"],
)
def test_directions_that_are_unknown_are_nan_and_said(kinds, note, tmp_path):
    write_bag(tmp_path / "bag", **kinds)
    done, rows = process(tmp_path / "bag", tmp_path / "out")
    assert len(rows) > 3 * FRAMES
    assert {row["ra_deg"] for row in rows} == {row["dec_deg"] for row in rows} == {"nan"}
    words = " ".join(done.stderr.split())
    assert note in words if note else words == ""


def test_each_frame_has_the_calibration_of_its_time(tmp_path):
    """A focuser moved in mid-recording: the last word on the frames before comes after that."""
    frames = list(scenario("survey", 1, frames=FRAMES, **SIZE))
    start_ns, changed = frames[0].stamp_ns, FRAMES // 2
    with BagWriter(tmp_path / "bag") as bag:
        for frame in frames:
            scale = SCALE_RAD * (1 if frame.frame < changed else 1.1)
            camera = Camera.ideal(SIZE["width"], SIZE["height"], scale)
            bag.write_camera_info(INFO, camera, frame.stamp_ns, FRAME_ID)
            for at_ns in (frame.stamp_ns - 1_000_000, frame.stamp_ns):
                bag.write_attitude(ATTITUDE, attitude_at(at_ns, start_ns), at_ns, FRAME_ID)
            bag.write_image(IMAGE, frame.image, frame.stamp_ns, FRAME_ID)
    _, rows = process(tmp_path / "bag", tmp_path / "out")
    assert len({int(row["frame"]) >= changed for row in rows}) == 2
    for row in rows:
        ra, dec = np.radians([float(row["ra_deg"]), float(row["dec_deg"])])
        icrs = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
        sight = attitude_at(int(row["stamp_ns"]), start_ns).apply(icrs)
        expected = gnomonic(float(row["x_px"]), float(row["y_px"]))
        if int(row["frame"]) >= changed:
            expected[:2] *= 1.1
            expected /= np.linalg.norm(expected)
        assert np.linalg.norm(sight - expected) < 5e-8


def test_an_attitude_right_after_the_image_counts_with_published_presets_too(tmp_path):
    """Their last word is said at once; the attitude's message comes a moment later."""
    frames = list(scenario("survey", 1, frames=4, **SIZE))
    with BagWriter(tmp_path / "bag") as bag:
        for frame in frames:
            camera = Camera.ideal(SIZE["width"], SIZE["height"], SCALE_RAD)
            bag.write_camera_info(INFO, camera, frame.stamp_ns, FRAME_ID)
            bag.write_image(IMAGE, frame.image, frame.stamp_ns, FRAME_ID)
            attitude = attitude_at(frame.stamp_ns, frames[0].stamp_ns)
            bag.write_attitude(ATTITUDE, attitude, frame.stamp_ns, FRAME_ID)
    _, rows = process(tmp_path / "bag", tmp_path / "out", "--preset", "paper_opencv")
    assert len(rows) > 3
    assert "nan" not in {row["ra_deg"] for row in rows}


def test_an_old_attitude_does_not_count(bag, tmp_path):
    """The nearest attitude is 0.2 s before each frame; two are 0.4 s apart."""
    _, rows = process(bag, tmp_path / "out", "--attitude-max-age-s", 0.15, "--live")
    assert {row["ra_deg"] for row in rows} == {"nan"}


def test_tracking_data_hold_the_tracks_directions(bag, tmp_path):
    formats = ("--tdm", "kvn", "--tdm", "xml", "--tdm", "iod", "--station", 4171)
    done, rows = process(bag, tmp_path, *formats)
    assert "tracks.tdm, tracks.xml and tracks.iod are in" in " ".join(done.stdout.split())
    lines = (tmp_path / "tracks.tdm").read_text().splitlines()
    angles = [float(line.split()[-1]) for line in lines if line.startswith("ANGLE_1 ")]
    wanted = [float(row["ra_deg"]) for row in sorted(rows, key=lambda row: int(row["track_id"]))]
    # By track, in the order of time; the CSV has nine digits.
    assert sorted(angles) == pytest.approx(sorted(value % 360 for value in wanted), abs=1e-6)
    assert len((tmp_path / "tracks.iod").read_text().splitlines()) == len(rows)
    assert (tmp_path / "tracks.xml").read_text().count("<ANGLE_1>") == len(rows)


def test_tracking_data_without_directions_are_not_written_and_said(tmp_path):
    write_bag(tmp_path / "bag", attitudes=False)
    done, _ = process(tmp_path / "bag", tmp_path / "out", "--tdm", "kvn")
    assert not (tmp_path / "out" / "tracks.tdm").exists()
    words = " ".join(done.stderr.split())
    assert "no tracking data is written: no track has ra and dec in 3 frames" in words
