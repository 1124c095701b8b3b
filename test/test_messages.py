# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Conversion between arrays and ROS messages."""

import sys

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from ofsat_ros.detection import CANDIDATE, CONFIRMED, DETECTION_DTYPE
from ofsat_ros.images import EncodingError, decode_message, encode_png
from ofsat_ros.nodes import messages
from ofsat_ros.optical_flow import Flow
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.star_field import StarFieldMotion
from ofsat_ros.tracking import COASTING, TRACK_DTYPE

HEADER = Header(stamp=messages.time_message(1_700_000_000_123_456_789), frame_id="optical")


# Columns of DETECTION_DTYPE that no message has.
NOT_CARRIED = {"significance"}


def unit_vectors(count: int, random: np.random.Generator) -> np.ndarray:
    vectors = random.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def detections(count: int = 3, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    rows = np.zeros(count, DETECTION_DTYPE)
    for name in DETECTION_DTYPE.names:
        if DETECTION_DTYPE[name].kind == "f":
            rows[name] = random.uniform(1, 100, count)
    rows["sight"] = unit_vectors(count, random)
    rows["track_id"], rows["status"] = 1 + np.arange(count), CONFIRMED
    rows["object_index"] = rows["flow_index"] = -1
    return rows


def tracks(*statuses: int) -> np.ndarray:
    random = np.random.default_rng(2)
    rows = np.zeros(len(statuses), TRACK_DTYPE)
    for name in TRACK_DTYPE.names:
        if TRACK_DTYPE[name].kind == "f":
            rows[name] = random.uniform(1, 100, len(rows))
    rows["sight"] = unit_vectors(len(rows), random)
    rows["track_id"], rows["status"] = 4_000_000_000 + np.arange(len(rows)), statuses
    rows["hits"], rows["misses"] = 5 + np.arange(len(rows)), np.arange(len(rows))
    return rows


def result(rows: np.ndarray, flow: Flow | None = None, **values) -> FrameResult:
    about = {"dt_s": 0.5, "detections": rows, "flow": flow or Flow.empty(), **values}
    return FrameResult(stamp_ns=0, frame=1, shape=(100, 100), **about)


def points_of(marker: Marker) -> np.ndarray:
    """Begin and end of each line, (N, 2, 2) px."""
    return np.reshape([(p.x, p.y) for p in marker.points], (-1, 2, 2))


def field(inliers: list[bool]) -> StarFieldMotion:
    return StarFieldMotion(
        centre=np.zeros(2),
        displacement=np.zeros(2),
        rotation=0.0,
        scale=0.0,
        covariance=np.eye(4),
        inliers=np.array(inliers),
        residual_px=0.1,
        residual_sigmas=1.0,
        speed_mean=0.0,
        speed_std=0.0,
        model="shift",
    )


def flow(count: int) -> Flow:
    random = np.random.default_rng(1)
    position, step = random.uniform(0, 100, (2, count, 2))
    index = np.arange(count)
    return Flow.of_vectors(position, step, np.ones((count, 2)), np.ones(count, bool), index)


@pytest.mark.parametrize("ns", [0, 1, 999_999_999, 1_700_000_000_123_456_789])
def test_times_keep_every_nanosecond(ns):
    assert messages.stamp_ns(messages.time_message(ns)) == ns


def test_stamp_is_read_from_serialized_messages():
    expected = messages.stamp_ns(HEADER.stamp)
    assert messages.header_stamp_ns(serialize_message(Image(header=HEADER))) == expected
    assert messages.header_stamp_ns(serialize_message(CompressedImage(header=HEADER))) == expected
    array = messages.no_flow_markers(HEADER)
    found = messages.header_stamp_ns(serialize_message(array), messages.FIRST_MARKER_AT)
    assert found == expected


def test_stamp_is_read_in_either_byte_order():
    big = bytes([0, 0, 0, 0]) + (7).to_bytes(4, "big") + (9).to_bytes(4, "big")
    assert messages.header_stamp_ns(big) == 7_000_000_009


@pytest.mark.parametrize("length", [0, 1, 11])
def test_a_message_that_ends_before_its_stamp_is_refused(length):
    data = serialize_message(Image(header=HEADER))[:length]
    with pytest.raises(messages.MessageError, match=f"{length} bytes, too few"):
        messages.header_stamp_ns(data)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_image_there_and_back(dtype):
    pixels = np.arange(35, dtype=dtype).reshape(5, 7) * 7
    message = messages.image_message(HEADER, pixels)
    assert message.header == HEADER
    assert (message.height, message.width, message.step) == (5, 7, 7 * pixels.itemsize)
    back = decode_message(message)
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, pixels)


