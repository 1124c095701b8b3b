# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A job: a recording, or a segment of one, and how to process it, in plain values.

The command ``ofsat process`` does one; a batch sends many to its workers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from ofsat_ros import __version__
from ofsat_ros.camera import Astrometry
from ofsat_ros.parameters import (
    DEFAULT_PRESET,
    CameraParameters,
    DetectorParameters,
    ParameterError,
    Parameters,
    Table,
    TrackingDataParameters,
)
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.processing.run import Processing, Watch
from ofsat_ros.processing.segments import Segment, SegmentRecord, settling_frames
from ofsat_ros.recordings import Recording, open_recording
from ofsat_ros.results import DETECTIONS, STAR_FIELD, TRACKS, ResultWriter, write_run
from ofsat_ros.results.bag import BAG, ResultBag
from ofsat_ros.tracking_data import TRACKING_DATA, TrackArcs

# Arguments of `open_recording` with which it gives the same frames again.
SOURCE = ("topic", "camera_info_topic", "attitude_topic", "fps", "exposure_s", "start_ns")
_TABLES = (Parameters, CameraParameters, TrackingDataParameters)
# With so many times the frames of a last word on each side, segments tell the same.
_OVERLAP = 4


@dataclass(frozen=True)
class Job:
    """What to process, and how.

    Attributes
    ----------
    paths : tuple of str
        The recording, as `open_recording` takes it.
    source : dict
        Those of its other arguments that are named in `SOURCE`.
    preset : str
        Set of parameters.
    parameters : dict
        Values of others than the preset's, by the names of all tables.
    formats : tuple of str
        Tracking data to write: ``kvn``, ``xml``, ``iod``.
    bag : bool
        Whether to write the results as a bag, too; not of a segment.
    live : bool
        Write what the node says at each frame, not the last word on it.
    segment : Segment or None
        The part of the recording to process; None for all of it.

    Raises
    ------
    ParameterError
        If a preset or a parameter is not there, or has no such value, or a format asks for more.
    """

    paths: tuple[str, ...]
    source: dict[str, Any] = field(default_factory=dict)
    preset: str = DEFAULT_PRESET
    parameters: dict[str, Any] = field(default_factory=dict)
    formats: tuple[str, ...] = ()
    bag: bool = False
    live: bool = False
    segment: Segment | None = None

    def __post_init__(self) -> None:
        if self.bag and self.segment is not None:
            raise ValueError("bags of results are not joined: process the recording in one piece")
        known = set().union(*map(_names, _TABLES))
        if unknown := ", ".join(sorted(self.parameters.keys() - known)):
            raise ParameterError(f"there is no parameter {unknown}")
        self.make_parameters()
        self.make_arcs()

    def make_parameters(self) -> tuple[Parameters, CameraParameters, TrackingDataParameters]:
        """Return the tables of parameters."""
        given = [
            {name: value for name, value in self.parameters.items() if name in _names(table)}
            for table in _TABLES
        ]
        return (
            Parameters.preset(self.preset, **given[0]),
            CameraParameters.of(given[1]),
            TrackingDataParameters.of(given[2]),
        )

    def make_arcs(self) -> TrackArcs | None:
        """Return what collects the directions of tracks, if they are wanted."""
        about = self.make_parameters()[2]
        return TrackArcs(about, self.formats) if self.formats else None

    @property
    def overlap(self) -> int:
        """Frames on each side of a cut that two segments should have in common."""
        return _OVERLAP * self.settling

    @property
    def settling(self) -> int:
        """After so many more frames the last word on a frame has been said."""
        parameters = self.make_parameters()[0]
        return settling_frames(parameters.history_frames, parameters.coast_frames)

    def start(self, say: Callable[[str], None]) -> Run:
        """Return a run of this job; `say` takes lines for the user."""
        return Run(self, say)

    def run(
        self, folder: Path, say: Callable[[str], None], watch: Watch | None = None
    ) -> dict[str, Any]:
        """Do it; see `Run.into`."""
        with self.start(say) as run:
            return run.into(folder, watch)


