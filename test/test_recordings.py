# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Bags in and out: every storage and compression; test_bag_salvage.py has those that are torn."""

import threading

import numpy as np
import pytest
from recorded import (
    ENDING,
    FIRST_NS,
    FRAME_ID,
    JAZZY,
    NOETIC,
    STORAGES,
    TOPIC,
    assert_holds_three_images,
    compressed_message,
    header_of,
    image_message,
    scene,
    simple_bag,
    stamp_of,
    three_images,
    write_foreign,
)
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2 import Reader as Rosbag2Reader
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.images import encode_png
from ofsat_ros.recordings import (
    IMAGE,
    Bag,
    BagWriter,
    RecordingError,
    open_recording,
)


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        ("mcap", "none"),
        ("mcap", "message"),
        ("mcap", "file"),
        ("mcap", "chunk"),
        ("sqlite3", "none"),
        ("sqlite3", "message"),
        ("sqlite3", "file"),
    ],
)
def test_round_trip_in_every_storage_and_compression(tmp_path, storage, compression):
    path = simple_bag(tmp_path / "bag", storage=storage, compression=compression)
    assert_holds_three_images(path)


@pytest.mark.parametrize("compression", ["none", "message", "chunk"])
def test_compression_makes_the_bag_smaller(tmp_path, compression):
    with BagWriter(tmp_path / "bag", compression=compression) as bag:
        bag.write_image(TOPIC, np.zeros((500, 500), np.uint16), FIRST_NS, FRAME_ID)
    size = (tmp_path / "bag" / "bag.mcap").stat().st_size
    assert (size < 100_000) == (compression != "none")


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        ("mcap", CompressionMode.NONE),
        ("mcap", CompressionMode.MESSAGE),
        ("mcap", CompressionMode.FILE),
        ("mcap", CompressionMode.STORAGE),
        ("sqlite3", CompressionMode.NONE),
        ("sqlite3", CompressionMode.MESSAGE),
        ("sqlite3", CompressionMode.FILE),
    ],
)
def test_big_endian_padded_bags_of_another_writer_are_read(tmp_path, storage, mode):
    assert_holds_three_images(write_foreign(tmp_path / "bag", three_images(), storage, mode))


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bare_file_is_read(tmp_path, storage):
    folder = write_foreign(tmp_path / "bag", three_images(), storage)
    assert_holds_three_images(folder / f"bag{ENDING[storage]}")


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_a_ros1_bag_is_read(tmp_path, compression):
    path = tmp_path / "old.bag"
    writer = Rosbag1Writer(path)
    if compression != "none":
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    with writer:
        connection = writer.add_connection(TOPIC, IMAGE, typestore=NOETIC)
        for n in (1, 2, 3):
            message = image_message(scene(n), stamp_of(n), store=NOETIC, seq=n)
            writer.write(connection, stamp_of(n), NOETIC.serialize_ros1(message, IMAGE))
    assert_holds_three_images(path)
    # What the player publishes has to be ROS 2's.
    with Bag(path) as bag:
        _, msgtype, _, data = next(bag.messages([TOPIC]))
        message = JAZZY.deserialize_cdr(data, msgtype)
    assert message.header.frame_id == FRAME_ID
    assert message.header.stamp.nanosec == stamp_of(1) % 10**9
    assert message.encoding == "mono16"


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_png_images_make_the_round_trip(tmp_path, dtype):
    pixels = scene(7, dtype)
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image(TOPIC, pixels, FIRST_NS, FRAME_ID, compressed=True)
    with open_recording(tmp_path / "bag") as recording:
        (frame,) = recording
    np.testing.assert_array_equal(frame.image, pixels)
    assert frame.image.dtype == pixels.dtype
    assert (frame.stamp_ns, frame.frame_id) == (FIRST_NS, FRAME_ID)


def test_compressed_images_of_another_writer_are_read(tmp_path):
    message = compressed_message(encode_png(scene(3)), FIRST_NS)
    write_foreign(tmp_path / "bag", [(TOPIC, message, FIRST_NS)])
    with open_recording(tmp_path / "bag") as recording:
        (frame,) = recording
    np.testing.assert_array_equal(frame.image, scene(3))


