# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat info``: what it says of recordings, and of what is none."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from command import fails, ofsat, succeeds
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.cli import survey
from ofsat_ros.recordings import IMAGE, BagWriter, Frame
from ofsat_ros.recordings.salvage.mcap import McapWreck

TOPIC = "/camera/image_raw"
START = 1_767_225_600_000_000_000  # 2026-01-01
SECOND = 1_000_000_000
# Of the optical axis, right ascension 30 and declination 20 deg: z is the axis, y is south.
POINTING = Rotation.from_euler("ZY", [30, 90 - 20], degrees=True).inv()


def image(value: int = 100, dtype: str = "uint16", shape: tuple[int, int] = (48, 64)):
    pixels = np.random.default_rng(value).normal(value, 5, shape).clip(0)
    pixels[0, 0], pixels[1, 1] = 0, 1000 if dtype != "uint8" else 250
    return pixels.astype(dtype)


def write(path: Path, seconds: list[float], topics: tuple[str, ...] = (TOPIC,), **options) -> Path:
    with BagWriter(path) as bag:
        for topic in topics:
            for second in seconds:
                stamp_ns = START + round(second * SECOND)
                compressed = topic.endswith("/compressed")
                bag.write_image(
                    topic, image(**options), stamp_ns, "optical", compressed=compressed
                )
    return path


def told(*arguments: object, code: int = 0) -> dict:
    done = ofsat("info", *arguments, "--json")
    assert done.exit_code == code, done.output
    assert done.stderr == ""
    return json.loads(done.stdout)


def line(text: str, name: str) -> str:
    (found,) = re.findall(rf"^  {name} +(.*)$", text, re.M)
    return found


def test_a_bag_is_told_in_words(tmp_path: Path):
    matrix = np.array([[41253.0, 0, 32], [0, 41253.0, 24], [0, 0, 1]])
    camera = Camera(64, 48, matrix, np.zeros(5), "plumb_bob")
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(4):
            stamp_ns = START + i * 2 * SECOND
            bag.write_camera_info("/camera/camera_info", camera, stamp_ns, "optical")
            bag.write_attitude("/camera/attitude", POINTING, stamp_ns, "optical")
            bag.write_image(TOPIC, image(), stamp_ns, "optical")
    text = succeeds("info", tmp_path / "bag").stdout
    assert text.splitlines()[0] == f"{tmp_path}/bag: rosbag2"
    assert re.search(r"^  /camera/camera_info +4  sensor_msgs/msg/CameraInfo$", text, re.M)
    assert re.search(rf"^  {TOPIC} +4  sensor_msgs/msg/Image$", text, re.M)
    assert line(text, "frames") == "4"
    assert line(text, "size") == "64x48 px"
    assert line(text, "pixels") == "mono16: uint16, values 0 to 1000 (10 bits)"
    assert line(text, "from") == "2026-01-01T00:00:00.000Z"
    assert line(text, "to") == "2026-01-01T00:00:06.000Z, 6 s later"
    assert line(text, "rate") == "one every 2 s"
    assert line(text, "gaps") == "none"
    # 41253 px of focal length are 5 arcsec per px; 64 of them 0.0889 deg.
    assert line(text, "directions") == (
        "5 arcsec per px, a field of 0.0889 x 0.0667 deg; ra 30.0000 dec +20.0000 deg at first"
    )
    verdict = f"It can be processed: ofsat process {tmp_path}/bag -o results"
    assert text.splitlines()[-1] == verdict


def test_the_command_that_is_told_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write(tmp_path / "a bag", [0, 1, 2])
    command = told(path)["images"][0]["command"]
    monkeypatch.chdir(tmp_path)
    succeeds(*shlex.split(command)[1:])
    assert (tmp_path / "results" / "star_field.csv").exists()


def test_json_holds_what_the_words_say(tmp_path: Path):
    path = write(tmp_path / "bag", [0, 0.04, 0.08, 0.12], dtype="float32")
    about = told(path)
    assert about["processable"] is True
    assert about["topics"] == {TOPIC: {"type": IMAGE, "messages": 4}}
    (images,) = about["images"]
    assert (images["frames"], images["skipped"], images["sizes"]) == (4, 0, [[64, 48, 4]])
    assert (images["encoding"], images["pixels"]) == ("32FC1", ["float32"])
    assert (images["lowest"], images["highest"]) == (0, 1000)
    assert (images["first_stamp_ns"], images["last_stamp_ns"]) == (START, START + 120_000_000)
    assert images["interval_s"] == pytest.approx(0.04)
    assert (images["camera"], images["first_boresight_deg"]) == (None, None)
    text = succeeds("info", path).stdout
    assert line(text, "rate") == "25 per second"
    assert line(text, "pixels") == "32FC1: float32, values 0 to 1000"
    assert line(text, "directions") == "no calibration; no attitude"


