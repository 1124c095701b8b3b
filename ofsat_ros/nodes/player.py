# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The player node: a bag's images over DDS, as a camera would send them, none lost.

The recorded bytes go out as they are, on the recorded topics, with the recording's time on
``/clock``.  It waits for a subscriber before the first frame and for every reliable subscriber to
have received the last.  Calibrations and attitudes go out with them, in the recorded order.
While a detector answers and asks for every frame, at most a few frames
are on their way to it: replay then slows down instead of losing frames.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque

from geometry_msgs.msg import QuaternionStamped
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from ofsat_ros.nodes import messages
from ofsat_ros.nodes.ros_parameters import NodeParameters
from ofsat_ros.nodes.runtime import StartError, lifetime, parser_of, run
from ofsat_ros.nodes.topics import advertise, hear
from ofsat_ros.parameters import PlayerParameters
from ofsat_ros.printing import printable
from ofsat_ros.recordings import (
    ATTITUDE,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    Bag,
    RecordingError,
)

_TYPES = {IMAGE: Image, COMPRESSED_IMAGE: CompressedImage}
# What gives images directions; small, and of all cameras and mounts in the bag.
_TYPES_BESIDE = {CAMERA_INFO: CameraInfo, ATTITUDE: QuaternionStamped}
# Frames that may be on their way: kept by the middleware until received, or not yet answered.
_DEPTH = 10
_UNANSWERED = 4
# Small messages beside the images that may be on their way.
_BESIDE_DEPTH = 50
_NS = 1_000_000_000
_POLL_S = 0.02
_CLOCK_PERIOD_S = 0.025
# A detector that answers no more must not hold up the others for ever.
_ANSWER_PATIENCE_S = 30.0
# Best-effort subscribers acknowledge neither that they know us nor that they received anything.
_BEST_EFFORT_GRACE_S = 0.5
# Being late by less is caught up with, by more is not.
_CATCH_UP_S = 1.0
# A longer wait for the next message is said aloud: a camera that paused, or a clock that was set.
_LONG_WAIT_S = 10.0


