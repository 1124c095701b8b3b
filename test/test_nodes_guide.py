# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The guide node over real DDS: what it tells a mount, and what it says of itself."""

import math
import re
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped, Vector3Stamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_graph import Graph, Process
from rosgraph_msgs.msg import Clock as ClockMessage
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from ofsat_ros.camera import to_radec
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.guide import GuideNode
from ofsat_ros.tracking import TRACK_DTYPE

ARCSEC = math.radians(1 / 3600)
FOCAL_PX = 1 / (10 * ARCSEC)
FRAME_ID = "north_optical_frame"
DOCS = Path(__file__).parents[1] / "docs" / "integration.md"


def camera_info(focal_px: float = FOCAL_PX) -> CameraInfo:
    k = [focal_px, 0.0, 255.5, 0.0, focal_px, 255.5, 0.0, 0.0, 1.0]
    return CameraInfo(width=512, height=512, k=k, distortion_model="plumb_bob", d=[0.0] * 5)


def tracks(*given: dict) -> np.ndarray:
    """Tracks seen at the boresight, unless told otherwise; they go right at 72 px/s."""
    rows = np.zeros(len(given), TRACK_DTYPE)
    usual = {"track_id": 1, "status": 1, "x": 255.5, "y": 255.5, "rel_vx": 72.0, "flux": 100.0}
    usual["sight"] = (0.0, 0.0, 1.0)
    for row, own in zip(rows, given, strict=True):
        for name, value in (usual | own).items():
            row[name] = value
    return rows


class Bench:
    """A guide, and what surrounds it: its inputs are published whenever the graph is served."""

    def __init__(self, *arguments: str) -> None:
        self.graph = Graph(*arguments)
        self.guide = self.graph.add(GuideNode(context=self.graph.context))
        self.offsets = self.graph.listen(Vector3Stamped, "target_offset")
        self.rates = self.graph.listen(Vector3Stamped, "target_rate")
        self.mount = self.graph.listen(TwistStamped, "mount_rate")
        self.diagnostics = self.graph.listen(DiagnosticArray, "/diagnostics")
        self._clouds = self.graph.publisher(PointCloud2, "rso_tracks")
        self._infos = self.graph.publisher(CameraInfo, "camera_info", best_effort=True)
        self.graph.connect(self._clouds, self._infos)
        self.rows = tracks({})
        self.info: CameraInfo | None = camera_info()
        self.behind_s = 0.0
        self._sent_s = 0.0

    def __enter__(self) -> "Bench":
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.__exit__()

    def until(self, condition) -> None:
        def served() -> bool:
            self._send()
            return condition()

        self.graph.until(served)

    def _send(self) -> None:
        """Ten frames a second."""
        if time.monotonic() - self._sent_s < 0.1:
            return
        self._sent_s = time.monotonic()
        if self.info is not None:
            self._infos.publish(self.info)
        if self.rows is not None:
            now_ns = self.guide.get_clock().now().nanoseconds
            stamp = messages.time_message(now_ns - round(self.behind_s * 1e9))
            self._clouds.publish(
                messages.tracks_cloud(Header(stamp=stamp, frame_id=FRAME_ID), self.rows)
            )

    def until_state(self, state: str) -> dict[str, str]:
        """Wait until the node says this state; return its values, with the message and level."""
        self.diagnostics.clear()
        self.until(lambda: self.diagnostics and self.last["state"] == state)
        return self.last

    @property
    def last(self) -> dict[str, str]:
        (status,) = self.diagnostics[-1].status
        values = {value.key: value.value for value in status.values}
        return {"state": "", **values, "message": status.message, "level": status.level}

    def message(self) -> str:
        return self.last["message"] if self.diagnostics else ""

    def engage(self, on: bool) -> SetBool.Response:
        return self.graph.call(SetBool, "/guide/engage", SetBool.Request(data=on))

    def set(self, **values) -> None:
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParameters.Request(parameters=given)
        response = self.graph.call(SetParameters, "/guide/set_parameters", request)
        assert all(result.successful for result in response.results)


@pytest.fixture
def bench():
    with Bench("-p", "stale_after_s:=0.5", "-p", "decay_s:=0.2") as made:
        yield made


