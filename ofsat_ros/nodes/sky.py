# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The detector's calibration and attitude: two topics in, the directions of what it finds out.

Callbacks put in what comes, the detector's worker asks for directions: hence the lock.  How
pixels become directions is ``camera``'s.
"""

from __future__ import annotations

import threading

import numpy as np
from geometry_msgs.msg import QuaternionStamped
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from ofsat_ros.camera import Astrometry, Camera, CameraError, rotation_of
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.causes import Causes
from ofsat_ros.nodes.topics import hear, hear_camera_info
from ofsat_ros.parameters import CameraParameters
from ofsat_ros.printing import printable

# Small messages, of which one thread may be late in taking many.
_DEPTH = 1000


class Sky:
    """Where the detector's camera looks.

    Parameters
    ----------
    node : Node
        Subscribes to ``camera_info`` and ``attitude``.
    parameters : CameraParameters
    reliable_input : bool
        Ask for attitudes as for the images: reliable; else best effort, which hears every sender.
    """

    def __init__(self, node: Node, parameters: CameraParameters, reliable_input: bool) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._astrometry = Astrometry(parameters)
        self._info: CameraInfo | None = None
        self._uncalibrated = "no camera_info has come"
        self._has_attitude = self._was_calibrated = False
        self._bad_calibrations, self._bad_attitudes = Causes(), Causes()
        hear_camera_info(node, self._on_camera_info)
        hear(
            node, QuaternionStamped, "attitude", self._on_attitude, _DEPTH, reliable=reliable_input
        )

    def look_around(self) -> None:
        """Say once where calibrations are, if nobody sends one where this node listens."""
        topic = self._node.resolve_topic_name("camera_info")
        if self._info is not None or self._node.count_publishers(topic):
            return
        found = [
            printable(name)
            for name, kinds in self._node.get_topic_names_and_types()
            if "sensor_msgs/msg/CameraInfo" in kinds and self._node.count_publishers(name)
        ]
        if not found:
            return
        why = f"nobody sends {topic}; remap camera_info (and attitude) to {' or '.join(found)}"
        with self._lock:
            said, self._uncalibrated = self._uncalibrated, why
        if said != why:
            self._node.get_logger().info(f"directions are unknown: {why}")

    def set_parameters(self, parameters: CameraParameters) -> None:
        """Take new parameters, from the next frame on."""
        with self._lock:
            self._astrometry.parameters = parameters

    def middle_ns(self, stamp_ns: int) -> int:
        """Return the middle of the exposure of the image with a stamp, ns UTC."""
        with self._lock:
            return self._astrometry.middle_ns(stamp_ns)

    def locate(
        self, middle_ns: int, shape: tuple[int, int], *tables: np.ndarray
    ) -> tuple[str, bool]:
        """Fill in the directions of detections and tracks.

        Parameters
        ----------
        middle_ns : int
            Middle of the exposure, ns UTC.
        shape : (height, width)
            Of the image, px.
        *tables : DETECTION_DTYPE or TRACK_DTYPE

        Returns
        -------
        why : str
            Why directions, or a part of them, are unknown; empty if they are known.
        wrong : bool
            Whether that is a fault: what is missing was there, or does not fit.
        """
        with self._lock:
            camera = self._astrometry.camera
            if camera is None:
                return self._uncalibrated, self._was_calibrated
            if (camera.height, camera.width) != shape:
                return (
                    f"camera_info is for images of {camera.width}x{camera.height}, not of"
                    f" {shape[1]}x{shape[0]}"
                ), True
            why = [self._astrometry.locate(table, middle_ns) for table in tables]
            return why[0], self._has_attitude and bool(why[0])

    def _on_camera_info(self, info: CameraInfo) -> None:
        # It comes with every image, mostly the same; the header tells nothing here.
        info.header = Header()
        if info == self._info:
            return
        camera, why = None, ""
        try:
            camera = Camera.from_message(info)
        except CameraError as error:
            why = f"camera_info: {error}"
            if self._bad_calibrations.wrong(str(error)):
                self._node.get_logger().info(f"{why}; directions are unknown")
        else:
            self._bad_calibrations.right()
        with self._lock:
            self._info, self._uncalibrated = info, why
            self._astrometry.camera = camera
            self._was_calibrated |= camera is not None

    def _on_attitude(self, message: QuaternionStamped) -> None:
        q = message.quaternion
        try:
            rotation = rotation_of(q.x, q.y, q.z, q.w)
        except CameraError as error:
            if self._bad_attitudes.wrong(str(error)):
                self._node.get_logger().warning(f"an attitude is left out: {error}")
            return
        if count := self._bad_attitudes.right():
            self._node.get_logger().info(f"attitudes are good again, after {count} left out")
        with self._lock:
            self._has_attitude = True
            self._astrometry.add_attitude(messages.stamp_ns(message.header.stamp), rotation)
