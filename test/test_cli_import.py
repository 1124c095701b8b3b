# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat import``: what is read is what is written, from FITS, pictures and other bags."""

import re
import signal
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from command import fails, subprocess_ofsat, succeeds
from rosbags.highlevel import AnyReader

from ofsat_ros.camera import to_radec
from ofsat_ros.recordings import BagWriter, Frame, open_recording

TOPIC = "/camera/image_raw"
START = 1_767_225_600_000_000_000  # 2026-01-01
SECOND = 1_000_000_000


def image(value: int = 100, dtype: str = "uint16") -> np.ndarray:
    return np.random.default_rng(value).normal(value, 5, (48, 64)).clip(0).astype(dtype)


def write_fits(folder: Path, count: int = 3, dtype: str = "uint16") -> list[Path]:
    """Files of images that are solved, two seconds apart, exposed for a second."""
    folder.mkdir()
    files = []
    for i in range(count):
        header = solution(i).to_header()
        header["DATE-OBS"], header["EXPTIME"] = f"2026-01-01T00:00:{2 * i:02}", 1.0
        # The first row is the top one, as cameras write it.
        header["ROWORDER"] = "TOP-DOWN"
        files.append(folder / f"light_{i}.fits")
        fits.writeto(files[-1], image(i + 1, dtype), header)
    return files


def solution(i: int) -> WCS:
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval, wcs.wcs.crpix = [150 + 0.01 * i, 20], [32.5, 24.5]
    # North is up with the first row on top; 5 arcsec per px.
    wcs.wcs.cd = np.array([[-5, 0], [0, -5]]) / 3600
    return wcs


def frames_of(path: Path) -> tuple[list[Frame], list[str]]:
    with open_recording(path) as recording:
        return list(recording), recording.problems


def test_fits_with_a_solution_become_a_bag_with_directions(tmp_path: Path):
    write_fits(tmp_path / "night")
    done = succeeds("import", tmp_path / "night", "-o", tmp_path / "bag")
    assert done.stdout == f"3 frames on {TOPIC} are in {tmp_path}/bag\n"
    # Somebody else's reader finds the topics.
    with AnyReader([tmp_path / "bag"]) as reader:
        assert {name: about.msgcount for name, about in reader.topics.items()} == {
            TOPIC: 3,
            "/camera/camera_info": 3,
            "/camera/attitude": 3,
        }
    frames, problems = frames_of(tmp_path / "bag")
    assert problems == []
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.image, image(i + 1))
        assert frame.stamp_ns == START + 2 * i * SECOND + SECOND // 2  # middle of the exposure
        ((stamp_ns, attitude),) = frame.attitudes
        assert stamp_ns == frame.stamp_ns
        pixels = np.array([[0.0, 0], [63, 47], [10, 30]])
        assert frame.camera is not None
        ra, dec = to_radec(frame.camera.lines_of_sight(pixels), attitude)
        wanted = solution(i).pixel_to_world_values(*pixels.T)
        # To 0.1 mas: a double's rounding on the way.
        np.testing.assert_allclose(np.rad2deg([ra, dec]), wanted, atol=3e-8)


def test_the_bag_of_files_that_are_named_is_that_of_their_folder(tmp_path: Path):
    files = write_fits(tmp_path / "night")
    succeeds("import", tmp_path / "night", "-o", tmp_path / "folder")
    succeeds("import", *reversed(files), "-o", tmp_path / "named")
    expected, _ = frames_of(tmp_path / "folder")
    found, problems = frames_of(tmp_path / "named")
    assert problems == []
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in expected]
    for frame, wanted in zip(found, expected, strict=True):
        assert np.array_equal(frame.image, wanted.image)


