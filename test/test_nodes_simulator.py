# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The simulator node over real DDS: its topics agree with each other, and it obeys commands."""

import threading
import time

import numpy as np
import pytest
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from ros_graph import Graph, stamps
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from ofsat_ros.camera import Camera, from_radec, rotation_of
from ofsat_ros.images import decode_message
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.simulator import Simulator
from ofsat_ros.simulation import scenario


def attitude_of(message: QuaternionStamped) -> Rotation:
    q = message.quaternion
    return rotation_of(q.x, q.y, q.z, q.w)


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


def test_camera_and_attitude_are_the_scenarios(geo, truth_frames):
    camera = Camera.from_message(geo["camera_info"][0])
    expected = scenario("geo", 7).camera
    assert (camera.width, camera.height, camera.model) == (512, 512, "plumb_bob")
    np.testing.assert_array_equal(camera.matrix, expected.matrix)
    info = geo["camera_info"][0]
    assert list(info.d) == [0] * 5
    np.testing.assert_array_equal(info.p.reshape(3, 4), np.c_[expected.matrix, np.zeros(3)])
    for message, frame in zip(geo["attitude"], truth_frames, strict=True):
        difference = attitude_of(message) * frame.attitude.inv()
        # The frame's attitude comes from the start on; to 1e-12 rad it is the same.
        assert difference.magnitude() < 1e-12


def test_directions_of_the_truth_agree_with_camera_and_attitude(geo):
    camera = Camera.from_message(geo["camera_info"][0])
    for cloud, attitude in zip(geo["rso_truth"], geo["attitude"], strict=True):
        rows = messages.cloud_array(cloud)
        pixels = np.stack([rows["u"], rows["v"]], axis=-1)
        sight = from_radec(rows["ra"], rows["dec"], attitude_of(attitude))
        np.testing.assert_allclose(camera.pixels(sight), pixels, atol=1e-6)
        fields = np.stack([rows["x"], rows["y"], rows["z"]], axis=-1)
        np.testing.assert_allclose(fields, sight, atol=1e-7)  # FLOAT32


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


# --- the mount --------------------------------------------------------------------------------


# Of the scenarios' mount, rad/s: 8 arcsec in 40 s is at most 6e-6.
PERIODIC = 7e-6
STILL = (0.0, 0.0, 0.0)


class Watched(Graph):
    """A graph with a simulator of a scenario that has a mount, small and quick to render."""

    def __init__(self, monkeypatch, *arguments: str, name: str = "guide_drift", **settings):
        small = {"width": 64, "height": 48, "star_count": 0, **settings}
        monkeypatch.setattr(
            "ofsat_ros.nodes.simulator.scenario",
            lambda name, seed, **given: scenario(name, seed, **small, **given),
        )
        super().__init__("-p", f"scenario:={name}", *arguments)
        self.mount_rate = self.publisher(TwistStamped, "mount_rate")
        self.heard = self.listen(QuaternionStamped, "attitude")
        self.add(Simulator(threading.Event(), context=self.context))
        self.connect(self.mount_rate)

    def command(self, *rate: float) -> None:
        message = TwistStamped()  # its stamp is 0: arrival counts
        angular = message.twist.angular
        angular.x, angular.y, angular.z = rate
        self.mount_rate.publish(message)

    def command_until_obeyed(self, *rate: float) -> None:
        """Command at 25 Hz until it moves so in the mean between three pairs of frames."""

        def obeys() -> bool:
            self.command(*rate)
            self.serve(0.04)
            return self.moves(rate, 3)

        self.until(obeys)

    def moves(self, rate, pairs: int = 1) -> bool:
        """Whether the newest frames have this rate, but for the mount's periodic error."""
        newest = self.rates()[-pairs:]
        return len(newest) == pairs and np.allclose(newest, rate, rtol=0, atol=PERIODIC)

    def rates(self) -> np.ndarray:
        """Rates, rad/s in the optical frame, between the attitudes heard so far."""
        if len(self.heard) < 2:
            return np.empty((0, 3))
        attitudes = Rotation.concatenate([attitude_of(message) for message in self.heard])
        turns = (attitudes[1:] * attitudes[:-1].inv()).as_rotvec()
        return -turns / (np.diff(stamps(self.heard)) * 1e-9)[:, None]


