"""A recording, from its first frame to its result files: what ``ofsat process`` does.

Stands between ``recordings`` and ``results`` and runs the same `Pipeline` as the detector node;
what the command's options mean is ``cli``'s.  Directions are looked up when the last word on a
frame is said: the attitudes around its exposure have been read by then.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros.camera import Astrometry, Camera
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.recordings import Attitude, Frame, Recording
from ofsat_ros.results import ResultWriter, in_words
from ofsat_ros.tracking import Settled
from ofsat_ros.tracking_data import TrackArcs

Detections = NDArray[np.void]


class Totals:
    """Counts and times for the summary."""

    def __init__(self) -> None:
        self.frames = self.left_out = 0
        self.detections: Counter[int] = Counter()
        self.unlocated: Counter[str] = Counter()  # detections without direction, by the reason
        self.reason = ""
        self.reading_s = 0.0  # in its own thread, beside all others
        self._seconds: dict[str, float] = defaultdict(float)  # none overlap

    @contextmanager
    def timed(self, stage: str) -> Iterator[dict[str, float]]:
        """Count the time of a stage; that of its parts, which it may be told of, apart."""
        parts: dict[str, float] = {}
        start_s = time.perf_counter()
        try:
            yield parts
        finally:
            taken_s = time.perf_counter() - start_s
            for part, seconds in (*parts.items(), (stage, taken_s - sum(parts.values()))):
                self._seconds[part] += seconds

    def profile(self) -> str:
        """Return a table of where the time went."""
        frames, whole_s = max(self.frames, 1), sum(self._seconds.values())
        lines = [f"{'stage':<26}{'ms per frame':>12}{'share':>8}"]
        rows = sorted(self._seconds.items(), key=lambda row: -row[1])
        rows += [("all", whole_s), ("reading, meanwhile", self.reading_s)]
        for stage, seconds in rows:
            name, share = stage.replace("_", " "), f"{seconds / whole_s:.1%}"
            lines.append(f"{name:<26}{1e3 * seconds / frames:>12.2f}{share:>8}")
        return "\n".join(lines)

    def __str__(self) -> str:
        words = f"{in_words(self.detections)} in {self.frames} frames"
        if self.left_out:
            words += f" ({self.left_out} more could not be processed)"
        if not self.detections and self.reason:
            words += f"; the last frame says: {self.reason}"
        return words


class Processing:
    """Takes a recording's frames through the pipeline, and what they give into files.

    Parameters
    ----------
    pipeline : Pipeline
    astrometry : Astrometry
        Takes calibration and attitudes from the recording.
    arcs : TrackArcs or None
        Collects the tracks' directions; None if nobody wants them.
    live : bool
        Write what the node would say at each frame, instead of the last word on it.
    say : callable
        Takes a line for the user.

    Attributes
    ----------
    totals : Totals
    """

    def __init__(
        self,
        pipeline: Pipeline,
        astrometry: Astrometry,
        arcs: TrackArcs | None,
        live: bool,
        say: Callable[[str], None],
    ) -> None:
        self.totals = Totals()
        self._pipeline, self._astrometry = pipeline, astrometry
        self._arcs, self._live, self._say = arcs, live, say
        self._writer: ResultWriter
        self._refused = 0
        self._misfit = self._calibrated = False
        # Of each frame by the pipeline's number: that in the recording, which counts those that
        # could not be decoded, too, and its calibration.
        self._frames: dict[int, tuple[int, Camera | None]] = {}
        self._settled: list[Settled] = []  # until the attitudes after their frames are known

    def run(self, frames: Recording, writer: ResultWriter) -> None:
        """Process every frame; what was done is written whatever ends it.

        Raises
        ------
        RecordingError, OSError
            If a file cannot be read, or written.
        """
        totals, self._writer = self.totals, writer
        coming = iter(tqdm(frames, unit=" frames", dynamic_ncols=True, disable=None))
        try:
            while True:
                with totals.timed("waiting for frames"):
                    frame = next(coming, None)
                if frame is None:
                    break
                self._take(frame)
            self._add_attitudes(frames.last_attitudes)
        finally:
            # Also when stopped or torn off: what was seen is not lost.
            with totals.timed("the last frames' last word"):
                self._settled += self._pipeline.finish()
                self._write_settled()
            totals.reading_s = frames.seconds
        totals.left_out = self._refused + frames.skipped
        for problem in frames.problems:
            self._say(f"note: {problem}")
        # Most cameras are not calibrated, and nobody misses directions then.
        wanted = self._arcs is not None or self._calibrated
        for why, count in totals.unlocated.items() if wanted else ():
            self._say(f"note: {count} detections have no ra and dec: {why}{_missing(frames)}")

    def _take(self, frame: Frame) -> None:
        totals = self.totals
        camera = self._camera_of(frame)
        self._add_attitudes(frame.attitudes)
        self._write_settled()
        try:
            with totals.timed("other") as stages:
                middle_ns = self._astrometry.middle_ns(frame.stamp_ns)
                result = self._pipeline.process(frame.image, middle_ns)
                stages |= result.seconds
        except ImageError as error:
            self._refused += 1
            if self._refused == 1:
                self._say(f"note: frame {frame.number} is left out, and others like it: {error}")
            return
        if result.reset and totals.frames:
            self._say(f"note: frame {frame.number} starts afresh: {result.reset}")
        self._frames[result.frame] = frame.number, camera
        with totals.timed("writing"):
            self._write(result)
        totals.frames += 1
        totals.reason = result.reason

    def _camera_of(self, frame: Frame) -> Camera | None:
        camera, (height, width) = frame.camera, frame.image.shape
        if camera is not None and (camera.height, camera.width) != (height, width):
            if not self._misfit:
                self._misfit = True
                self._say(
                    f"note: camera_info is for images of {camera.width}x{camera.height}, not of"
                    f" {width}x{height}: directions are unknown"
                )
            return None
        if camera is not None and not self._calibrated:
            # The first calibration often comes with the first image, and after it.
            self._calibrated = True
            self._frames = {key: (number, camera) for key, (number, _) in self._frames.items()}
        return camera

    def _add_attitudes(self, attitudes: tuple[Attitude, ...]) -> None:
        for stamp_ns, rotation in attitudes:
            self._astrometry.add_attitude(stamp_ns, rotation)

    def _write(self, result: FrameResult) -> None:
        number, _ = self._frames[result.frame]
        self._writer.add_star_field(replace(result, frame=number))
        if self._live:
            self._write_detections(result.stamp_ns, result.frame, result.detections)
        self._settled += result.settled

    def _write_settled(self) -> None:
        settled, self._settled = self._settled, []
        for last in settled:
            # A frame in which an error ended all is in the history, but was not answered.
            if last.frame in self._frames and not self._live:
                self._write_detections(last.stamp_ns, last.frame, last.detections)
            self._frames.pop(last.frame, None)

    def _write_detections(self, stamp_ns: int, frame: int, detections: Detections) -> None:
        number, self._astrometry.camera = self._frames[frame]
        why = self._astrometry.locate(detections, stamp_ns)
        if why and len(detections):
            self.totals.unlocated[why] += len(detections)
        self._writer.add_detections(stamp_ns, number, detections)
        if self._arcs is not None:
            self._arcs.add(stamp_ns, detections)
        self.totals.detections.update(detections["track_id"].tolist())


def _missing(frames: Recording) -> str:
    """Say which topics for directions a recording does not have; empty if it has both."""
    topics = {
        "camera_info (sensor_msgs/CameraInfo)": frames.camera_info_topic,
        "attitude (geometry_msgs/QuaternionStamped)": frames.attitude_topic,
    }
    missing = [about for about, topic in topics.items() if not topic]
    return f"; the recording has no topic {' and none '.join(missing)}" if missing else ""
