# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The tdm_writer node: each track's directions as a file, once the track has ended.

Stands after the detector, beside whatever determines orbits, and writes what ``tracking_data``
makes: CCSDS TDM as text or XML, or IOD lines.  It takes ``rso_detections`` and, on purpose, not
``rso_tracks``: those are measurements, each with its own error, while the places of a track are
filtered, and so lean on each other and go on where nothing was seen; an orbit fitted to them
would be off, and believe itself better than it is.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from ofsat_ros.camera import Astrometry
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.causes import Causes, say_left_out
from ofsat_ros.nodes.diagnostics import Diagnostics, nobody_publishes
from ofsat_ros.nodes.ros_parameters import NodeParameters
from ofsat_ros.nodes.runtime import StartError, parser_of, run, say
from ofsat_ros.nodes.topics import hear
from ofsat_ros.parameters import (
    CameraParameters,
    Table,
    TdmWriterParameters,
    TrackingDataParameters,
)
from ofsat_ros.timeline import AstrayError, Timeline
from ofsat_ros.tracking_data import SUFFIXES, Arc, TrackArcs, remove_parts, write_arcs

_DEPTH = 1000  # detections of so many frames may wait to be taken
_RETRY_S = 10.0
_LAST_WRITES_S = 5.0  # patience at the end with a disk that hangs
# No more images come when nothing was heard for so many times what lay between the last two
# messages, but not before _RETRY_S: neither slow cameras nor slow players shall end the tracks.
_SILENT_INTERVALS = 5
_NO_DIRECTIONS = (
    "the detections have no right ascension and declination, so that there is nothing to write:"
    " the detector needs a calibration on camera_info and a fresh attitude, and its own"
    " diagnostics say what is missing"
)


