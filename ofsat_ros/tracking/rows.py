"""What tracks tell others: rows of detections and of tracks, in pixels of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import CONFIRMED, DETECTION_DTYPE
from ofsat_ros.history import History, PastFrame
from ofsat_ros.tracking.track import Hit, Track

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
        ("ra", "f8"),  # rad, ICRS; NaN without attitude
        ("dec", "f8"),
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


def settled_row(track: Track, hit: Hit, history: History) -> np.void:
    """Return `detection_row` with the velocity that hits before and after it show."""
    state = np.array([*hit.sky, *track.velocity_near(hit.number)])
    return _row(track, hit, state, history, CONFIRMED)


def detection_row(track: Track, hit: Hit, history: History, status: int) -> np.void:
    """Return what a track's hit says of its frame, as one DETECTION_DTYPE."""
    return _row(track, hit, track.predict(hit.stamp_ns)[0], history, status)


def _row(track: Track, hit: Hit, state: Array, history: History, status: int) -> np.void:
    frame = _frame(history, hit.number)
    row = np.zeros(1, DETECTION_DTYPE)[0]
    for name in ("x", "y", "sigma_x", "sigma_y", "snr", "flux", "length", "angle"):
        row[name] = hit.spot[name]
    row["vx"], row["vy"] = _image_velocity(state, frame, history)
    row["rel_vx"], row["rel_vy"] = _turned(frame, state[2:])
    row["ra"] = row["dec"] = np.nan
    row["significance"] = hit.spot["excess"]
    row["track_id"], row["status"] = track.track_id, status
    row["object_index"], row["flow_index"] = hit.spot["object_index"], -1
    return row


def track_row(track: Track, history: History) -> np.void:
    """Return a track's state in the newest frame, as one TRACK_DTYPE."""
    frame = history[-1]
    state, covariance = track.predict(frame.stamp_ns)
    row = np.zeros(1, TRACK_DTYPE)[0]
    row["x"], row["y"] = frame.pixels(state[None, :2])[0]
    row["vx"], row["vy"] = _image_velocity(state, frame, history)
    row["rel_vx"], row["rel_vy"] = _turned(frame, state[2:])
    turn = frame.from_sky[:2, :2]
    row["sigma_x"], row["sigma_y"] = np.sqrt(np.diag(turn @ covariance[:2, :2] @ turn.T))
    row["sigma_vx"], row["sigma_vy"] = np.sqrt(np.diag(turn @ covariance[2:, 2:] @ turn.T))
    for name in ("snr", "flux", "length", "angle"):
        row[name] = track.last.spot[name]
    row["ra"] = row["dec"] = np.nan
    row["age"] = (frame.stamp_ns - track.born_ns) / 1e9
    row["hits"], row["misses"] = track.hit_count, track.missed
    row["log_false"], row["track_id"] = track.log_false, track.track_id
    row["status"] = CONFIRMED if frame.number in track.hits else COASTING
    return row


def _frame(history: History, number: int) -> PastFrame:
    return history[number - history[0].number]


def _image_velocity(state: Array, frame: PastFrame, history: History) -> Array:
    """Velocity in the image, px/s: the RSO's own and the field's.

    Of the line through its places in the frames around: a mount that jitters moves the image from
    frame to frame, but goes nowhere.
    """
    near = sorted(history, key=lambda other: abs(other.number - frame.number))[:_FIT_FRAMES]
    t = np.array([(other.stamp_ns - frame.stamp_ns) / 1e9 for other in near])
    places = np.array(
        [
            other.pixels((state[:2] + state[2:] * seconds)[None])[0]
            for other, seconds in zip(near, t, strict=True)
        ]
    )
    return np.polynomial.polynomial.polyfit(t - t.mean(), places, 1)[1]


def _turned(frame: PastFrame, velocity: Array) -> Array:
    return frame.from_sky[:2, :2] @ velocity