@pytest.mark.parametrize(
    ("image", "encoding", "written"),
    [
        (scene(1, "u1"), None, "mono8"),
        (scene(1, "u2"), None, "mono16"),
        (scene(1, ">u2"), None, "mono16"),
        (scene(1, "f4") / 7, None, "32FC1"),
        (scene(1, "u2"), "16UC1", "16UC1"),
        (scene(1, "u1"), "bayer_rggb8", "bayer_rggb8"),
        (np.dstack([scene(1, "u1")] * 3), None, "bgr8"),
        (scene(1)[::2, ::3], None, "mono16"),
    ],
)
def test_an_image_is_written_under_the_encoding_that_holds_it(tmp_path, image, encoding, written):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image(TOPIC, image, FIRST_NS, FRAME_ID, encoding)
    # Read by the library alone.
    with Rosbag2Reader(tmp_path / "bag") as reader:
        ((connection, received_ns, data),) = reader.messages()
    message = JAZZY.deserialize_cdr(data, connection.msgtype)
    assert message.encoding == written
    assert (message.height, message.width) == image.shape[:2]
    assert received_ns == FIRST_NS
    little = image.astype(image.dtype.newbyteorder("<"))
    assert message.data.tobytes() == little.tobytes()
    assert message.step * message.height == message.data.size


def test_colour_becomes_luminance_when_read(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image(TOPIC, np.full((4, 5, 3), (0, 0, 200), np.uint8), FIRST_NS, FRAME_ID)
    with open_recording(tmp_path / "bag") as recording:
        (frame,) = recording
    np.testing.assert_array_equal(frame.image, np.full((4, 5), 60))  # 0.299 * 200 of red


def test_offered_quality_of_service_is_what_ros2_bag_play_can_use(tmp_path):
    simple_bag(tmp_path / "bag")
    with Rosbag2Reader(tmp_path / "bag") as reader:
        (quality,) = reader.connections[0].ext.offered_qos_profiles
    assert quality.reliability.name == "RELIABLE"
    assert quality.durability.name == "VOLATILE"
    assert (quality.history.name, quality.depth) == ("KEEP_LAST", 10)


def two_topics(path):
    messages = [*three_images("/left"), *three_images("/right")[:2]]
    info = JAZZY.types["std_msgs/msg/String"](data="no image")
    return write_foreign(path, [*messages, ("/chatter", info, FIRST_NS)])


def test_of_several_image_topics_one_has_to_be_chosen(tmp_path):
    path = two_topics(tmp_path / "bag")
    with pytest.raises(
        RecordingError, match=r"several .* choose one of /left \(3\), /right \(2\)"
    ):
        open_recording(path)
    assert_holds_three_images(path, "/left")
    assert_holds_three_images(path, "left")
    with open_recording(path, "/right") as recording:
        assert recording.topics == {"/left": 3, "/right": 2}
        assert recording.topic == "/right"
        assert [frame.stamp_ns for frame in recording] == [stamp_of(1), stamp_of(2)]


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("/up", r"topic /up is not there; image topics are /left \(3\), /right \(2\)"),
        ("/chatter", r"topic /chatter is std_msgs/msg/String; image topics are /left"),
    ],
)
def test_a_wrong_topic_is_answered_with_the_right_ones(tmp_path, topic, message):
    path = two_topics(tmp_path / "bag")
    with pytest.raises(RecordingError, match=message):
        open_recording(path, topic)


def test_an_empty_image_topic_does_not_stand_in_the_way(tmp_path):
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/empty", IMAGE, typestore=JAZZY)
        connection = writer.add_connection(TOPIC, IMAGE, typestore=JAZZY)
        for _, message, received_ns in three_images():
            writer.write(connection, received_ns, JAZZY.serialize_cdr(message, IMAGE))
    assert_holds_three_images(path)
    with pytest.raises(RecordingError, match=rf"topic /empty is empty; .* {TOPIC} \(3\)"):
        open_recording(path, "/empty")


def test_a_bag_without_images_says_what_it_holds(tmp_path):
    text = JAZZY.types["std_msgs/msg/String"](data="no image")
    path = write_foreign(tmp_path / "bag", [("/chatter", text, FIRST_NS)])
    with pytest.raises(RecordingError, match=r"no images; its topics are /chatter \(std_msgs/"):
        open_recording(path)


