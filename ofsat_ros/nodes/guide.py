# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The guide node: the detector's tracks in, commands for a mount out; a shell around ``guidance``.

While it is engaged, ``mount_rate`` comes at `command_hz`; after that, until the rate has come to
zero and a second longer; and then not at all, so that another node may drive the mount.  Frames,
signs, units and what the mount must do itself: docs/integration.md.
"""

from __future__ import annotations

import math
import threading
import time

import numpy as np
from geometry_msgs.msg import TwistStamped, Vector3Stamped
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from ofsat_ros.camera import Astrometry, Camera, CameraError
from ofsat_ros.guidance import Command, Guide
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.causes import Causes, say_left_out
from ofsat_ros.nodes.diagnostics import Diagnostics, nobody_publishes
from ofsat_ros.nodes.ros_parameters import NodeParameters
from ofsat_ros.nodes.runtime import parser_of, run
from ofsat_ros.nodes.topics import advertise, hear, hear_camera_info
from ofsat_ros.parameters import CameraParameters, GuideParameters, Table

# A frame's tracks that come late are of use only if nothing newer has come.
_DEPTH = 10
# s; a state that comes and goes is told of again after so long.
_AGAIN_AFTER_S = 10.0
_NS = 1_000_000_000
# What an engaged guide should be doing.
_GOOD_STATES = ("following", "disengaged")


class GuideNode(Node):
    """Publishes ``target_offset``, ``target_rate`` and ``mount_rate``.

    Parameters
    ----------
    context : Context, optional
        ROS context; default: the process's.

    Raises
    ------
    ofsat_ros.parameters.ParameterError
        If a start parameter is bad.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("guide", context=context)
        self._settings = NodeParameters(
            self, GuideParameters(), CameraParameters(), changed=self._on_change
        )
        own = self._settings[GuideParameters]
        self._guide = Guide(own)
        self._astrometry = Astrometry(self._settings[CameraParameters])
        self._info: CameraInfo | None = None
        self._uncalibrated = "no camera_info has come"
        self._frame_id = ""
        self._frames = self._commands = 0
        self._lag_s = math.nan  # of the newest frame, when it came
        self._command: Command | None = None
        self._said = ""  # state and target that the diagnostics tell
        self._told, self._told_at_s = "", {}  # those that the log tells, and when each was told
        self._lag_is_told = False
        self._without_sight = False
        self._foreign = Causes()  # of messages that are left out
        # Commands and close() come from two threads.
        self._lock = threading.Lock()
        self._closed = False
        self._offset = advertise(self, Vector3Stamped, "target_offset", _DEPTH)
        self._rate = advertise(self, Vector3Stamped, "target_rate", _DEPTH)
        self._mount_rate = advertise(self, TwistStamped, "mount_rate", _DEPTH)
        self._diagnostics = Diagnostics(self, "guidance")
        hear_camera_info(self, self._on_camera_info)
        self._tracks = hear(self, PointCloud2, "rso_tracks", self._on_tracks, _DEPTH)
        self.create_service(SetBool, "~/engage", self._on_engage)
        # A timer of the node's own clock would be silent for as long as that was set back.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1 / own.command_hz, self._on_command_due, clock=steady)
        self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        how = "engaged" if own.engaged else "disengaged; call ~/engage"
        self.get_logger().info(f"waiting for tracks on {self._tracks.topic_name}; {how}")

    def close(self) -> None:
        """Tell the mount to stop, if it hears this node; that is the last it hears."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            if self._command is not None and self._command.commanding:
                self._publish_rate(self._header(), np.zeros(3))

    def _on_change(self, table: Table) -> None:
        if isinstance(table, GuideParameters):
            self._guide.parameters = table
        elif isinstance(table, CameraParameters):
            self._astrometry.parameters = table

    def _on_camera_info(self, info: CameraInfo) -> None:
        # It comes with every image, mostly the same; the header tells nothing here.
        info.header = Header()
        if info == self._info:
            return
        self._info, self._uncalibrated, self._astrometry.camera = info, "", None
        try:
            self._astrometry.camera = Camera.from_message(info)
        except CameraError as error:
            self._uncalibrated = f"camera_info: {error}"

    def _on_tracks(self, cloud: PointCloud2) -> None:
        try:
            tracks = messages.tracks_array(cloud)
        # Whatever others publish under this name must not end what guides a mount.
        except messages.MessageError as error:
            say_left_out(self.get_logger(), self._foreign, self._tracks.topic_name, error)
            return
        self._foreign.right()
        middle_ns = self._astrometry.middle_ns(messages.stamp_ns(cloud.header.stamp))
        self._lag_s = (self._now_ns() - middle_ns) / _NS
        self._frame_id = cloud.header.frame_id
        self._frames += 1
        self._without_sight = len(tracks) > 0 and not np.isfinite(tracks["sight"]).any()
        self._guide.update(middle_ns, tracks, self._astrometry.camera)

    def _on_engage(self, request: SetBool.Request, response: SetBool.Response):
        self._guide.engage(request.data)
        response.success = True
        response.message = (
            f"the mount is commanded on {self._mount_rate.topic_name}"
            if request.data
            else "the mount is brought to rest, and then no longer commanded"
        )
        self.get_logger().info(response.message)
        return response

    def _on_command_due(self) -> None:
        with self._lock:
            if not self._closed:
                self._tell_mount()

    def _tell_mount(self) -> None:
        now_ns = self._now_ns()
        # No /clock yet, or it stands still: nothing is sent, and the mount stops.
        if not now_ns or (self._command is not None and now_ns == self._command.stamp_ns):
            return
        self._command = command = self._guide.command(now_ns)
        header = self._header()
        for publisher, pair in ((self._offset, command.offset), (self._rate, command.rate)):
            message = Vector3Stamped(header=header)
            message.vector.x, message.vector.y = pair.tolist()
            publisher.publish(message)
        if command.commanding:
            self._publish_rate(header, command.mount_rate)
        self._say_aloud(command)

    def _publish_rate(self, header: Header, rate: np.ndarray) -> None:
        message = TwistStamped(header=header)
        angular = message.twist.angular
        angular.x, angular.y, angular.z = rate.tolist()
        self._mount_rate.publish(message)
        self._commands += 1

    def _header(self) -> Header:
        stamp = messages.time_message(self._command.stamp_ns if self._command else self._now_ns())
        return Header(stamp=stamp, frame_id=self._frame_id)

    def _now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    def _say_aloud(self, command: Command) -> None:
        """Tell in the diagnostics at once what changes; log it, though not at each flicker."""
        what = f"{command.state} {command.target_id}"
        now_s = time.monotonic()
        last_s = self._told_at_s.get(what, -math.inf)
        if what != self._told and now_s - last_s >= _AGAIN_AFTER_S:
            recent = {w: at for w, at in self._told_at_s.items() if now_s - at < _AGAIN_AFTER_S}
            self._told, self._told_at_s = what, recent | {what: now_s}
            self.get_logger().info(command.reason)
        if what != self._said:
            self._said = what
            self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        command = self._command
        summary = command.reason if command else "no clock"
        self._diagnostics.say(summary, self._values(command), *self._problems(command))

    def _problems(self, command: Command | None) -> tuple[list[str], list[str]]:
        """Return what keeps it from guiding at all, and what is merely not as it should be."""
        own = self._settings[GuideParameters]
        errors, warnings = [], []
        if command is None:
            errors.append("use_sim_time is set, but no /clock has come")
        elif command.state not in _GOOD_STATES:
            warnings.append(command.reason)
        if self._uncalibrated:
            errors.append(f"no directions: {self._uncalibrated}")
        elif self._without_sight:
            errors.append(
                "the detector gives no lines of sight: does it hear the same camera_info, and is"
                " that one of its images' size?"
            )
        if nobody := nobody_publishes(self, self._tracks.topic_name):
            errors.append(nobody)
        elif lag := self._lag_in_words(own.stale_after_s):
            errors.append(lag)
        others = self.count_publishers(self._mount_rate.topic_name) - 1
        if others > 0 and command is not None and command.commanding:
            warnings.append(f"{others} more publish {self._mount_rate.topic_name}")
        return errors, warnings

    def _lag_in_words(self, stale_after_s: float) -> str:
        """Return what to say of frames that are too old or of the future; log when it begins."""
        lags = abs(self._lag_s) > stale_after_s
        began, self._lag_is_told = lags and not self._lag_is_told, lags
        if not lags:
            return ""
        words = (
            f"frames are stamped {abs(self._lag_s):.1f} s"
            f" {'behind' if self._lag_s > 0 else 'ahead of'} this node's clock: check"
            " use_sim_time, stamp_offset_s, the machines' clocks, and that the sender keeps up"
        )
        if began:
            self.get_logger().warning(words)
        return words

    def _values(self, command: Command | None) -> dict[str, object]:
        if command is None:
            return {}
        mount, seen = command.mount_rate, self._guide.seen_rate
        return {
            "state": command.state,
            "engaged": self._guide.engaged,
            "target_id": command.target_id,
            "target_age_s": command.age_s,
            "offset_x_arcsec": _arcsec(command.offset[0]),
            "offset_y_arcsec": _arcsec(command.offset[1]),
            "target_rate_x_arcsec_s": _arcsec(command.rate[0]),
            "target_rate_y_arcsec_s": _arcsec(command.rate[1]),
            "mount_rate_x_deg_s": math.degrees(mount[0]),
            "mount_rate_y_deg_s": math.degrees(mount[1]),
            # As the stars show it, for comparison: signs and scale of a new mount.
            "mount_rate_seen_x_deg_s": math.degrees(-seen[1]),
            "mount_rate_seen_y_deg_s": math.degrees(seen[0]),
            "limited": command.limited,
            "integral_x_arcsec_s": _arcsec(command.integral[0]),
            "integral_y_arcsec_s": _arcsec(command.integral[1]),
            "frame_lag_s": self._lag_s,
            "frames_received": self._frames,
            "commands_sent": self._commands,
        }


def _arcsec(radians: float) -> float:
    return math.degrees(radians) * 3600


def main() -> int:
    """Run the node; return the exit code."""
    return run(
        lambda stop, options: GuideNode(),
        parser_of("guide", "Keep a mount on a satellite that the detector tracks."),
    )
