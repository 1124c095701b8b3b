# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The detector's directions: calibration and attitude in over DDS, x y z, ra and dec out."""

import itertools

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from rclpy.parameter import Parameter
from ros_graph import Graph
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from ofsat_ros.nodes import messages
from ofsat_ros.nodes.detector import Detector
from ofsat_ros.simulation import scenario

FRAME_ID = "camera_optical_frame"
WIDTH, HEIGHT = 160, 128
FOCAL_PX = 40_000.0
FIRST_NS = 1_767_225_600_000_000_000
PERIOD_NS = 500_000_000


def attitude_at(stamp_ns: int) -> Rotation:
    return Rotation.from_euler("zxz", [1e-3 * (stamp_ns - FIRST_NS) / 1e9, 0.5, 2.0])


def header(stamp_ns: int) -> Header:
    return Header(stamp=messages.time_message(stamp_ns), frame_id=FRAME_ID)


class Camera:
    """A probe that plays camera and mount: six frames in which RSOs are found."""

    def __init__(self, graph: Graph, detector: Detector) -> None:
        self.graph, self.detector = graph, detector
        self.images = [
            frame.image for frame in scenario("survey", 1, frames=6, width=WIDTH, height=HEIGHT)
        ]
        self.clouds = graph.listen(PointCloud2, "rso_detections")
        self.tracks = graph.listen(PointCloud2, "rso_tracks")
        self.states = graph.listen(DiagnosticArray, "/diagnostics")
        self.image = graph.publisher(Image, "image")
        self.info = graph.publisher(CameraInfo, "camera_info")
        self.attitude = graph.publisher(QuaternionStamped, "attitude")
        graph.connect(self.image, self.info, self.attitude)

    def calibrate(self, width: int = WIDTH, focal_px: float = FOCAL_PX) -> None:
        info = CameraInfo(header=header(0), width=width, height=HEIGHT)
        info.distortion_model = "plumb_bob"
        k = [focal_px, 0.0, 80.0, 0.0, focal_px, 60.0, 0.0, 0.0, 1.0]
        info.k = k if focal_px else [0.0] * 9
        self.info.publish(info)

    def point(self, stamp_ns: int, length: float = 1.0) -> None:
        message = QuaternionStamped(header=header(stamp_ns))
        q = message.quaternion
        q.x, q.y, q.z, q.w = (attitude_at(stamp_ns).as_quat() * length).tolist()
        self.attitude.publish(message)

    def expose(self, stamp_ns: int, number: int) -> np.ndarray:
        """Send an image and return the detections of its answer."""
        count = len(self.clouds)
        self.image.publish(messages.image_message(header(stamp_ns), self.images[number]))
        self.graph.until(lambda: len(self.clouds) > count and len(self.tracks) > count)
        return messages.detections_array(self.clouds[-1])

    def state(self, frame: int) -> DiagnosticStatus:
        """Wait for what the detector says of a frame of its own count."""

        def found() -> list[DiagnosticStatus]:
            statuses = [status for array in self.states for status in array.status]
            return [s for s in statuses if _values(s).get("frame") == str(frame)]

        self.graph.until(lambda: bool(found()))
        return found()[-1]


def _values(status: DiagnosticStatus) -> dict[str, str]:
    return {value.key: value.value for value in status.values}


@pytest.fixture
def camera():
    with Graph("-p", "reliable_input:=true") as graph:
        yield Camera(graph, graph.add(Detector(graph.context)))


def run(camera: Camera, point_ms: tuple[int, ...] = (-300, -100)) -> list[np.ndarray]:
    """Expose six frames, each after attitudes at times around its stamp, ms."""
    found = []
    for number in range(6):
        stamp_ns = FIRST_NS + number * PERIOD_NS
        for shift_ms in point_ms:
            camera.point(stamp_ns + shift_ms * 1_000_000)
        # Three topics have no order among them: the detector is to have heard the attitudes.
        camera.graph.serve(0.05)
        found.append(camera.expose(stamp_ns, number))
    return found


def test_directions_are_those_of_pixel_and_attitude(camera):
    camera.calibrate()
    frames = run(camera)
    rows = frames[-1]
    assert len(rows) > 3
    stamp_ns = FIRST_NS + 5 * PERIOD_NS
    for row in (*rows, *messages.tracks_array(camera.tracks[-1])):
        sight = np.array([(row["x"] - 80) / FOCAL_PX, (row["y"] - 60) / FOCAL_PX, 1.0])
        sight /= np.linalg.norm(sight)
        np.testing.assert_allclose(row["sight"], sight, atol=1e-7)  # FLOAT32
        ra, dec = row["ra"], row["dec"]
        icrs = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
        # The attitude was carried on for 0.1 s at a rate that does not change.
        np.testing.assert_allclose(attitude_at(stamp_ns).apply(icrs), sight, atol=1e-10)
    assert camera.clouds[-1].header.stamp == messages.time_message(stamp_ns)
    assert camera.clouds[-1].is_dense
    state = camera.state(5)
    assert state.level == DiagnosticStatus.OK
    assert _values(state)["directions"] == "known"


