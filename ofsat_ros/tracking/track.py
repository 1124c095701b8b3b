"""One track: the hits of an RSO and a constant-velocity Kalman filter in the sky plane."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.history import PastFrame

Array = NDArray[np.float64]

# What the velocity changes by in a frame, std: of itself, and at least, px per frame.
_MANOEUVRE, _WANDER_PX = 0.01, 0.02
# What a centroid is off by beside its stated std: the pixel grid, blends, px.
_FLOOR_PX = 0.05
# Along a streak, a centroid may be off by this part of its length, and once refined by this.
_STREAK_SPREAD, _REFINED_SPREAD = 0.12, 0.01
# Hits over which a velocity is fitted, and over which a track must have moved.
_FIT_HITS, _WAY_HITS = 9, 5
# What stays within this way on the sky is a star, px; nor is it motion if it may be chance.
_LEAST_WAY_PX, _WAY_SIGMAS = 1.0, 4.0
# Logarithm of how much less likely a miss makes a track, and a hit after its birth more.
_MISS_LOG = 1.5
# Nothing is known of the velocity before the second hit, px per frame.
_ANY_SPEED_PX = 1000.0


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
        sky = frame.sky(np.array([[spot["x"], spot["y"]]]))[0]
        along = np.array([np.cos(spot["angle"]), np.sin(spot["angle"])])
        along *= (_REFINED_SPREAD if spot["refined"] else _STREAK_SPREAD) * spot["length"]
        own = np.diag([spot["sigma_x"] ** 2, spot["sigma_y"] ** 2])
        own = own + np.outer(along, along) + _FLOOR_PX**2 * np.eye(2)
        turn = frame.to_sky[:2, :2]
        return cls(frame.number, frame.stamp_ns, spot, sky, turn @ own @ turn.T)

    @property
    def xy(self) -> Array:
        """Its place in the image, px."""
        return np.array([self.spot["x"], self.spot["y"]])


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
        Frames since the last sure hit in which it was not surely seen.
    missed : int
        All frames in which it was expected and not seen.
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
    missed: int = 0
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
            self._update(hit)

    def predict(self, stamp_ns: int) -> tuple[Array, Array]:
        """State and covariance at another time, (4,) and (4, 4)."""
        dt = (stamp_ns - self.stamp_ns) / 1e9
        step = np.eye(4)
        step[0, 2] = step[1, 3] = dt
        speed = np.hypot(*self.state[2:])
        wander = (_WANDER_PX / self.frame_s + _MANOEUVRE * speed) ** 2 / self.frame_s
        t = abs(dt)
        noise = np.kron([[t**3 / 3, t * dt / 2], [t * dt / 2, t]], np.eye(2)) * wander
        return step @ self.state, step @ self.covariance @ step.T + noise

    def add(self, hit: Hit) -> None:
        """Take the next hit, of a later frame than all others."""
        self.hits[hit.number] = hit
        self.hit_count += 1
        self._update(hit)

    def _update(self, hit: Hit) -> None:
        state, covariance = self.predict(hit.stamp_ns)
        gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + hit.covariance)
        self.state = state + gain @ (hit.sky - state[:2])
        covariance = covariance - gain @ covariance[:2]
        self.covariance = (covariance + covariance.T) / 2
        self.stamp_ns = hit.stamp_ns

    def velocity_near(self, number: int) -> Array:
        """Velocity in the sky plane around a frame, (2,) px/s: of a line through the nearest hits.

        With hits before and after it, an acceleration does not bias it as it does the filter.
        """
        near = sorted(self.hits.values(), key=lambda hit: abs(hit.number - number))[:_FIT_HITS]
        return self._line(near)[0]

    def stands_still(self) -> bool:
        """Whether its last hits show no motion on the sky, so that it is a star after all."""
        last = [self.hits[number] for number in sorted(self.hits)[-2 * _WAY_HITS :]]
        if len(last) < _WAY_HITS:
            return False
        velocity, error = self._line(last)
        span = (last[-1].stamp_ns - last[0].stamp_ns) / 1e9
        way = float(np.hypot(*velocity)) * span
        return way < max(_LEAST_WAY_PX, _WAY_SIGMAS * error * span)

    def is_sustained(self, log_limit: float) -> bool:
        """Whether it is still no chance when hits and misses since its birth are counted."""
        later = self.hit_count - self.born_hits
        balance = max(self.missed, self.misses) - later
        return self.log_false + _MISS_LOG * balance < log_limit

    def _line(self, hits: list[Hit]) -> tuple[Array, float]:
        """Velocity of the line through hits, px/s, and its std."""
        t = np.array([(hit.stamp_ns - hits[0].stamp_ns) / 1e9 for hit in hits])
        weight = np.array([1 / np.trace(hit.covariance) for hit in hits])
        off = t - np.average(t, weights=weight)
        sky = np.array([hit.sky for hit in hits])
        spread = float(np.sum(weight * off**2))
        if spread <= 0:
            return np.zeros(2), np.inf
        return np.sum((weight * off)[:, None] * sky, axis=0) / spread, float(1 / np.sqrt(spread))

    def forget(self, before: int) -> None:
        """Drop the hits in frames of lower numbers; the state keeps what they taught."""
        kept = {number: hit for number, hit in self.hits.items() if number >= before}
        self.hits = kept or {max(self.hits): self.last}

    def place(self, frame: PastFrame) -> Array:
        """Where it is expected in a frame, px."""
        return frame.pixels(self.predict(frame.stamp_ns)[0][None, :2])[0]

    @property
    def last(self) -> Hit:
        """The newest hit."""
        return self.hits[max(self.hits)]

    @property
    def flux(self) -> float:
        """Median flux of the hits, DN."""
        return float(np.median([hit.spot["flux"] for hit in self.hits.values()]))

    @property
    def length(self) -> float:
        """Median length of the hits' streaks, px."""
        return float(np.median([hit.spot["length"] for hit in self.hits.values()]))
