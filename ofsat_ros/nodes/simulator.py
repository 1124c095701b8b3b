"""The simulator node: a simulated telescope camera, with the truth of what it sees.

Takes the place of a camera driver; ``simulation`` renders.  Stamps run evenly on the scenario's
own clock from the time of the start, so that displacement over time is the true velocity.
"""

from __future__ import annotations

import math
import sys
import threading
import time

import numpy as np
from geometry_msgs.msg import QuaternionStamped
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.ros_parameters import NodeParameters
from ofsat_ros.nodes.runtime import lifetime, overridable_qos, parser_of, reliable, run
from ofsat_ros.parameters import SimulatorParameters
from ofsat_ros.simulation import SimulatedFrame, SkySimulator, scenario

_FRAME_ID = "camera_optical_frame"
_DEPTH = 10
_ARCSEC = math.radians(1 / 3600)
_NS = 1_000_000_000


class Simulator(Node):
    """Publishes ``image``, ``camera_info``, ``attitude`` and ``rso_truth``.

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
        own = self._settings[SimulatorParameters]
        start_ns = self.get_clock().now().nanoseconds or time.time_ns()
        self._sky = scenario(own.scenario, own.seed, start_stamp_ns=start_ns)
        self._images = self._publisher(Image, "image")
        self._camera_info = self._publisher(CameraInfo, "camera_info")
        self._attitude = self._publisher(QuaternionStamped, "attitude")
        self._truth = self._publisher(PointCloud2, "rso_truth")
        self._thread = threading.Thread(target=self._run, name="simulator", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End rendering."""
        self._stop.set()
        self._thread.join(0.5)

    def _publisher(self, kind: type, topic: str):
        return self.create_publisher(
            kind, topic, reliable(_DEPTH), qos_overriding_options=overridable_qos()
        )

    def _run(self) -> None:
        own = self._settings[SimulatorParameters]
        settings = self._sky.settings
        self.get_logger().info(
            f"{own.scenario}: {settings.width} x {settings.height} px every"
            f" {settings.period_s / own.rate:g} s on {self._images.topic_name}"
        )
        due_s = time.monotonic()
        number = 0
        with lifetime(self, self._stop):
            while number < settings.frames or own.loop:
                header, frame, attitude = self._render()
                self._stop.wait(max(0.0, due_s - time.monotonic()))
                if self._stop.is_set():
                    return
                self._publish(header, frame, attitude)
                number += 1
                # A machine that cannot keep up renders late, not in bursts.
                due_s = max(due_s, time.monotonic() - 1.0) + settings.period_s / own.rate
            self._images.wait_for_all_acked(Duration(seconds=10))

    def _render(self) -> tuple[Header, SimulatedFrame, np.ndarray]:
        """Expose a frame; with it the attitude in the middle of the exposure."""
        sky, settings = self._sky, self._sky.settings
        before = np.array([*sky.pointing_arcsec, sky.field_angle_rad])
        frame = sky.frame()
        after = np.array([*sky.pointing_arcsec, sky.field_angle_rad])
        middle = before + (after - before) * settings.exposure_s / 2 / settings.period_s
        stamp = messages.time_message(frame.stamp_ns)
        return Header(stamp=stamp, frame_id=_FRAME_ID), frame, attitude_of(*middle)

    def _publish(self, header: Header, frame: SimulatedFrame, attitude: np.ndarray) -> None:
        self._truth.publish(truth_cloud(header, frame, self._sky))
        self._camera_info.publish(camera_info(header, self._sky))
        message = QuaternionStamped(header=header)
        q = message.quaternion
        q.w, q.x, q.y, q.z = attitude.tolist()
        self._attitude.publish(message)
        self._images.publish(messages.image_message(header, frame.image))


def camera_info(header: Header, sky: SkySimulator) -> CameraInfo:
    """Return an ideal camera's calibration: the focal length in px is 1 / (pixel scale in rad)."""
    settings = sky.settings
    focal_px = 1 / (settings.pixel_scale_arcsec * _ARCSEC)
    x, y = (settings.width - 1) / 2, (settings.height - 1) / 2
    info = CameraInfo(header=header, width=settings.width, height=settings.height)
    info.distortion_model, info.d = "plumb_bob", [0.0] * 5
    info.k = [focal_px, 0.0, x, 0.0, focal_px, y, 0.0, 0.0, 1.0]
    info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    info.p = [focal_px, 0.0, x, 0.0, 0.0, focal_px, y, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


def truth_cloud(header: Header, frame: SimulatedFrame, sky: SkySimulator) -> PointCloud2:
    """Return a frame's truth in the layout of ``rso_detections``; ``id`` is the RSO's number."""
    truth, settings = frame.truth, sky.settings
    rows = messages.cloud_rows(len(truth))
    columns = {"u": "x_px", "v": "y_px", "u_rate": "vx_px_s", "v_rate": "vy_px_s"}
    for field, column in (columns | {"snr": "snr", "flux": "flux", "id": "id"}).items():
        rows[field] = truth[column]
    rows["length"] = truth["length_px"]
    angle = np.arctan2(rows["v_rate"], rows["u_rate"])
    # A streak has no head: its angle lies within (-pi/2, pi/2].
    rows["angle"] = np.pi / 2 - np.mod(np.pi / 2 - angle, np.pi)
    camera_rate = np.array(sky.camera_rate_arcsec_s) / settings.pixel_scale_arcsec
    turn = settings.field_rotation_rad_s
    rows["rel_u_rate"] = rows["u_rate"] + camera_rate[0]
    rows["rel_u_rate"] += turn * (rows["v"] - (settings.height - 1) / 2)
    rows["rel_v_rate"] = rows["v_rate"] + camera_rate[1]
    rows["rel_v_rate"] -= turn * (rows["u"] - (settings.width - 1) / 2)
    rows["sigma_u"] = rows["sigma_v"] = 0.0
    rows["status"] = CONFIRMED
    return messages.cloud_message(header, rows)


def attitude_of(x_arcsec: float, y_arcsec: float, angle_rad: float) -> np.ndarray:
    """Return the rotation ICRS -> optical frame as a quaternion (w, x, y, z).

    It turns coordinates: a direction d in ICRS is q d q* in the optical frame (x right, y down,
    z forward).  The simulated sky is a plane without a place among the stars; its origin is taken
    to be at right ascension 0, declination 0, its x axis to the west and its y axis to the south,
    so that the image at field angle 0 has north up and east to the left.

    Parameters
    ----------
    x_arcsec, y_arcsec : float
        Where the camera points on the plane.
    angle_rad : float
        Turn of the field in the image, x axis towards y axis.
    """
    ra, dec = -x_arcsec * _ARCSEC, -y_arcsec * _ARCSEC
    # Base axes at RA 0, dec 0 (x = -Y, y = -Z, z = X of ICRS), then about them: first the sky is
    # turned by -RA about the pole, then by the declination about the image's x axis, then rolled.
    base = np.array([0.5, 0.5, -0.5, 0.5])
    turned = _product(base, _about(2, -ra))
    tilted = _product(_about(0, -dec), turned)
    return _product(_about(2, angle_rad), tilted)


def _about(axis: int, angle: float) -> np.ndarray:
    quaternion = np.zeros(4)
    quaternion[0], quaternion[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
    return quaternion


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product: first b, then a."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.array([scalar, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def main() -> int:
    """Run the node; return the exit code."""
    return run(
        lambda stop, options: Simulator(stop),
        parser_of("simulator", "Simulate a telescope camera."),
    )


if __name__ == "__main__":
    sys.exit(main())
