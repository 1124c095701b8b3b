# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Bags of every storage, compression and recorder, whole ones."""

import re
import shutil

import cv2
import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from recorded import (
    NOETIC,
    TOPIC,
    compressed_message,
    image_message,
    noise,
    scene,
    simple_bag,
    stamp_of,
    write_bag,
    write_foreign,
    write_mcap,
)
from rosbags.rosbag1 import Writer as Rosbag1Writer

from ofsat_ros.recordings import IMAGE, Bag, RecordingError, open_recording


def numbers_in(path):
    """Return which images are in a bag, in its order, and what is said of it."""
    with open_recording(path) as recording:
        frames = list(recording)
        numbers = [round((frame.stamp_ns - stamp_of(0)) / 1e8) for frame in frames]
        for number, frame in zip(numbers, frames, strict=True):
            np.testing.assert_array_equal(frame.image, noise(number))
        return numbers, recording.problems


@pytest.mark.parametrize("chunks", [True, False])
@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_mcap_by_its_own_library_is_read(tmp_path, compression, chunks):
    file = tmp_path / "night.mcap"
    write_mcap(file, range(9), compression, chunk_size=10_000, use_chunking=chunks)
    assert numbers_in(file) == (list(range(9)), [])


BARE = {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False}


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.NONE, **BARE},
        {"index_types": IndexType.NONE, "use_chunking": False, **BARE},
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.MESSAGE},
        {"enable_crcs": False, "use_summary_offsets": False},
    ],
    ids=["no index", "no chunks", "no index of messages", "no index of chunks", "no checksums"],
)
def test_mcap_is_read_whatever_index_it_has(tmp_path, options):
    write_mcap(tmp_path / "night.mcap", range(9), "ZSTD", chunk_size=10_000, **options)
    numbers, _ = numbers_in(tmp_path / "night.mcap")
    assert numbers == list(range(9))


def test_mcap_without_an_index_and_out_of_order_is_given_once(tmp_path):
    shuffled = [3, 1, 2, 0, 5, 4]
    options = {"index_types": IndexType.NONE, "use_chunking": False, **BARE}
    write_mcap(tmp_path / "night.mcap", shuffled, **options)
    numbers, problems = numbers_in(tmp_path / "night.mcap")
    # The library gives the first, and then finds the order wrong.
    assert numbers == [3, 0, 1, 2, 4, 5]
    assert "read without its index (Unindexed MCAP messages are not in" in problems[0]
    assert "Messages in it, which seem to be all: 6" in problems[0]


def test_mcap_of_no_ros_profile_is_read(tmp_path):
    write_mcap(tmp_path / "night.mcap", range(5), profile="")
    numbers, problems = numbers_in(tmp_path / "night.mcap")
    assert numbers == list(range(5))
    assert len(problems) == 1


def test_ros1_messages_in_mcap_are_read(tmp_path):
    with (tmp_path / "old.mcap").open("wb") as file:
        writer = McapWriter(file, compression=CompressionType.ZSTD)
        writer.start("ros1")
        schema = writer.register_schema("sensor_msgs/Image", "ros1msg", b"")
        channel = writer.register_channel(TOPIC, "ros1", schema)
        for n in range(5):
            message = image_message(noise(n), stamp_of(n), store=NOETIC, seq=n)
            data = bytes(NOETIC.serialize_ros1(message, IMAGE))
            writer.add_message(channel, stamp_of(n), data, stamp_of(n))
        writer.finish()
    assert numbers_in(tmp_path / "old.mcap")[0] == list(range(5))


def test_several_publishers_of_a_topic_in_a_ros1_bag_are_read(tmp_path):
    with Rosbag1Writer(tmp_path / "old.bag") as writer:
        publishers = [
            writer.add_connection(TOPIC, IMAGE, typestore=NOETIC, callerid=name)
            for name in ("/left", "/right")
        ]
        for n in range(6):
            message = image_message(noise(n), stamp_of(n), store=NOETIC, seq=n)
            data = NOETIC.serialize_ros1(message, IMAGE)
            writer.write(publishers[n % 2], stamp_of(n), data)
    with Bag(tmp_path / "old.bag") as bag:
        assert {name: about.count for name, about in bag.topics.items()} == {TOPIC: 6}
    assert numbers_in(tmp_path / "old.bag") == (list(range(6)), [])