def test_image_buffer_is_used_without_a_copy():
    message = messages.image_message(HEADER, np.zeros((4, 6), np.uint16))
    decode_message(message)[1, 2] = 0x0201
    at = 2 * (6 + 2)
    expected = [1, 2] if sys.byteorder == "little" else [2, 1]
    assert list(message.data[at : at + 2]) == expected


def test_part_of_an_image_becomes_a_whole_one():
    pixels = np.arange(100, dtype=np.uint8).reshape(10, 10)
    back = decode_message(messages.image_message(HEADER, pixels[2:5, 3:9]))
    np.testing.assert_array_equal(back, pixels[2:5, 3:9])


def test_color_image_is_bgr():
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[..., 0] = 200
    message = messages.image_message(HEADER, pixels)
    assert (message.encoding, message.step, message.data[0]) == ("bgr8", 9, 200)


def test_compressed_image_keeps_16_bits():
    pixels = np.arange(400, dtype=np.uint16).reshape(20, 20) * 150
    message = CompressedImage(header=HEADER, format="png", data=encode_png(pixels))
    np.testing.assert_array_equal(decode_message(message), pixels)


def test_an_image_that_is_too_short_is_an_encoding_error():
    message = messages.image_message(HEADER, np.zeros((4, 6), np.uint16))
    message.height = 5
    with pytest.raises(EncodingError, match="too short"):
        decode_message(message)


@pytest.mark.parametrize(
    ("cloud", "more"),
    [
        (messages.detections_cloud(HEADER, detections(2)), {}),
        (
            messages.tracks_cloud(HEADER, tracks(CONFIRMED, COASTING)),
            dict.fromkeys(("sigma_u_rate", "sigma_v_rate", "age"), PointField.FLOAT64)
            | dict.fromkeys(("hits", "misses"), PointField.UINT32),
        ),
    ],
    ids=["detections", "tracks"],
)
def test_cloud_has_the_fields_of_the_design(cloud, more):
    doubles = "u v u_rate v_rate rel_u_rate rel_v_rate sigma_u sigma_v snr flux length angle"
    doubles += " ra dec sigma_ra sigma_dec"
    expected = dict.fromkeys(doubles.split(), PointField.FLOAT64)
    expected |= dict.fromkeys("xyz", PointField.FLOAT32)
    expected |= {"id": PointField.UINT32, "status": PointField.UINT8, **more}
    assert {f.name: f.datatype for f in cloud.fields} == expected
    assert {f.count for f in cloud.fields} == {1}
    assert (cloud.height, cloud.width) == (1, 2)
    assert cloud.row_step == 2 * cloud.point_step == len(cloud.data)
    assert cloud.is_dense


def test_a_cloud_without_lines_of_sight_is_not_dense():
    rows = detections(2)
    rows["sight"][1] = np.nan
    cloud = messages.detections_cloud(HEADER, rows)
    assert not cloud.is_dense
    axes = messages.cloud_array(cloud)[list("xyz")].tolist()
    assert axes[0] == pytest.approx(rows["sight"][0], abs=1e-7)
    assert np.isnan(axes[1]).all()


def test_cloud_holds_the_detections():
    rows = detections(4)
    cloud = messages.detections_cloud(HEADER, rows)
    assert cloud.header == HEADER
    back = messages.cloud_array(deserialize_message(serialize_message(cloud), PointCloud2))
    for field, column in [("u", "x"), ("v", "y"), ("u_rate", "vx"), ("v_rate", "vy")]:
        np.testing.assert_array_equal(back[field], rows[column])
    for field, column in [("rel_u_rate", "rel_vx"), ("sigma_v", "sigma_y"), ("id", "track_id")]:
        np.testing.assert_array_equal(back[field], rows[column])
    for name in ("snr", "flux", "length", "angle", "status"):
        np.testing.assert_array_equal(back[name], rows[name])
    for axis, name in enumerate("xyz"):  # FLOAT32
        np.testing.assert_array_equal(back[name], rows["sight"][:, axis].astype("f4"))


def test_detections_come_back_from_a_cloud():
    rows = detections(4)
    back = messages.detections_array(messages.detections_cloud(HEADER, rows))
    carried = set(DETECTION_DTYPE.names) - NOT_CARRIED - {"object_index", "flow_index"}
    for name in carried - {"sight"}:
        np.testing.assert_array_equal(back[name], rows[name])
    np.testing.assert_allclose(back["sight"], rows["sight"], atol=1e-7)
    for name in NOT_CARRIED:
        assert np.isnan(back[name]).all()  # what is not carried is unknown, not 0
    assert (back["object_index"] == -1).all()
    assert (back["flow_index"] == -1).all()