def test_the_middle_of_the_exposure_counts_and_the_stamp_stays_the_images(camera):
    """Stamps of the start of 0.2 s, by a clock 0.1 s slow: the middle is 0.2 s later."""
    camera.calibrate()
    done = camera.detector.set_parameters(
        [
            Parameter("stamp_reference", value="start"),
            Parameter("exposure_time_s", value=0.2),
            Parameter("stamp_offset_s", value=0.1),
        ]
    )
    assert all(one.successful for one in done)
    rows = run(camera, point_ms=(100, 300))[-1]
    assert len(rows) > 3
    middle_ns = FIRST_NS + 5 * PERIOD_NS + 200_000_000
    for row in rows:
        icrs = [
            np.cos(row["dec"]) * np.cos(row["ra"]),
            np.cos(row["dec"]) * np.sin(row["ra"]),
            np.sin(row["dec"]),
        ]
        sight = attitude_at(middle_ns).apply(icrs)
        np.testing.assert_allclose(sight, row["sight"], atol=1e-7)
    assert messages.stamp_ns(camera.clouds[-1].header.stamp) == FIRST_NS + 5 * PERIOD_NS
    assert _values(camera.state(5))["stamp_ns"] == str(middle_ns)


def test_without_camera_info_or_attitude_nothing_is_wrong(camera):
    rows = run(camera, point_ms=())[-1]
    assert len(rows) > 3
    for name in ("sight", "ra", "dec"):
        assert np.isnan(rows[name]).all()
    state = camera.state(5)
    assert state.level == DiagnosticStatus.OK
    assert _values(state)["directions"] == "no camera_info has come"


def test_calibration_alone_gives_lines_of_sight(camera):
    camera.calibrate()
    rows = run(camera, point_ms=())[-1]
    assert np.isfinite(rows["sight"]).all()
    assert np.isnan(rows["ra"]).all()
    state = camera.state(5)
    assert state.level == DiagnosticStatus.OK
    assert _values(state)["directions"] == "no attitude has come"


def test_an_attitude_that_stays_away_is_a_warning_and_never_a_stale_angle(camera):
    camera.calibrate()
    for ms in (-200, -100):
        camera.point(FIRST_NS + ms * 1_000_000)
    frames = run(camera, point_ms=())
    # 1 s is the default: the newest attitude is 0.1 s old in the first frame, 2.6 s in the last.
    seen = [np.isfinite(rows["ra"]).all() for rows in frames if len(rows)]
    assert not seen[-1]
    assert np.isnan(frames[-1]["ra"]).all()
    assert np.isfinite(frames[-1]["sight"]).all()
    state = camera.state(5)
    assert state.level == DiagnosticStatus.WARN
    assert "the newest attitude is older than attitude_max_age_s" in state.message


@pytest.mark.parametrize(
    ("calibration", "level", "words"),
    [
        ({"focal_px": 0.0}, DiagnosticStatus.OK, "not calibrated"),
        ({"width": 100}, DiagnosticStatus.WARN, "images of 100x128, not of 160x128"),
    ],
    ids=["uncalibrated", "another size"],
)
def test_a_calibration_that_does_not_count_is_said(camera, calibration, level, words):
    camera.calibrate(**calibration)
    rows = run(camera)[-1]
    assert len(rows) > 3
    assert np.isnan(rows["sight"]).all()
    state = camera.state(5)
    assert state.level == level
    assert words in _values(state)["directions"]


def test_an_attitude_that_is_no_rotation_is_left_out(camera):
    camera.calibrate()
    camera.point(FIRST_NS, length=0.5)
    rows = run(camera)[-1]
    assert np.isfinite(rows["ra"]).all()


def test_a_calibration_that_is_elsewhere_is_pointed_at(camera):
    camera.graph.publisher(CameraInfo, "/camera/camera_info")
    camera.graph.probe.destroy_publisher(camera.info)

    def told() -> list[str]:
        statuses = [status for array in camera.states for status in array.status]
        return [_values(status).get("directions", "") for status in statuses]

    stamps_ns = itertools.count(FIRST_NS, PERIOD_NS)

    def is_told() -> bool:
        camera.expose(next(stamps_ns), 0)
        return any("/camera/camera_info" in words for words in told())

    camera.graph.until(is_told)
