# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The recorder node: what a detector finds, as a table on the screen and as files.

Writes into a folder: ``detections.csv``, ``frame_*.png`` (every n-th annotated image), and
``results``, a bag of the results as they were received.  All are whole after Ctrl-C, too.
"""

from __future__ import annotations

import math
import shutil
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from ofsat_ros.images import encode_png
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.causes import Causes, say_left_out
from ofsat_ros.nodes.diagnostics import Diagnostics, nobody_publishes
from ofsat_ros.nodes.ros_parameters import NodeParameters
from ofsat_ros.nodes.runtime import StartError, parser_of, run, say
from ofsat_ros.nodes.topics import hear
from ofsat_ros.parameters import RecorderParameters
from ofsat_ros.recordings import BagWriter, RecordingError
from ofsat_ros.report.words import instant
from ofsat_ros.results import DETECTION_COLUMNS, DETECTIONS, detection_lines, in_words
from ofsat_ros.results.bag import BAG

PICTURE = "frame_{:06d}.png"
HEARING = "hearing a detector"  # printed as soon as this is so

# Results that may wait while a picture is written.
_DEPTH = 1000
# Pictures that come while one is written: none that is wanted may be lost.
_PICTURES_DEPTH = 20
# Consecutive frames without detection that share one line of the table.
_QUIET_FRAMES = 10
# Of a disk; a night of results without pictures takes less.
_LITTLE_ROOM_BYTES = 1e9
# What else belongs to the last frame comes a moment after its detections.
_LAST_RESULTS_S = 1.0


class Recorder(Node):
    """Prints and records results; sets `stop` after the wanted count of frames.

    Parameters
    ----------
    stop : threading.Event
        Set by the recorder when it has all frames it was asked for.
    context : Context, optional
        ROS context; default: the process's.

    Attributes
    ----------
    exit_code : int
        1 if the files could not be written to the end, else 0.

    Raises
    ------
    ofsat_ros.parameters.ParameterError
        If a start parameter is bad.
    StartError
        If the output folder holds something else, or cannot be written.
    """

    def __init__(self, stop: threading.Event, context: Context | None = None) -> None:
        super().__init__("recorder", context=context)
        self.exit_code = 0
        self._stop = stop
        self._own = NodeParameters(self, RecorderParameters())[RecorderParameters]
        named_by_time = datetime.now(UTC).strftime("ofsat_%Y%m%d_%H%M%S")
        self._folder = Path(self._own.output or named_by_time)
        try:
            _claim(self._folder, self._own.overwrite)
            self._bag = BagWriter(self._folder / BAG, force=True)
            self._csv = open(self._folder / DETECTIONS, "w", encoding="utf-8")  # noqa: SIM115
            self._csv.write(",".join(DETECTION_COLUMNS) + "\n")
        except (OSError, RecordingError) as error:
            raise StartError(str(error)) from error
        self._table = _Table()
        self._frames = self._pictures = 0
        self._detections: Counter[int] = Counter()  # of each track, 0 for candidates
        self._numbers = _Numbers()
        self._recent: deque[tuple[int, int]] = deque(maxlen=_DEPTH)  # stamp, frame
        self._last_frame_s = math.inf
        self._hears = False
        self._foreign = Causes()  # of messages that are left out
        # Callbacks and close() come from two threads.
        self._lock = threading.Lock()
        self._closed = False
        self._subscribe()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.1, self._watch, clock=steady)
        self._diagnostics = Diagnostics(self, "recording")
        self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        self.get_logger().info(f"recording into {self._folder}")

    def close(self) -> None:
        """Finish the files and say what is in them."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            for finish in (self._table.end, self._csv.close, self._bag.close):
                try:
                    finish()
                except (OSError, RecordingError) as error:
                    self._give_up(error)
        if self.exit_code:
            return
        say(
            f"{self._frames} frames, {in_words(self._detections)}; {DETECTIONS},"
            f" {self._pictures} pictures and the bag {BAG} are in {self._folder}"
        )

    def _subscribe(self) -> None:
        def subscribe(
            kind: type, topic: str, take: Callable[..., None], depth: int = _DEPTH
        ) -> str:
            # Raw: the bag is to hold what was received, and few pictures are looked into.
            def on_message(data: bytes, info: dict) -> None:
                self._take(topic, take, data, info)

            return hear(self, kind, topic, on_message, depth, raw=True).topic_name

        self._cloud_topic = subscribe(PointCloud2, "rso_detections", self._on_detections)
        self._tracks_topic = subscribe(PointCloud2, "rso_tracks", self._on_tracks)
        self._motion_topic = subscribe(Vector3Stamped, "star_field_motion", self._on_motion)
        self._marker_topic = subscribe(MarkerArray, "flow_markers", self._on_markers)
        if self._own.picture_every:
            subscribe(Image, "image_annotated", self._on_picture, _PICTURES_DEPTH)

    def _take(self, topic: str, take: Callable[..., None], data: bytes, info: dict) -> None:
        try:
            if not self.exit_code:
                take(data, info["publication_sequence_number"])
                self._foreign.right()
        except (OSError, RecordingError) as error:
            self._give_up(error)
        # Whatever others publish under these names must not end the recording.
        except Exception as error:  # noqa: BLE001
            say_left_out(self.get_logger(), self._foreign, topic, error)

    def _give_up(self, error: Exception) -> None:
        """End, since a file cannot be written; say the first reason."""
        if not self.exit_code:
            self.exit_code = 1
            why = getattr(error, "strerror", None) or error
            say(f"recorder: the recording in {self._folder} ends: {why}", sys.stderr)
        self._stop.set()

    def _on_detections(self, data: bytes, sequence: int) -> None:
        cloud = deserialize_message(data, PointCloud2)
        stamp, rows = messages.stamp_ns(cloud.header.stamp), messages.detections_array(cloud)
        with self._lock:
            if self._closed or self._is_complete():
                return
            if began_after := self._numbers.make_unique(rows["track_id"], sequence):
                self.get_logger().warning(
                    f"another detector sends, or the same was started anew: in {DETECTIONS}, its"
                    f" track 1 is {began_after + 1}, and so on"
                )
            self._write(self._cloud_topic, "sensor_msgs/msg/PointCloud2", data, stamp)
            self._csv.writelines(detection_lines(stamp, self._frames, rows))
            self._csv.flush()
            self._table.add(stamp, self._frames, rows)
            self._recent.append((stamp, self._frames))
            self._frames += 1
            self._detections.update(rows["track_id"].tolist())
            self._last_frame_s = time.monotonic()

    def _on_tracks(self, data: bytes, _: int) -> None:
        with self._lock:
            stamp = messages.header_stamp_ns(data)
            self._write(self._tracks_topic, "sensor_msgs/msg/PointCloud2", data, stamp)

    def _on_motion(self, data: bytes, _: int) -> None:
        with self._lock:
            stamp = messages.header_stamp_ns(data)
            self._write(self._motion_topic, "geometry_msgs/msg/Vector3Stamped", data, stamp)

    def _on_markers(self, data: bytes, _: int) -> None:
        with self._lock:
            # The array's length comes first, then the first marker's header.
            stamp = messages.header_stamp_ns(data, messages.FIRST_MARKER_AT)
            self._write(self._marker_topic, "visualization_msgs/msg/MarkerArray", data, stamp)

    def _on_picture(self, data: bytes, _: int) -> None:
        frame = dict(self._recent).get(messages.header_stamp_ns(data))
        if frame is None or frame % self._own.picture_every:
            return
        png = encode_png(messages.picture_array(deserialize_message(data, Image)))
        path = self._folder / PICTURE.format(frame)
        with self._lock:
            if self._closed:
                return
            try:
                path.write_bytes(png)
            except OSError:  # no torn picture stays
                path.unlink(missing_ok=True)
                raise
            self._pictures += 1

    def _write(self, topic: str, msgtype: str, data: bytes, stamp: int) -> None:
        """Write into the bag, at the image's time: it then plays beside the recording."""
        if stamp < 0:
            raise messages.MessageError("its stamp is before 1970")
        if not self._closed:
            self._bag.write(topic, msgtype, data, stamp or time.time_ns())

    def _is_complete(self) -> bool:
        return 0 < self._own.frames <= self._frames

    def _watch(self) -> None:
        """Say when a detector is there; end when all is recorded."""
        if not self._hears and self.count_publishers(self._cloud_topic):
            self._hears = True
            say(HEARING)
        if self._is_complete() and time.monotonic() - self._last_frame_s > _LAST_RESULTS_S:
            self._stop.set()

    def _publish_diagnostics(self) -> None:
        errors, warnings, free = [], [], math.nan
        if nobody := nobody_publishes(self, self._cloud_topic):
            errors.append(nobody)
        try:
            free = float(shutil.disk_usage(self._folder).free)
        except OSError as error:
            errors.append(f"{self._folder} cannot be looked into: {error.strerror}")
        if free < _LITTLE_ROOM_BYTES:
            warnings.append(f"{self._folder} has room for {free / 1e6:.0f} MB only: free some")
        with self._lock:
            values = {
                "frames_recorded": self._frames,
                "detections": self._detections.total(),
                "pictures": self._pictures,
                "folder": self._folder,
                "free_bytes": free,
            }
        summary = f"{values['frames_recorded']} frames recorded"
        self._diagnostics.say(summary, values, errors, warnings)


