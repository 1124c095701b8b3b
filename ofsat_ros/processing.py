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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros.camera import Astrometry, Camera
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.recordings import Attitude, Frame, Recording
from ofsat_ros.results import STAR_FIELD, ResultWriter, in_words
from ofsat_ros.results.bag import ResultBag
from ofsat_ros.tracking import Settled
from ofsat_ros.tracking_data import TrackArcs

Detections = NDArray[np.void]

# Of a camera that stamps badly, each frame may start afresh.
_RESETS_TOLD = 5


class Totals:
    """Counts, times and notes, for the summary and for ``run.json``."""

    def __init__(self) -> None:
        self.frames = self.left_out = 0
        self.first_stamp_ns: int | None = None  # middle of the exposure, as in all files
        self.last_stamp_ns: int | None = None
        self.problems: list[str] = []
        self.detections: Counter[int] = Counter()  # by track; 0 stands for candidates
        self.unlocated: Counter[str] = Counter()  # detections without direction, by the reason
        self.resets = 0  # after the first frame
        self.reason = ""
        self.reading_s = 0.0  # in its own thread, beside all others
        self._sizes: Counter[tuple[int, int]] = Counter()  # of the images: height, width
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

    def add_frame(self, result: FrameResult) -> None:
        """Count a frame."""
        self.frames += 1
        self.reason = result.reason
        self._sizes[result.shape] += 1
        self.last_stamp_ns = result.stamp_ns
        if self.first_stamp_ns is None:
            self.first_stamp_ns = result.stamp_ns

    def as_dict(self) -> dict[str, Any]:
        """Return what ``run.json`` says of them."""
        same = ("frames", "left_out", "first_stamp_ns", "last_stamp_ns")
        candidates = self.detections[0]
        # Of most frames, should they differ.
        height, width = self._sizes.most_common(1)[0][0] if self._sizes else (None, None)
        return {
            **{name: getattr(self, name) for name in same},
            **{"width": width, "height": height},
            "detections": self.detections.total() - candidates,
            "candidates": candidates,
            "tracks": sum(1 for track_id in self.detections if track_id),
            "problems": self.problems,
            "unlocated": dict(self.unlocated),
            "profile": {**self._seconds, "reading, meanwhile": self.reading_s},
        }

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
        words = f"{in_words(self.detections)} in {self.frames} frame{'s' * (self.frames != 1)}"
        if self.left_out:
            words += f" ({self.left_out} more could not be processed)"
        if not self.detections and self.reason:
            words += f"; the last frame says: {self.reason}"
        return words