def test_the_mount_obeys_and_stops_when_commands_go_stale(monkeypatch):
    wanted = np.array([2e-3, -3e-3, 1e-3])
    with Watched(monkeypatch, "-p", "mount_timeout_s:=0.4") as graph:
        graph.until(lambda: graph.moves(STILL, 2))
        graph.command_until_obeyed(*wanted)
        last_s, count = time.monotonic(), len(graph.heard)
        graph.until(lambda: graph.moves(STILL))
        stopped_s = time.monotonic() - last_s
        graph.until(lambda: len(graph.heard) > count + 12)
        assert graph.moves(STILL, 3)
        kept = graph.rates()[count - 1 : count + 2]
    # It went on until the timeout, 0.4 s after the last command, which was at most 0.1 s before
    # the last frame that had been heard then.
    np.testing.assert_allclose(kept, [wanted] * 3, atol=PERIODIC)
    # Timeout, latency, deceleration and two frames: 0.76 s; the rest is for a busy machine.
    assert 0.3 < stopped_s < 3


def test_a_command_that_is_not_a_number_stops_the_mount(monkeypatch):
    with Watched(monkeypatch, "-p", "mount_timeout_s:=60.0") as graph:
        for bad in (float("nan"), float("inf")):
            graph.command(0.0, 3e-3, 0.0)
            graph.until(lambda: graph.moves((0, 3e-3, 0)))
            graph.command(0.0, bad, 1e-3)
            graph.until(lambda: graph.moves(STILL, 3))


def test_a_command_counts_on_the_scenarios_clock(monkeypatch):
    # Four times as fast: commands are rad per second of the stamps.
    with Watched(monkeypatch, "-p", "rate:=4.0", "-p", "mount_timeout_s:=4.0") as graph:
        begun_s, first = time.monotonic(), len(graph.heard)
        graph.command_until_obeyed(0.0, 3e-3, 0.0)
        frames, seconds = len(graph.heard) - first, time.monotonic() - begun_s
        # A tenth of a second of the scenario between stamps, 40 frames a second between arrivals.
        assert np.allclose(np.diff(stamps(graph.heard)), 1e8)
        assert frames <= 40 * seconds + 10
        graph.until(lambda: graph.moves(STILL))


def test_a_frame_comes_when_its_exposure_is_over(monkeypatch):
    begun_ns = time.time_ns()
    with Watched(monkeypatch, exposure_s=0.1) as graph:
        graph.until(lambda: len(graph.heard) >= 4)
        now_ns = time.time_ns()
    # Half an exposure after the stamp, at least.
    assert stamps(graph.heard)[0] >= begun_ns + 50_000_000
    assert stamps(graph.heard)[-1] + 50_000_000 <= now_ns


def test_the_guides_scenario_shows_its_rso(monkeypatch):
    kinds = {"image": Image, "camera_info": CameraInfo, "rso_truth": PointCloud2}
    with Watched(monkeypatch, width=128, height=128) as graph:
        heard = {topic: graph.listen(kind, topic) for topic, kind in kinds.items()}
        graph.until(lambda: all(len(found) >= 4 for found in heard.values()))
    (row,) = messages.cloud_array(heard["rso_truth"][0])
    # 0.2 deg/s at 10 arcsec a pixel, and the mount tracks the stars.
    assert np.hypot(row["rel_u_rate"], row["rel_v_rate"]) == pytest.approx(72, rel=0.01)
    assert np.hypot(row["u_rate"], row["v_rate"]) == pytest.approx(72, rel=0.01)
    assert 30 < row["snr"] < 50
    camera = Camera.from_message(heard["camera_info"][0])
    assert camera.matrix[0, 0] == pytest.approx(1 / np.radians(10 / 3600))
    assert decode_message(heard["image"][0]).shape == (128, 128)


def test_without_a_mount_nobody_listens_to_commands():
    with Graph("-p", "scenario:=sidereal") as graph:
        simulator = graph.add(Simulator(threading.Event(), context=graph.context))
        subscribed = simulator.get_subscriber_names_and_types_by_node("simulator", "/")
    assert "/mount_rate" not in dict(subscribed)
