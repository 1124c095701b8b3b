# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The detector node: images in, RSOs and their tracks out; a shell around ``pipeline.Pipeline``.

Its callbacks only take messages in; one worker thread processes and publishes, so that every
frame it takes is answered once, in order: by empty clouds if it could not be processed.
With ``reliable_input`` every frame of the sender is answered; a live camera's frames (best effort)
may wait for ``backlog_s``, and then only the newest is.  Topics, fields and units: README.
"""

from __future__ import annotations

import threading
import time
import traceback

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.images import EncodingError, decode_message
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.causes import Causes
from ofsat_ros.nodes.diagnostics import Diagnostics, Heartbeat
from ofsat_ros.nodes.drawing import Drawing
from ofsat_ros.nodes.health import Around, Health, stuck_words, timed
from ofsat_ros.nodes.ros_parameters import NodeParameters, start_value
from ofsat_ros.nodes.runtime import Inbox, parser_of, profile_path, run
from ofsat_ros.nodes.sky import Sky
from ofsat_ros.nodes.topics import advertise, hear
from ofsat_ros.parameters import (
    DEFAULT_PRESET,
    CameraParameters,
    DetectorParameters,
    Parameters,
    Table,
)
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.printing import printable
from ofsat_ros.tracking import TRACK_DTYPE

# Results are small; a subscriber may be this far behind and lose none.
_RESULTS_DEPTH = 100
_PICTURES_DEPTH = 20
_WARN_EVERY_S = 10.0
# A longer name of a frame is none, and would go out again in each marker.
_LONGEST_FRAME_ID = 255


class Detector(Node):
    """Subscribes to images and publishes what ``Pipeline`` finds in them.

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
        super().__init__("detector", context=context)
        preset = start_value(self, "preset", DEFAULT_PRESET)
        self._settings = NodeParameters(
            self,
            Parameters.preset(preset),
            CameraParameters(),
            DetectorParameters(),
            changed=self._on_change,
        )
        own = self._settings[DetectorParameters]
        self._pipeline = Pipeline(self._settings[Parameters])
        self._sky = Sky(self, self._settings[CameraParameters], own.reliable_input)
        self._reset_wanted = ""
        self._causes = Causes()  # of frames in which nothing is found
        backlog_s = None if own.reliable_input else own.backlog_s
        self._inbox = Inbox(own.queue_depth, backlog_s)
        self._create_publishers()
        self._images = self._subscribe(own)
        self._health = Health(self._images.topic_name, own.reliable_input, profile_path())
        self._said: set[str] = set()  # kinds of problems that are logged already
        self._drawing = Drawing(
            self, self._markers, self._annotated, own.reliable_input, self._health
        )
        self._callbacks_s: float | None = None  # CPU time of their thread at the end of the last
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self._worker = threading.Thread(target=self._work, name="detector", daemon=True)
        self._worker.start()
        self._heartbeat = Heartbeat(self, self._tick)
        self.get_logger().info(f"waiting for images on {self._images.topic_name}")

    def close(self) -> None:
        """End the worker; a frame in work may still be answered."""
        self._heartbeat.close()
        self._inbox.close()
        self._drawing.close()
        self._worker.join(0.5)

    def _create_publishers(self) -> None:
        self._detections = advertise(self, PointCloud2, "rso_detections", _RESULTS_DEPTH)
        self._tracks = advertise(self, PointCloud2, "rso_tracks", _RESULTS_DEPTH)
        self._markers = advertise(self, MarkerArray, "flow_markers", _RESULTS_DEPTH)
        self._motion = advertise(self, Vector3Stamped, "star_field_motion", _RESULTS_DEPTH)
        self._annotated = advertise(self, Image, "image_annotated", _PICTURES_DEPTH)
        self._diagnostics = Diagnostics(self, "detection")

    def _subscribe(self, own: DetectorParameters):
        compressed = own.image_transport == "compressed"
        return hear(
            self,
            CompressedImage if compressed else Image,
            "image/compressed" if compressed else "image",
            self._on_image,
            own.queue_depth,
            reliable=own.reliable_input,
            explain=lambda policy: self._health.incompatible_qos(policy),
        )

    def _on_change(self, table: Table) -> None:
        if isinstance(table, Parameters):
            self._pipeline.parameters = table
        elif isinstance(table, CameraParameters):
            self._sky.set_parameters(table)

    def _on_image(self, message: Image | CompressedImage, info: dict) -> None:
        received_s = time.monotonic()
        # Each sender counts for itself, so numbers tell of losses only while there is one.
        alone = self._health.around.publishers == 1
        sequence = info["publication_sequence_number"] if alone else None
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._health.image_received(sequence, has_stamp=stamp_ns != 0)
        seconds = {"receive": self._callback_cpu_s()}
        if self._health.enabled:
            item = (message, received_s, seconds)
            self._health.dropped(self._inbox.put(item, len(message.data)))

    def _callback_cpu_s(self) -> float:
        """CPU time that the callbacks' thread took since the last call, s.

        It is spent in the middleware, before the message is there, so that no clock can be read
        around it.
        """
        before, self._callbacks_s = self._callbacks_s, time.thread_time()
        return 0.0 if before is None else self._callbacks_s - before

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._reset_wanted = "reset asked for"
        response.success, response.message = True, "the next frame starts afresh"
        return response

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response):
        if request.data and not self._health.enabled:
            self._reset_wanted = "it was disabled"
        self._health.enabled = request.data
        response.success = True
        response.message = "images are processed" if request.data else "images are ignored"
        return response

    def _work(self) -> None:
        while (item := self._inbox.get()) is not None:
            try:
                self._answer(*item)
                # Each frame's own numbers; those of the timer go on when no image comes.
                if self._diagnostics.heard():
                    self._publish_diagnostics()
            # Nothing that is drawn or sent may end the thread, and with it all answers.
            except Exception:  # noqa: BLE001
                if self._inbox.closed:
                    return
                self.get_logger().error(
                    traceback.format_exc(), throttle_duration_sec=_WARN_EVERY_S
                )

    def _answer(
        self, message: Image | CompressedImage, received_s: float, seconds: dict[str, float]
    ) -> None:
        """Answer an image; `seconds` takes what each step of it needs."""
        seconds["wait"] = time.monotonic() - received_s
        header, own = message.header, self._settings[DetectorParameters]
        try:
            if self._reset_wanted:
                reason, self._reset_wanted = self._reset_wanted, ""
                self._pipeline.reset(reason)
            _check_header(header)
            with timed(seconds, "convert"):
                image = decode_message(message, own.max_pixels)
            with timed(seconds, "process"):
                middle_ns = self._sky.middle_ns(messages.stamp_ns(header.stamp))
                result = self._pipeline.process(image, middle_ns)
            with timed(seconds, "locate"):
                self._health.directions = self._sky.locate(
                    middle_ns, result.shape, result.detections, result.tracks
                )
        except (EncodingError, ImageError) as error:
            self._fail(header, str(error))
        # Whatever an image does to the stages, it must not take the node down.
        except Exception as error:  # noqa: BLE001
            self._reset_wanted = "an error in the frame before"
            self._fail(header, f"{type(error).__name__}: {error}", traceback.format_exc())
        else:
            with timed(seconds, "publish"):
                self._publish_clouds(header, result.detections, result.tracks)
                self._motion.publish(messages.star_field_vector(header, result))
            self._health.processed(result, time.monotonic() - received_s, seconds | result.seconds)
            self._say_what_is_seen(result)
            self._drawing.show(header, image, result, own.marker_scale)

    def _say_what_is_seen(self, result: FrameResult) -> None:
        """Log that images show nothing, and when they show something again."""
        if not len(result.objects):
            if self._causes.wrong(result.reason):
                self.get_logger().warning(f"nothing is seen: {result.reason}")
        elif count := self._causes.right():
            frames = "1 frame" if count == 1 else f"{count} frames"
            self.get_logger().info(f"objects are found again, after {frames} without")

    def _fail(self, header: Header, why: str, details: str = "") -> None:
        """Answer an image that could not be processed: nothing found, and nothing stale left."""
        self._health.failed(why)
        if self._causes.wrong(why):
            self.get_logger().warning(f"image not processed: {details or why}")
        self._publish_clouds(header, np.zeros(0, DETECTION_DTYPE), np.zeros(0, TRACK_DTYPE))
        self._motion.publish(messages.star_field_vector(header, None))
        self._drawing.clear(header)

    def _publish_clouds(self, header: Header, detections: np.ndarray, tracks: np.ndarray) -> None:
        self._detections.publish(messages.detections_cloud(header, detections))
        self._tracks.publish(messages.tracks_cloud(header, tracks))

    def _tick(self) -> None:
        """Do once a second what does not depend on images."""
        self._clear_stale_markers()
        self._health.around = self._look_around()
        self._sky.look_around()
        self._say_aloud()
        self._publish_diagnostics()

    def _clear_stale_markers(self) -> None:
        """Delete what is drawn when images stop."""
        timeout_s = self._settings[DetectorParameters].no_image_timeout_s
        goes_on = self._health.enabled and self._health.silence_s() <= timeout_s
        # A slow frame is answered long after its image has come: its markers stay as long, too.
        if not goes_on:
            self._drawing.clear_after(timeout_s)

    def _look_around(self) -> Around:
        publishers = self.count_publishers(self._images.topic_name)
        infos = self.get_publishers_info_by_topic(self._detections.topic_name)
        nodes = [printable(f"{i.node_namespace.rstrip('/')}/{i.node_name}") for i in infos]
        if (own := self.get_fully_qualified_name()) in nodes:
            nodes.remove(own)
        return Around(publishers, [] if publishers else self._other_image_topics(), nodes)

    def _publish_diagnostics(self) -> None:
        timeout_s = self._settings[DetectorParameters].no_image_timeout_s
        errors, warnings = self._health.problems(timeout_s, self._inbox.in_work_s())
        self._diagnostics.say(self._health.summary(), self._health.values(), errors, warnings)

    def _other_image_topics(self) -> list[str]:
        """Topics with images that somebody else publishes: perhaps the camera's."""
        kind = "sensor_msgs/msg/" + self._images.msg_type.__name__
        return [
            printable(name)
            for name, kinds in self.get_topic_names_and_types()
            if kind in kinds and name != self._annotated.topic_name and self.count_publishers(name)
        ]

    def _say_aloud(self) -> None:
        """Log what a user must know who does not watch ``/diagnostics``, once while it lasts."""
        timeout_s = self._settings[DetectorParameters].no_image_timeout_s
        stuck = stuck_words(self._inbox.in_work_s(), timeout_s)
        problems = {
            "stuck": stuck,
            "silence": "" if stuck else self._health.silence(timeout_s),
            "rivals": self._health.rivalry(),
            "losses": self._health.losses(),
            "lateness": self._health.lateness(timeout_s),
        }
        for kind, words in problems.items():
            if words and kind not in self._said:
                self.get_logger().warning(words)
        if "silence" in self._said and self._health.silence_s() <= timeout_s:
            self.get_logger().info(f"images come again on {self._images.topic_name}")
        self._said = {kind for kind, words in problems.items() if words}


def _check_header(header: Header) -> None:
    """Raise an EncodingError if a header is not to be sent on as it is; it is then."""
    length = len(header.frame_id)
    if length > _LONGEST_FRAME_ID:
        header.frame_id = ""
        raise EncodingError(
            f"header.frame_id has {length} characters, more than {_LONGEST_FRAME_ID}"
        )


def main() -> int:
    """Run the node; return the exit code."""
    return run(
        lambda stop, options: Detector(),
        parser_of("detector", "Detect satellites in a camera's images."),
    )
