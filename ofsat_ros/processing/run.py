# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A recording's frames through the pipeline, one after the other.

Directions are looked up when the last word on a frame is said: the attitudes around its exposure
have been read by then.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.camera import Astrometry, Camera
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.processing.output import Output
from ofsat_ros.processing.segments import SegmentRecord
from ofsat_ros.recordings import Attitude, Frame, Recording
from ofsat_ros.results import ResultWriter
from ofsat_ros.results.bag import ResultBag
from ofsat_ros.tracking import Settled
from ofsat_ros.tracking_data import TrackArcs

Detections = NDArray[np.void]
# Is told how many frames are done, and of how many, 0 if that is not known.
Watch = Callable[[int, int], None]


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
    record : SegmentRecord, optional
        Of a segment of a recording: takes what its joining with others needs.

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
        record: SegmentRecord | None = None,
    ) -> None:
        self._output = Output(arcs, say)
        self.totals, self.note = self._output.totals, self._output.note
        self._pipeline, self._astrometry, self._live = pipeline, astrometry, live
        self._record = record
        self._bag: ResultBag | None
        self._refused = 0
        # The frame before with its camera, if it was refused, and why: the next may confirm it.
        self._held: tuple[Frame, Camera | None, str] | None = None
        self._misfit = self._calibrated = False
        self._seen: dict[int, _Seen] = {}  # by the pipeline's number
        self._settled: list[Settled] = []  # until the attitudes after their frames are known

    def run(
        self,
        frames: Recording,
        writer: ResultWriter,
        bag: ResultBag | None = None,
        watch: Watch | None = None,
    ) -> None:
        """Process every frame; what was done is written whatever ends it.

        Parameters
        ----------
        frames : Recording
        writer : ResultWriter
        bag : ResultBag, optional
            Gets the same detections; the tracks are as they were known at their frame.
        watch : callable, optional
            Is told how many frames are done, and of how many, 0 if that is not known.

        Raises
        ------
        RecordingError, OSError
            If a file cannot be read, or written.
        """
        totals, self._output.writer, self._bag = self.totals, writer, bag
        done, coming = 0, iter(frames)
        try:
            while True:
                with totals.timed("waiting for frames"):
                    frame = next(coming, None)
                if frame is None:
                    break
                self._take(frame)
                done += 1
                if watch is not None:
                    watch(done, len(frames))
            self._add_attitudes(frames.last_attitudes)
        finally:
            # Also when stopped or torn off: what was seen is not lost.
            with totals.timed("the last frames' last word"):
                self._settled += self._pipeline.finish()
                self._write_settled()
            self._leave_out_held()
            totals.reading_s = frames.seconds
            totals.left_out = self._refused + frames.skipped
            missing = _missing(frames)
            if self._record is not None:
                notes = self._output.notes.copy()
                self._record.end(frames, notes, self._calibrated, missing)
            self._output.end(frames.problems)
        self._output.tell_unlocated(self._calibrated, missing)

    def _take(self, frame: Frame) -> None:
        totals = self.totals
        camera = self._camera_of(frame)
        self._add_attitudes(frame.attitudes)
        with totals.timed("writing"):
            self._write_settled()
        only_learn = self._record is not None and frame.number < self._record.segment.start
        try:
            with totals.timed("other") as stages:
                middle_ns = self._astrometry.middle_ns(frame.stamp_ns)
                if only_learn:
                    self._pipeline.learn(frame.image, middle_ns)
                    return
                result = self._pipeline.process(frame.image, middle_ns)
                stages |= result.seconds
        except ImageError as error:
            if not only_learn:
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
        output, stamp_ns = self._output, result.stamp_ns
        seen = _Seen(frame.number, frame.stamp_ns, frame.frame_id, camera, result)
        self._seen[result.frame] = seen
        with self.totals.timed("writing"):
            output.writer.add_star_field(replace(result, frame=frame.number))
            if self._live:
                self._write(seen, result.detections)
        # Not before it is written: what the disk has no room for does not count.
        output.add_frame(frame.number, stamp_ns, result.shape, result.reset, result.reason)
        if self._record is not None:
            self._record.add_frame(frame.number, result)

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
        self._output.add_detections(seen.number, stamp_ns, detections, why)
        if self._record is not None:
            self._record.add_detections(seen.number, stamp_ns, detections, why)
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
