# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The simulator node: a simulated telescope camera, with the truth of what it sees.

Takes the place of a camera driver and, in the scenarios that have one, of a mount; ``simulation``
renders.  Stamps run evenly on the scenario's own clock from the time of the start, so that
displacement over time is the true velocity.  As of a real camera, a frame comes when its exposure
is over.

A ``mount_rate`` counts from the time on that clock at which it arrives, whatever its header says;
the mount starts to obey its latency later.  At a `rate` other than 1 the scenario runs faster or
slower than real time, and so does the mount: commands are still rad per second of the stamps'
clock, while whatever lies between frame and command (rendering, detection, transport) and is
measured in real time lasts `rate` times as long for it, as does a guide's pause between commands.
"""

from __future__ import annotations

import threading
import time
from collections import deque

import numpy as np
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from ofsat_ros.camera import Camera, to_radec
from ofsat_ros.detection import CONFIRMED
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.ros_parameters import NodeParameters
from ofsat_ros.nodes.runtime import lifetime, parser_of, run
from ofsat_ros.nodes.topics import advertise, hear
from ofsat_ros.parameters import SimulatorParameters
from ofsat_ros.simulation import SimulatedFrame, SimulatedMount, SphereSimulator, scenario

_FRAME_ID = "camera_optical_frame"
_DEPTH = 10
# A machine that cannot keep up renders late, not in bursts: by so much it may fall behind.
_MOST_BEHIND_S = 0.2
# s; what is not worth a word.
_LITTLE_BEHIND_S = 0.5


class Simulator(Node):
    """Publishes ``image``, ``camera_info``, ``attitude`` and ``rso_truth``; obeys ``mount_rate``.

    Parameters
    ----------
    stop : threading.Event
        Set from outside to end, and by the node after the last frame.
    context : Context, optional
        ROS context; default: the process's.

    Attributes
    ----------
    exit_code : int
        1 if an error ended it, else 0.

    Raises
    ------
    ofsat_ros.parameters.ParameterError
        If a start parameter is bad.
    """

    def __init__(self, stop: threading.Event, context: Context | None = None) -> None:
        super().__init__("simulator", context=context)
        self.exit_code = 0
        self._stop = stop
        self._settings = NodeParameters(self, SimulatorParameters())
        self._own = own = self._settings[SimulatorParameters]
        start_ns = self.get_clock().now().nanoseconds or time.time_ns()
        self._sky = scenario(own.scenario, own.seed, start_stamp_ns=start_ns)
        self._images = advertise(self, Image, "image", _DEPTH)
        self._camera_info = advertise(self, CameraInfo, "camera_info", _DEPTH)
        self._attitude = advertise(self, QuaternionStamped, "attitude", _DEPTH)
        self._truth = advertise(self, PointCloud2, "rso_truth", _DEPTH)
        self._begun_s = time.monotonic()
        self._behind_s, self._say_behind_s = 0.0, _LITTLE_BEHIND_S
        self._mount: SimulatedMount | None = None
        if isinstance(self._sky, SphereSimulator) and isinstance(self._sky.motion, SimulatedMount):
            self._mount = self._sky.motion
            self._mount.timeout_s = own.mount_timeout_s
            self._listen_for_commands()
        self._thread = threading.Thread(target=self._run, name="simulator", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End rendering."""
        self._stop.set()
        self._thread.join(0.5)

    def _listen_for_commands(self) -> None:
        # From the callback's thread to that which renders and has the mount for itself.
        self._commands: deque[tuple[float, list[float]]] = deque()
        # Takes what any publisher offers; of commands, the newest counts.
        hear(self, TwistStamped, "mount_rate", self._on_mount_rate, _DEPTH, reliable=False)

    def _on_mount_rate(self, message: TwistStamped) -> None:
        rate = message.twist.angular
        self._commands.append((self._now_s(), [rate.x, rate.y, rate.z]))

    def _now_s(self) -> float:
        """Time on the scenario's clock, since its first exposure began."""
        return (time.monotonic() - self._begun_s) * self._own.rate

    def _run(self) -> None:
        own, settings = self._own, self._sky.settings
        self.get_logger().info(
            f"{own.scenario}: {settings.width} x {settings.height} px every"
            f" {settings.period_s / own.rate:g} s on {self._images.topic_name}"
        )
        number = 0
        with lifetime(self, self._stop):
            while number < settings.frames or own.loop:
                due_s = number * settings.period_s + settings.exposure_s
                late_s = (self._now_s() - due_s) / own.rate
                if late_s > _MOST_BEHIND_S:
                    self._fall_behind(late_s - _MOST_BEHIND_S)
                self._stop.wait(max(0.0, -late_s))
                if self._stop.is_set():
                    return
                self._publish(self._render())
                number += 1
            self._images.wait_for_all_acked(Duration(seconds=10))

    def _fall_behind(self, seconds: float) -> None:
        """Have stamps stay behind the clock by so much more; say so whenever it has doubled."""
        self._begun_s += seconds
        self._behind_s += seconds
        if self._behind_s >= self._say_behind_s:
            self._say_behind_s = 2 * self._behind_s
            self.get_logger().warning(
                "this machine renders slower than the camera exposes: stamps are"
                f" {self._behind_s:.1f} s behind the clock; lower the rate, or use fewer or"
                " smaller frames"
            )

    def _render(self) -> SimulatedFrame:
        if self._mount is not None:
            self._tell(self._mount)
        return self._sky.frame()

    def _tell(self, mount: SimulatedMount) -> None:
        """Hand over the commands that have come since the frame before."""
        while self._commands:
            time_s, rate = self._commands.popleft()
            # Behind, if the clock was put back, or while a frame was being rendered.
            problem = mount.command(max(time_s, mount.time_s), rate)
            if problem:
                self.get_logger().warning(f"mount_rate: {problem}", throttle_duration_sec=5.0)

    def _publish(self, frame: SimulatedFrame) -> None:
        header = Header(stamp=messages.time_message(frame.stamp_ns), frame_id=_FRAME_ID)
        self._truth.publish(truth_cloud(header, frame, self._sky.camera))
        self._camera_info.publish(camera_info(header, self._sky.camera))
        message = QuaternionStamped(header=header)
        q = message.quaternion
        q.x, q.y, q.z, q.w = frame.attitude.as_quat().tolist()
        self._attitude.publish(message)
        self._images.publish(messages.image_message(header, frame.image))


