# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Tracks: the hits of an RSO and a constant-velocity Kalman filter in the sky plane.

The filter works on all tracks at once: a matrix of one track costs as much as those of a hundred.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import mul
from statistics import median

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.following import Paths
from ofsat_ros.history import PastFrame
from ofsat_ros.pixels import positions
from ofsat_ros.tracking.sightings import STREAK_SPREAD

Array = NDArray[np.float64]

# What the velocity changes by in a frame, std: of itself, and at least, px per frame.
_MANOEUVRE, _WANDER_PX = 0.01, 0.02
# What a centroid is off by beside its stated std: the pixel grid, blends, px.
_FLOOR_PX = 0.05
# Along a streak, a refined centroid may be off by this part of its length.
_REFINED_SPREAD = 0.01
# Hits over which a velocity is fitted, and over which a track must have moved.
_FIT_HITS, _WAY_HITS = 9, 5
# So many tell a velocity from errors.
_LEAST_HITS = 3
# What stays within this way on the sky is a star, px; nor is it motion if it may be chance.
_LEAST_WAY_PX, _WAY_SIGMAS = 1.0, 4.0
# Logarithm of how much less likely a miss makes a track, and a hit after its birth more.
_MISS_LOG = 1.5
# Nothing is known of the velocity before the second hit, px per frame.
_ANY_SPEED_PX = 1000.0
# Which elements of a (4, 4) matrix are of the place, of the place and the rate, of the rate.
_PLACE, _BOTH, _RATE = (
    np.kron(block, np.eye(2)) for block in ([[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]])
)
_STEP = np.triu(_BOTH)


@dataclass(frozen=True)
class Hit:
    """One sight of the RSO.

    Attributes
    ----------
    number, stamp_ns : int
        Number and stamp of the frame.
    spot : SPOT_DTYPE
        What was seen there.
    sky : (2,) float64
        Its place in the sky plane, px.
    covariance : (2, 2) float64
        Of that place, px^2.
    """

    number: int
    stamp_ns: int
    spot: np.void
    sky: Array
    covariance: Array

    @classmethod
    def of(cls, frame: PastFrame, spot: np.void) -> Hit:
        """Build from a spot of a frame."""
        (hit,) = cls.of_all(frame, np.array([spot], spot.dtype))
        return hit

    @classmethod
    def of_all(cls, frame: PastFrame, spots: NDArray[np.void]) -> list[Hit]:
        """Build from spots (N,) of a frame."""
        sky = frame.sky(positions(spots))
        parts = zip(spots, sky, covariances(frame, spots), strict=True)
        return [cls(frame.number, frame.stamp_ns, *part) for part in parts]

    @cached_property
    def weight(self) -> float:
        """One over the variance of its place, px^-2."""
        return 1 / float(self.covariance[0, 0] + self.covariance[1, 1])

    @property
    def xy(self) -> Array:
        """Its place in the image, px."""
        return np.array([self.spot["x"], self.spot["y"]])


def covariances(frame: PastFrame, spots: NDArray[np.void]) -> Array:
    """Covariances of the places of spots (N,) of a frame in the sky plane, (N, 2, 2) px^2."""
    along = np.where(spots["refined"], _REFINED_SPREAD, STREAK_SPREAD) * spots["length"]
    along_x, along_y = along * np.cos(spots["angle"]), along * np.sin(spots["angle"])
    own = np.empty((len(along), 2, 2))
    own[:, 0, 0] = spots["sigma_x"] ** 2 + along_x**2 + _FLOOR_PX**2
    own[:, 1, 1] = spots["sigma_y"] ** 2 + along_y**2 + _FLOOR_PX**2
    own[:, 0, 1] = own[:, 1, 0] = along_x * along_y
    turn = frame.to_sky[:2, :2]
    return turn @ own @ turn.T


