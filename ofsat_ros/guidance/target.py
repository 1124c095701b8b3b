# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Which track is the target: choice, and the same object again after a gap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.guidance.pointing import OwnMotion
from ofsat_ros.parameters import GuideParameters
from ofsat_ros.tracking import COASTING

Array = NDArray[np.float64]

# Gates of re-acquisition.  A new track is the lost object if it lies within so many px of the
# path, and so much of the ways that object and mount have gone meanwhile;
_NEAR_PX, _OF_ITS_WAY, _OF_OUR_WAY = 10.0, 0.2, 0.1
# and its velocity differs by no more than this part and so many sigmas of its own.
_OF_ITS_RATE, _RATE_SIGMAS = 0.3, 4.0
# Its acceleration is learned in such a time, and foretells no more than such a time, s.
_LEARN_S, _FORETELL_S = 1.5, 3.0
# Faster than this is no target and no mount, rad/s.
_FASTEST = 10.0
_NS = 1_000_000_000


@dataclass(frozen=True)
class Sights:
    """The tracks of one frame as lines of sight in the optical frame; unusable ones left out.

    Attributes
    ----------
    stamp_ns : int
        Middle of the exposure, ns UTC.
    tracks : (N,) TRACK_DTYPE
    sight : (N, 3) float64
        Unit vectors.
    omega : (N, 3) float64
        Angular velocity against the stars, rad/s.
    seen_rate : (N, 2) float64
        Rate of the camera's boresight against the stars that the images show there, rad/s.
    """

    stamp_ns: int
    tracks: NDArray[np.void]
    sight: Array
    omega: Array
    seen_rate: Array

    @classmethod
    def of(cls, stamp_ns: int, tracks: NDArray[np.void], camera: Camera) -> Sights:
        """Turn tracks into directions.

        Left out is what has no line of sight already, since then the calibration is not one of
        the images or has not come to the detector; what lies outside of the image by more than
        its size; and what is not finite, or faster than 10 rad/s.
        """
        size = np.array([camera.width, camera.height])
        within = np.abs(_pairs(tracks, "x", "y") - size / 2) <= 1.5 * size
        tracks = tracks[within.all(axis=1) & np.isfinite(tracks["sight"]).all(axis=1)]
        xy = _pairs(tracks, "x", "y")
        sight = camera.lines_of_sight(xy)
        # Whatever the numbers are, what comes of them is judged below.
        with np.errstate(over="ignore", invalid="ignore"):
            omega = np.cross(sight, camera.rates(xy, _pairs(tracks, "rel_vx", "rel_vy")))
            in_image = np.cross(sight, camera.rates(xy, _pairs(tracks, "vx", "vy")))
            seen = (omega - in_image)[:, [1, 0]] * (1, -1)
        seen[~(np.abs(seen) <= _FASTEST)] = np.nan
        usable = np.isfinite(sight).all(axis=1) & (np.abs(omega) <= _FASTEST).all(axis=1)
        return cls(stamp_ns, tracks[usable], sight[usable], omega[usable], seen[usable])

    def row(self, track_id: int) -> int | None:
        """Return the row of a track; None if it is not there."""
        (rows,) = np.nonzero(self.tracks["track_id"] == track_id)
        return int(rows[0]) if len(rows) else None


@dataclass(frozen=True)
class Target:
    """The object that is followed.

    Attributes
    ----------
    track_id : int
        Its track.
    stamp_ns : int
        When it was where `sight` says, and moved as `omega`: of its last row.
    sight, omega : (3,) float64
        In the optical frame of that time; angular velocity against the stars, rad/s.
    seen_ns, since_ns : int
        Stamps of the last frame that shows it, and of the first.
    beside : set of int
        Tracks that were there when it was seen last: other objects.
    alpha : (3,) float64
        Angular acceleration, rad/s^2, averaged over the last seconds.
    coasting, present : bool
        Whether its last row was an expectation; whether the newest frame has a row of it.
    was_id : int
        Track that it had before a gap; 0: none.
    """

    track_id: int
    stamp_ns: int
    sight: Array
    omega: Array
    seen_ns: int
    since_ns: int
    beside: frozenset[int]
    alpha: Array
    coasting: bool = False
    present: bool = True
    was_id: int = 0

    def at(self, stamp_ns: int, own: OwnMotion) -> tuple[Array, Array]:
        """Return line of sight and angular velocity in the optical frame of another time."""
        seconds = (stamp_ns - self.stamp_ns) / _NS
        faster = self.alpha * min(max(seconds, 0.0), _FORETELL_S)
        moved = Rotation.from_rotvec((self.omega + faster / 2) * seconds)
        turn = own.turn(self.stamp_ns, stamp_ns)
        return turn.apply(moved.apply(self.sight)), turn.apply(self.omega + faster)

    def patience_s(self, parameters: GuideParameters) -> float:
        """Return for how long it is waited for: not for longer than it was followed."""
        return min(parameters.reacquire_s, max(1.0, (self.seen_ns - self.since_ns) / _NS))