def test_a_bag_without_messages_says_so(tmp_path):
    with BagWriter(tmp_path / "bag"):
        pass
    with pytest.raises(RecordingError, match="holds no messages"):
        open_recording(tmp_path / "bag")


def test_a_path_that_is_no_bag_says_what_to_give(tmp_path):
    with pytest.raises(RecordingError, match="nowhere does not exist"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"is empty: there is nothing to read"):
        open_recording(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(RecordingError, match=r"give a rosbag2 folder, or a file that ends in"):
        open_recording(tmp_path / "notes.txt")


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
@pytest.mark.parametrize("content", [b"", b"not a bag at all" * 100])
def test_a_file_of_something_else_is_an_error(tmp_path, suffix, content):
    path = tmp_path / f"broken{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"cannot read .*: it does not begin as an? \w+"):
        open_recording(path)


def test_what_the_system_forbids_is_said(tmp_path, monkeypatch):
    folder = simple_bag(tmp_path / "bag")

    def forbidden(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.is_dir", forbidden)
    with pytest.raises(RecordingError, match=r"cannot read .*bag: Permission denied$"):
        open_recording(folder)


def test_metadata_that_promises_more_than_there_is_is_said(tmp_path):
    folder = simple_bag(tmp_path / "bag")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 3", "message_count: 5"))
    with open_recording(folder) as recording:
        assert len(list(recording)) == 3
        assert recording.skipped == 2
        assert "tells of 5 images" in recording.problems[0]


def test_a_bad_frame_in_the_middle_is_left_out_and_said(tmp_path):
    messages = three_images()
    messages[1][1].encoding = "yuv422"
    path = write_foreign(tmp_path / "bag", messages)
    with open_recording(path) as recording:
        for _ in range(2):  # a second look starts its account over
            assert [frame.stamp_ns for frame in recording] == [stamp_of(1), stamp_of(3)]
            assert recording.skipped == 1
            assert len(recording.problems) == 1
            assert f"frame 1 of {TOPIC} skipped: unknown encoding" in recording.problems[0]
            assert recording.torn == ""


@pytest.mark.parametrize("damaged", [b"", b"\0\1", b"\0\1\0\0" + b"\xff" * 40, b"\7" * 900])
def test_bytes_that_are_no_message_are_skipped(tmp_path, damaged):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image(TOPIC, scene(1), stamp_of(1), FRAME_ID)
        bag.write(TOPIC, IMAGE, damaged, stamp_of(2))
        bag.write_image(TOPIC, scene(3), stamp_of(3), FRAME_ID)
    with open_recording(tmp_path / "bag") as recording:
        assert [frame.stamp_ns for frame in recording] == [stamp_of(1), stamp_of(3)]
        assert recording.skipped == 1
        assert "frame 1" in recording.problems[0]
        assert "the message is damaged" in recording.problems[0]


def test_an_undecodable_png_is_skipped(tmp_path):
    good = encode_png(scene(1))
    messages = [
        (TOPIC, compressed_message(data, stamp_of(n)), stamp_of(n))
        for n, data in enumerate([good, b"GIF89a", good])
    ]
    path = write_foreign(tmp_path / "bag", messages)
    with open_recording(path) as recording:
        assert [frame.stamp_ns for frame in recording] == [stamp_of(0), stamp_of(2)]
        assert "neither PNG nor JPEG" in recording.problems[0]


def test_problems_are_bounded_but_all_are_counted(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for number in range(50):
            bag.write(TOPIC, IMAGE, b"nonsense", stamp_of(number))
    with open_recording(tmp_path / "bag") as recording:
        assert list(recording) == []
        assert recording.skipped == 50
        assert len(recording.problems) == 10


def test_time_received_stands_in_for_missing_stamps_and_is_said_once(tmp_path):
    messages = [(TOPIC, image_message(scene(n), 0), stamp_of(n)) for n in (1, 2, 3)]
    path = write_foreign(tmp_path / "bag", messages)
    with open_recording(path) as recording:
        assert [frame.stamp_ns for frame in recording] == [stamp_of(n) for n in (1, 2, 3)]
        assert len(recording.problems) == 1
        assert "frame 0" in recording.problems[0]
        assert "no stamp" in recording.problems[0]
        assert recording.skipped == 0


def test_order_is_that_of_the_recording_and_not_of_the_stamps(tmp_path):
    messages = [
        (TOPIC, image_message(scene(1), stamp_of(stamped)), stamp_of(received))
        for stamped, received in [(3, 1), (1, 2), (2, 3)]
    ]
    path = write_foreign(tmp_path / "bag", messages)
    with open_recording(path) as recording:
        assert [frame.stamp_ns for frame in recording] == [stamp_of(n) for n in (3, 1, 2)]


def test_messages_are_given_as_they_were_recorded(tmp_path):
    path = two_topics(tmp_path / "bag")
    with Bag(path) as bag:
        assert {name: (t.msgtype, t.count) for name, t in bag.topics.items()} == {
            "/left": (IMAGE, 3),
            "/right": (IMAGE, 2),
            "/chatter": ("std_msgs/msg/String", 1),
        }
        assert bag.start_ns == FIRST_NS
        both = list(bag.messages(["/left", "/right"]))
        late = list(bag.messages(["/left"], start_ns=stamp_of(2)))
        assert list(bag.messages([])) == []
    received = [time for _, _, time, _ in both]
    assert received == sorted(received)
    assert sorted({(topic, kind) for topic, kind, _, _ in both}) == [
        ("/left", IMAGE),
        ("/right", IMAGE),
    ]
    assert [time for _, _, time, _ in late] == [stamp_of(2) + 5000, stamp_of(3) + 5000]
    expected = JAZZY.serialize_cdr(image_message(scene(2), stamp_of(2)), IMAGE)
    assert bytes(late[0][3]) == bytes(expected)


def test_frames_are_views_of_the_messages(tmp_path):
    simple_bag(tmp_path / "bag")
    with open_recording(tmp_path / "bag") as recording:
        assert not next(iter(recording)).image.flags.owndata


def test_frames_bear_their_place_in_the_recording(tmp_path):
    messages = three_images()
    messages[1][1].encoding = "yuv422"
    with open_recording(write_foreign(tmp_path / "bag", messages)) as recording:
        assert [frame.number for frame in recording] == [0, 2]


@pytest.mark.parametrize("storage", STORAGES)
def test_frames_are_read_ahead_in_one_thread(storage, tmp_path, monkeypatch):
    threads, decoded = set(), []
    two_more = threading.Event()

    def watched(self, data, msgtype, deserialize=Bag.deserialize):
        threads.add(threading.current_thread())
        decoded.append(data)
        if len(decoded) == 3:
            two_more.set()
        return deserialize(self, data, msgtype)

    monkeypatch.setattr(Bag, "deserialize", watched)
    with open_recording(simple_bag(tmp_path / "bag", 6, storage=storage)) as recording:
        frames = iter(recording)
        assert next(frames).stamp_ns == stamp_of(1)
        assert two_more.wait(10), "while the first is in work"
        assert [frame.stamp_ns for frame in frames] == [stamp_of(n) for n in range(2, 7)]
        assert recording.seconds > 0
    (thread,) = threads
    assert thread is not threading.current_thread()
    assert not thread.is_alive(), "it ends with the recording"


def test_reading_goes_no_further_ahead_than_two_frames(tmp_path, monkeypatch):
    decoded = []

    def watched(self, data, msgtype, deserialize=Bag.deserialize):
        decoded.append(data)
        return deserialize(self, data, msgtype)

    monkeypatch.setattr(Bag, "deserialize", watched)
    with open_recording(simple_bag(tmp_path / "bag", 9)) as recording:
        next(iter(recording))
    assert len(decoded) <= 3


def test_a_new_look_ends_the_one_before(tmp_path):
    with open_recording(simple_bag(tmp_path / "bag", 6)) as recording:
        first = iter(recording)
        next(first)
        assert [frame.number for frame in recording] == list(range(6))
        assert list(first) == []


def test_a_closed_recording_says_so(tmp_path):
    recording = open_recording(simple_bag(tmp_path / "bag"))
    recording.close()
    recording.close()
    with pytest.raises(RecordingError, match="is closed"):
        list(recording)


def test_any_message_is_written_as_it_is(tmp_path):
    text = JAZZY.serialize_cdr(
        JAZZY.types["std_msgs/msg/String"](data="hello"), "std_msgs/msg/String"
    )
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/chatter", "std_msgs/msg/String", text, FIRST_NS)
        with pytest.raises(RecordingError, match="/chatter holds std_msgs/msg/String, not"):
            bag.write("/chatter", IMAGE, text, FIRST_NS)
        with pytest.raises(RecordingError, match="nowhere_msgs/msg/None is no message type known"):
            bag.write("/other", "nowhere_msgs/msg/None", text, FIRST_NS)
    with Bag(tmp_path / "bag") as bag:
        ((topic, msgtype, received_ns, data),) = bag.messages(["/chatter"])
    assert (topic, msgtype, received_ns) == ("/chatter", "std_msgs/msg/String", FIRST_NS)
    assert bytes(data) == bytes(text)
    with pytest.raises(RecordingError, match="is closed"):
        BagWriter.write(_closed(tmp_path / "closed"), "/chatter", IMAGE, text, FIRST_NS)


def _closed(path):
    bag = BagWriter(path)
    bag.close()
    bag.close()
    return bag


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("interruption", [KeyboardInterrupt, RuntimeError])
def test_a_bag_is_whole_after_an_interruption(tmp_path, storage, interruption):
    def interrupted():
        with BagWriter(tmp_path / "bag", storage=storage) as bag:
            for number in (1, 2, 3):
                bag.write_image(TOPIC, scene(number), stamp_of(number), FRAME_ID)
            raise interruption

    with pytest.raises(interruption):
        interrupted()
    assert_holds_three_images(tmp_path / "bag")


@pytest.mark.parametrize("stamp_ns", [-1, 2**63])
def test_a_time_that_no_bag_can_hold_is_refused_and_the_bag_stays_whole(tmp_path, stamp_ns):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image(TOPIC, scene(1), stamp_of(1), FRAME_ID)
        with pytest.raises(RecordingError, match=f"cannot hold the stamp {stamp_ns} ns"):
            bag.write_image(TOPIC, scene(2), stamp_ns, FRAME_ID)
        with pytest.raises(RecordingError, match=f"cannot hold the time {stamp_ns} ns"):
            bag.write(TOPIC, IMAGE, b"", stamp_ns)
    with open_recording(tmp_path / "bag") as recording:
        assert [frame.stamp_ns for frame in recording] == [stamp_of(1)]


def test_a_numpy_time_is_a_time(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image(TOPIC, scene(1), np.int64(FIRST_NS), FRAME_ID)
    with open_recording(tmp_path / "bag") as recording:
        assert [frame.stamp_ns for frame in recording] == [FIRST_NS]


@pytest.mark.parametrize(
    ("image", "encoding", "compressed", "message"),
    [
        (np.zeros((4, 4)), None, False, r"no encoding for an float64 image of shape \(4, 4\)"),
        (np.zeros((0, 4), "u1"), None, False, r"no encoding for an uint8 image of shape \(0, 4\)"),
        (np.zeros((4, 4, 2), "u1"), None, False, "no encoding for an uint8 image"),
        (np.zeros((4, 4), "u1"), "mono16", False, "step of 4 bytes is too small"),
        (np.zeros((4, 4), "u2"), "mono8", False, "mono8 does not hold uint16 pixels"),
        (np.zeros((4, 4), "f4"), None, True, "PNG holds uint8 or uint16"),
    ],
)
def test_an_image_that_fits_no_encoding_is_refused(tmp_path, image, encoding, compressed, message):
    with (
        BagWriter(tmp_path / "bag") as bag,
        pytest.raises(RecordingError, match=message),
    ):
        bag.write_image(TOPIC, image, FIRST_NS, FRAME_ID, encoding, compressed)


def test_unknown_storage_and_compression_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="storage must be one of mcap, sqlite3, not 'tape'"):
        BagWriter(tmp_path / "bag", storage="tape")
    with pytest.raises(RecordingError, match=r"compression must be one of none, .* not 'lzma'"):
        BagWriter(tmp_path / "bag", compression="lzma")
    with pytest.raises(RecordingError, match="only mcap is compressed by chunk"):
        BagWriter(tmp_path / "bag", storage="sqlite3", compression="chunk")
    assert not (tmp_path / "bag").exists()


def test_what_exists_is_not_overwritten(tmp_path):
    path = simple_bag(tmp_path / "bag")
    with pytest.raises(RecordingError, match="bag exists: choose another path"):
        BagWriter(path)
    assert_holds_three_images(path)
    simple_bag(path, count=1, storage="sqlite3", force=True)
    with open_recording(path) as recording:
        assert len(list(recording)) == 1
    assert sorted(file.name for file in path.iterdir()) == ["bag.db3", "metadata.yaml"]


def test_force_removes_nothing_but_a_bag(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "night.mcap").write_text("another recorder's, in a folder of another name")
    with pytest.raises(RecordingError, match="not replaced, since it is no bag"):
        BagWriter(folder, force=True)
    bag = simple_bag(tmp_path / "bag")
    (bag / "thesis.txt").write_text("years of work")
    with pytest.raises(RecordingError, match=r"not replaced, since it also holds thesis.txt"):
        BagWriter(bag, force=True)
    assert_holds_three_images(bag)
    link = tmp_path / "link"
    link.symlink_to(bag)
    with pytest.raises(RecordingError, match="not replaced, since it is no bag"):
        BagWriter(link, force=True)
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(RecordingError, match="not replaced"):
        BagWriter(file, force=True)
    assert file.read_text() == "mine"


def test_a_place_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write"):
        BagWriter(tmp_path / "file" / "bag")


def rotation(number):
    return Rotation.from_rotvec([0.1, 0.02 * number, -0.3])


def camera_of(width=30, height=20):
    k = [2000.0, 0.0, 14.5, 0.0, 2010.0, 9.5, 0.0, 0.0, 1.0]
    return Camera.from_calibration(width, height, k, [0.1, -0.01, 1e-3, 2e-3, 0.0], "plumb_bob")


def calibrated_bag(path, topics=("/camera/camera_info", "/camera/attitude"), count=3):
    """Images, with calibration and two attitudes before each, and one attitude at the end."""
    with BagWriter(path) as bag:
        for number in range(count):
            stamp_ns = stamp_of(number)
            bag.write_camera_info(topics[0], camera_of(), stamp_ns - 3, FRAME_ID)
            for i in (2, 1):
                bag.write_attitude(topics[1], rotation(2 * number - i), stamp_ns - i, FRAME_ID)
            bag.write_image(TOPIC, scene(number), stamp_ns, FRAME_ID)
        bag.write_attitude(topics[1], rotation(99), stamp_of(count), FRAME_ID)


def test_frames_bear_calibration_and_attitudes(tmp_path):
    calibrated_bag(tmp_path / "bag")
    with open_recording(tmp_path / "bag") as recording:
        frames = list(recording)
        assert recording.problems == []
        assert len(recording) == 3  # images
        last = recording.last_attitudes
    for number, frame in enumerate(frames):
        camera, kept = frame.camera, camera_of()
        assert (camera.width, camera.height, camera.model) == (30, 20, "plumb_bob")
        np.testing.assert_array_equal(camera.matrix, kept.matrix)
        np.testing.assert_array_equal(camera.distortion, kept.distortion)
        assert [stamp for stamp, _ in frame.attitudes] == [stamp_of(number) - i for i in (2, 1)]
        for i, (_, attitude) in zip((2, 1), frame.attitudes, strict=True):
            error = attitude * rotation(2 * number - i).inv()
            assert error.magnitude() < 1e-12
    assert [stamp for stamp, _ in last] == [stamp_of(3)]


def test_a_bag_without_calibration_says_nothing_of_it(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image(TOPIC, scene(0), FIRST_NS, FRAME_ID)
    with open_recording(tmp_path / "bag") as recording:
        (frame,) = recording
        assert recording.problems == []
    assert frame.camera is None
    assert frame.attitudes == ()


@pytest.mark.parametrize(
    ("topics", "options", "used"),
    [
        (("/elsewhere/info", "/mount/attitude"), {}, ("/elsewhere/info", "/mount/attitude")),
        (("/other/camera_info", "/other/attitude", "/camera/camera_info"), {}, None),
        (
            ("/camera/camera_info", "/b", "/b/camera_info"),
            {"camera_info_topic": "b/camera_info"},
            ("/b/camera_info", "/b"),
        ),
    ],
    ids=["the only ones", "the one beside", "the one asked for"],
)
def test_which_calibration_and_attitude_are_read(tmp_path, topics, options, used):
    with BagWriter(tmp_path / "bag") as bag:
        for topic in (topics[0], *topics[2:]):
            bag.write_camera_info(topic, camera_of(), FIRST_NS, FRAME_ID)
        bag.write_attitude(topics[1], rotation(0), FIRST_NS, FRAME_ID)
        bag.write_image(TOPIC, scene(0), FIRST_NS, FRAME_ID)
    with open_recording(tmp_path / "bag", **options) as recording:
        found = (recording.camera_info_topic, recording.attitude_topic)
        (frame,) = recording
        assert recording.problems == []
    assert found == (used or ("/camera/camera_info", "/other/attitude"))
    assert frame.camera is not None
    assert len(frame.attitudes) == 1


def test_another_cameras_calibration_is_not_taken(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_camera_info("/left/camera_info", camera_of(), FIRST_NS, FRAME_ID)
        for side in ("left", "right"):
            bag.write_image(f"/{side}/image_raw", scene(0), FIRST_NS, FRAME_ID)
    with open_recording(tmp_path / "bag", "/right/image_raw") as recording:
        (frame,) = recording
        (problem,) = recording.problems
    assert frame.camera is None
    assert problem.startswith("/left/camera_info is beside another image topic")
    options = {"topic": "/right/image_raw", "camera_info_topic": "/left/camera_info"}
    with open_recording(tmp_path / "bag", **options) as recording:
        (frame,) = recording
    assert frame.camera is not None


def test_among_several_calibrations_none_is_guessed(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for topic in ("/left/camera_info", "/right/camera_info"):
            bag.write_camera_info(topic, camera_of(), FIRST_NS, FRAME_ID)
        bag.write_image(TOPIC, scene(0), FIRST_NS, FRAME_ID)
    with open_recording(tmp_path / "bag") as recording:
        (frame,) = recording
        (problem,) = recording.problems
    assert frame.camera is None
    assert "/left/camera_info, /right/camera_info" in problem
    assert "/camera/camera_info" in problem
    with pytest.raises(RecordingError, match=r"/camera/image_raw is no .*CameraInfo topic; there"):
        open_recording(tmp_path / "bag", camera_info_topic=TOPIC)


def test_useless_calibration_and_attitude_are_told_once_and_cost_no_frame(tmp_path):
    """Of messages from another writer; the calibration's K[0] of 0 says: not calibrated."""
    types = JAZZY.types
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False)
    nine = np.zeros(9)
    with Writer(tmp_path / "bag", version=9) as writer:
        topics = {
            "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
            "/camera/attitude": "geometry_msgs/msg/QuaternionStamped",
            TOPIC: IMAGE,
        }
        at = {
            name: writer.add_connection(name, kind, typestore=JAZZY)
            for name, kind in topics.items()
        }
        for number in range(3):
            header = header_of(stamp_of(number))
            info = types[topics["/camera/camera_info"]](
                header, 20, 30, "plumb_bob", np.zeros(5), nine, nine, np.zeros(12), 0, 0, region
            )
            quaternion = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=2.0)
            attitude = types[topics["/camera/attitude"]](header, quaternion)
            image = image_message(scene(number), stamp_of(number))
            for message, name in zip((info, attitude, image), topics, strict=True):
                data = JAZZY.serialize_cdr(message, topics[name])
                writer.write(at[name], stamp_of(number), data)
    with open_recording(tmp_path / "bag") as recording:
        frames = list(recording)
        uncalibrated, length = recording.problems
    assert len(frames) == 3
    assert all(frame.camera is None and frame.attitudes == () for frame in frames)
    assert uncalibrated.startswith("/camera/camera_info: ")
    assert "not calibrated" in uncalibrated
    assert "a quaternion of length 2 is no rotation" in length


def test_ctrl_c_in_the_midst_of_waiting_is_ctrl_c(tmp_path, monkeypatch):
    def interrupted(_):
        try:
            raise KeyboardInterrupt
        finally:
            raise RuntimeError("cannot release un-acquired lock")  # as Condition does

    simple_bag(tmp_path / "bag")
    with open_recording(tmp_path / "bag") as recording:
        monkeypatch.setattr("concurrent.futures.Future.result", interrupted)
        with pytest.raises(KeyboardInterrupt):
            next(iter(recording))
        monkeypatch.undo()
        assert len(list(recording)) == 3