class Player(Node):
    """Publishes the images of a bag; sets `stop` when all is done.

    Parameters
    ----------
    stop : threading.Event
        Set from outside to end playing, and by the player at its end.
    bag : str
        Bag to play; empty: the parameter ``bag``.
    context : Context, optional
        ROS context; default: the process's.

    Attributes
    ----------
    exit_code : int
        1 if the bag could not be played to its end, else 0.

    Raises
    ------
    ofsat_ros.parameters.ParameterError
        If a start parameter is bad.
    StartError
        If there is nothing to play.
    """

    def __init__(
        self, stop: threading.Event, bag: str = "", context: Context | None = None
    ) -> None:
        super().__init__("player", context=context)
        self.exit_code = 0
        self._stop = stop
        self._settings = NodeParameters(self, PlayerParameters())
        own = self._settings[PlayerParameters]
        self._bag = _open(bag or own.bag)
        for problem in self._bag.problems:
            self.get_logger().warning(printable(problem))
        topics = _image_topics(self._bag, own.topic)
        self._publishers_of = {name: self._publisher(name) for name in topics}
        self._beside = {
            name: self._publisher(name, _BESIDE_DEPTH)
            for name, about in self._bag.topics.items()
            if about.msgtype in _TYPES_BESIDE
        }
        self._clock_publisher = advertise(self, Clock, "/clock", _DEPTH) if own.clock else None
        self._clock_at_s = 0.0
        self._unanswered: deque[int] = deque()
        self._answered = threading.Condition()
        self._answers = hear(self, PointCloud2, "rso_detections", self._on_answer, 100)
        self._nobody_answers = False
        self._answered_s = -math.inf
        self._truncated = 0
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End playing and close the bag."""
        self._stop.set()
        self._thread.join(0.5)
        if not self._thread.is_alive():
            self._bag.close()

    def _publisher(self, name: str, depth: int = _DEPTH) -> Publisher:
        kind = (_TYPES | _TYPES_BESIDE)[self._bag.topics[name].msgtype]
        return advertise(self, kind, name, depth)

    def _on_answer(self, cloud: PointCloud2) -> None:
        stamp = messages.stamp_ns(cloud.header.stamp)
        with self._answered:
            self._nobody_answers = False
            self._answered_s = time.monotonic()
            if stamp in self._unanswered:
                # An answer stands for what a live detector has skipped before it, too.
                while self._unanswered.popleft() != stamp:
                    pass
            self._answered.notify_all()

    def _run(self) -> None:
        with lifetime(self, self._stop):
            self._wait_for_subscribers()
            try:
                again = True
                while again and not self._stop.is_set():
                    self._play()
                    again = self._settings[PlayerParameters].loop
            except RecordingError as error:
                self.get_logger().error(printable(str(error)))
                self.exit_code = 1
            self._finish()

    def _wait_for_subscribers(self) -> None:
        wanted = self._settings[PlayerParameters].wait_for_subscribers
        for publisher in self._publishers_of.values():
            if publisher.get_subscription_count() < wanted:
                self.get_logger().info(
                    f"waiting for {wanted} subscriber(s) to {publisher.topic_name}"
                )
            while publisher.get_subscription_count() < wanted and not self._stop.is_set():
                self._stop.wait(_POLL_S)
        if self._any_subscriber(ReliabilityPolicy.BEST_EFFORT):
            self._stop.wait(_BEST_EFFORT_GRACE_S)

    def _any_subscriber(self, reliability: ReliabilityPolicy) -> bool:
        return any(
            about.qos_profile.reliability == reliability
            for publisher in self._publishers_of.values()
            for about in self.get_subscriptions_info_by_topic(publisher.topic_name)
        )

    def _play(self) -> None:
        """Play the bag once."""
        own = self._settings[PlayerParameters]
        start_ns = self._bag.start_ns + round(own.start_s * _NS)
        count, last_ns, due_s = 0, None, time.monotonic()
        topics = [*self._publishers_of, *self._beside]
        beside = self._play_calibrations_before(start_ns) if own.start_s else 0
        for topic, _, time_ns, data in self._bag.messages(topics, start_ns):
            last_ns = time_ns if last_ns is None else last_ns
            due_s = self._wait_until_due(last_ns, time_ns, due_s)
            last_ns = time_ns
            if self._stop.is_set():
                break
            stamp = self._stamp_ns(topic, time_ns, data)
            if stamp is None:
                continue
            if topic in self._beside:
                self._beside[topic].publish(bytes(data))
                beside += 1
                if beside % _BESIDE_DEPTH == 0:
                    self._wait_for_receipt()
                continue
            self._wait_for_answers(_UNANSWERED - 1)
            if self._stop.is_set():
                break
            self._publish_clock(time_ns)
            with self._answered:
                self._unanswered.append(stamp)
            self._publishers_of[topic].publish(bytes(data))
            count += 1
            if count % _DEPTH == 0:
                self._wait_for_receipt()
        skipped = f"; {self._truncated} truncated ones skipped" if self._truncated else ""
        self.get_logger().info(f"played {count} frames of {self._bag.path}{skipped}")
        if not count and not self._stop.is_set():
            raise RecordingError(
                f"{self._bag.path} holds no image after start_s = {own.start_s:g} s"
            )

    def _play_calibrations_before(self, start_ns: int) -> int:
        """Play each calibration that holds at a time; return how many these are."""
        topics = [n for n in self._beside if self._bag.topics[n].msgtype == CAMERA_INFO]
        last: dict[str, bytes] = {}
        for topic, _, time_ns, data in self._bag.messages(topics):
            if time_ns >= start_ns or self._stop.is_set():
                break
            if self._stamp_ns(topic, time_ns, data) is not None:
                last[topic] = bytes(data)
        for topic, data in last.items():
            self._beside[topic].publish(data)
        return len(last)

    def _wait_until_due(self, last_ns: int, time_ns: int, due_s: float) -> float:
        """Wait until a message's time has come; return when that was.  Advances the clock."""
        said = False
        while not self._stop.is_set():
            rate = self._settings[PlayerParameters].rate  # it may change meanwhile
            now_s = time.monotonic()
            if rate == 0:
                return now_s
            next_s = due_s + (time_ns - last_ns) / _NS / rate
            if next_s <= now_s:
                return max(next_s, now_s - _CATCH_UP_S)
            if next_s - now_s > _LONG_WAIT_S and not said:
                said = True
                self.get_logger().info(
                    f"the recording pauses: its next message is due in {next_s - now_s:.0f} s; a"
                    f" higher rate is sooner there: ros2 param set {self.get_name()} rate 100"
                )
            if now_s - self._clock_at_s >= _CLOCK_PERIOD_S:
                self._publish_clock(time_ns - round((next_s - now_s) * rate * _NS))
            self._stop.wait(min(next_s - now_s, _CLOCK_PERIOD_S))
        return due_s

    def _stamp_ns(self, topic: str, time_ns: int, data: bytes | memoryview) -> int | None:
        """Return a message's stamp; None if it ends before that, and is not to be sent.

        An empty one would be asked for again by the middleware, which waits with all that follow.
        """
        try:
            return messages.header_stamp_ns(data)
        except messages.MessageError as error:
            self._truncated += 1
            self.get_logger().warning(
                f"{topic}: a message at {time_ns} ns is skipped: {error}", once=True
            )
            return None

    def _publish_clock(self, time_ns: int) -> None:
        self._clock_at_s = time.monotonic()
        if self._clock_publisher is not None:
            self._clock_publisher.publish(Clock(clock=messages.time_message(time_ns)))

    def _wait_for_answers(self, at_most: int) -> None:
        """Wait until at most so many frames are unanswered, if somebody answers every frame.

        Acknowledgements do not tell: the middleware gives them when a frame arrives, and
        overwrites frames that its reader has not taken.
        """
        begun_s = time.monotonic()
        with self._answered:
            while len(self._unanswered) > at_most and not self._stop.is_set():
                if self._nobody_answers or not self._is_answered():
                    self._unanswered.clear()
                # A slow detector answers seldom, but it answers: each answer buys time anew.
                elif time.monotonic() > max(begun_s, self._answered_s) + _ANSWER_PATIENCE_S:
                    self._nobody_answers = True
                    self.get_logger().warning(
                        f"{self._answers.topic_name} answers no more: going on without"
                    )
                else:
                    self._answered.wait(_POLL_S)

    def _is_answered(self) -> bool:
        return self.count_publishers(self._answers.topic_name) > 0

    def _wait_for_receipt(self) -> None:
        """Wait until every reliable subscriber has received all: nothing is overwritten."""
        for publisher in (*self._publishers_of.values(), *self._beside.values()):
            while not self._stop.is_set():
                if publisher.wait_for_all_acked(Duration(seconds=_POLL_S)):
                    break

    def _finish(self) -> None:
        """Stay until the last frame has arrived, and until it is answered."""
        self._wait_for_receipt()
        self._wait_for_answers(0)
        if self._any_subscriber(ReliabilityPolicy.BEST_EFFORT):
            self._stop.wait(_BEST_EFFORT_GRACE_S)


def _open(path: str) -> Bag:
    if not path:
        raise StartError("no bag given: player PATH, or --ros-args -p bag:=PATH")
    try:
        return Bag(path)
    except RecordingError as error:
        raise StartError(str(error)) from error


def _image_topics(bag: Bag, wanted: str) -> list[str]:
    """Return the image topics to play."""
    images = [name for name, about in bag.topics.items() if about.is_image and about.count]
    if not images:
        raise StartError(f"{bag.path} holds no images; its topics are {', '.join(bag.topics)}")
    if not wanted:
        return images
    chosen = [name for name in images if name in (wanted, f"/{wanted}")]
    if not chosen:
        raise StartError(
            f"{bag.path} has no images on {wanted}; image topics are {', '.join(images)}"
        )
    return chosen


def main() -> int:
    """Run the node; return the exit code."""
    parser = parser_of("player", "Play the images of a bag.")
    parser.add_argument("bag", nargs="?", default="", help="a bag's folder, .mcap, .db3 or .bag")
    return run(lambda stop, options: Player(stop, options.bag), parser)
