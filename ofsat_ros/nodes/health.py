# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the detector knows of its own state: counts, rates, and what is wrong in words.

The detector tells it what happens; ``/diagnostics`` shows what it makes of it.  It imports no ROS.
Images come in one thread, are answered in another, and a third asks how it is.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from ofsat_ros import report
from ofsat_ros.detection import CONFIRMED
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.tracking import COASTING

# s; a loss is a warning for so long, and rates are taken over it.
_RECENT_S = 10.0
# More of the newest frames are not needed for a rate.
_FRAMES_IN_RATE = 200
# A torn frame or two are none of the node's; so many in a row are.
_FAILING = 3
# The middleware drops what it cannot read, and does not tell it from what did not come.
_OR_TORN = "; or, if it is one now and then, the sender's messages are torn"
# s; a stage's time is its mean over it, or that of the last frame.
_PROFILE_S = 1.0


@contextmanager
def timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Put the time that the ``with`` takes into `seconds`, s."""
    start_s = time.perf_counter()
    try:
        yield
    finally:
        seconds[step] = time.perf_counter() - start_s


@dataclass(frozen=True)
class Around:
    """What a detector sees of the graph.

    Attributes
    ----------
    publishers : int
        How many publish the image topic.
    elsewhere : sequence of str
        Other topics with images.
    rivals : sequence of str
        Other nodes that publish detections where this one does.
    """

    publishers: int = 0
    elsewhere: Sequence[str] = ()
    rivals: Sequence[str] = ()


class Health:
    """State of a detector; its methods are told what happens, `problems` and `values` read it.

    Parameters
    ----------
    topic : str
        Image topic, as resolved.
    reliable : bool
        Whether every frame is to be processed.
    profile : str
        Path of the Fast DDS profile for large images.
    """

    def __init__(self, topic: str, reliable: bool, profile: str) -> None:
        self._lock = threading.Lock()  # for what both threads touch
        self._topic = topic
        self._reliable = reliable
        self._profile = profile
        self._counts = dict.fromkeys(("received", "processed", "failed", "dropped", "lost"), 0)
        self._last_image_s = time.monotonic()
        self._last_loss_s = self._last_drop_s = -_RECENT_S
        self._last_sequence: int | None = None
        self._processed_at: deque[float] = deque(maxlen=_FRAMES_IN_RATE)
        self._latency_s = float("nan")
        self._profile_of: deque[tuple[float, Mapping[str, float]]] = deque(maxlen=_FRAMES_IN_RATE)
        self._drawing_s = float("nan")
        self._failure, self._failures = "", 0  # of the last frames, in a row
        self._incompatible = ""
        self._zero_stamp = False
        self._result: FrameResult | None = None
        self.enabled = True
        self.around = Around()
        # Why directions are unknown, empty if they are known; and whether that is a fault.
        self.directions: tuple[str, bool] = ("no image has come", False)

    def image_received(self, sequence: int | None, has_stamp: bool) -> None:
        """Count an image; `sequence` is its sender's number of it, None if that means nothing."""
        now = time.monotonic()
        last, self._last_sequence = self._last_sequence, sequence
        # A smaller number is a sender that began anew.
        if last is not None and sequence is not None and sequence > last + 1:
            self._counts["lost"] += sequence - last - 1
            self._last_loss_s = now
        self._counts["received"] += 1
        self._last_image_s = now
        self._zero_stamp = not has_stamp

    def dropped(self, count: int) -> None:
        """Count frames that a newer one replaced before they were processed."""
        if count:
            self._counts["dropped"] += count
            self._last_drop_s = time.monotonic()

    def processed(
        self, result: FrameResult, latency_s: float, seconds: Mapping[str, float]
    ) -> None:
        """Take note of a frame's result.

        Parameters
        ----------
        result : FrameResult
        latency_s : float
            From its receipt to its answer, s.
        seconds : mapping of str to float
            What each step took, s, in their order.
        """
        now = time.monotonic()
        with self._lock:
            self._counts["processed"] += 1
            self._processed_at.append(now)
            self._profile_of.append((now, seconds))
            while now - self._profile_of[0][0] > _PROFILE_S:
                self._profile_of.popleft()
            self._latency_s = latency_s
            self._result = result
            self._failure, self._failures = "", 0

    def drawn(self, seconds: float) -> None:
        """Take note of how long drawing took, s."""
        self._drawing_s = seconds

    def failed(self, why: str) -> None:
        """Take note of a frame that could not be processed."""
        with self._lock:
            self._counts["failed"] += 1
            self._failure = why
            self._failures += 1

    def incompatible_qos(self, policy: str) -> str:
        """Take note of a publisher that cannot be heard; return what to say about it."""
        if policy == "RELIABILITY":
            remedy = (
                "this detector asks for reliable delivery, the publisher is best effort: start the"
                " detector with reliable_input:=false, or make the publisher reliable"
            )
        else:
            remedy = (
                f"they differ in {policy}: set qos_overrides.{self._topic}.subscription."
                f"{policy.lower()} to what the publisher offers"
            )
        self._incompatible = f"a publisher of {self._topic} cannot be heard: {remedy}"
        return self._incompatible

    def silence_s(self) -> float:
        """Return the time since the last image, or since the start, s."""
        return time.monotonic() - self._last_image_s

    def silence(self, timeout_s: float) -> str:
        """Return what to say when no image came for so long, with the remedy; else empty."""
        if not self.enabled or self.silence_s() <= timeout_s:
            return ""
        elsewhere = self.around.elsewhere
        if self._counts["received"]:
            state = (
                "the sender has paused or hangs: see to the camera and its driver"
                if self.around.publishers
                else "nobody publishes it any more: start the camera's driver again"
            )
            why = f"{self._counts['received']} came before; {state}"
        elif not self.around.publishers:
            found = f"; images are on {', '.join(elsewhere)}" if elsewhere else ""
            why = f"nobody publishes it; remap {_relative(self._topic)} to the camera's{found}"
        else:
            why = (
                "somebody publishes it, but paused, or with an incompatible QoS, or its images do"
                f" not fit its shared memory; {self._remedy_at_sender()}"
            )
        return f"no image on {self._topic} for {self.silence_s():.0f} s: {why}"

    def rivalry(self) -> str:
        """Return what to say when others publish detections on the same topic; else empty."""
        if not self.around.rivals:
            return ""
        return (
            f"{', '.join(self.around.rivals)} publishes detections on the same topic, and who"
            " listens takes both for one: end one of them, or give each a namespace"
            " (-r __ns:=/east)"
        )

    def mixture(self) -> str:
        """Return what to say when several send images on the one topic; else empty."""
        if self.around.publishers < 2:
            return ""
        return (
            f"{self.around.publishers} publish {self._topic}: if two cameras do, their skies are"
            " mixed; give each camera a topic and a detector of its own"
        )

    def lateness(self, timeout_s: float) -> str:
        """Return what to say when images are answered so long after they came; else empty."""
        with self._lock:
            late = self._latency_s > timeout_s
            # Of the last image before a silence nothing more is to be done.
            late = late and time.monotonic() - self._processed_at[-1] <= _RECENT_S
            latency_s = self._latency_s
        if not late:
            return ""
        return (
            f"answers come {latency_s:.0f} s after their images, which come faster than they are"
            " processed: slow the sender down, bin the images, or raise threshold_sigmas"
        )

    def losses(self) -> str:
        """Return what to say about frames lost a short while ago; empty if there are none."""
        if time.monotonic() - self._last_loss_s > _RECENT_S:
            return ""
        lost = self._counts["lost"]
        if self._reliable:
            return (
                f"at least {lost} frames lost: they come faster than they are processed; slow the"
                f" sender down, or raise queue_depth{_OR_TORN}"
            )
        return f"at least {lost} frames lost on the way: {self._remedy_at_sender()}{_OR_TORN}"

    def problems(self, timeout_s: float, in_work_s: float = 0.0) -> tuple[list[str], list[str]]:
        """Return what is wrong now, in words.

        Parameters
        ----------
        timeout_s : float
            What must happen once in a while is missed after so long, s.
        in_work_s : float
            How long the frame in work has been so, s.

        Returns
        -------
        errors, warnings : list of str
            What keeps it from detecting anything; what is merely not as it should be.
        """
        drops = time.monotonic() - self._last_drop_s <= _RECENT_S
        with self._lock:
            failure, failures, result = self._failure, self._failures, self._result
        failed = f"the last frame could not be processed: {failure}" if failure else ""
        unknown, faulty = self.directions
        stuck = stuck_words(in_work_s, timeout_s)
        errors = [
            stuck,
            # Who is at a frame for so long may not have looked for the next.
            "" if stuck else self.silence(timeout_s),
            self._incompatible if not self._counts["received"] else "",
            failed if failures >= _FAILING else "",
            "images bear no stamp, without which there is no velocity: have the driver set"
            " header.stamp"
            if self._zero_stamp
            else "",
        ]
        warnings = [
            "" if self.enabled else "disabled by ~/enable: images are ignored",
            self.rivalry(),
            self.mixture(),
            self.losses(),
            self.lateness(timeout_s),
            f"slower than the camera: {self._counts['dropped']} frames dropped" if drops else "",
            failed if failures < _FAILING else "",
            f"nothing is seen: {result.reason}" if result and not len(result.objects) else "",
            f"directions are unknown: {unknown}" if faulty else "",
        ]
        return [words for words in errors if words], [words for words in warnings if words]

    def summary(self) -> str:
        """Return the state in words when nothing is wrong."""
        with self._lock:
            result = self._result
        if result is None:
            return "waiting for images"
        return report.summary(result)

    def pace(self) -> str:
        """Return in words how fast frames are answered, and how many were not."""
        with self._lock:
            rate_hz, latency_s = self._rate_hz(), self._latency_s
        dropped, lost = self._counts["dropped"], self._counts["lost"]
        return (
            f"{rate_hz:.1f} Hz  latency {1e3 * latency_s:.0f} ms  {dropped} dropped  {lost} lost"
        )

    def values(self) -> dict[str, Any]:
        """Return names and values for ``/diagnostics``: counts, and what the last frame gave."""
        values: dict[str, Any] = {}
        with self._lock:
            values |= {f"frames_{key}": count for key, count in self._counts.items()}
            values |= {"rate_hz": self._rate_hz(), "latency_s": self._latency_s}
            result = self._result
            recent = [seconds for _, seconds in self._profile_of]
        if result is None:
            return values
        profile = _means(recent) | {"draw": self._drawing_s}
        steps = {f"profile_{step}_ms": 1e3 * seconds for step, seconds in profile.items()}
        return (
            values | _frame_values(result) | {"directions": self.directions[0] or "known"} | steps
        )

    def _rate_hz(self) -> float:
        now = time.monotonic()
        recent = [at for at in self._processed_at if now - at <= _RECENT_S]
        if len(recent) < 2 or recent[-1] == recent[0]:
            return 0.0
        return (len(recent) - 1) / (recent[-1] - recent[0])

    def _remedy_at_sender(self) -> str:
        return (
            "start the camera driver with"
            f" FASTRTPS_DEFAULT_PROFILES_FILE={self._profile} (the sender's setting decides), and"
            " see that /dev/shm has room for it"
        )


