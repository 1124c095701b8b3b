# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The watch node: tracks and health of a running detector on a terminal, for people on ssh.

It shows again and again what ``board`` makes of ``rso_tracks`` and ``/diagnostics``, until Ctrl-C;
what the terminal held before is then there again.
"""

from __future__ import annotations

import shutil
import sys
import threading
from typing import Self, TextIO

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from ofsat_ros.nodes import messages
from ofsat_ros.nodes.board import Board
from ofsat_ros.nodes.runtime import StartError, lifetime, parser_of, run
from ofsat_ros.nodes.topics import hear

# s; of text on a slow line this is little, and an eye is not faster.
_PERIOD_S = 0.5
_DEPTH = 10
# xterm's: another screen and back, no cursor and again one; to the top, to the end of the line or
# of the screen.
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
_TOP, _CLEAR_LINE, _CLEAR_REST = "\x1b[H", "\x1b[K", "\x1b[J"


class Watch(Node):
    """Shows a table that refreshes.

    Parameters
    ----------
    stop : threading.Event
        Set if the terminal cannot be written to any more.
    out : TextIO
        The terminal.
    context : Context, optional
        ROS context; default: the process's.

    Attributes
    ----------
    exit_code : int
        1 if the terminal could not be written to, else 0.
    """

    def __init__(self, stop: threading.Event, out: TextIO, context: Context | None = None) -> None:
        super().__init__("watch", context=context)
        self.exit_code = 0
        self._stop, self._out = stop, out
        self._closed = threading.Event()
        # Best effort hears every sender, and a frame that is lost is not missed here.
        self._tracks = hear(
            self, PointCloud2, "rso_tracks", self._on_tracks, _DEPTH, reliable=False
        )
        hear(self, DiagnosticArray, "/diagnostics", self._on_diagnostics, _DEPTH, reliable=False)
        self._board = Board(self._tracks.topic_name)
        # Callbacks and the terminal's thread look at the same board.
        self._lock = threading.Lock()
        self.create_timer(
            _PERIOD_S, self._look_around, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._thread = threading.Thread(target=self._show, name="terminal", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the terminal as it was."""
        self._closed.set()
        self._thread.join(0.5)

    def _on_tracks(self, cloud: PointCloud2) -> None:
        try:
            rows = messages.tracks_array(cloud)
        # Whatever others publish under this name.
        except messages.MessageError:
            return
        with self._lock:
            self._board.tracks(messages.stamp_ns(cloud.header.stamp), rows)

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        with self._lock:
            for status in array.status:
                values = {pair.key: pair.value for pair in status.values}
                warns = status.level != DiagnosticStatus.OK
                self._board.status(status.name, warns, status.message, values)

    def _look_around(self) -> None:
        """See who publishes the tracks, and where else there are some."""
        topic = self._tracks.topic_name
        infos = self.get_publishers_info_by_topic(topic)
        nodes = sorted({f"{i.node_namespace.rstrip('/')}/{i.node_name}" for i in infos})
        name = topic.rpartition("/")[2]
        elsewhere = [
            other
            for other, _ in self.get_topic_names_and_types()
            if other.rpartition("/")[2] == name and other != topic and self.count_publishers(other)
        ]
        with self._lock:
            self._board.publishers(nodes, elsewhere)

    def _show(self) -> None:
        with lifetime(self, self._stop):
            try:
                with _Screen(self._out) as screen:
                    self._refresh(screen)
            except OSError:  # the terminal is gone, and with it whom to tell
                self.exit_code = 1

    def _refresh(self, screen: _Screen) -> None:
        while not self._closed.wait(_PERIOD_S):
            size = shutil.get_terminal_size()
            with self._lock:
                lines = self._board.lines(size.columns, size.lines)
            screen.show(lines)


class _Screen:
    """A terminal's other screen, while it is entered."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def __enter__(self) -> Self:
        self._write(_ENTER)
        return self

    def __exit__(self, *_: object) -> None:
        self._write(_LEAVE)

    def show(self, lines: list[str]) -> None:
        """Replace what is shown, without a flicker."""
        self._write(_TOP + "\r\n".join(line + _CLEAR_LINE for line in lines) + _CLEAR_REST)

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()


def _terminal() -> TextIO:
    if not sys.stdout.isatty():
        raise StartError(
            "this is for a terminal, and standard output is none; `ros2 run ofsat_ros recorder`"
            " prints lines and writes files"
        )
    return sys.stdout


def main() -> int:
    """Run the node; return the exit code."""
    return run(
        lambda stop, options: Watch(stop, _terminal()),
        parser_of("watch", "Show tracks and health of a running detector on a terminal."),
    )