class _Numbers:
    """Keeps the numbers of tracks apart that several detectors give, one after the other or not.

    Each begins with 1.  Who sends is told by the middleware's count of a sender's messages.
    """

    def __init__(self) -> None:
        self._highest = 0
        # Of each sender, the last known one first: count of its messages, and what is added.
        self._senders: list[list[int]] = []

    def make_unique(self, track_ids: np.ndarray, sequence: int) -> int:
        """Change numbers in place; return what was added if the sender is a new one, else 0."""
        near = [sender for sender in self._senders if sender[0] < sequence]
        sender = max(near, key=lambda one: one[0], default=None)
        new = sender is None
        if sender is None:
            sender = [sequence, self._highest]
        else:
            self._senders.remove(sender)
        sender[0] = sequence
        self._senders.insert(0, sender)
        track_ids[track_ids > 0] += sender[1]
        self._highest = max(self._highest, int(track_ids.max(initial=0)))
        return sender[1] if new else 0


class _Table:
    """The detections, printed for a person: a line for each, one for many frames without."""

    def __init__(self) -> None:
        self._quiet: list[int] = []
        self._begun = False

    def add(self, stamp: int, frame: int, rows: np.ndarray) -> None:
        """Print the detections of a frame."""
        if not self._begun:
            self._begun = True
            say(
                f"{'time (UTC)':>23} {'frame':>6} {'id':>4} {'x px':>8} {'y px':>8}"
                f" {'px/s':>8} {'towards':>7} {'px/s vs stars':>13} {'SNR':>7}"
            )
        if not len(rows):
            self._quiet.append(frame)
            if len(self._quiet) >= _QUIET_FRAMES:
                self.end()
            return
        self.end()
        when = instant(stamp)
        for row in rows:
            speed = math.hypot(row["vx"], row["vy"])
            relative = math.hypot(row["rel_vx"], row["rel_vy"])
            towards = math.degrees(math.atan2(row["vy"], row["vx"]))
            say(
                f"{when} {frame:6d} {row['track_id'] or '-':>4} {row['x']:8.2f} {row['y']:8.2f}"
                f" {speed:8.3f} {towards:6.0f}° {relative:13.3f} {row['snr']:7.1f}"
            )

    def end(self) -> None:
        """Print the line for the frames without detection so far."""
        if self._quiet:
            first, last = self._quiet[0], self._quiet[-1]
            frames = f"frame {first}" if first == last else f"frames {first} to {last}"
            say(f"{'':>23} {frames}: no RSO")
            self._quiet.clear()


def _claim(folder: Path, overwrite: bool) -> None:
    """Make the folder, or remove the files that a recorder has left there, if so wanted."""
    folder.mkdir(parents=True, exist_ok=True)
    ours = [folder / DETECTIONS, *folder.glob(PICTURE.replace("{:06d}", "[0-9]*"))]
    foreign = sorted(p.name for p in folder.iterdir() if p not in [*ours, folder / BAG])
    if foreign:
        raise StartError(
            f"{folder} holds {', '.join(foreign[:3])}, which is not a recorder's: choose another"
            " folder with -p output:=FOLDER"
        )
    if not overwrite and any(folder.iterdir()):
        raise StartError(
            f"{folder} already holds results: choose another folder with -p output:=FOLDER, or"
            " replace them with -p overwrite:=true"
        )
    for path in ours:
        path.unlink(missing_ok=True)


def main() -> int:
    """Run the node; return the exit code."""
    return run(
        lambda stop, options: Recorder(stop),
        parser_of("recorder", "Print and record what a detector finds."),
    )
