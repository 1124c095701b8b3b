# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The player over real DDS: what the bag holds arrives whole, in order, when it should."""

import re
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from ros_graph import START_S, Graph, Process, sky, stamps, write_bag
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from ofsat_ros.camera import Camera
from ofsat_ros.images import decode_message
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.player import Player
from ofsat_ros.recordings import BagWriter

FRAMES = sky(12)  # one every 0.5 s
TIMES = [frame.stamp_ns for frame in FRAMES]


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / "bag", FRAMES)


@pytest.fixture
def stop():
    return threading.Event()


def test_waits_for_a_subscriber_and_loses_nothing(bag, tmp_path):
    with Process(tmp_path, "player", f"{bag}", "--ros-args", "-p", "rate:=0") as player:
        player.wait_for("waiting for 1 subscriber(s) to /camera/image")
        with Graph() as graph:
            heard = graph.listen(Image, "/camera/image")
            graph.until(lambda: len(heard) == len(FRAMES))
            graph.serve(0.2)
        assert player.wait() == 0
        assert "played 12 frames" in player.err
    assert stamps(heard) == TIMES
    assert {message.header.frame_id for message in heard} == {"camera_optical_frame"}
    np.testing.assert_array_equal(decode_message(heard[7]), FRAMES[7].image)


def test_a_best_effort_subscriber_gets_first_and_last_frame(bag, stop):
    with Graph("-p", "rate:=20.0") as graph:
        graph.add(Player(stop, f"{bag}", context=graph.context))
        heard = graph.listen(Image, "/camera/image", best_effort=True)
        graph.until(stop.is_set)
        graph.serve(0.2)
    assert (stamps(heard)[0], stamps(heard)[-1]) == (TIMES[0], TIMES[-1])


def test_rate_start_and_clock(bag, stop):
    arguments = ("-p", "rate:=5.0", "-p", "start_s:=2.0", "-p", f"bag:={bag}")
    with Graph(*arguments) as graph:
        clocks = graph.listen(Clock, "/clock")
        heard = graph.listen(Image, "/camera/image")
        graph.add(Player(stop, context=graph.context))
        graph.until(lambda: heard)
        begun_s = time.monotonic()
        graph.until(stop.is_set)
        graph.until(lambda: len(heard) == 8)
        took_s = time.monotonic() - begun_s
    assert stamps(heard) == TIMES[4:]
    # Seven intervals of 0.5 s at five times the speed; never faster, not much slower.
    assert 0.65 < took_s < 1.5
    times = [messages.stamp_ns(clock.clock) for clock in clocks]
    assert times == sorted(times)
    assert set(TIMES[5:]) <= set(times)
    assert len(times) > 2 * len(heard)  # it runs on between the frames


def test_rate_may_change_while_playing(bag, stop, capfd):
    with Graph("-p", "rate:=0.01") as graph:
        heard = graph.listen(Image, "/camera/image")
        graph.add(Player(stop, f"{bag}", context=graph.context))
        graph.until(lambda: heard)
        faster = Parameter(name="rate", value=ParameterValue(type=2, integer_value=100))
        request = SetParametersAtomically.Request(parameters=[faster])
        service = "player/set_parameters_atomically"
        assert graph.call(SetParametersAtomically, service, request).result.successful
        graph.until(stop.is_set)
        graph.until(lambda: len(heard) == len(FRAMES))
    # Who waits is told for how long, and what to do.
    pause = r"the recording pauses: its next message is due in \d\d s; .* rate 100"
    assert re.search(pause, capfd.readouterr().err)


