# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Messages into bags: those that need not be given whole, and those that Ctrl-C would cut.

What is written of images, calibrations and attitudes is read back in test_recordings.py.
"""

import signal
import threading

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import Writer
from sensor_msgs.msg import CameraInfo
from visualization_msgs.msg import Marker

from ofsat_ros.recordings import (
    Bag,
    BagWriter,
    RecordingError,
    header_message,
    message_type,
)

TEXT = "std_msgs/msg/String"
STAMP = 1_767_225_600_123_456_789


def texts_of(path) -> list[str]:
    with Bag(path) as bag:
        return [
            bag.deserialize(data, msgtype).data
            for _, msgtype, _, data in bag.messages(list(bag.topics))
        ]


@pytest.mark.parametrize(
    ("msgtype", "kind"),
    [("visualization_msgs/msg/Marker", Marker), ("sensor_msgs/msg/CameraInfo", CameraInfo)],
)
def test_fields_that_are_not_given_are_those_of_ros(msgtype, kind, tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        header = header_message(STAMP, "optical")
        bag.write_message("/topic", message_type(msgtype)(header=header), STAMP)
    with Bag(tmp_path / "bag") as bag:
        ((_, written_type, at_ns, data),) = bag.messages(["/topic"])
    assert (written_type, at_ns) == (msgtype, STAMP)
    expected = kind()
    expected.header.stamp.sec, expected.header.stamp.nanosec = divmod(STAMP, 10**9)
    expected.header.frame_id = "optical"
    heard = deserialize_message(bytes(data), kind)
    if kind is Marker:
        assert heard.pose.orientation.w == 0  # the one default of ROS that is not zero
        heard.pose.orientation.w = 1.0
    assert heard == expected


def test_messages_share_nothing_that_was_not_given():
    marker = message_type("visualization_msgs/msg/Marker")
    one, other = marker(), marker()
    one.pose.position.x, one.points = 3.0, [*one.points, None]
    one.header.stamp.sec = 5
    assert (other.pose.position.x, other.points, other.header.stamp.sec) == (0.0, [], 0)


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_a_header_cannot_hold_every_time(stamp_ns):
    with pytest.raises(RecordingError, match=f"cannot hold the stamp {stamp_ns} ns"):
        header_message(stamp_ns, "optical")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_ctrl_c_waits_until_the_message_is_whole(storage, tmp_path, monkeypatch):
    def interrupted(self, connection, stamp_ns, data):
        signal.raise_signal(signal.SIGINT)
        write(self, connection, stamp_ns, data)

    write = Writer.write
    monkeypatch.setattr(Writer, "write", interrupted)
    usual = signal.getsignal(signal.SIGINT)
    with BagWriter(tmp_path / "bag", storage=storage) as bag:
        for word in ("one", "two"):
            with pytest.raises(KeyboardInterrupt):
                bag.write_message("/chatter", message_type(TEXT)(data=word), STAMP)
            assert signal.getsignal(signal.SIGINT) is usual
    assert texts_of(tmp_path / "bag") == ["one", "two"]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_ctrl_c_while_a_bag_is_opened_leaves_a_whole_one(storage, tmp_path, monkeypatch):
    def interrupted(self):
        signal.raise_signal(signal.SIGINT)
        start(self)

    start = Writer.open
    monkeypatch.setattr(Writer, "open", interrupted)
    with pytest.raises(KeyboardInterrupt):
        BagWriter(tmp_path / "bag", storage=storage)
    monkeypatch.undo()
    with BagWriter(tmp_path / "bag", storage=storage, force=True) as bag:  # it is a bag
        bag.write_message("/chatter", message_type(TEXT)(data="anew"), STAMP)
    assert texts_of(tmp_path / "bag") == ["anew"]


def test_other_threads_write_as_well(tmp_path):
    """They can set no signal's handler, and get no signal."""
    with BagWriter(tmp_path / "bag") as bag:
        message = message_type(TEXT)(data="from afar")
        thread = threading.Thread(target=bag.write_message, args=("/chatter", message, STAMP))
        thread.start()
        thread.join()
    assert texts_of(tmp_path / "bag") == ["from afar"]


def test_arrays_are_numpys():
    image = message_type("sensor_msgs/msg/Image")()
    assert (image.data.dtype, len(image.data)) == (np.uint8, 0)