@dataclass
class Track:
    """An RSO that was seen several times.

    Attributes
    ----------
    log_false : float
        Logarithm of the number of such tracks that chance gives in one frame.
    frame_s : float
        Time between two frames, s: the scale of what may change unforeseen.
    hits : dict of int to Hit
        Number of the frame to hit, for the frames that the history still holds.
    track_id : int
        Its number, never used again; 0 until it is confirmed.
    hit_count, born_hits : int
        All hits, and those that it was born with.
    born_ns : int
        Stamp of the first hit.
    misses : int
        Frames in which it was expected and not seen.
    unsure : int
        Frames since the last sure hit in which it was expected: not seen, or only faintly.
    stamp_ns : int
        Time of the state, ns UTC.
    state : (4,) float64
        x, y px and their rates px/s in the sky plane.
    covariance : (4, 4) float64
        Of the state.
    """

    log_false: float
    frame_s: float
    hits: dict[int, Hit]
    track_id: int = 0
    hit_count: int = 0
    born_hits: int = 0
    born_ns: int = 0
    misses: int = 0
    unsure: int = 0
    stamp_ns: int = 0
    state: Array = field(default_factory=lambda: np.zeros(4))
    covariance: Array = field(default_factory=lambda: np.eye(4))

    def fit(self) -> None:
        """Filter all hits again, in their order."""
        hits = [self.hits[number] for number in sorted(self.hits)]
        first = hits[0]
        rate = (_ANY_SPEED_PX / self.frame_s) ** 2
        self.hit_count = self.born_hits = len(hits)
        self.born_ns = first.stamp_ns
        self.state = np.array([*first.sky, 0.0, 0.0])
        self.covariance = np.diag([0.0, 0.0, rate, rate])
        self.covariance[:2, :2] = first.covariance
        self.stamp_ns = first.stamp_ns
        for hit in hits[1:]:
            _update([self], [hit])

    def see_in(self, frames: Mapping[int, PastFrame]) -> None:
        """Take its hits to where frames of their numbers are now, and filter them again.

        Hits of other frames go with the nearest of those.
        """
        known = {n: Hit.of(frames[n], hit.spot) for n, hit in self.hits.items() if n in frames}
        if not known:
            return
        way = {n: hit.sky - self.hits[n].sky for n, hit in known.items()}
        others = {
            n: replace(hit, sky=hit.sky + way[min(way)])
            for n, hit in self.hits.items()
            if n not in known
        }
        if len(known) < _LEAST_HITS:
            # Too few tell the velocity.
            self.state[:2] += way[max(way)]
        else:
            kept = self.hit_count, self.born_hits, self.born_ns
            self.hits = known
            self.fit()
            self.hit_count, self.born_hits, self.born_ns = kept
        self.hits = {**others, **known}

    def go_on_from(self, before: Track) -> None:
        """Be the same RSO as a track that has ended; where both have a hit, its own counts."""
        self.track_id, self.born_ns = before.track_id, before.born_ns
        self.misses += before.misses
        new = sum(number not in before.hits for number in self.hits)
        self.hit_count = self.born_hits = before.hit_count + new
        self.hits = {**before.hits, **self.hits}

    def velocity_near(self, number: int) -> Array:
        """Velocity in the sky plane around a frame, (2,) px/s: of a line through the nearest hits.

        With hits before and after it, an acceleration does not bias it as it does the filter.
        """
        near = sorted(self.hits.values(), key=lambda hit: abs(hit.number - number))[:_FIT_HITS]
        return self._line(near)[0]

    def stands_still(self, least_hits: int = _WAY_HITS) -> bool:
        """Whether its last hits show no motion on the sky, so that it is a star after all."""
        last = [self.hits[number] for number in sorted(self.hits)[-2 * _WAY_HITS :]]
        if len(last) < least_hits:
            return False
        velocity, error = self._line(last)
        span = (last[-1].stamp_ns - last[0].stamp_ns) / 1e9
        way = math.hypot(*velocity) * span
        return way < max(_LEAST_WAY_PX, _WAY_SIGMAS * error * span)

    def is_sustained(self, log_limit: float) -> bool:
        """Whether it is still no chance when hits and misses since its birth are counted."""
        later = self.hit_count - self.born_hits
        balance = max(self.misses, self.unsure) - later
        return self.log_false + _MISS_LOG * balance < log_limit

    def _line(self, hits: Sequence[Hit]) -> tuple[Array, float]:
        """Velocity of the line through hits, px/s, and its std."""
        t = [(hit.stamp_ns - hits[0].stamp_ns) / 1e9 for hit in hits]
        weight = [hit.weight for hit in hits]
        mean = sum(map(mul, weight, t)) / sum(weight)
        off = [w * (seconds - mean) for w, seconds in zip(weight, t, strict=True)]
        spread = sum(map(mul, off, t))
        if spread <= 0:
            return np.zeros(2), math.inf
        velocity = sum(part * hit.sky for part, hit in zip(off, hits, strict=True)) / spread
        return velocity, 1 / math.sqrt(spread)

    def forget(self, before: int) -> None:
        """Drop the hits in frames of lower numbers; the state keeps what they taught."""
        kept = {number: hit for number, hit in self.hits.items() if number >= before}
        self.hits = kept or {max(self.hits): self.last}

    @property
    def speed(self) -> float:
        """Its speed in the sky plane, px/s."""
        return math.hypot(self.state[2], self.state[3])

    @property
    def last(self) -> Hit:
        """The newest hit."""
        return self.hits[max(self.hits)]

    @property
    def flux(self) -> float:
        """Median flux of the hits, DN."""
        return float(median(hit.spot["flux"] for hit in self.hits.values()))

    @property
    def length(self) -> float:
        """Median length of the hits' streaks, px."""
        return float(median(hit.spot["length"] for hit in self.hits.values()))