def test_loop_goes_on_until_told_otherwise(bag, stop):
    with Graph("-p", "rate:=0", "-p", "loop:=true") as graph:
        heard = graph.listen(Image, "/camera/image")
        graph.add(Player(stop, f"{bag}", context=graph.context))
        graph.until(lambda: len(heard) > 2 * len(FRAMES))
        once = Parameter(name="loop", value=ParameterValue(type=1, bool_value=False))
        request = SetParametersAtomically.Request(parameters=[once])
        graph.call(SetParametersAtomically, "player/set_parameters_atomically", request)
        graph.until(stop.is_set)
        graph.serve(0.2)
    assert len(heard) % len(FRAMES) == 0
    assert stamps(heard) == TIMES * (len(heard) // len(FRAMES))


def test_topic_is_chosen_and_compressed_images_go_out_as_they_are(tmp_path, stop):
    with BagWriter(tmp_path / "two") as writer:
        for frame in FRAMES[:4]:
            writer.write_image("/left", frame.image, frame.stamp_ns, "left")
            writer.write_image(
                "/right/compressed", frame.image, frame.stamp_ns, "right", compressed=True
            )
    with Graph("-p", "rate:=0", "-p", "topic:=/right/compressed") as graph:
        left = graph.listen(Image, "/left")
        right = graph.listen(CompressedImage, "/right/compressed")
        graph.add(Player(stop, f"{tmp_path / 'two'}", context=graph.context))
        graph.until(lambda: len(right) == 4)
        graph.until(stop.is_set)
    assert left == []
    np.testing.assert_array_equal(decode_message(right[3]), FRAMES[3].image)


def test_calibration_and_attitude_go_out_in_the_recorded_order(tmp_path, stop):
    camera = Camera.ideal(16, 16, 1e-4)
    with BagWriter(tmp_path / "bag") as writer:
        for number in range(3):
            at_ns = TIMES[number]
            writer.write_camera_info("/cam/camera_info", camera, at_ns, "cam")
            writer.write_attitude("/mount/attitude", Rotation.identity(), at_ns + 1, "cam")
            writer.write_image("/cam/image", np.zeros((16, 16), np.uint8), at_ns + 2, "cam")
    order = []
    with Graph("-p", "rate:=20.0") as graph:
        graph.add(Player(stop, f"{tmp_path / 'bag'}", context=graph.context))
        infos = graph.listen(CameraInfo, "/cam/camera_info")
        attitudes = graph.listen(QuaternionStamped, "/mount/attitude")
        images = graph.listen(Image, "/cam/image")
        graph.until(lambda: len(infos) == len(attitudes) == len(images) == 3)
    for number in range(3):
        order += [stamps(one)[number] for one in (infos, attitudes, images)]
    assert order == [at_ns + i for at_ns in TIMES[:3] for i in range(3)]
    np.testing.assert_array_equal(infos[0].k, camera.matrix.ravel())
    assert attitudes[0].quaternion.w == 1.0


def test_a_later_start_begins_with_the_calibration_that_holds(tmp_path, stop):
    with BagWriter(tmp_path / "bag") as writer:
        for scale, at_ns in ((1e-4, TIMES[0]), (2e-4, TIMES[1])):
            camera = Camera.ideal(16, 16, scale)
            writer.write_camera_info("/cam/camera_info", camera, at_ns, "cam")
        for at_ns in TIMES[:6]:
            writer.write_image("/cam/image", np.zeros((16, 16), np.uint8), at_ns, "cam")
    with Graph("-p", "rate:=20.0", "-p", "start_s:=1.1") as graph:
        graph.add(Player(stop, f"{tmp_path / 'bag'}", context=graph.context))
        infos = graph.listen(CameraInfo, "/cam/camera_info")
        images = graph.listen(Image, "/cam/image")
        graph.until(lambda: len(images) == 3 and infos)
    assert [info.k[0] for info in infos] == [pytest.approx(5000)]


def test_replay_waits_for_the_answers_of_a_detector(bag, stop):
    with Graph("-p", "rate:=0") as graph:
        answers = graph.publisher(PointCloud2, "rso_detections")
        heard = graph.listen(Image, "/camera/image")
        graph.add(Player(stop, f"{bag}", context=graph.context))
        graph.connect(answers)
        graph.until(lambda: len(heard) == 4)
        graph.serve(0.3)
        assert len(heard) == 4  # no more are on their way
        for answered in range(1, len(FRAMES) + 1):
            assert not stop.is_set()
            to = heard[answered - 1].header
            answers.publish(messages.cloud_message(to, messages.cloud_rows(0)))
            wanted = min(answered + 4, len(FRAMES))
            graph.until(lambda wanted=wanted: len(heard) == wanted)
        graph.until(stop.is_set)
    assert stamps(heard) == TIMES


def test_a_slow_detector_is_waited_for_while_it_answers(bag, stop, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("ofsat_ros.nodes.player.time", SimpleNamespace(monotonic=lambda: now[0]))
    with Graph("-p", "rate:=0") as graph:
        answers = graph.publisher(PointCloud2, "rso_detections")
        heard = graph.listen(Image, "/camera/image")
        player = graph.add(Player(stop, f"{bag}", context=graph.context))
        graph.connect(answers)
        graph.until(lambda: len(heard) == 4)
        for answered in range(1, len(FRAMES)):
            now[0] += 20  # s for a frame; several are waited for
            graph.serve(0.05)
            assert not stop.is_set(), f"gave up before answer {answered}"
            to = heard[answered - 1].header
            answers.publish(messages.cloud_message(to, messages.cloud_rows(0)))
            wanted = min(answered + 4, len(FRAMES))
            graph.until(lambda wanted=wanted: len(heard) == wanted)
            graph.until(lambda: player._answered_s == now[0])
        graph.serve(0.05)
        assert not stop.is_set()
        now[0] += 31  # the last answer never comes
        graph.until(stop.is_set)
    assert stamps(heard) == TIMES


def test_a_truncated_message_is_skipped_and_said_once(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for frame in FRAMES[:4]:
            writer.write_image("/image", frame.image, frame.stamp_ns, "left")
            cut = b"\0\1\0\0\1\2"
            writer.write("/image", "sensor_msgs/msg/Image", cut, frame.stamp_ns + 1)
            # The middleware would ask for it again and again, and the player wait for ever.
            attitude = "geometry_msgs/msg/QuaternionStamped"
            writer.write("/attitude", attitude, b"", frame.stamp_ns + 2)
    arguments = (f"{tmp_path / 'bag'}", "--ros-args", "-p", "rate:=0")
    with Process(tmp_path, "player", *arguments) as player, Graph() as graph:
        heard = graph.listen(Image, "/image")
        graph.listen(QuaternionStamped, "/attitude")
        graph.until(lambda: len(heard) == 4)
        assert player.wait() == 0
    assert stamps(heard) == TIMES[:4]
    assert player.err.count("is skipped: it has 6 bytes") == 1
    assert "played 4 frames" in player.err
    assert "8 truncated ones skipped" in player.err


def test_a_recorded_topic_that_is_no_name_is_one_line_that_no_terminal_obeys(tmp_path):
    bag = write_bag(tmp_path / "bag", FRAMES[:2], "/camera\x1b[2J/image")
    with Process(tmp_path, "player", f"{bag}") as player:
        assert player.wait(START_S) == 2
    (said,) = player.err.splitlines()
    assert "player: Invalid topic name" in said
    assert r"/camera\x1b[2J/image" in said


def test_a_torn_bag_plays_what_is_whole_and_says_so(bag, tmp_path):
    (bag / "metadata.yaml").unlink()
    (file,) = bag.iterdir()
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with Process(tmp_path, "player", f"{file}", "--ros-args", "-p", "rate:=0") as player:
        player.wait_for("waiting for 1 subscriber(s) to /camera/image")
        with Graph() as graph:
            heard = graph.listen(Image, "/camera/image")
            assert player.wait() == 0
            graph.serve(0.2)
    assert f"{file.name} is not whole" in player.err.partition("waiting for")[0]
    assert 0 < len(heard) < len(FRAMES)
    assert stamps(heard) == TIMES[: len(heard)]


def test_an_error_while_playing_is_no_success(bag, stop, monkeypatch):
    def broken(self, *given):
        raise OverflowError("of whatever")

    monkeypatch.setattr(Player, "_publish_clock", broken)
    with Graph("-p", "wait_for_subscribers:=0") as graph:
        player = graph.add(Player(stop, f"{bag}", context=graph.context))
        graph.until(stop.is_set)
        assert player.exit_code == 1


def test_starting_beyond_the_end_is_an_error(bag, tmp_path):
    arguments = (f"{bag}", "--ros-args", "-p", "start_s:=100", "-p", "wait_for_subscribers:=0")
    with Process(tmp_path, "player", *arguments) as player:
        assert player.wait() == 1
        assert "holds no image after start_s = 100 s" in player.err


def test_large_images_reach_another_process_none_lost(tmp_path):
    # 4096 x 4096 px of 16 bit, more frames than the detector's subscription holds.  What is
    # tested is the transport: nothing is above the threshold, which is quickly found out.
    count, start_ns = 12, 1_767_225_600_000_000_000
    random = np.random.default_rng(1)
    pixels = random.normal(1000, 10, (4096, 4096)).astype(np.uint16)
    with BagWriter(tmp_path / "large") as writer:
        for number in range(count):
            writer.write_image("/image", pixels, start_ns + number * 10**9, f"frame{number}")
    settings = {
        "reliable_input": "true",
        "queue_depth": "3",
        "preset": "paper_opencv",
        "flow_targets": "objects",
        "threshold_sigmas": "100.0",
    }
    given = [f"{name}:={value}" for name, value in settings.items()]
    detector_arguments = [word for one in given for word in ("-p", one)]
    # Without the tests' own setting: the nodes are to find the profile for large images.
    unset = {"FASTRTPS_DEFAULT_PROFILES_FILE": ""}
    with (
        Graph() as graph,
        Process(tmp_path, "detector", "--ros-args", *detector_arguments, **unset) as detector,
    ):
        clouds = graph.listen(PointCloud2, "rso_detections")
        status = graph.listen(DiagnosticArray, "/diagnostics")
        graph.until(lambda: status)
        arguments = (f"{tmp_path / 'large'}", "--ros-args", "-p", "rate:=0")
        with Process(tmp_path, "player", *arguments, **unset) as player:
            graph.until(lambda: len(clouds) == count, patience_s=60)
            assert player.wait() == 0
        graph.until(lambda: _value(status[-1], "frames_processed") == str(count))
        assert detector.popen.poll() is None
    assert stamps(clouds) == [start_ns + number * 10**9 for number in range(count)]
    assert [c.header.frame_id for c in clouds] == [f"frame{number}" for number in range(count)]
    assert _value(status[-1], "frames_lost") == "0"


def _value(array: DiagnosticArray, key: str) -> str:
    return {pair.key: pair.value for pair in array.status[0].values}[key]