def angular(message: TwistStamped) -> np.ndarray:
    rate = message.twist.angular
    return np.array([rate.x, rate.y, rate.z])


def test_disengaged_measures_but_does_not_command(bench):
    bench.rows = tracks({"x": 275.5, "y": 245.5, "vx": 3.0, "vy": -2.0})
    bench.until(lambda: "disengaged; following: track 1" in bench.message())
    assert bench.last["level"] == DiagnosticStatus.OK
    bench.until(lambda: bench.rates and math.isfinite(bench.rates[-1].vector.x))
    offset, rate = bench.offsets[-1], bench.rates[-1]
    assert offset.header.frame_id == rate.header.frame_id == FRAME_ID
    # 20 px right and 10 px up of the boresight, and 0.1 s of its motion older at most.
    seen = np.array([offset.vector.x, offset.vector.y, offset.vector.z]) * FOCAL_PX
    np.testing.assert_allclose(seen, (20, -10, 0), atol=1.5)
    np.testing.assert_allclose(rate.vector.x * FOCAL_PX, 3, atol=0.1)
    np.testing.assert_allclose(rate.vector.y * FOCAL_PX, -2, atol=0.1)
    assert not bench.mount


def test_engaged_follows_and_disengaged_comes_to_rest(bench):
    bench.until_state("disengaged")
    assert bench.engage(True).success
    bench.until(lambda: bench.mount and angular(bench.mount[-1])[1] > 0.15 * math.pi / 180)
    assert bench.mount[-1].header.frame_id == FRAME_ID
    assert bench.until_state("following")["engaged"] == "True"
    # To the right: about +y.  It stands at the boresight, so the rate is its own: 0.2 deg/s.
    np.testing.assert_allclose(np.degrees(angular(bench.mount[-1])), (0, 0.2, 0), atol=0.02)
    # It does not move in the image, but against the stars: so does the camera, they say.
    bench.until(lambda: float(bench.last["mount_rate_y_deg_s"]) > 0.19)
    assert float(bench.last["mount_rate_seen_y_deg_s"]) == pytest.approx(0.2, rel=0.01)
    assert float(bench.last["mount_rate_seen_x_deg_s"]) == pytest.approx(0.0, abs=1e-6)

    response = bench.engage(False)
    assert "brought to rest" in response.message
    heard = len(bench.mount)
    bench.until(lambda: not angular(bench.mount[-1]).any())
    zeros_s = time.monotonic()
    last = [len(bench.mount), zeros_s]

    def silent() -> bool:
        if len(bench.mount) != last[0]:
            last[:] = len(bench.mount), time.monotonic()
        return time.monotonic() - last[1] > 0.5

    bench.until(silent)
    assert len(bench.mount) > heard
    # Zeros for a second, and then nothing: another may drive the mount.
    assert last[1] - zeros_s == pytest.approx(1.0, abs=0.5)
    assert not any(angular(message).any() for message in bench.mount[-5:])


def test_rate_comes_to_zero_without_tracks(bench):
    bench.engage(True)
    bench.until(lambda: bench.mount and angular(bench.mount[-1]).any())
    bench.rows = None
    said = bench.until_state("dead-man")
    assert said["level"] == DiagnosticStatus.WARN
    assert "track 1 was not seen for" in said["message"]
    bench.until(lambda: not angular(bench.mount[-1]).any())
    assert math.isnan(bench.offsets[-1].vector.x)
    # It is engaged: the mount goes on to be told to rest.
    heard = len(bench.mount)
    bench.until(lambda: len(bench.mount) > heard + 3)
    bench.rows = tracks({})
    bench.until_state("following")


def test_nan_tracks_are_not_followed(bench):
    bench.engage(True)
    bench.rows = tracks({"x": math.nan}, {"track_id": 2, "rel_vx": math.nan})
    assert "there is no track" in bench.until_state("searching")["message"]
    heard = len(bench.mount)
    bench.until(lambda: len(bench.mount) > heard + 5)
    assert not any(angular(message).any() for message in bench.mount)