def predict(tracks: Sequence[Track], stamp_ns: int) -> tuple[Array, Array]:
    """States and covariances of N tracks at another time, (N, 4) and (N, 4, 4)."""
    if not tracks:
        return np.zeros((0, 4)), np.zeros((0, 4, 4))
    states = np.array([track.state for track in tracks])
    covariances = np.array([track.covariance for track in tracks])
    dt, frame_s = np.array(
        [((stamp_ns - track.stamp_ns) / 1e9, track.frame_s) for track in tracks]
    ).T[:, :, None, None]
    speed = np.hypot(states[:, 2], states[:, 3])[:, None, None]
    wander = np.abs(dt) * (_WANDER_PX / frame_s + _MANOEUVRE * speed) ** 2 / frame_s
    step = np.eye(4) + dt * _STEP
    noise = wander * ((dt**2 / 3) * _PLACE + (dt / 2) * _BOTH + _RATE)
    states[:, :2] += dt[:, 0] * states[:, 2:]
    return states, step @ covariances @ step.transpose(0, 2, 1) + noise


def places(tracks: Sequence[Track], frame: PastFrame) -> Array:
    """Where N tracks are expected in a frame, (N, 2) px."""
    ahead = [(frame.stamp_ns - track.stamp_ns) / 1e9 for track in tracks]
    states = np.array([track.state for track in tracks]).reshape(-1, 4)
    return frame.pixels(states[:, :2] + np.array(ahead)[:, None] * states[:, 2:])


def paths_of(tracks: Sequence[Track], frames: Sequence[PastFrame]) -> Paths:
    """Where N tracks were seen in frames, the newest first."""
    shape = len(tracks), len(frames)
    rows, variance = np.full(shape, -1, np.intp), np.zeros(shape)
    sky, image = np.zeros((2, *shape), np.complex128)
    for row, track in enumerate(tracks):
        for column, frame in enumerate(frames):
            if (hit := track.hits.get(frame.number)) is not None:
                at = row, column
                rows[at], variance[at] = row, np.trace(hit.covariance) / 2
                sky[at], image[at] = complex(*hit.sky), complex(*hit.xy)
    times = np.array([frame.seconds_since(frames[0]) for frame in frames])
    return Paths(times, rows, sky, image, variance)


def add_hits(tracks: Sequence[Track], hits: Sequence[Hit]) -> None:
    """Give each track its next hit, all of one frame, later than all others."""
    for track, hit in zip(tracks, hits, strict=True):
        track.hits[hit.number] = hit
        track.hit_count += 1
    _update(tracks, hits)


def _update(tracks: Sequence[Track], hits: Sequence[Hit]) -> None:
    """Filter a hit of each track, all of one frame."""
    if not tracks:
        return
    states, covariances = predict(tracks, hits[0].stamp_ns)
    spread = covariances[:, :2, :2] + np.array([hit.covariance for hit in hits])
    gain = covariances[:, :, :2] @ np.linalg.inv(spread)
    off = np.array([hit.sky for hit in hits]) - states[:, :2]
    states += (gain @ off[:, :, None])[:, :, 0]
    covariances = covariances - gain @ covariances[:, :2]
    covariances = (covariances + covariances.transpose(0, 2, 1)) / 2
    for track, hit, state, covariance in zip(tracks, hits, states, covariances, strict=True):
        track.state, track.covariance, track.stamp_ns = state, covariance, hit.stamp_ns