def stuck_words(in_work_s: float, timeout_s: float) -> str:
    """Return what to say of a frame that is in work for longer than the timeout; else empty."""
    if in_work_s <= timeout_s:
        return ""
    return (
        f"the frame in work takes {in_work_s:.0f} s so far: if it does not end, restart the"
        " detector; if all are slow, bin the images or raise threshold_sigmas"
    )


def _frame_values(result: FrameResult) -> dict[str, Any]:
    confirmed = int(np.count_nonzero(result.detections["status"] == CONFIRMED))
    field = result.star_field
    # x px, y px, rotation rad
    motion = np.full(3, np.nan) if field is None else [*field.displacement, field.rotation]
    rate = np.divide(motion, result.dt_s)
    return {
        "frame": result.frame,
        "stamp_ns": result.stamp_ns,
        "objects": len(result.objects),
        "stars": field.star_count if field else 0,
        "spots": result.spot_count,
        "rso_confirmed": confirmed,
        "rso_candidates": len(result.detections) - confirmed,
        "tracks": len(result.tracks),
        "tracks_coasting": int(np.count_nonzero(result.tracks["status"] == COASTING)),
        "noise_dn": result.noise,
        "background_dn": result.background,
        "threshold_dn": result.threshold,
        "star_motion_x_px": motion[0],
        "star_motion_y_px": motion[1],
        "star_motion_x_px_s": rate[0],
        "star_motion_y_px_s": rate[1],
        "star_rotation_rad_s": rate[2],
        "star_residual_px": field.residual_px if field else float("nan"),
        "frame_interval_s": result.dt_s,
        "processing_s": sum(result.seconds.values()),
        "nothing_detected_because": result.reason,
    }


def _means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each step that the last row has; a row without a step counts as 0."""
    return {step: sum(row.get(step, 0.0) for row in rows) / len(rows) for step in rows[-1]}


def _relative(topic: str) -> str:
    return "image/compressed" if topic.endswith("/compressed") else "image"
