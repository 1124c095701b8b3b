# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the detector draws for people: ``flow_markers`` and ``image_annotated``.

It stands after the answer, in a thread of its own: nothing is drawn that nobody looks at, and
what is drawn delays no answer.  A live camera's frames are left out when drawing falls behind or
would take more than half a core; with reliable input every frame is drawn, and drawing slows the
replay down instead.  A viewer who does not take his pictures (stopped, or behind a slow line) gets
fewer, and nobody waits for him.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Header

from ofsat_ros import report
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.health import Health
from ofsat_ros.nodes.runtime import Inbox
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.report.words import instant

# s; the longest rest between two pictures.
_REST_S = 0.2
# s; so long what was sent may be on its way to a viewer before he is taken to hang.
_PATIENCE_S = 1.0
_POLL_S = 0.01
_WARN_EVERY_S = 10.0


@dataclass(frozen=True)
class _Scene:
    """What is to be drawn: an image, its result, and where its tracks were before."""

    image: np.ndarray
    result: FrameResult
    scale: float
    tails: Mapping[int, np.ndarray]


class Drawing:
    """Draws the newest result while the detector goes on.

    Parameters
    ----------
    node : Node
        Its logger says what went wrong.
    markers, pictures : Publisher
        Of MarkerArray and Image.
    every_frame : bool
        Whether no frame may be left out.
    health : Health
        Told how long it took.
    """

    def __init__(
        self,
        node: Node,
        markers: Publisher,
        pictures: Publisher,
        every_frame: bool,
        health: Health,
    ) -> None:
        self._logger = node.get_logger()
        self._markers, self._pictures, self._health = markers, pictures, health
        self._every_frame = every_frame
        # One in work and one that waits: more would only take memory.
        self._inbox = Inbox(1, None if every_frame else 0.0, limit_bytes=0)
        self._shown: tuple[Header, float] | None = None  # markers that are to be seen, since when
        self._received_s = 0.0  # when all pictures sent so far had arrived
        self._tails = report.Tails()
        self._thread = threading.Thread(target=self._work, name="drawing", daemon=True)
        self._thread.start()

    def show(self, header: Header, image: np.ndarray, result: FrameResult, scale: float) -> None:
        """Have a result drawn, if anybody looks."""
        # Always: who begins to look is to see where the tracks come from.
        self._tails.add(result)
        if self._markers.get_subscription_count() or self._pictures.get_subscription_count():
            scene = _Scene(image, result, scale, self._tails.places())
            self._inbox.put((header, scene), image.nbytes)

    def clear(self, header: Header) -> None:
        """Have the markers deleted after a frame that gave nothing."""
        self._inbox.put((header, None), 0)

    def clear_after(self, seconds: float) -> None:
        """Delete markers that are older; viewers would show them for ever."""
        shown = self._shown
        if shown is not None and time.monotonic() - shown[1] > seconds:
            self._shown = None
            self._markers.publish(messages.no_flow_markers(shown[0]))

    def close(self) -> None:
        """End the thread, after the picture in work."""
        self._inbox.close()
        self._thread.join(0.2)

    def _work(self) -> None:
        while (item := self._inbox.get()) is not None:
            start_s = time.perf_counter()
            try:
                self._draw(*item)
            # A viewer gets no picture of this frame; the next may succeed.
            except Exception:  # noqa: BLE001
                if self._inbox.closed:
                    return
                self._logger.error(traceback.format_exc(), throttle_duration_sec=_WARN_EVERY_S)
            taken_s = time.perf_counter() - start_s
            if item[1] is not None:
                self._health.drawn(taken_s)
            if not self._every_frame:
                time.sleep(min(taken_s, _REST_S))

    def _draw(self, header: Header, scene: _Scene | None) -> None:
        if scene is None:
            self._shown = None
            self._markers.publish(messages.no_flow_markers(header))
            return
        if self._markers.get_subscription_count():
            array = messages.flow_markers(header, scene.result, scene.scale)
            self._markers.publish(array)
            self._shown = (header, time.monotonic())
        if self._pictures.get_subscription_count() and self._pictures_arrive():
            picture = report.annotate(
                scene.image,
                scene.result,
                scale=scene.scale,
                tails=scene.tails,
                footer=f"{instant(messages.stamp_ns(header.stamp))} UTC  {self._health.pace()}",
            )
            self._pictures.publish(messages.image_message(header, picture))

    def _pictures_arrive(self) -> bool:
        """Tell whether all viewers have what was sent: to send more holds up this whole process.

        rclpy lets no other thread run while the middleware sends, which takes many times as long
        for one who takes nothing.
        """
        while not self._pictures.wait_for_all_acked(Duration(seconds=0)):
            behind = time.monotonic() - self._received_s > _PATIENCE_S
            if behind:
                self._logger.warning(
                    f"pictures are left out: a viewer of {self._pictures.topic_name} does not take"
                    " them; end it, or let it ask for best effort",
                    throttle_duration_sec=_WARN_EVERY_S,
                )
            if behind or not self._every_frame or self._inbox.closed:
                return False
            time.sleep(_POLL_S)
        self._received_s = time.monotonic()
        return True
