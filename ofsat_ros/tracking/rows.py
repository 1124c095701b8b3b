# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What tracks tell others: rows of detections and of tracks, in pixels of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import (
    CONFIRMED,
    DETECTION_DTYPE,
    DIRECTION_FIELDS,
    MEASURED_FIELDS,
    SPOT_DTYPE,
)
from ofsat_ros.history import History, PastFrame
from ofsat_ros.tracking.track import Track, predict

Array = NDArray[np.float64]

COASTING = 2
# Frames over which the velocity in the image is fitted.
_FIT_FRAMES = 7

TRACK_DTYPE = np.dtype(
    [
        ("x", "f8"),  # px, in the current frame
        ("y", "f8"),
        ("vx", "f8"),  # velocity in the image, px/s
        ("vy", "f8"),
        ("rel_vx", "f8"),  # velocity against the star field, px/s
        ("rel_vy", "f8"),
        ("sigma_x", "f8"),  # std of the position, px
        ("sigma_y", "f8"),
        ("sigma_vx", "f8"),  # std of the velocity, px/s
        ("sigma_vy", "f8"),
        ("snr", "f8"),  # of the last hit
        ("flux", "f8"),  # DN
        ("length", "f8"),  # px
        ("angle", "f8"),  # rad, from x to y
        ("sight", "f8", (3,)),  # unit line of sight, optical frame; NaN without calibration
        ("ra", "f8"),  # rad, ICRS; NaN without attitude
        ("dec", "f8"),
        ("sigma_ra", "f8"),  # std along the equator (of ra times cos dec), rad
        ("sigma_dec", "f8"),
        ("age", "f8"),  # s since the first hit
        ("hits", "i4"),
        ("misses", "i4"),  # frames in which it was expected and not seen
        ("log_false", "f8"),  # ln of the number of such tracks that chance gives in a frame
        ("track_id", "u4"),
        ("status", "u1"),  # CONFIRMED: seen in this frame; COASTING: only expected there
    ]
)


@dataclass(frozen=True)
class Settled:
    """The last word on one frame, with what later frames taught.

    Attributes
    ----------
    frame : int
        Its number in the pipeline.
    stamp_ns : int
        Its stamp, ns UTC.
    detections : (K,) DETECTION_DTYPE
        RSOs in it, also those that only later frames confirmed.
    """

    frame: int
    stamp_ns: int
    detections: NDArray[np.void]


def settled_rows(tracks: Sequence[Track], frame: PastFrame, history: History) -> NDArray[np.void]:
    """Return what tracks' hits say of a frame, (K,) DETECTION_DTYPE, in their order.

    With the velocities that the hits before and after them show.
    """
    hits = [track.hits[frame.number] for track in tracks]
    velocities = [track.velocity_near(frame.number) for track in tracks]
    states = [[*hit.sky, *rate] for hit, rate in zip(hits, velocities, strict=True)]
    return _rows(tracks, np.array(states), CONFIRMED, frame, history)


def detection_rows(tracks: Sequence[Track], status: int, history: History) -> NDArray[np.void]:
    """Return what tracks' hits say of the newest frame, (K,) DETECTION_DTYPE, in their order."""
    frame = history[-1]
    return _rows(tracks, predict(tracks, frame.stamp_ns)[0], status, frame, history)


def _rows(
    tracks: Sequence[Track], states: Array, status: int, frame: PastFrame, history: History
) -> NDArray[np.void]:
    rows = np.zeros(len(tracks), DETECTION_DTYPE)
    if not tracks:
        return rows
    spots = np.array([track.hits[frame.number].spot for track in tracks], SPOT_DTYPE)
    for name in MEASURED_FIELDS:
        rows[name] = spots[name]
    _set_velocities(rows, states, frame, history)
    for name in DIRECTION_FIELDS:
        rows[name] = np.nan
    rows["significance"] = spots["excess"]
    rows["track_id"], rows["status"] = [track.track_id for track in tracks], status
    rows["object_index"], rows["flow_index"] = spots["object_index"], -1
    return rows


def track_rows(tracks: Sequence[Track], history: History) -> NDArray[np.void]:
    """Return tracks' states in the newest frame, (N,) TRACK_DTYPE, in their order."""
    rows = np.zeros(len(tracks), TRACK_DTYPE)
    if not tracks:
        return rows
    frame = history[-1]
    states, covariances = predict(tracks, frame.stamp_ns)
    rows["x"], rows["y"] = frame.pixels(states[:, :2]).T
    _set_velocities(rows, states, frame, history)
    turn = frame.from_sky[:2, :2]
    for names, part in (
        (("sigma_x", "sigma_y"), slice(2)),
        (("sigma_vx", "sigma_vy"), slice(2, 4)),
    ):
        spread = turn @ covariances[:, part, part] @ turn.T
        for axis, name in enumerate(names):
            rows[name] = np.sqrt(spread[:, axis, axis])
    spots = np.array([track.last.spot for track in tracks], SPOT_DTYPE)
    for name in ("snr", "flux", "length", "angle"):
        rows[name] = spots[name]
    for name in DIRECTION_FIELDS:
        rows[name] = np.nan
    rows["age"] = [(frame.stamp_ns - track.born_ns) / 1e9 for track in tracks]
    rows["hits"] = [track.hit_count for track in tracks]
    rows["misses"] = [track.misses for track in tracks]
    rows["log_false"] = [track.log_false for track in tracks]
    rows["track_id"] = [track.track_id for track in tracks]
    seen = [frame.number in track.hits for track in tracks]
    rows["status"] = np.where(seen, CONFIRMED, COASTING)
    return rows


def _set_velocities(
    rows: NDArray[np.void], states: Array, frame: PastFrame, history: History
) -> None:
    """Set the velocities in the image and against the star field, of states (N, 4)."""
    rows["vx"], rows["vy"] = _image_velocities(states, frame, history).T
    rows["rel_vx"], rows["rel_vy"] = frame.from_sky[:2, :2] @ states[:, 2:].T


def _image_velocities(states: Array, frame: PastFrame, history: History) -> Array:
    """Velocities in the image, (N, 2) px/s: the RSOs' own and the field's.

    Of the lines through their places in the frames around: a mount that jitters moves the image
    from frame to frame, but goes nowhere.
    """
    near = sorted(history, key=lambda other: abs(other.number - frame.number))[:_FIT_FRAMES]
    t = np.array([other.seconds_since(frame) for other in near])
    off = t - t.mean()
    # The fit is linear in the places, and these are in the states.
    matrices = np.array([other.from_sky[:2] for other in near])
    share = off / (off @ off)
    of_place = np.tensordot(share, matrices, 1)
    of_rate = np.tensordot(share * t, matrices[:, :, :2], 1)
    return states[:, :2] @ of_place[:, :2].T + of_place[:, 2] + states[:, 2:] @ of_rate.T