def split_bag(path, storage="mcap", parts=11, metadata=True, **options):
    """Make a bag of many files, two images in each."""
    path.mkdir()
    names = []
    for part in range(parts):
        numbers = (2 * part, 2 * part + 1)
        file = write_bag(path / "part", numbers, storage=storage, **options)
        names.append(f"night_{part}{''.join(file.suffixes)}")
        file.rename(path / names[-1])
        about = yaml.safe_load((path / "part" / "metadata.yaml").read_text())
        shutil.rmtree(path / "part")
    told = about["rosbag2_bagfile_information"]
    told["relative_file_paths"] = names
    told["message_count"] = 2 * parts
    told["topics_with_message_count"][0]["message_count"] = 2 * parts
    if metadata:
        (path / "metadata.yaml").write_text(yaml.safe_dump(about))
    return path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("compression", ["none", "message", "file"])
def test_a_bag_split_over_files_is_read(tmp_path, storage, compression):
    path = split_bag(tmp_path / "night", storage, parts=3, compression=compression)
    assert len(list(path.iterdir())) == 4
    assert numbers_in(path) == (list(range(6)), [])
    with Bag(path) as bag:
        assert bag.start_ns == stamp_of(0)
        late = list(bag.messages([TOPIC], start_ns=stamp_of(3)))
        assert [received for _, _, received, _ in late] == [stamp_of(n) for n in (3, 4, 5)]


@pytest.mark.parametrize("compression", ["none", "file"])
def test_a_split_bag_whose_recorder_was_killed_is_read_in_order(tmp_path, compression):
    path = split_bag(tmp_path / "night", metadata=False, compression=compression)
    last = max(path.iterdir(), key=lambda file: int(file.name.split("_")[1].split(".")[0]))
    last.write_bytes(last.read_bytes()[:-4500])  # its second message
    numbers, problems = numbers_in(path)
    assert numbers == list(range(21)) or (compression == "file" and numbers == list(range(20)))
    assert "has no metadata.yaml (was the recorder killed?)" in problems[0]
    assert "night_10.mcap" in problems[1]


def test_a_file_that_was_being_compressed_is_read_uncompressed(tmp_path):
    path = split_bag(tmp_path / "night", parts=2, metadata=False)
    (path / "night_1.mcap.zstd").write_bytes(b"\x28\xb5\x2f\xfd and no more")
    numbers, problems = numbers_in(path)
    assert numbers == [0, 1, 2, 3]
    assert len(problems) == 1


def test_a_missing_file_of_a_split_bag_is_told(tmp_path):
    path = split_bag(tmp_path / "night", parts=3)
    (path / "night_1.mcap").unlink()
    numbers, problems = numbers_in(path)
    assert numbers == [0, 1, 4, 5]
    assert "tells of files that are missing: night_1.mcap" in problems[0]
    assert "tells of 6 images" in problems[1]


def test_a_file_of_a_split_bag_that_is_none_is_left_out(tmp_path):
    path = split_bag(tmp_path / "night", parts=3)
    (path / "night_1.mcap").write_bytes(b"")
    numbers, problems = numbers_in(path)
    assert numbers == [0, 1, 4, 5]
    assert "cannot read night_1.mcap: it does not begin as an MCAP file" in problems[0]


def test_a_folder_without_metadata_is_read_when_it_holds_one_file(tmp_path):
    folder = simple_bag(tmp_path / "bag")
    (folder / "metadata.yaml").unlink()
    with open_recording(folder) as recording:
        assert len(list(recording)) == 3
        assert len(recording.problems) == 1
        assert "no metadata.yaml" in recording.problems[0]
    (folder / "second.mcap").touch()
    with pytest.raises(RecordingError, match=r"several files, .* open one of bag.mcap, second"):
        open_recording(folder)
    for name in ("night_0.mcap", "day_0.mcap"):
        (folder / "second.mcap").touch()
        (folder / "second.mcap").rename(folder / name)
    (folder / "bag.mcap").unlink()
    with pytest.raises(RecordingError, match=r"several files, .* one of day_0.mcap, night_0.mcap"):
        open_recording(folder)