def test_cloud_holds_the_tracks_and_they_come_back():
    rows = tracks(CONFIRMED, COASTING, CONFIRMED)
    cloud = messages.tracks_cloud(HEADER, rows)
    assert cloud.header == HEADER
    heard = messages.cloud_array(deserialize_message(serialize_message(cloud), PointCloud2))
    columns = {"u": "x", "rel_v_rate": "rel_vy", "sigma_u": "sigma_x", "id": "track_id"}
    columns |= {"sigma_u_rate": "sigma_vx", "sigma_v_rate": "sigma_vy"}
    for field, column in columns.items():
        np.testing.assert_array_equal(heard[field], rows[column])
    for name in ("snr", "age", "hits", "misses", "status"):
        np.testing.assert_array_equal(heard[name], rows[name])
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(heard[name], rows["sight"][:, axis].astype("f4"))

    back = messages.tracks_array(cloud)
    assert back.dtype == TRACK_DTYPE
    unknown = {"log_false"}
    for name in set(TRACK_DTYPE.names) - unknown - {"sight"}:
        np.testing.assert_array_equal(back[name], rows[name])
    np.testing.assert_allclose(back["sight"], rows["sight"], atol=1e-7)
    for name in unknown:
        assert np.isnan(back[name]).all()


def test_what_reads_detections_reads_tracks_too_but_not_the_other_way():
    rows = tracks(CONFIRMED)
    back = messages.detections_array(messages.tracks_cloud(HEADER, rows))
    assert back["x"] == rows["x"]
    with pytest.raises(messages.MessageError, match="no field age, hits, misses, sigma_u_rate"):
        messages.tracks_array(messages.detections_cloud(HEADER, detections(1)))


def test_a_cloud_of_something_else_says_what_it_lacks():
    cloud = messages.detections_cloud(HEADER, detections(2))
    cloud.fields = [f for f in cloud.fields if f.name not in ("snr", "u_rate")]
    with pytest.raises(messages.MessageError, match="no field snr, u_rate"):
        messages.detections_array(cloud)


@pytest.mark.parametrize(
    "change",
    [
        lambda cloud: setattr(cloud, "width", 3),
        lambda cloud: (setattr(cloud, "width", 2**32 - 1), setattr(cloud, "height", 2**32 - 1)),
        lambda cloud: (setattr(cloud, "width", 2**31), setattr(cloud, "height", 2**31)),
        lambda cloud: setattr(cloud, "point_step", 10),
        lambda cloud: setattr(cloud, "point_step", 2**32 - 1),
        lambda cloud: setattr(cloud.fields[0], "datatype", 99),
        lambda cloud: setattr(cloud.fields[0], "name", cloud.fields[1].name),
    ],
    ids=[
        "too few points",
        "more points than can be counted",
        "more bytes than can be counted",
        "overlapping points",
        "points too long",
        "no such type",
        "a name twice",
    ],
)
def test_a_cloud_that_contradicts_itself_is_refused(change):
    cloud = messages.detections_cloud(HEADER, detections(2))
    # Of its own: those of messages made here are shared.
    cloud = deserialize_message(serialize_message(cloud), PointCloud2)
    change(cloud)
    with pytest.raises(messages.MessageError, match="contradicts itself"):
        messages.detections_array(cloud)


def test_pictures_come_back_and_others_are_refused():
    pixels = np.random.default_rng(1).integers(0, 255, (4, 5, 3), np.uint8)
    picture = messages.image_message(HEADER, pixels)
    np.testing.assert_array_equal(messages.picture_array(picture), pixels)
    padded = messages.image_message(HEADER, pixels)
    padded.step += 1
    cut = messages.image_message(HEADER, pixels)
    cut.data = cut.data[:-1]
    for other in (padded, cut, messages.image_message(HEADER, pixels[..., 0]), Image()):
        with pytest.raises(messages.MessageError, match="not bgr8 without padding"):
            messages.picture_array(other)


def test_empty_cloud_is_whole():
    cloud = messages.detections_cloud(HEADER, detections(0))
    assert (cloud.width, len(cloud.data), len(cloud.fields)) == (0, 0, len(messages.CLOUD_DTYPE))
    assert len(messages.cloud_array(cloud)) == 0
    cloud = messages.tracks_cloud(HEADER, tracks())
    assert (cloud.width, len(cloud.data)) == (0, 0)
    assert len(messages.tracks_array(cloud)) == 0