@dataclass(frozen=True)
class _Seen:
    """A frame that the pipeline has processed, until the last word on it is said."""

    number: int  # in the recording, which counts those that could not be decoded, too
    stamp_ns: int  # of its header
    frame_id: str
    camera: Camera | None
    result: FrameResult


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
        self._bag: ResultBag | None
        self._refused = 0
        # The frame before with its camera, if it was refused, and why: the next may confirm it.
        self._held: tuple[Frame, Camera | None, str] | None = None
        self._misfit = self._calibrated = False
        self._seen: dict[int, _Seen] = {}  # by the pipeline's number
        self._settled: list[Settled] = []  # until the attitudes after their frames are known

    def run(self, frames: Recording, writer: ResultWriter, bag: ResultBag | None = None) -> None:
        """Process every frame; what was done is written whatever ends it.

        Parameters
        ----------
        frames : Recording
        writer : ResultWriter
        bag : ResultBag, optional
            Gets the same detections; the tracks are as they were known at their frame.

        Raises
        ------
        RecordingError, OSError
            If a file cannot be read, or written.
        """
        totals, self._writer, self._bag = self.totals, writer, bag
        bar = tqdm(
            frames,
            total=len(frames) or None,
            unit=" frames",
            dynamic_ncols=True,
            disable=None,  # where nobody watches
        )
        coming = iter(bar)
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
            self._leave_out_held()
            totals.reading_s = frames.seconds
            totals.left_out = self._refused + frames.skipped
            if more := max(totals.resets - _RESETS_TOLD, 0):
                self.note(f"{more} more frames start afresh: {STAR_FIELD} says why")
            for problem in frames.problems:
                self.note(problem)
        # Most cameras are not calibrated, and nobody misses directions then.
        wanted = self._arcs is not None or self._calibrated
        for why, count in totals.unlocated.items() if wanted else ():
            self.note(f"{count} detections have no ra and dec: {why}{_missing(frames)}")

    def note(self, problem: str) -> None:
        """Tell the user, now and in ``run.json``."""
        self.totals.problems.append(problem)
        self._say(f"note: {problem}")

    def _take(self, frame: Frame) -> None:
        totals = self.totals
        camera = self._camera_of(frame)
        self._add_attitudes(frame.attitudes)
        with totals.timed("writing"):
            self._write_settled()
        try:
            with totals.timed("other") as stages:
                middle_ns = self._astrometry.middle_ns(frame.stamp_ns)
                result = self._pipeline.process(frame.image, middle_ns)
                stages |= result.seconds
        except ImageError as error:
            self._leave_out_held()
            self._held = frame, camera, f"{error}"
            return
        if result.held_back is not None and self._held is not None:
            self._see(*self._held[:2], result.held_back)
            self._held = None
        self._leave_out_held()
        self._see(frame, camera, result)
        self._settled += result.settled

    def _leave_out_held(self) -> None:
        """Give up the frame before, if it was refused: it stays so."""
        if self._held is None:
            return
        (frame, _, why), self._held = self._held, None
        self._refused += 1
        if self._refused == 1:
            self.note(f"frame {frame.number} is left out, and others like it: {why}")

    def _see(self, frame: Frame, camera: Camera | None, result: FrameResult) -> None:
        """Write what is known of a frame at once, and what its last word will need."""
        totals = self.totals
        if result.reset and totals.frames:
            totals.resets += 1
            if totals.resets <= _RESETS_TOLD:
                self.note(f"frame {frame.number} starts afresh: {result.reset}")
        seen = _Seen(frame.number, frame.stamp_ns, frame.frame_id, camera, result)
        self._seen[result.frame] = seen
        with totals.timed("writing"):
            self._writer.add_star_field(replace(result, frame=frame.number))
            if self._live:
                self._write(seen, result.detections)
        totals.add_frame(result)

    def _camera_of(self, frame: Frame) -> Camera | None:
        camera, (height, width) = frame.camera, frame.image.shape
        if camera is not None and (camera.height, camera.width) != (height, width):
            if not self._misfit:
                self._misfit = True
                self.note(
                    f"camera_info is for images of {camera.width}x{camera.height}, not of"
                    f" {width}x{height}: directions are unknown"
                )
            return None
        if camera is not None and not self._calibrated:
            # The first calibration often comes with the first image, and after it.
            self._calibrated = True
            self._seen = {key: replace(seen, camera=camera) for key, seen in self._seen.items()}
        return camera

    def _add_attitudes(self, attitudes: tuple[Attitude, ...]) -> None:
        for stamp_ns, rotation in attitudes:
            self._astrometry.add_attitude(stamp_ns, rotation)

    def _write_settled(self) -> None:
        settled, self._settled = self._settled, []
        for last in settled:
            # A frame in which an error ended all is in the history, but was not answered.
            seen = self._seen.pop(last.frame, None)
            if seen is not None and not self._live:
                self._write(seen, last.detections)

    def _write(self, seen: _Seen, detections: Detections) -> None:
        stamp_ns, tracks = seen.result.stamp_ns, seen.result.tracks
        self._astrometry.camera = seen.camera
        why = self._astrometry.locate(detections, stamp_ns)
        if why and len(detections):
            self.totals.unlocated[why] += len(detections)
        self._writer.add_detections(stamp_ns, seen.number, detections)
        if self._arcs is not None:
            self._arcs.add(stamp_ns, detections)
        self.totals.detections.update(detections["track_id"].tolist())
        if self._bag is not None:
            self._astrometry.locate(tracks, stamp_ns)
            self._bag.add(
                seen.stamp_ns, seen.frame_id, replace(seen.result, detections=detections)
            )


def _missing(frames: Recording) -> str:
    """Say what for directions a recording does not have; empty if it has all."""
    if not frames.topic:
        return "; no file's header has a celestial WCS" if frames.kind == "FITS" else ""
    topics = {
        "camera_info (sensor_msgs/CameraInfo)": frames.camera_info_topic,
        "attitude (geometry_msgs/QuaternionStamped)": frames.attitude_topic,
    }
    missing = [about for about, topic in topics.items() if not topic]
    return f"; the recording has no topic {' and none '.join(missing)}" if missing else ""
