# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Bags for tests, written by this package and by the libraries of others."""

import mcap.writer
import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from ofsat_ros.recordings import COMPRESSED_IMAGE, IMAGE, BagWriter, open_recording

TOPIC = "/camera/image_raw"
FRAME_ID = "camera_optical_frame"
# Nanoseconds that a float could not hold.
FIRST_NS, STEP_NS = 1_767_225_600_123_456_789, 100_000_001
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
ENDING = {"mcap": ".mcap", "sqlite3": ".db3"}
JAZZY = get_typestore(Stores.ROS2_JAZZY)
NOETIC = get_typestore(Stores.ROS1_NOETIC)


def scene(number, dtype="u2"):
    return np.random.default_rng(number).integers(0, 255, (20, 30)).astype(dtype) * number


def stamp_of(number):
    return FIRST_NS + number * STEP_NS


def header_of(stamp_ns, store=JAZZY, **more):
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME_ID, **more)


def image_message(pixels, stamp_ns, encoding="mono16", store=JAZZY, **header):
    """Build a big-endian Image with padded rows: unlike what `BagWriter` writes."""
    rows = np.full((pixels.shape[0], 2 * pixels.shape[1] + 3), 0xEE, np.uint8)
    rows[:, :-3] = pixels.byteswap().view(np.uint8)
    return store.types[IMAGE](
        header=header_of(stamp_ns, store, **header),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=1,
        step=rows.shape[1],
        data=rows.ravel(),
    )


def compressed_message(data, stamp_ns):
    return JAZZY.types[COMPRESSED_IMAGE](
        header=header_of(stamp_ns), format="png", data=np.frombuffer(data, np.uint8)
    )


def write_foreign(path, messages, storage="mcap", mode=CompressionMode.NONE):
    """Write (topic, message, received_ns) with the library's own writer."""
    writer = Writer(path, version=9, storage_plugin=STORAGES[storage])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        known = {}
        for topic, message, received_ns in messages:
            msgtype = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, msgtype, typestore=JAZZY)
            writer.write(known[topic], received_ns, JAZZY.serialize_cdr(message, msgtype))
    return path


def three_images(topic=TOPIC):
    # Received later than stamped, as it is in life.
    return [(topic, image_message(scene(n), stamp_of(n)), stamp_of(n) + 5000) for n in (1, 2, 3)]


def simple_bag(path, count=3, **options):
    with BagWriter(path, **options) as bag:
        for number in range(1, count + 1):
            bag.write_image(TOPIC, scene(number), stamp_of(number), FRAME_ID)
    return path


def assert_holds_three_images(path, topic=None):
    with open_recording(path, topic) as recording:
        assert len(recording) == 3
        frames = list(recording)
        assert (recording.problems, recording.skipped, recording.torn) == ([], 0, "")
    for number, frame in enumerate(frames, start=1):
        np.testing.assert_array_equal(frame.image, scene(number))
        assert frame.image.dtype == np.uint16
        assert frame.stamp_ns == stamp_of(number)
        assert frame.frame_id == FRAME_ID
    assert len(frames) == 3


def noise(number):
    """Pixels that do not compress: 4 KB, some pages of a database."""
    return np.random.default_rng(number).integers(0, 65536, (40, 50)).astype(np.uint16)


def cdr_of(number):
    message = image_message(noise(number), stamp_of(number))
    return bytes(JAZZY.serialize_cdr(message, IMAGE))


def write_ros1(path, numbers, compression="none", chunk_bytes=1 << 20):
    """Write noise with rosbags."""
    writer = Rosbag1Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    with writer:
        connection = writer.add_connection(TOPIC, IMAGE, typestore=NOETIC)
        for n in numbers:
            message = image_message(noise(n), stamp_of(n), store=NOETIC, seq=n)
            writer.write(connection, stamp_of(n), NOETIC.serialize_ros1(message, IMAGE))
    return path


def write_mcap(path, numbers, compression="NONE", profile="ros2", encoding="cdr", **options):
    """Write noise with MCAP's own library."""
    pack = mcap.writer.CompressionType[compression]
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file, compression=pack, **options)
        writer.start(profile)
        schema = writer.register_schema(IMAGE, "ros2msg", b"")
        channel = writer.register_channel(TOPIC, encoding, schema)
        for n in numbers:
            writer.add_message(channel, stamp_of(n), cdr_of(n), stamp_of(n))
        writer.finish()
    return path


def write_bag(path, numbers, **options):
    """Write noise with this package; return the bag's only file."""
    with BagWriter(path, **options) as bag:
        for n in numbers:
            bag.write(TOPIC, IMAGE, cdr_of(n), stamp_of(n))
    (file,) = (file for file in path.iterdir() if file.name != "metadata.yaml")
    return file