def test_pictures_get_the_times_that_are_given(tmp_path: Path):
    (tmp_path / "frames").mkdir()
    for i in range(12):
        cv2.imwrite(f"{tmp_path}/frames/frame{i}.png", image(i, "uint8"))
    assert "--fps" in fails(1, "import", tmp_path / "frames", "-o", tmp_path / "bag")
    assert not (tmp_path / "bag").exists()
    options = ("--fps", 4, "--compressed", "--storage", "sqlite3")
    done = succeeds("import", tmp_path / "frames", "-o", tmp_path / "bag", *options)
    assert f"12 frames on {TOPIC}/compressed" in done.stdout
    assert next((tmp_path / "bag").glob("*.db3"))
    frames, _ = frames_of(tmp_path / "bag")
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.image, image(i, "uint8"))
    assert set(np.diff([frame.stamp_ns for frame in frames])) == {SECOND // 4}


def test_several_pictures_are_one_recording_that_starts_when_it_is_told(tmp_path: Path):
    for i in range(11):
        cv2.imwrite(f"{tmp_path}/frame{i}.png", image(i, "uint8"))
    names = sorted(tmp_path.glob("*.png"))
    times = ("--fps", 4, "--exposure", 0.1, "--start", "2026-01-01T01:00:00+01:00")
    succeeds("import", *names, "-o", tmp_path / "bag", *times)
    frames, _ = frames_of(tmp_path / "bag")
    # The middle of the exposures; frame 2 comes before frame 10.
    wanted = [START + SECOND // 20 + i * SECOND // 4 for i in range(11)]
    assert [frame.stamp_ns for frame in frames] == wanted
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.image, image(i, "uint8"))


def test_copies_are_left_out_and_said(tmp_path: Path):
    files = write_fits(tmp_path / "night", 3)
    copy = tmp_path / "night" / "light_0 (1).fits"
    copy.write_bytes(files[0].read_bytes())
    done = succeeds("import", *files, copy, files[1], "-o", tmp_path / "bag")
    assert done.stdout == f"3 frames on {TOPIC} are in {tmp_path}/bag\n"
    assert "note: left out, as copies of other files: light_0 (1).fits" in done.stderr


def test_several_bags_of_a_night_are_one(tmp_path: Path):
    for name, first in (("a", 3), ("b", 0)):  # against the order of names
        with BagWriter(tmp_path / name) as bag:
            for i in range(first, first + 3):
                bag.write_image(TOPIC, image(i), START + i * SECOND, "optical")
    done = succeeds("import", tmp_path / "a", tmp_path / "b", "-o", tmp_path / "bag")
    assert done.stdout.startswith("6 frames on")
    frames, _ = frames_of(tmp_path / "bag")
    assert [frame.stamp_ns for frame in frames] == [START + i * SECOND for i in range(6)]
    write_fits(tmp_path / "night")
    said = fails(1, "import", tmp_path / "a", tmp_path / "night", "-o", tmp_path / "more")
    assert "are of several kinds, " in said
    assert f"{tmp_path}/a (bag) and {tmp_path}/night (FITS)" in said


def test_a_bag_of_files_gives_the_detections_of_the_files(tmp_path: Path):
    succeeds("simulate", "-o", tmp_path / "sky", "--frames", 10, "--size", 160, 120)
    frames, _ = frames_of(tmp_path / "sky")
    (tmp_path / "night").mkdir()
    for frame in frames:
        middle = np.datetime64(frame.stamp_ns, "ns")
        header = solution(frame.number).to_header()
        header["DATE-OBS"], header["EXPTIME"] = f"{middle - np.timedelta64(250, 'ms')}", 0.5
        fits.writeto(tmp_path / "night" / f"{frame.number}.fits", frame.image, header)
    files = (tmp_path / "night").glob("*.fits")
    succeeds("import", *files, "-o", tmp_path / "bag")
    results = []
    for name in ("night", "bag"):
        output = tmp_path / f"{name}_results"
        succeeds("process", tmp_path / name, "-o", output)
        results.append(np.genfromtxt(output / "detections.csv", delimiter=",", skip_header=1))
    assert len(results[0]) > 5
    # The stages add up in an order of their own: not to the last digit of nine.
    np.testing.assert_allclose(*results, rtol=1e-5, atol=1e-6)


def test_a_bag_gives_the_same_bag_with_its_directions(tmp_path: Path):
    succeeds("simulate", "-o", tmp_path / "sky", "--frames", 3, "--size", 64, 48)
    succeeds("import", tmp_path / "sky", "-o", tmp_path / "bag")
    expected, _ = frames_of(tmp_path / "sky")
    found, problems = frames_of(tmp_path / "bag")
    assert problems == []
    for frame, wanted in zip(found, expected, strict=True):
        assert np.array_equal(frame.image, wanted.image)
        assert (frame.stamp_ns, frame.number) == (wanted.stamp_ns, wanted.number)
        assert frame.camera is not None
        assert wanted.camera is not None
        assert np.array_equal(frame.camera.matrix, wanted.camera.matrix)
        ((stamp_ns, attitude),) = frame.attitudes
        ((wanted_ns, wanted_attitude),) = wanted.attitudes
        assert stamp_ns == wanted_ns
        assert (attitude * wanted_attitude.inv()).magnitude() == pytest.approx(0, abs=1e-15)


def test_what_cannot_be_read_among_others_is_left_out_and_said(tmp_path: Path):
    files = write_fits(tmp_path / "night")
    files[1].write_bytes(b"no FITS at all")
    done = succeeds("import", *files, "-o", tmp_path / "bag")
    assert done.stdout == (
        f"2 frames (1 more could not be read) on {TOPIC} are in {tmp_path}/bag\n"
    )
    assert "light_1.fits" in done.stderr


def test_a_frame_that_cannot_be_read_is_counted(tmp_path: Path):
    files = write_fits(tmp_path / "night")
    files[1].write_bytes(files[1].read_bytes()[:3000])
    done = succeeds("import", tmp_path / "night", "-o", tmp_path / "bag")
    assert done.stdout.startswith("2 frames (1 more could not be read) on")
    assert "light_1.fits" in done.stderr


def test_nothing_is_made_of_nothing(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    fails(1, "import", tmp_path / "empty", "-o", tmp_path / "bag")
    fails(1, "import", tmp_path / "absent", tmp_path / "empty", "-o", tmp_path / "bag")
    assert "Missing argument 'INPUT...'" in fails(2, "import", "-o", tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_floats_are_no_png(tmp_path: Path):
    write_fits(tmp_path / "night", dtype="float32")
    said = fails(1, "import", tmp_path / "night", "-o", tmp_path / "bag", "--compressed")
    assert said.endswith("leave out --compressed")
    assert not (tmp_path / "bag").exists()
    succeeds("import", tmp_path / "night", "-o", tmp_path / "bag")
    frames, _ = frames_of(tmp_path / "bag")
    assert np.array_equal(frames[1].image, image(2, "float32"))


def test_a_bag_is_replaced_only_with_force_and_never_while_it_is_read(tmp_path: Path):
    write_fits(tmp_path / "night")
    command = ("import", tmp_path / "night", "-o", tmp_path / "bag")
    succeeds(*command)
    assert "exists" in fails(1, *command)
    succeeds(*command, "--force")
    again = ("import", tmp_path / "bag", "-o", tmp_path / "bag", "--force")
    assert "is read, so it cannot be the output" in fails(1, *again)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    assert "is read" in fails(1, "import", file, "-o", tmp_path / "bag", "--force")
    assert len(frames_of(tmp_path / "bag")[0]) == 3


def test_ctrl_c_leaves_a_whole_bag(tmp_path: Path):
    # Of images that come to more than is read while the signal is on its way.
    pixels = np.zeros((1024, 1024), np.uint16)
    with BagWriter(tmp_path / "long", storage="sqlite3") as bag:
        for i in range(150):
            bag.write_image(TOPIC, pixels + i, START + i * SECOND, "optical", compressed=True)
    output = tmp_path / "bag"
    program = subprocess_ofsat("import", tmp_path / "long", "-o", output)
    deadline = time.monotonic() + 60
    made = tmp_path / "bag.unfinished" / "bag"
    while sum(file.stat().st_size for file in made.glob("*.mcap")) < 3 * pixels.nbytes:
        assert program.poll() is None, program.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)
    program.send_signal(signal.SIGINT)
    out, err = program.communicate(timeout=60)
    assert program.returncode == 130, err
    assert (out, "Traceback" in err) == ("", False)
    said = re.search(r"stopped; (\d+) frames are in", err)
    assert said is not None
    frames, problems = frames_of(output)
    assert problems == []
    # The signal may come between a frame's writing and its count.
    assert len(frames) - int(said[1]) in (0, 1)
    assert 3 <= len(frames) < 150
    assert np.array_equal(frames[2].image, pixels + 2)