def test_tracks_without_lines_of_sight_are_not_followed(bench):
    # As when camera_info is not for images of this size, which only the detector sees.
    bench.engage(True)
    bench.rows = tracks({"sight": math.nan})
    bench.until(lambda: "the detector gives no lines of sight" in bench.message())
    assert bench.last["state"] == "searching"
    assert not any(angular(message).any() for message in bench.mount)
    bench.rows = tracks({})
    bench.until(lambda: bench.message().startswith("following: track 1"))


def test_target_is_chosen_by_parameter_while_running(bench):
    bench.rows = tracks({}, {"track_id": 5, "x": 300.5}, {"track_id": 6, "flux": 900.0})
    bench.until_state("disengaged")
    for given, wanted in (
        ({"target": "brightest"}, "6"),
        ({"target": "id", "target_id": 5}, "5"),
        ({"target": "first"}, "1"),
    ):
        bench.set(**given)
        bench.until(lambda wanted=wanted: bench.last.get("target_id") == wanted)
    bench.set(target="id", target_id=9)
    bench.until(lambda: "track 9 is not there" in bench.message())


@pytest.mark.parametrize(
    ("info", "why"),
    [(None, "no camera_info has come"), (camera_info(0.0), "not calibrated")],
)
def test_without_calibration_it_waits(bench, info, why):
    bench.info = info
    bench.engage(True)
    said = bench.until_state("waiting for camera_info")
    assert said["level"] == DiagnosticStatus.ERROR
    bench.until(lambda: why in bench.message())
    bench.info = camera_info()
    bench.until_state("following")


def test_clock_that_disagrees_with_the_stamps_is_named(bench):
    bench.behind_s = 40.0
    bench.engage(True)
    bench.until_state("dead-man")
    bench.until(lambda: "frames are stamped 40.0 s behind this node's clock" in bench.message())
    assert not any(angular(message).any() for message in bench.mount)


def test_a_state_that_flickers_is_logged_seldom_and_how_it_ends(bench, monkeypatch, capfd):
    """As when frames come just as late as is allowed."""
    now_s = 1000.0
    with monkeypatch.context() as patch:
        patch.setattr("time.monotonic", lambda: now_s)
        for tick in range(200):
            now_s = 1000 + tick / 25
            state = ("following", "dead-man")[min(tick, 99) % 2]
            bench.guide._say_aloud(SimpleNamespace(state=state, target_id=7, reason=f"{state} 7"))
        now_s += 10
        bench.guide._say_aloud(SimpleNamespace(state="following", target_id=7, reason="back to 7"))
    assert re.findall(r"following 7|dead-man 7|back to 7", capfd.readouterr().err) == [
        *("following 7", "dead-man 7", "back to 7")
    ]


def test_clock_that_is_set_back_silences_nothing():
    with Bench("-p", "use_sim_time:=true") as bench:
        clock = bench.graph.publisher(ClockMessage, "/clock", best_effort=True)
        bench.graph.connect(clock)

        def until(condition, at_s: float, speed: float = 1.0) -> None:
            begun_s = time.monotonic()

            def served() -> bool:
                now_ns = round((at_s + speed * (time.monotonic() - begun_s)) * 1e9)
                clock.publish(ClockMessage(clock=messages.time_message(now_ns)))
                return condition()

            bench.until(served)

        bench.engage(True)
        until(lambda: bench.mount and angular(bench.mount[-1]).any(), 5000)
        # An hour would have to go by on the clock.
        until(lambda: bench.mount[-1].header.stamp.sec < 2000, 1400)
        until(lambda: bench.message().startswith("following"), 1500)
        # Where it stands still, nothing is sent, and the mount stops of itself.
        until(lambda: bench.mount[-1].header.stamp.sec == 1600, 1600, 0)
        heard, end_s = len(bench.mount), time.monotonic() + 0.3
        until(lambda: time.monotonic() > end_s, 1600, 0)
        assert len(bench.mount) == heard


def test_nothing_is_commanded_after_the_last_zero(bench):
    bench.engage(True)
    bench.until(lambda: bench.mount and angular(bench.mount[-1]).any())
    bench.guide.close()
    bench.until(lambda: not angular(bench.mount[-1]).any())
    heard, end_s = len(bench.mount), time.monotonic() + 0.3
    # What calls back once more, from another thread, says nothing.
    bench.until(lambda: time.monotonic() > end_s)
    assert len(bench.mount) == heard


