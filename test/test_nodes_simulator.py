"""The simulator node over real DDS: its topics agree with each other and with the truth."""

import threading

import numpy as np
import pytest
from geometry_msgs.msg import QuaternionStamped
from ros_graph import Graph, stamps
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from ofsat_ros.images import decode_message
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.simulator import Simulator, attitude_of
from ofsat_ros.simulation import scenario

ARCSEC = np.pi / 180 / 3600


def turned(quaternion, vectors: np.ndarray) -> np.ndarray:
    """Turn (N, 3) vectors by a quaternion (w, x, y, z): q v q*."""
    w, axis = quaternion[0], np.asarray(quaternion[1:])
    return vectors + 2 * np.cross(axis, np.cross(axis, vectors) + w * vectors)


def components(message: QuaternionStamped) -> np.ndarray:
    q = message.quaternion
    return np.array([q.w, q.x, q.y, q.z])


def run(name: str, frames: int) -> dict[str, list]:
    """Return what the topics give for the first frames of a scenario with seed 7."""
    kinds = {
        "image": Image,
        "camera_info": CameraInfo,
        "attitude": QuaternionStamped,
        "rso_truth": PointCloud2,
    }
    with Graph("-p", f"scenario:={name}", "-p", "seed:=7", "-p", "rate:=20.0") as graph:
        heard = {topic: graph.listen(kind, topic) for topic, kind in kinds.items()}
        graph.add(Simulator(threading.Event(), context=graph.context))
        graph.until(lambda: all(len(found) >= frames + 1 for found in heard.values()))
    # The very first ones may have gone before the listener was known.
    common = sorted(set.intersection(*(set(stamps(found)) for found in heard.values())))
    return {
        topic: [m for m in found if messages.stamp_ns(m.header.stamp) in common[:frames]]
        for topic, found in heard.items()
    }


@pytest.fixture(scope="module")
def geo() -> dict[str, list]:
    return run("geo", 4)


@pytest.fixture(scope="module")
def truth_frames(geo) -> list:
    """The same frames, rendered here."""
    sky = scenario("geo", 7)
    first_image = decode_message(geo["image"][0])
    frames = (sky.frame() for _ in range(10))
    frame = next((f for f in frames if np.array_equal(f.image, first_image)), None)
    assert frame, "the first image is none of the scenario's"
    later_ns = stamps(geo["image"])[0] - frame.stamp_ns
    sky = scenario("geo", 7, start_stamp_ns=sky.settings.start_stamp_ns + later_ns)
    return [sky.frame() for _ in range(frame.frame + 4)][frame.frame :]


def test_images_are_the_scenarios(geo, truth_frames):
    assert stamps(geo["image"]) == [f.stamp_ns for f in truth_frames]
    for message, frame in zip(geo["image"], truth_frames, strict=True):
        assert message.encoding == "mono16"
        np.testing.assert_array_equal(decode_message(message), frame.image)


def test_truth_has_the_layout_of_detections(geo, truth_frames):
    for cloud, frame in zip(geo["rso_truth"], truth_frames, strict=True):
        rows = messages.cloud_array(cloud)
        assert rows.dtype.names == messages.CLOUD_DTYPE.names
        assert list(rows["id"]) == [1, 2, 3, 4, 5]
        for field, column in [("u", "x_px"), ("v", "y_px"), ("u_rate", "vx_px_s"), ("snr", "snr")]:
            np.testing.assert_array_equal(rows[field], frame.truth[column])
        # GEO objects stand still in the image, so against the stars they move as the stars do
        # against them.
        stars = np.array([frame.stars["vx_px_s"][0], frame.stars["vy_px_s"][0]])
        np.testing.assert_allclose(rows["rel_u_rate"], -stars[0], atol=1e-9)
        np.testing.assert_allclose(rows["rel_v_rate"], -stars[1], atol=1e-9)
        assert (np.abs(rows["angle"]) <= np.pi / 2).all()


def test_every_topic_bears_the_images_header(geo):
    for topic in ("camera_info", "attitude", "rso_truth"):
        assert [m.header for m in geo[topic]] == [m.header for m in geo["image"]]
    assert geo["image"][0].header.frame_id.endswith("_optical_frame")


def test_stars_move_in_the_image_as_the_attitude_says(geo, truth_frames):
    info = geo["camera_info"][0]
    k = info.k.reshape(3, 3)
    assert (info.width, info.height) == (geo["image"][0].width, geo["image"][0].height)
    assert k[0, 0] == pytest.approx(1 / (scenario("geo").settings.pixel_scale_arcsec * ARCSEC))
    first, last = components(geo["attitude"][0]), components(geo["attitude"][-1])
    # A star at the first image's centre, in ICRS, seen by the last attitude.
    inverse = first * (1, -1, -1, -1)
    star = turned(inverse, np.array([[0.0, 0.0, 1.0]]))
    seen = turned(last, star)[0]
    pixel = (k @ seen)[:2] / seen[2]
    moved = pixel - k[:2, 2]
    expected = sum(f.displacement_px for f in truth_frames[1:])
    # The simulated sky is flat: over these 100 arcsec that is below 1e-3 px.
    np.testing.assert_allclose(moved, expected, atol=0.01)


def test_attitude_without_motion_has_north_up_and_east_left():
    axes = turned(attitude_of(0, 0, 0), np.eye(3))  # vernal equinox, east of it, north pole
    np.testing.assert_allclose(axes, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)


def test_field_angle_turns_x_towards_y():
    right_of_centre = turned(attitude_of(0, 0, 0) * (1, -1, -1, -1), np.array([[0.01, 0, 1]]))
    seen = turned(attitude_of(0, 0, np.pi / 2), right_of_centre)[0]
    np.testing.assert_allclose(seen, [0, 0.01, 1], atol=1e-12)


def test_without_loop_it_ends_with_the_scenario(monkeypatch):
    monkeypatch.setattr(
        "ofsat_ros.nodes.simulator.scenario",
        lambda name, seed, **given: scenario(name, seed, frames=3, width=64, height=64, **given),
    )
    stop = threading.Event()
    with Graph("-p", "loop:=false", "-p", "rate:=10.0") as graph:
        heard = graph.listen(Image, "image", best_effort=True)
        graph.add(Simulator(stop, context=graph.context))
        graph.until(stop.is_set)
        graph.serve(0.1)
    assert 1 <= len(heard) <= 3
    gaps = np.diff(stamps(heard))
    assert (gaps == 1_000_000_000).all()  # on the scenario's clock, whatever the rate


def test_an_error_while_rendering_is_no_success(monkeypatch):
    def broken(self):
        raise OverflowError("of whatever")

    monkeypatch.setattr(Simulator, "_render", broken)
    stop = threading.Event()
    with Graph() as graph:
        simulator = graph.add(Simulator(stop, context=graph.context))
        graph.until(stop.is_set)
        assert simulator.exit_code == 1
