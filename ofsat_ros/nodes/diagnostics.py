# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How a node says how it is: its line on ``/diagnostics``, as aggregators and monitors expect it.

Once a second, whether anything comes or not.  OK: all is well.  WARN: it works, but something is
lost, or is not as it should be.  ERROR: it cannot do its work until somebody does something.  No
node says STALE: that is what an aggregator makes of one that says nothing for some seconds.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from ofsat_ros.nodes.topics import advertise

_DEPTH = 100
_HARDWARE_ID = "ofsat_ros"
_PERIOD_S = 1.0
_WARN_EVERY_S = 10.0


class Diagnostics:
    """A node's line on ``/diagnostics``.

    Parameters
    ----------
    node : Node
    about : str
        What follows the node in the line's name, which is ``<namespace>/<node>: <about>``.
    """

    def __init__(self, node: Node, about: str) -> None:
        self._node = node
        self._name = f"{node.get_fully_qualified_name()}: {about}"
        self._publisher = advertise(node, DiagnosticArray, "/diagnostics", _DEPTH)

    def heard(self) -> bool:
        """Return whether anybody listens."""
        return self._publisher.get_subscription_count() > 0

    def say(
        self,
        summary: str,
        values: Mapping[str, Any],
        errors: Sequence[str] = (),
        warnings: Sequence[str] = (),
    ) -> None:
        """Publish what is wrong, errors first; or, if nothing is, the summary."""
        level = DiagnosticStatus.OK
        if errors or warnings:
            level = DiagnosticStatus.ERROR if errors else DiagnosticStatus.WARN
        status = DiagnosticStatus(
            level=level,
            name=self._name,
            message="; ".join([*errors, *warnings]) or summary,
            # The same on every machine: a viewer's layout finds a line by name and this.
            hardware_id=_HARDWARE_ID,
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


class Heartbeat:
    """Calls something once a second, in a thread of its own.

    For a node whose callbacks may have to wait: it is then that others want to know how it is.

    Parameters
    ----------
    node : Node
        Its logger tells of errors; they do not end the beat.
    beat : callable
    """

    def __init__(self, node: Node, beat: Callable[[], None]) -> None:
        self._logger, self._beat = node.get_logger(), beat
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._closed.set()
        self._thread.join(0.2)

    def _run(self) -> None:
        while not self._closed.wait(_PERIOD_S):
            try:
                self._beat()
            # To say how it is must not end what works.
            except Exception:  # noqa: BLE001
                if not self._closed.is_set():
                    self._logger.error(traceback.format_exc(), throttle_duration_sec=_WARN_EVERY_S)


def nobody_publishes(node: Node, topic: str) -> str:
    """Return what a node says that waits for a detector's topic; empty if somebody sends it."""
    if node.count_publishers(topic):
        return ""
    return f"nobody publishes {topic}: is the detector running?"


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