def test_another_that_commands_the_mount_is_named(bench):
    bench.engage(True)
    bench.graph.publisher(TwistStamped, "mount_rate")
    bench.until(lambda: "1 more publish /mount_rate" in bench.message())


def test_what_is_no_cloud_of_tracks_is_left_out(bench):
    bench.until_state("disengaged")
    bench._clouds.publish(PointCloud2(width=3, height=1, point_step=1))
    bench.until_state("disengaged")


def test_process_stops_the_mount_at_its_end(tmp_path):
    with Graph() as graph:
        mount = graph.listen(TwistStamped, "mount_rate")
        arguments = ("--ros-args", "-p", "engaged:=true", "-p", "command_hz:=10.0")
        with Process(tmp_path, "guide", *arguments) as guide:
            graph.until(lambda: len(mount) > 3)
            graph.serve(0.3)
            heard = len(mount)
            guide.end(2)
            assert guide.wait() == 0
            graph.until(lambda: len(mount) > heard)
    assert not angular(mount[-1]).any()


def test_bad_parameter_is_refused(tmp_path):
    arguments = ("--ros-args", "-p", "target:=largest")
    with Process(tmp_path, "guide", *arguments) as guide:
        assert guide.wait() == 2
        assert "target must be one of first | brightest | nearest | id" in guide.err


# The example of the docs


class Mount:
    """What the example drives."""

    def __init__(self, declination: float) -> None:
        self.moves: list[tuple[float, float]] = []
        self._declination = declination

    def declination(self) -> float:
        return self._declination

    def move(self, hour_angle_rate: float, declination_rate: float) -> None:
        self.moves.append((hour_angle_rate, declination_rate))


@pytest.fixture(scope="module")
def example() -> dict:
    """What the page's mount-control node defines."""
    page = DOCS.read_text(encoding="utf-8")
    (code,) = (c for c in re.findall(r"```python\n(.*?)```", page, re.S) if "MountControl" in c)
    names: dict = {}
    exec(code, names)
    return names


def attitude(ra: float, dec: float, roll: float) -> Rotation:
    """ICRS -> optical frame of a camera in whose image north is `roll` to the right of up."""
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    west = np.array([np.sin(ra), -np.cos(ra), 0.0])
    ahead = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    right = west * np.cos(roll) + north * np.sin(roll)
    down = west * np.sin(roll) - north * np.cos(roll)
    return Rotation.from_matrix([right, down, ahead])


@pytest.mark.parametrize("roll", [0.0, 0.7, -2.5])
def test_documented_node_turns_the_camera_as_told(example, roll):
    rate, dec = np.array([0.002, -0.005, 0.0]), 0.9
    mount = Mount(dec)
    with Graph() as graph:
        graph.add(example["MountControl"](mount, roll, context=graph.context))
        commands = graph.publisher(TwistStamped, "mount_rate")
        graph.connect(commands)
        message = TwistStamped()
        message.twist.angular.x, message.twist.angular.y, message.twist.angular.z = rate.tolist()
        commands.publish(message)
        graph.until(lambda: mount.moves)
        hour_angle_rate, declination_rate = mount.moves[0]
        # Nobody speaks any more: it tracks the stars, and says so once.
        graph.until(lambda: len(mount.moves) == 2)
        assert mount.moves[1] == (pytest.approx(7.2921e-5, rel=1e-4), 0.0)
        graph.serve(0.3)
        assert len(mount.moves) == 2
    seconds = 1e-3
    turned = Rotation.from_rotvec(-rate * seconds) * attitude(1.0, dec, roll)
    (ra_after,), (dec_after,) = to_radec(np.array([[0.0, 0.0, 1.0]]), turned)
    # RA is sidereal time less hour angle.
    stars = example["SIDEREAL"]
    assert (stars - hour_angle_rate) * seconds == pytest.approx(ra_after - 1.0, rel=1e-3)
    assert declination_rate * seconds == pytest.approx(dec_after - dec, rel=1e-3)