def test_gaps_are_counted_and_the_longest_is_named(tmp_path: Path):
    # Two missing after frame 2, four after frame 4; a jitter of 30 % is no gap.
    path = write(tmp_path / "bag", [0, 1, 2, 5, 6, 11, 12.3, 13])
    gaps = told(path)["images"][0]["gaps"]
    assert (gaps["count"], gaps["missing_frames"]) == (2, 6)
    assert gaps["longest"] == [
        {"after_frame": 4, "seconds": 5.0},
        {"after_frame": 2, "seconds": 3.0},
    ]
    words = line(succeeds("info", path).stdout, "gaps")
    assert words == "2, of some 6 frames; the longest 5 s after frame 4"


def test_time_that_goes_back_is_told(tmp_path: Path):
    with BagWriter(tmp_path / "bag") as bag:
        for i, second in enumerate([0, 1, 2, 2, 1.5, 3]):
            # Received in order, with stamps that are not.
            header = write_stamped(image(), START + round(second * SECOND))
            bag.write(TOPIC, IMAGE, header, START + i * SECOND)
    images = told(tmp_path / "bag")["images"][0]
    assert (images["frames_back_in_time"], images["first_back_in_time"]) == (2, 3)
    words = line(succeeds("info", tmp_path / "bag").stdout, "disorder")
    assert words == "2 frames are no later than the one before, frame 3 first"