def test_stars_are_what_moves_with_the_field_and_is_no_detection():
    vectors = flow(6)
    rows = detections(2)
    rows["object_index"] = [4, -1]
    found = result(rows, vectors)
    without_field = messages.flow_markers(HEADER, found, scale=3.0)
    assert "star_flow" not in {m.ns for m in without_field.markers}

    found.star_field = field([True, False, True, True, True, True])
    array = messages.flow_markers(HEADER, found, scale=3.0)
    (stars,) = [m for m in array.markers if m.ns == "star_flow"]
    assert stars.type == Marker.LINE_LIST
    assert stars.color.b > stars.color.r
    ends = np.reshape([(p.x, p.y) for p in stars.points], (-1, 2, 2))
    kept = [0, 2, 3, 5]
    np.testing.assert_allclose(ends[:, 0], vectors.position[kept])
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], 3 * vectors.displacement[kept])


def test_rso_markers_have_a_box_and_an_id_each():
    rows = detections(3)
    array = messages.flow_markers(HEADER, result(rows), scale=1.0)
    assert array.markers[0].action == Marker.DELETEALL
    (flow_marker,) = [m for m in array.markers if m.ns == "rso_flow"]
    assert flow_marker.color.r > flow_marker.color.b
    assert len(flow_marker.points) == 6
    boxes = [m for m in array.markers if m.ns == "rso_boxes"]
    texts = [m for m in array.markers if m.ns == "rso_ids"]
    assert {(m.color.r, m.color.b) for m in boxes + texts} == {
        (flow_marker.color.r, flow_marker.color.b)
    }
    assert len({(m.ns, m.id) for m in array.markers[1:]}) == len(array.markers) - 1
    for row, box, text in zip(rows, boxes, texts, strict=True):
        x, y = np.array([(p.x, p.y) for p in box.points]).T
        assert (x.min() + x.max()) / 2 == pytest.approx(row["x"])
        assert (y.min() + y.max()) / 2 == pytest.approx(row["y"])
        assert x.max() - x.min() > row["length"]
        assert text.pose.position.x == pytest.approx(row["x"])
        assert text.text.startswith(f"{row['track_id']} ")
        assert box.pose.orientation.w == text.pose.orientation.w == 1.0


def test_a_candidate_has_corners_and_no_id():
    rows = detections(2)
    rows["status"], rows["track_id"] = [CONFIRMED, CANDIDATE], [8, 0]
    array = messages.flow_markers(HEADER, result(rows), scale=1.0)
    whole, open_ = (points_of(m) for m in array.markers if m.ns == "rso_boxes")
    (text,) = [m for m in array.markers if m.ns == "rso_ids"]
    assert text.text.startswith("8 ")
    side = np.ptp(whole[..., 0])
    drawn = np.hypot(*(whole[:, 1] - whole[:, 0]).T).sum()
    assert drawn == pytest.approx(4 * side)
    # Around the same place, but with gaps: the middle of each side is free.
    centre = np.array([rows["x"][1], rows["y"][1]])
    side = np.ptp(open_[..., 0])
    np.testing.assert_allclose(open_.reshape(-1, 2).mean(axis=0), centre)
    drawn = np.hypot(*(open_[:, 1] - open_[:, 0]).T).sum()
    assert drawn < 0.8 * 4 * side
    (flow_marker,) = [m for m in array.markers if m.ns == "rso_flow"]
    assert len(flow_marker.points) == 4  # it moves as well


def test_coasting_tracks_have_a_box_of_their_own_where_they_are_expected():
    rows = tracks(CONFIRMED, COASTING)
    array = messages.flow_markers(HEADER, result(detections(1), tracks=rows), scale=1.0)
    (box,) = [m for m in array.markers if m.ns == "coasting_boxes"]
    place = [rows["x"][1], rows["y"][1]]
    np.testing.assert_allclose(points_of(box).reshape(-1, 2).mean(axis=0), place)
    assert box.color.g > 0.5 > box.color.b  # yellow, not red
    texts = {m.text for m in array.markers if m.ns == "rso_ids"}
    assert f"{rows['track_id'][1]}  coasting" in texts
    assert len(texts) == 2
    names = [(m.ns, m.id) for m in array.markers[1:]]
    assert len(set(names)) == len(names)


def test_unknown_length_still_gives_a_box():
    rows = detections(1)
    rows["length"] = np.nan
    array = messages.flow_markers(HEADER, result(rows), scale=1.0)
    (box,) = [m for m in array.markers if m.ns == "rso_boxes"]
    assert np.isfinite([(p.x, p.y) for p in box.points]).all()


def test_a_frame_without_anything_only_clears():
    array = messages.flow_markers(HEADER, result(detections(0)), scale=1.0)
    assert [m.action for m in array.markers] == [Marker.DELETEALL]


def test_star_field_motion_is_unknown_without_a_field():
    for nothing in (None, result(detections(0))):
        vector = messages.star_field_vector(HEADER, nothing).vector
        assert np.isnan([vector.x, vector.y, vector.z]).all()