def camera_info(header: Header, camera: Camera) -> CameraInfo:
    """Return the calibration of an ideal camera, which has no distortion."""
    info = CameraInfo(header=header, width=camera.width, height=camera.height)
    info.distortion_model, info.d = "plumb_bob", [0.0] * 5
    info.k = camera.matrix.ravel().tolist()
    info.r = np.eye(3).ravel().tolist()
    info.p = np.column_stack([camera.matrix, np.zeros(3)]).ravel().tolist()
    return info


def truth_cloud(header: Header, frame: SimulatedFrame, camera: Camera) -> PointCloud2:
    """Return a frame's truth in the layout of ``rso_detections``; ``id`` is the RSO's number.

    Directions are those of where the RSO is in the image, its jitter included.
    """
    truth = frame.truth
    rows = messages.cloud_rows(len(truth))
    columns = {"u": "x_px", "v": "y_px", "u_rate": "vx_px_s", "v_rate": "vy_px_s"}
    for field, column in (columns | {"snr": "snr", "flux": "flux", "id": "id"}).items():
        rows[field] = truth[column]
    rows["length"] = truth["length_px"]
    angle = np.arctan2(rows["v_rate"], rows["u_rate"])
    # A streak has no head: its angle lies within (-pi/2, pi/2].
    rows["angle"] = np.pi / 2 - np.mod(np.pi / 2 - angle, np.pi)
    rows["rel_u_rate"], rows["rel_v_rate"] = frame.relative_velocity_px_s.T
    sight = camera.lines_of_sight(np.stack([truth["x_px"], truth["y_px"]], axis=-1))
    rows["x"], rows["y"], rows["z"] = sight.T
    rows["ra"], rows["dec"] = to_radec(sight, frame.attitude)
    rows["sigma_u"] = rows["sigma_v"] = 0.0
    rows["status"] = CONFIRMED
    return messages.cloud_message(header, rows)


def main() -> int:
    """Run the node; return the exit code."""
    return run(
        lambda stop, options: Simulator(stop),
        parser_of("simulator", "Simulate a telescope camera."),
    )