def write_stamped(pixels: np.ndarray, stamp_ns: int) -> bytes:
    """A serialized Image with a stamp of its own."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, SECOND))
    message = types[IMAGE](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="optical"),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding="mono16",
        is_bigendian=0,
        step=pixels.shape[1] * 2,
        data=pixels.reshape(-1).view(np.uint8),
    )
    return bytes(store.serialize_cdr(message, IMAGE))


def test_each_image_topic_is_told_and_one_can_be_chosen(tmp_path: Path):
    topics = ("/left/image/compressed", "/right/image")
    path = write(tmp_path / "bag", [0, 1, 2], topics)
    about = told(path)
    assert [images["topic"] for images in about["images"]] == list(topics)
    assert about["images"][0]["encoding"] == "mono16; png compressed"
    assert [shlex.split(images["command"])[-1] for images in about["images"]] == list(topics)
    text = succeeds("info", path).stdout
    assert text.count("can be processed: ") == 2
    (images,) = told(path, "--topic", "right/image")["images"]
    assert images["topic"] == "/right/image"
    assert shlex.split(images["command"])[-2:] == ["--topic", "/right/image"]


def test_fits_files_are_told(tmp_path: Path):
    for i in range(3):
        header = fits.Header()
        header["DATE-OBS"], header["EXPTIME"] = f"2026-01-01T00:00:{10 + 3 * i}", 2.0
        fits.writeto(tmp_path / f"light_{i}.fits", image(), header)
    about = told(tmp_path)
    assert (about["kind"], about["topics"], about["processable"]) == ("FITS", {}, True)
    (images,) = about["images"]
    assert (images["topic"], images["encoding"]) == ("", "")
    assert (images["exposures_s"], images["interval_s"]) == ([2.0], 3.0)
    assert images["first_utc"] == "2026-01-01T00:00:11.000Z"
    assert line(succeeds("info", tmp_path).stdout, "exposure") == "2 s"


def test_what_is_given_goes_into_the_command(tmp_path: Path):
    for i in range(3):
        fits.writeto(tmp_path / f"light_{i}.fits", image())
    assert "--fps" in fails(1, "info", tmp_path)
    images = told(tmp_path, "--fps", 4, "--exposure", 0.2)["images"][0]
    assert shlex.split(images["command"])[5:] == ["--fps", "4.0", "--exposure", "0.2"]
    assert (images["interval_s"], images["exposures_s"]) == (0.25, [0.2])


def test_several_files_are_told_as_one_recording(tmp_path: Path):
    for i in range(5):
        fits.writeto(tmp_path / f"light_{i}.fits", image())
    files = sorted(tmp_path.glob("*.fits"))
    options = ("--fps", 4, "--start", "2026-01-01T00:00Z")
    about = told(*files[:3], *options)
    assert about["path"] == [f"{file}" for file in files[:3]]
    (images,) = about["images"]
    assert (images["frames"], images["first_stamp_ns"]) == (3, START)
    command = shlex.split(images["command"])
    assert command[2:5] == about["path"]
    assert command[-4:] == ["--fps", "4.0", "--start", "2026-01-01T00:00:00Z"]
    # Hundreds of names are not repeated.
    text = succeeds("info", *files, *options).stdout
    assert text.splitlines()[0] == f"{files[0]} and 4 more: FITS"
    verdict = "It can be processed: ofsat process, with the same names and options"
    assert text.splitlines()[-1] == verdict
    assert "'soon' is no date and time: give it as" in fails(2, "info", *files, "--start", "soon")


def test_a_bag_is_opened_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # A torn one is looked through at each opening.
    path = write(tmp_path / "bag", [0, 1, 2])
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-200])
    scans, scan = [], McapWreck.scan
    monkeypatch.setattr(McapWreck, "scan", lambda wreck: (scans.append(wreck), scan(wreck)))
    assert told(path)["topics"][TOPIC]["messages"] == 3
    assert len(scans) == 1


# What cannot be processed


@pytest.mark.parametrize(
    ("seconds", "options", "reason"),
    [
        ([0, 1, 2], {"shape": (8, 64)}, r"an image of shape \(8, 64\) cannot be processed"),
        ([0, 1], {}, "an RSO is confirmed in 3 frames, and there are 2"),
        ([1, 1, 1], {}, "no frame is later than the one before"),
    ],
)
def test_images_that_cannot_be_processed(
    seconds: list, options: dict, reason: str, tmp_path: Path
):
    path = write(tmp_path / "bag", seconds, **options)
    about = told(path, code=1)
    assert about["processable"] is False
    assert re.match(reason, about["images"][0]["hindrance"])
    done = ofsat("info", path)
    assert done.exit_code == 1
    assert re.match(f"It cannot be processed: {reason}", done.stdout.splitlines()[-1])


def test_a_bag_without_images_is_told_with_its_topics(tmp_path: Path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_attitude("/mount/attitude", POINTING, START, "optical")
    done = ofsat("info", tmp_path / "bag")
    assert done.exit_code == 1
    assert re.search(r"^  /mount/attitude +1  geometry_msgs/msg/Quaternion", done.stdout, re.M)
    assert "It cannot be processed: " in done.stdout.splitlines()[-1]
    assert "holds no images" in done.stdout.splitlines()[-1]


def test_damaged_frames_are_counted(tmp_path: Path):
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(5):
            bag.write_image(TOPIC, image(), START + i * SECOND, "optical")
        bag.write(TOPIC, IMAGE, b"\0\1\0\0" + b"\7" * 60, START + 9 * SECOND)
    text = succeeds("info", tmp_path / "bag").stdout
    assert line(text, "frames") == "5, 1 more could not be read"
    assert "frame 5 of /camera/image_raw skipped: the message is damaged" in line(text, "note")


def test_a_calibration_for_another_size_is_of_no_use(tmp_path: Path):
    camera = Camera(640, 480, np.diag([4e4, 4e4, 1]), np.zeros(5), "plumb_bob")
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(3):
            bag.write_camera_info("/camera/camera_info", camera, START + i * SECOND, "optical")
            bag.write_image(TOPIC, image(), START + i * SECOND, "optical")
    words = line(succeeds("info", tmp_path / "bag").stdout, "directions")
    assert words == "a calibration for 640x480 px, so of no use; no attitude"


def test_what_is_not_there_is_an_error(tmp_path: Path):
    said = f"{tmp_path}/absent does not exist: check the path"
    assert fails(1, "info", tmp_path / "absent") == f"ofsat: {said}"
    about = told(tmp_path / "absent", code=1)
    assert (about["processable"], about["problem"]) == (False, said)


def test_ctrl_c_tells_what_was_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, look = write(tmp_path / "bag", [0, 1, 2, 3]), survey._row

    def stopped_at_the_third(frame: Frame) -> object:
        if frame.number == 2:
            raise KeyboardInterrupt
        return look(frame)

    monkeypatch.setattr(survey, "_row", stopped_at_the_third)
    done = ofsat("info", path)
    assert done.exit_code == 130
    assert line(done.stdout, "frames") == "2, then stopped"