class Run:
    """One run of a job; a context manager that opens the recording.

    Attributes
    ----------
    frames : Recording
        Once it is entered.
    totals : Totals
    about : dict
        What ``run.json`` says.

    Raises
    ------
    RecordingError
        If the recording cannot be opened.
    """

    frames: Recording

    def __init__(self, job: Job, say: Callable[[str], None]) -> None:
        self._job, self._start_s = job, time.monotonic()
        parameters, camera, tracking_data = job.make_parameters()
        self._record = SegmentRecord(job.segment) if job.segment else None
        # Of a segment, the joined one gets them.
        self._arcs = None if job.segment else job.make_arcs()
        self._processing = Processing(
            *(Pipeline(parameters), Astrometry(camera), self._arcs, job.live, say, self._record)
        )
        self._learns = parameters.hot_pixels == "replace"
        self.totals = self._processing.totals
        self.about: dict[str, Any] = {
            "version": __version__,
            "preset": job.preset,
            "live": job.live,
            "started_utc": datetime.now(UTC).isoformat(timespec="seconds"),
            "parameters": parameters.as_dict() | camera.as_dict() | tracking_data.as_dict(),
            "stopped": True,
            "files": [DETECTIONS, TRACKS, STAR_FIELD, *([f"{BAG}/"] if job.bag else [])],
        }

    def __enter__(self) -> Self:
        part: dict[str, Any] = {}
        if segment := self._job.segment:
            first = max(0, segment.start - segment.learned * self._learns)
            part = {"first": first, "end": segment.stop}
        self.frames = open_recording(self._job.paths, **self._job.source, **part)
        return self

    def __exit__(self, *_: object) -> None:
        self.frames.close()

    def into(self, folder: Path, watch: Watch | None = None) -> dict[str, Any]:
        """Process the frames; whatever ends it, what was done is whole.

        Parameters
        ----------
        folder : Path
            An existing folder, for the tables and ``run.json``.
        watch : callable, optional
            Is told how many frames are done, and of how many, 0 if that is not known.

        Returns
        -------
        dict
            What ``run.json`` says.

        Raises
        ------
        RecordingError, OSError
            If a file cannot be read, or written.
        """
        about, job = self.about, self._job
        with ExitStack() as stack:
            writer = stack.enter_context(ResultWriter(folder))
            scale = DetectorParameters().marker_scale
            bag = stack.enter_context(ResultBag(folder, scale)) if job.bag else None
            try:
                self._processing.run(self.frames, writer, bag, watch)
                about["stopped"] = False
            finally:
                note = self._processing.note
                about["files"] += write_arcs(self._arcs, folder, job.formats, note)
                about |= (
                    dict.fromkeys(SOURCE)
                    | job.source
                    | _origin(job.paths, self.frames)
                    | self.totals.as_dict()
                )
                about["seconds"] = time.monotonic() - self._start_s
                if self._record is not None:
                    self._record.write(folder)
                    about["segment"] = self._record.about | {"formats": list(job.formats)}
                write_run(folder, about)
        return about


def _names(table: type[Table]) -> set[str]:
    return {about.name for about in table.describe()}


def write_arcs(
    arcs: TrackArcs | None, folder: Path, formats: Sequence[str], note: Callable[[str], None]
) -> list[str]:
    """Write the tracks' directions, and return the files' names; say so if there are none."""
    if arcs is None:
        return []
    made = [name for name in formats if arcs.write(folder / TRACKING_DATA[name], name, force=True)]
    if not made:
        least = arcs.parameters.least_detections
        note(f"no tracking data is written: no track has ra and dec in {least} frames")
    return [TRACKING_DATA[name] for name in made]


def _origin(paths: Sequence[str], frames: Recording) -> dict[str, Any]:
    """Return what was opened; None where there is none."""
    where = [f"{Path(path).resolve()}" for path in paths]
    return {
        "recording": where if len(where) > 1 else where[0],
        "topic": frames.topic or None,
        "camera_info_topic": frames.camera_info_topic or None,
        "attitude_topic": frames.attitude_topic or None,
    }