def found(sights: Sights, row: int) -> Target:
    """Return the target that a row shows for the first time."""
    track = sights.tracks[row]
    return Target(
        track_id=int(track["track_id"]),
        stamp_ns=sights.stamp_ns,
        sight=sights.sight[row],
        omega=sights.omega[row],
        seen_ns=sights.stamp_ns,
        since_ns=sights.stamp_ns,
        beside=frozenset(sights.tracks["track_id"].tolist()),
        alpha=np.zeros(3),
        coasting=bool(track["status"] == COASTING),
    )


def found_again(before: Target, sights: Sights, row: int, own: OwnMotion) -> Target:
    """Return the target that a row of a later frame shows; its track may be another one."""
    now = found(sights, row)
    turn = own.turn(before.stamp_ns, now.stamp_ns)
    alpha = turn.apply(before.alpha)
    was_id = before.was_id
    if now.track_id != before.track_id:
        was_id = before.track_id
    elif not now.coasting:
        # Against the lag of all that is measured: else it would be behind where rates change.
        seconds = (now.stamp_ns - before.stamp_ns) / _NS
        change = (now.omega - turn.apply(before.omega)) / seconds
        alpha = alpha + (change - alpha) * seconds / (seconds + _LEARN_S)
    now = replace(now, since_ns=before.since_ns, alpha=alpha, was_id=was_id)
    if now.coasting:
        return replace(now, seen_ns=before.seen_ns, beside=before.beside)
    return now


def choose(sights: Sights, parameters: GuideParameters) -> int | None:
    """Return the row of the track that the parameters ask for; None if none is seen."""
    # What is only expected tells nothing new, and may have been wrong for long.
    (seen,) = np.nonzero(sights.tracks["status"] != COASTING)
    tracks = sights.tracks[seen]
    if parameters.target == "id":
        seen = seen[tracks["track_id"] == parameters.target_id]
        return int(seen[0]) if len(seen) else None
    if not len(tracks):
        return None
    if parameters.target == "brightest":
        worse = -np.nan_to_num(tracks["flux"], nan=-np.inf)
    elif parameters.target == "nearest":
        worse = -sights.sight[seen, 2]
    else:
        worse = tracks["track_id"].astype(float)
    return int(seen[np.argmin(worse)])


def same_again(
    target: Target, sights: Sights, own: OwnMotion, camera: Camera, stale_after_s: float
) -> int | None:
    """Return the row of a later frame that is the target; None if there is none.

    That is its own track's, seen or where it is expected; and if that has no such row, a new
    track's on the same path.  After a gap of `stale_after_s`, of which no frame tells, the number
    alone says nothing: the detector may have begun anew.
    """
    tracks = sights.tracks
    row = sights.row(target.track_id)
    sure = target.present and sights.stamp_ns - target.stamp_ns < stale_after_s * _NS
    if row is not None and sure and tracks["status"][row] != COASTING:
        return row
    distance = _distance(target, sights, own, camera)
    if row is not None and target.present and distance[row] <= 1:
        return row
    # What has gone astray, or has begun anew with the same number, is as good as any new track.
    others = np.isin(tracks["track_id"], list(target.beside - {target.track_id}))
    distance[others | (tracks["status"] == COASTING)] = np.inf
    best = int(np.argmin(distance)) if len(distance) else None
    return best if best is not None and distance[best] <= 1 else None


def _distance(target: Target, sights: Sights, own: OwnMotion, camera: Camera) -> Array:
    """How far tracks are from a target's path and velocity, (N,); 1: at the gate.

    The path is predicted in space: by the target's own rate against the stars, and the mount's.
    """
    tracks = sights.tracks
    sight, omega = target.at(sights.stamp_ns, own)
    px = _pixel_angle(camera, tracks)
    its_way = np.linalg.norm(target.omega) * (sights.stamp_ns - target.stamp_ns) / _NS
    our_way = own.turn(target.stamp_ns, sights.stamp_ns).magnitude()
    far = np.linalg.norm(sights.sight - sight, axis=1)
    far /= _NEAR_PX * px + _OF_ITS_WAY * its_way + _OF_OUR_WAY * our_way
    sigma = np.nan_to_num(np.hypot(tracks["sigma_vx"], tracks["sigma_vy"]))
    gate = _OF_ITS_RATE * np.linalg.norm(omega) + _RATE_SIGMAS * sigma * px
    distance: Array = np.maximum(
        far, np.linalg.norm(sights.omega - omega, axis=1) / np.maximum(gate, 1e-15)
    )
    return distance


def _pairs(tracks: NDArray[np.void], x: str, y: str) -> Array:
    """Two columns of a table, (N, 2)."""
    return np.column_stack([tracks[x], tracks[y]])


def _pixel_angle(camera: Camera, tracks: NDArray[np.void]) -> Array:
    """Angle of a pixel at each track, rad."""
    xy = _pairs(tracks, "x", "y")
    along_x = np.broadcast_to([1.0, 0.0], xy.shape)
    return np.linalg.norm(camera.rates(xy, along_x), axis=1)
