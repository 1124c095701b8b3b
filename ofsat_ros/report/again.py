# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The recording that results are of, looked at a second time: where all pictures come from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros.camera import Astrometry
from ofsat_ros.parameters import CameraParameters, ParameterError
from ofsat_ros.recordings import Frame, Recording, RecordingError, open_recording
from ofsat_ros.report import words
from ofsat_ros.report.findings import Findings
from ofsat_ros.results import RUN, ResultError


def open_again(findings: Findings, recording: str | Path | None) -> Recording:
    """Open the recording that the findings are of.

    Raises
    ------
    RecordingError
        If it is not there, or not readable.
    """
    run = findings.run
    told = [recording] if recording else words.recordings(run)
    paths = [Path(each) for each in told or ["?"]]
    for path in paths:
        if not path.exists():
            raise RecordingError(
                f"the recording is not at {path}: say where it is with --recording PATH"
            )
    names = ("topic", "fps", "exposure_s", "start_ns")
    return open_recording(paths, **{name: run[name] for name in names if run.get(name)})


def processed(
    frames: Recording, findings: Findings, doing: str
) -> Iterator[tuple[int, NDArray[np.generic]]]:
    """Yield number and image of each frame that was processed.

    Those of another size than most are left out.

    Raises
    ------
    RecordingError
        If a frame is not that which was processed.
    ResultError
        If the parameters of time in ``run.json`` make no sense.
    """
    times = _astrometry(findings)
    size = findings.run["height"], findings.run["width"]
    last = int(findings.frames["frame"].max(initial=-1))
    shown = 0
    bar = tqdm(
        frames, doing, last + 1, unit=" frames", dynamic_ncols=True, disable=None, leave=False
    )
    for frame in bar:
        if frame.number in findings.row_of:
            _check(frame, times.middle_ns(frame.stamp_ns), frames, findings)
            if frame.image.shape == size:
                shown += 1
                yield frame.number, frame.image
        if frame.number >= last:
            break
    if len(findings.frames) and not shown:
        raise RecordingError(
            f"{frames.path} is another recording: it has no images of {size[1]}x{size[0]}, as"
            f" those of {findings.folder} are"
        )


def _astrometry(findings: Findings) -> Astrometry:
    names = {about.name for about in CameraParameters.describe()}
    used = findings.run["parameters"] or {}
    try:
        about = CameraParameters.of({name: used[name] for name in names & used.keys()})
    except ParameterError as error:
        raise ResultError(
            f"{findings.folder / RUN} is damaged: {error}; run ofsat process again"
        ) from error
    return Astrometry(about)


def _check(frame: Frame, stamp_ns: int, frames: Recording, findings: Findings) -> None:
    then_ns = int(findings.frames["stamp_ns"][findings.row_of[frame.number]])
    if stamp_ns != then_ns:
        raise RecordingError(
            f"{frames.path} is another recording, or was changed: its frame {frame.number} is of"
            f" {words.instant(stamp_ns)} UTC, that of {findings.folder} of"
            f" {words.instant(then_ns)} UTC"
        )