class TdmWriter(Node):
    """Collects directions and writes a file for every track that has ended.

    Parameters
    ----------
    context : Context, optional
        ROS context; default: the process's.

    Attributes
    ----------
    exit_code : int
        1 if some track could not be written to the end, else 0.

    Raises
    ------
    ofsat_ros.parameters.ParameterError
        If a start parameter is bad, or does not do for the format.
    StartError
        If the output folder cannot be made or written.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("tdm_writer", context=context)
        self.exit_code = 0
        self._settings = NodeParameters(
            self,
            CameraParameters(),
            TrackingDataParameters(),
            TdmWriterParameters(),
            changed=self._on_change,
        )
        own = self._settings[TdmWriterParameters]
        self._format, self._ended_after_s = own.format, own.ended_after_s
        self._astrometry = Astrometry(self._settings[CameraParameters])
        self._arcs = TrackArcs(
            self._settings[TrackingDataParameters], [own.format], own.longest_directions
        )
        self._timeline = Timeline()
        self._heard_s, self._interval_s = -math.inf, math.inf  # last message, and from its last
        self._folder = Path(own.output or datetime.now(UTC).strftime("tracks_%Y%m%d_%H%M%S"))
        _claim(self._folder)
        self._waiting: list[Arc] = []  # ended, and not yet written
        self._counts: Counter[str] = Counter()
        self._why_waiting = ""
        self._foreign = Causes()  # of messages that are left out
        # Callbacks, close() and the thread that writes share what stands above.
        self._lock = threading.Lock()
        self._to_write = threading.Event()
        self._closed = False
        # No callback waits for a disk: heartbeat and detections go on while it hangs.
        self._thread = threading.Thread(target=self._write, name="tdm_writer", daemon=True)
        self._thread.start()
        subscription = hear(self, PointCloud2, "rso_detections", self._on_detections, _DEPTH)
        self._diagnostics = Diagnostics(self, "tracking data")
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        self.create_timer(_RETRY_S, self._on_timer, clock=steady)
        self._topic = subscription.topic_name
        self.get_logger().info(f"writing the tracks of {self._topic} into {self._folder}")

    def close(self) -> None:
        """Write what is still open, and say what there is."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._waiting += self._arcs.take_all()
        self._to_write.set()
        self._thread.join(_LAST_WRITES_S)
        with self._lock:
            if self._waiting:
                self.exit_code = 1
                if not self._why_waiting:
                    self._why_waiting = f"{self._folder} cannot be written: its disk hangs"
                lost = _in_words(len(self._waiting))
                say(f"tdm_writer: {lost} lost: {self._why_waiting}", sys.stderr)
            elif self._only_without_direction():
                say(f"tdm_writer: {_NO_DIRECTIONS}", sys.stderr)
            say(f"{_in_words(self._counts['tracks'])} written into {self._folder}")

    def _on_change(self, table: Table) -> None:
        with self._lock:
            if isinstance(table, CameraParameters):
                self._astrometry.parameters = table
            elif isinstance(table, TrackingDataParameters):
                self._arcs.parameters = table
            elif isinstance(table, TdmWriterParameters):
                self._ended_after_s = table.ended_after_s
                self._arcs.longest = table.longest_directions

    def _on_detections(self, cloud: PointCloud2) -> None:
        try:
            rows = messages.detections_array(cloud)
        except messages.MessageError as error:
            say_left_out(self.get_logger(), self._foreign, self._topic, error)
            return
        self._foreign.right()
        with self._lock:
            if self._closed:
                return
            now_s = time.monotonic()
            self._interval_s, self._heard_s = now_s - self._heard_s, now_s
            self._count(rows)
            stamp_ns = self._astrometry.middle_ns(messages.stamp_ns(cloud.header.stamp))
            try:
                self._timeline.follow(stamp_ns)
            except AstrayError:  # as the detector, which says so
                self._counts["frames_left_out"] += 1
                return
            self._arcs.add(stamp_ns, rows)
            if ended := self._arcs.take_ended(self._ended_after_s):
                self._waiting += ended
                self._to_write.set()

    def _count(self, rows: np.ndarray) -> None:
        self._counts["frames"] += 1
        of_tracks = rows[rows["track_id"] > 0]
        known = np.isfinite(of_tracks["ra"]) & np.isfinite(of_tracks["dec"])
        self._counts["detections"] += len(of_tracks)
        self._counts["without_direction"] += int((~known).sum())
        if self._only_without_direction():
            self.get_logger().warning(_NO_DIRECTIONS, once=True)

    def _only_without_direction(self) -> bool:
        return 0 < self._counts["detections"] == self._counts["without_direction"]

    def _on_timer(self) -> None:
        """End the tracks if no more images come, whose stamps would do so; write what waits."""
        with self._lock:
            if self._closed:
                return
            longest_s = max(self._ended_after_s, _RETRY_S, _SILENT_INTERVALS * self._interval_s)
            if time.monotonic() - self._heard_s > longest_s:
                self._waiting += self._arcs.take_all()
            self._to_write.set()

    def _write(self) -> None:
        """Write whenever there is something, and a last time when the node is closed."""
        closed = False
        while not closed:
            self._to_write.wait()
            self._to_write.clear()
            with self._lock:
                closed = self._closed
            self._write_waiting()

    def _write_waiting(self) -> None:
        """Write what has ended; keep what cannot be written, and say why, once."""
        while True:
            with self._lock:
                if not self._waiting:
                    return
                arc, parameters = self._waiting[0], self._arcs.parameters
            path = _free(self._folder, arc, SUFFIXES[self._format])
            try:
                write_arcs(path, [arc], self._format, parameters)
            except FileExistsError:  # another writer has just taken the name
                continue
            # Whatever it is, the thread must go on: the next track may be written.
            except Exception as error:  # noqa: BLE001
                why = f"{path} cannot be written: {getattr(error, 'strerror', None) or error}"
                if not self._why_waiting:
                    self.get_logger().error(f"{why}; its track is kept and tried again")
                self._why_waiting = why
                return
            with self._lock:
                del self._waiting[0]
                self._why_waiting = ""
                self._counts["tracks"] += 1
            say(f"{path}: {len(arc.rows)} directions of track {arc.label}")

    def _publish_diagnostics(self) -> None:
        with self._lock:
            counts, waiting, why = self._counts.copy(), len(self._waiting), self._why_waiting
            errors = [f"{_in_words(waiting)} waiting: {why}"] if waiting else []
            warnings = [_NO_DIRECTIONS] if self._only_without_direction() else []
        if nobody := nobody_publishes(self, self._topic):
            errors.append(nobody)
        values = {
            "tracks_written": counts["tracks"],
            "tracks_waiting": waiting,
            "frames": counts["frames"],
            "frames_left_out": counts["frames_left_out"],
            "detections": counts["detections"],
            "detections_without_direction": counts["without_direction"],
            "folder": self._folder,
        }
        self._diagnostics.say(f"{_in_words(counts['tracks'])} written", values, errors, warnings)


def _claim(folder: Path) -> None:
    """Make the folder; what it holds is never touched."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(OSError):  # what cannot be removed harms nobody
            remove_parts(folder)
    except OSError as error:
        raise StartError(
            f"{folder} cannot be made: {error.strerror}; choose another folder with"
            " -p output:=FOLDER"
        ) from error
    if not os.access(folder, os.W_OK):
        raise StartError(f"{folder} cannot be written; choose another with -p output:=FOLDER")


def _free(folder: Path, arc: Arc, suffix: str) -> Path:
    """A name for an arc's file that no file has."""
    first = datetime.fromtimestamp(arc.first_ns // 1_000_000_000, UTC)
    stem = f"{first:%Y%m%dT%H%M%S}_{arc.label}"
    path, number = folder / (stem + suffix), 1
    while os.path.lexists(path):
        number += 1
        path = folder / f"{stem}_{number}{suffix}"
    return path


def _in_words(tracks: int) -> str:
    return f"{tracks} track{'s' * (tracks != 1)}"


def main() -> int:
    """Run the node; return the exit code."""
    return run(
        lambda stop, options: TdmWriter(),
        parser_of("tdm_writer", "Write the directions of tracks for orbit determination."),
    )