@pytest.mark.parametrize(
    "text",
    [b"", b"nonsense: [", b"rosbag2_bagfile_information: 3", b"\xff\xfe", b"- 1"],
)
def test_damaged_metadata_is_told_and_not_needed(tmp_path, text):
    folder = simple_bag(tmp_path / "bag")
    (folder / "metadata.yaml").write_bytes(text)
    with open_recording(folder) as recording:
        assert len(list(recording)) == 3
        (problem,) = recording.problems
        assert "metadata.yaml is damaged and not used" in problem


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("compression", ["message", "file"])
def test_a_bare_compressed_file_needs_no_metadata(tmp_path, storage, compression):
    file = write_bag(tmp_path / "bag", range(5), storage=storage, compression=compression)
    assert (file.suffix == ".zstd") == (compression == "file")
    shutil.move(file, tmp_path / file.name)
    assert numbers_in(tmp_path / file.name) == (list(range(5)), [])


def test_what_was_unpacked_is_removed(tmp_path, monkeypatch):
    file = write_bag(tmp_path / "bag", range(5), compression="file")
    (tmp_path / "unpacked").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "unpacked"))
    with Bag(file):
        assert len(list((tmp_path / "unpacked").iterdir())) == 1
    assert list((tmp_path / "unpacked").iterdir()) == []
    file.write_bytes(b"no zstd")
    with pytest.raises(RecordingError, match=r"could not be unpacked to its end: .*MCAP"):
        Bag(file)
    assert list((tmp_path / "unpacked").iterdir()) == []


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_message_that_cannot_be_unpacked_is_left_out_and_told(tmp_path, storage):
    path = tmp_path / "bag"
    file = write_bag(path, range(5), storage=storage, compression="message")
    data = bytearray(file.read_bytes())
    frames = [found.start() for found in re.finditer(re.escape(b"\x28\xb5\x2f\xfd"), data)]
    data[frames[1] + 4 : frames[1] + 12] = b"\xff" * 8
    file.write_bytes(data)
    numbers, problems = numbers_in(path)
    assert len(numbers) == 4
    assert f"{TOPIC}: a damaged message is left out: " in problems[0]


# What image_transport and drivers write in the field "format".
@pytest.mark.parametrize(
    ("image", "extension", "named"),
    [
        (scene(3), ".png", "16UC1; png compressed "),
        (scene(3), ".png", "mono16; png compressed mono16"),
        (scene(1, "u1"), ".png", "mono8; png compressed "),
        (scene(1, "u1"), ".png", "png"),
        (np.full((20, 30), 77, "u1"), ".jpg", "mono8; jpeg compressed "),
        (np.full((20, 30), 77, "u1"), ".jpg", "jpeg"),
        (np.full((20, 30, 3), 77, "u1"), ".jpg", "bgr8; jpeg compressed bgr8"),
        (np.full((20, 30, 3), 77, "u1"), ".png", "rgb8; png compressed bgr8"),
        (np.full((20, 30, 3), 7777, "u2"), ".png", "rgb16; png compressed bgr16"),
    ],
)
def test_compressed_images_are_read_whatever_their_format_is_called(
    tmp_path, image, extension, named
):
    message = compressed_message(cv2.imencode(extension, image)[1].tobytes(), stamp_of(0))
    message.format = named
    path = write_foreign(tmp_path / "bag", [(TOPIC, message, stamp_of(0))])
    with open_recording(path) as recording:
        (frame,) = recording
        assert recording.problems == []
    assert frame.image.dtype == image.dtype
    np.testing.assert_array_equal(frame.image, image if image.ndim == 2 else image[..., 0])
