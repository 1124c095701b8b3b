# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the frames of a recording tell of it: sizes, times, gaps, directions."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros.camera import Camera, to_radec
from ofsat_ros.pipeline import ImageError, Pipeline
from ofsat_ros.recordings import Attitude, Frame, Recording

_NS = 1_000_000_000
_ARCSEC_PER_RAD = 3600 * np.rad2deg(1)
# An interval is a gap if it is longer than so many usual ones: jitter is less than half of one.
_GAP = 1.5
_GAPS_KEPT = 10
_LEAST_FRAMES = 3


class _Row(NamedTuple):
    """What is kept of a frame."""

    number: int
    stamp_ns: int
    size: tuple[int, int]
    pixels: str
    low: float
    high: float
    exposure_s: float | None
    encoding: str


def survey(recording: Recording) -> dict[str, Any]:
    """Read every frame of a recording, and return what they tell, as JSON can hold it.

    Ctrl-C ends the reading: what was read until then is told, with `stopped`.  In `hindrance` is
    why the recording cannot be processed; empty if it can.
    """
    rows: list[_Row] = []
    cameras: list[Camera] = []  # the first
    attitudes: list[Attitude] = []  # the first of each frame
    hindrance, stopped = "", False
    try:
        for frame in tqdm(recording, unit=" frames", leave=False, disable=None):
            if not rows:
                hindrance = _refusal(frame)
            if not cameras and frame.camera is not None:
                cameras.append(frame.camera)
            attitudes += frame.attitudes[:1]
            rows.append(_row(frame))
    except KeyboardInterrupt:
        stopped = True
    problems = recording.problems
    times = _times(rows)
    if not rows:
        hindrance = f"no frame could be read: {', '.join(problems[:1])}".rstrip(": ")
    elif not hindrance and len(rows) < _LEAST_FRAMES and not stopped:
        hindrance = f"an RSO is confirmed in {_LEAST_FRAMES} frames, and there are {len(rows)}"
    elif not hindrance and not times["interval_s"]:
        hindrance = "no frame is later than the one before"
    return {
        "topic": recording.topic,
        "frames": len(rows),
        "skipped": recording.skipped,
        "sizes": [[*size, count] for size, count in Counter(r.size for r in rows).items()],
        "encoding": ", ".join(dict.fromkeys(row.encoding for row in rows if row.encoding)),
        "pixels": sorted({row.pixels for row in rows}),
        "lowest": min((row.low for row in rows if row.low <= row.high), default=None),
        "highest": max((row.high for row in rows if row.low <= row.high), default=None),
        **times,
        "exposures_s": sorted({row.exposure_s for row in rows if row.exposure_s is not None}),
        "camera_info_topic": recording.camera_info_topic,
        "camera": _of_camera(cameras[0]) if cameras else None,
        "attitude_topic": recording.attitude_topic,
        "frames_with_attitude": len(attitudes),
        "first_boresight_deg": _boresight(attitudes[0]) if attitudes else None,
        "problems": problems,
        "stopped": stopped,
        "hindrance": hindrance,
    }


def _refusal(frame: Frame) -> str:
    """Return why the pipeline does not take a frame; empty if it does."""
    try:
        Pipeline().process(frame.image, frame.stamp_ns)
    except ImageError as error:
        return f"{error}"
    return ""


def _row(frame: Frame) -> _Row:
    height, width = frame.image.shape
    low, high = np.inf, -np.inf
    if frame.image.dtype.kind == "f":
        finite = frame.image[np.isfinite(frame.image)]
        if finite.size:
            low, high = float(finite.min()), float(finite.max())
    else:
        low, high = int(frame.image.min()), int(frame.image.max())
    size, pixels = (width, height), frame.image.dtype.name
    times = frame.number, frame.stamp_ns
    return _Row(*times, size, pixels, low, high, frame.exposure_s, frame.encoding)


def _times(rows: list[_Row]) -> dict[str, Any]:
    """Return what the stamps tell."""
    stamps = np.array([row.stamp_ns for row in rows], np.int64)
    steps_s = np.diff(stamps) / _NS
    forward_s = steps_s[steps_s > 0]
    usual_s = float(np.median(forward_s)) if forward_s.size else None
    back = np.flatnonzero(steps_s <= 0) + 1
    first, last = (int(stamps.min()), int(stamps.max())) if rows else (None, None)
    return {
        "first_stamp_ns": first,
        "last_stamp_ns": last,
        "first_utc": _utc(first),
        "last_utc": _utc(last),
        "interval_s": usual_s,
        "gaps": _gaps(rows, steps_s, usual_s),
        "frames_back_in_time": len(back),
        "first_back_in_time": rows[back[0]].number if back.size else None,
    }


def _gaps(rows: list[_Row], steps_s: NDArray[np.float64], usual_s: float | None) -> dict[str, Any]:
    """Return the count of gaps, the frames that would fill them, and the longest ones."""
    where = np.flatnonzero(steps_s > _GAP * usual_s) if usual_s else np.zeros(0, int)
    missing = np.round(steps_s[where] / usual_s - 1).sum() if usual_s else 0
    longest = where[np.argsort(-steps_s[where], kind="stable")][:_GAPS_KEPT]
    return {
        "count": len(where),
        "missing_frames": int(missing),
        "longest": [
            {"after_frame": rows[i].number, "seconds": float(steps_s[i])} for i in longest
        ],
    }


def _utc(stamp_ns: int | None) -> str | None:
    if stamp_ns is None:
        return None
    return f"{np.datetime_as_string(np.datetime64(stamp_ns, 'ns'), unit='ms')}Z"


def _of_camera(camera: Camera) -> dict[str, Any]:
    focal_px = float(camera.matrix[0, 0])
    return {
        "width": camera.width,
        "height": camera.height,
        "model": camera.model,
        "focal_length_px": focal_px,
        "arcsec_per_px": float(_ARCSEC_PER_RAD / focal_px),
    }


def _boresight(attitude: Attitude) -> list[float]:
    """Return right ascension and declination of the optical axis, deg."""
    ra, dec = to_radec(np.array([[0.0, 0.0, 1.0]]), attitude[1])
    return [float(np.rad2deg(ra[0])), float(np.rad2deg(dec[0]))]
