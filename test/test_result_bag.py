# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A bag of results holds what the detector publishes, made without ROS."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import Vector3Stamped
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.nodes import messages
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import FrameResult, Pipeline
from ofsat_ros.recordings import Bag, RecordingError
from ofsat_ros.results.bag import BAG, ResultBag
from ofsat_ros.simulation import scenario

FRAME_ID = "camera_optical_frame"
SCALE = 3.0
# What makes each topic's messages live.
LIVE = {
    "/rso_detections": (PointCloud2, lambda h, r: messages.detections_cloud(h, r.detections)),
    "/rso_tracks": (PointCloud2, lambda h, r: messages.tracks_cloud(h, r.tracks)),
    "/star_field_motion": (Vector3Stamped, messages.star_field_vector),
    "/flow_markers": (MarkerArray, lambda h, r: messages.flow_markers(h, r, SCALE)),
}


@pytest.fixture(scope="module")
def found() -> list[tuple[int, FrameResult]]:
    """Stamps and results of a sky with stars, RSOs, candidates and coasting tracks."""
    pipeline = Pipeline(Parameters.preset("robust", false_tracks=0.1))
    frames = scenario("survey", 1, frames=14, width=200, height=160)
    results = [(frame.stamp_ns, pipeline.process(frame.image, frame.stamp_ns)) for frame in frames]
    assert any(len(result.tracks) for _, result in results)
    return results


def write(folder: Path, results: list[tuple[int, FrameResult]], **options) -> Path:
    with ResultBag(folder, SCALE, **options) as bag:
        for stamp_ns, result in results:
            bag.add(stamp_ns, FRAME_ID, result)
    return folder / BAG


def test_ros_reads_the_same_messages_as_the_detector_publishes(found, tmp_path):
    with Bag(write(tmp_path, found)) as bag:
        assert bag.problems == []
        kept = list(bag.messages(list(LIVE)))
    # All of a frame at the time of its image, in the order of the detector.
    assert [topic for topic, *_ in kept] == [*LIVE] * len(found)
    assert [at for _, _, at, _ in kept] == [stamp_ns for stamp_ns, _ in found for _ in LIVE]
    for number, (topic, _, _, data) in enumerate(kept):
        stamp_ns, result = found[number // len(LIVE)]
        kind, make = LIVE[topic]
        header = Header(stamp=messages.time_message(stamp_ns), frame_id=FRAME_ID)
        live = serialize_message(make(header, result))
        # As text, in which NaN is NaN.
        heard, expected = (repr(deserialize_message(raw, kind)) for raw in (bytes(data), live))
        assert heard == expected, (topic, number)


def test_it_offers_what_ros2_bag_play_and_viewers_can_use(found, tmp_path):
    with Reader(write(tmp_path, found[:1])) as reader:
        qualities = [each.ext.offered_qos_profiles[0] for each in reader.connections]
        assert {each.topic for each in reader.connections} == set(LIVE)
    assert {quality.reliability.name for quality in qualities} == {"RELIABLE"}
    assert {quality.durability.name for quality in qualities} == {"VOLATILE"}


def test_an_rso_that_was_only_later_found_in_a_first_frame_has_no_vector(tmp_path):
    """The look back says where it was, but not by which motion from the frame before."""
    rows = np.zeros(1, DETECTION_DTYPE)
    rows["x"], rows["y"], rows["vx"], rows["track_id"], rows["status"] = 30, 40, 2, 1, 1
    first = FrameResult(stamp_ns=10**9, frame=0, shape=(64, 64), detections=rows)
    with Bag(write(tmp_path, [(10**9, first)])) as bag:
        ((*_, data),) = bag.messages(["/flow_markers"])
    markers = deserialize_message(bytes(data), MarkerArray).markers
    assert [marker.ns for marker in markers] == ["", "rso_boxes", "rso_ids"]
    places = [(p.x, p.y) for marker in markers for p in marker.points]
    np.testing.assert_allclose(np.mean(places, axis=0), [30, 40])


def test_a_bag_is_replaced_only_when_told(found, tmp_path):
    write(tmp_path, found[:2])
    with pytest.raises(RecordingError, match="exists: choose another path, or --force"):
        write(tmp_path, found)
    write(tmp_path, found[:1], force=True)
    with Bag(tmp_path / BAG) as bag:
        assert {about.count for about in bag.topics.values()} == {1}


def test_a_stamp_that_no_header_can_hold_is_refused_and_the_bag_stays_whole(found, tmp_path):
    with ResultBag(tmp_path, SCALE) as bag:
        bag.add(5, FRAME_ID, found[0][1])
        with pytest.raises(RecordingError, match="a header cannot hold the stamp -1 ns"):
            bag.add(-1, FRAME_ID, found[1][1])
    with Bag(tmp_path / BAG) as bag:
        assert {about.count for about in bag.topics.values()} == {1}


def test_no_ros_is_needed(tmp_path):
    """As on a machine that has none of it."""
    program = f"""
import sys
for name in ("rclpy", "sensor_msgs", "std_msgs", "visualization_msgs", "geometry_msgs"):
    sys.modules[name] = None
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.results.bag import ResultBag
with ResultBag({str(tmp_path)!r}, 5.0) as bag:
    bag.add(7, "optical", FrameResult(7, 0, (64, 64)))
"""
    root = Path(messages.__file__).parents[2]
    subprocess.run([sys.executable, "-c", program], check=True, cwd=root, timeout=60)
    with Bag(tmp_path / BAG) as bag:
        assert {name: about.count for name, about in bag.topics.items()} == dict.fromkeys(LIVE, 1)
