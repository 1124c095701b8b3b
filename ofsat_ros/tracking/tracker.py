"""The tracker: spots over time become tracks with ids that stay.

Frame by frame: tracks take the spots where they are expected (assignment by the statistical
distance of a constant-velocity Kalman filter), and a closer look is taken where there is none;
what is left is searched for new tracks, and a new track labels what it was seen as before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import BORDER_PX, CANDIDATE, CONFIRMED, DETECTION_DTYPE, SPOT_DTYPE, Drift
from ofsat_ros.history import History, PastFrame
from ofsat_ros.tracking.linking import find_links
from ofsat_ros.tracking.rows import TRACK_DTYPE, Settled, detection_rows, settled_rows, track_rows
from ofsat_ros.tracking.sightings import Sighting, as_complex
from ofsat_ros.tracking.track import Hit, Track, add_hits, covariances, places, predict

Array = NDArray[np.float64]
# Looks in a frame, compared with others, near a point: none or one SPOT_DTYPE.
Look = Callable[[PastFrame, Sequence[PastFrame], Array], NDArray[np.void]]
# Measures spots of a frame again, compared with others, given their displacements per frame, px,
# and which of the others show them, too.
Refine = Callable[
    [PastFrame, Sequence[PastFrame], NDArray[np.void], Array, NDArray[np.bool_]], NDArray[np.void]
]

# Finds objects of the newest frame that drift, beside those of known rows.
FindDrifts = Callable[[NDArray[np.intp]], Sequence[Drift]]

# A spot this far from where a track is expected, in sigmas, is not its.
_GATE_SIGMAS = 4.0
# Beside the track's own uncertainty, px: what noise moves a faint spot by.
_SPREAD_PX = 0.35
# An object may be a slow track's sight; a fast track would take a star for it, px per frame.
_SLOW_PX = 2.0
_FLUX_RATIO = 3.0
# What is longer than the track by more than some such steps has grown together with a star, px.
_LONGER_PX = 1.5
# Spots this near to a track's are pieces of it, px beside its streak.
_PIECE_PX = 2.5
# A track whose hits are longer is a streak, whose ends its centroid needs, px.
_LONGEST_POINT_PX = 4.0
# Where a track is expected less surely than this, nothing faint is looked for, px.
_SURE_PX = 1.5
# A spot fainter than this has a poor place of its own, sigmas.
_FAINT_SIGMAS = 4.0
# What is left of a star beside a spot may pull it by this, px.
_PULLED_PX = 1.0
# Farther from where it is expected, beyond half of what it moves in a frame, it is not sought, px.
_FARTHEST_PX = 50.0
# The distance of what cannot be.
_NEVER = 1e6
# A frame in which the track itself was as near as this doesn't show what is behind it, px.
_SELF_PX = 2.5
# Nor one in which its wings reach what is measured.
_WINGS_PX = 6.0
# What moved less than this in the sensor may be a defect, px; for each known one so many are not.
_STILL_PX, _UNKNOWN_DEFECTS = 3.0, 0.1
# Logarithm of how much less sure a candidate may be than a confirmed track.
_CANDIDATE_LOG = np.log(30.0)


@dataclass
class Tracked:
    """What the tracker says of one frame.

    Attributes
    ----------
    detections : (K,) DETECTION_DTYPE
        RSOs seen in this frame: confirmed ones with the id of their track, and candidates.
    tracks : (N,) TRACK_DTYPE
        Confirmed tracks, coasting ones included.
    settled : list of Settled
        Frames of which this is the last word.
    """

    detections: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, DETECTION_DTYPE))
    tracks: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, TRACK_DTYPE))
    settled: list[Settled] = field(default_factory=list)


class Tracker:
    """Finds and follows RSOs.

    Parameters
    ----------
    look : callable
        Takes a closer look for a spot near a point of a frame.
    refine : callable
        Measures the places of spots of one frame once more.
    """

    def __init__(self, look: Look, refine: Refine) -> None:
        self._look, self._refine = look, refine
        self._tracks: list[Track] = []
        self._ended: list[Track] = []
        self._sightings: list[Sighting] = []
        self._last_id = 0
        self._next_to_settle = 0

    def clear(self, history: History) -> list[Settled]:
        """End all tracks and return what is said last of the history's frames.

        The ids are not used again.
        """
        settled = self.settle(history, len(history))
        self._tracks, self._ended, self._sightings = [], [], []
        return settled

    def update(
        self,
        history: History,
        spots: Sequence[NDArray[np.void]],
        find_drifts: FindDrifts,
        defects: int,
        log_limit: float,
        max_speed_px: float,
        coast_frames: int,
    ) -> Tracked:
        """Take the next frame.

        Parameters
        ----------
        history : History
            The frames, the current one last.
        spots : sequence of (N,) SPOT_DTYPE
            Spots of the newest frames that were not given before, the current one last.
        find_drifts : callable
            Finds objects of the current frame that drift, beside those that tracks took, whose
            rows it is given.
        defects : int
            Known defects of the sensor.
        log_limit : float
            Logarithm of the number of false tracks in one frame that is accepted.
        max_speed_px : float
            Fastest motion against the stars, px per frame.
        coast_frames : int
            A track that is not seen in so many frames in a row ends.

        Returns
        -------
        Tracked
        """
        frame = history[-1]
        for other, found in zip(list(history)[-len(spots) :], spots, strict=True):
            before = self._sightings[-1] if self._sightings else None
            self._sightings.append(Sighting.of(other, found, before))
        oldest = history[0].number
        self._sightings = [s for s in self._sightings if s.frame.number >= oldest]
        self._follow(history, log_limit, coast_frames)
        drifts = find_drifts(self._known_objects(frame))
        born, candidates = self._new_tracks(history, drifts, defects, log_limit, max_speed_px)
        self._tracks += born
        now = [
            detection_rows([t for t in tracks if frame.number in t.hits], status, history)
            for tracks, status in ((self._tracks, CONFIRMED), (candidates, CANDIDATE))
        ]
        rows = track_rows(self._tracks, history)
        # The oldest frame makes room for the next one.
        full = len(history) == history.length
        settled = self.settle(history, 1) if full else []
        for track in self._tracks:
            track.forget(oldest - history.length)
        self._ended = [track for track in self._ended if max(track.hits) > oldest]
        return Tracked(np.concatenate(now), rows, settled)

    def settle(self, history: History, count: int) -> list[Settled]:
        """Say the last word on the oldest frames, this many, that it was not said of before."""
        settled = []
        for frame in list(history)[:count]:
            if frame.number < self._next_to_settle:
                continue
            self._next_to_settle = frame.number + 1
            tracks = [t for t in (*self._ended, *self._tracks) if frame.number in t.hits]
            detections = settled_rows(tracks, frame, history)
            settled.append(Settled(frame.number, frame.stamp_ns, detections))
        return settled

    def _known_objects(self, frame: PastFrame) -> NDArray[np.intp]:
        """Rows of the objects that tracks took in a frame."""
        hits = [track.hits[frame.number] for track in self._tracks if frame.number in track.hits]
        rows = np.array([hit.spot["object_index"] for hit in hits], np.intp)
        return rows[rows >= 0]

    def _follow(self, history: History, log_limit: float, coast_frames: int) -> None:
        """Give each track its spot of the newest frame, and end those that are gone."""
        frame, sighting = history[-1], self._sightings[-1]
        inside = frame.contains(places(self._tracks, frame))
        rows, spots = self._assign(frame, sighting)
        taken = list(np.stack([spots["x"], spots["y"]], axis=1))
        sure = [self._tracks[row] for row in rows]
        hits = self._refined(sure, frame, history, spots)
        add_hits(sure, hits)
        for track in sure:
            track.misses = 0
        for row in sorted(set(np.flatnonzero(inside)) - set(rows)):
            # What only a closer look finds keeps the track where it is, but not alive.
            track = self._tracks[row]
            track.misses += 1
            hit = self._closer_look(track, frame, history, taken)
            if hit is None:
                track.missed += 1
            else:
                add_hits([track], [hit])
                hits.append(hit)
        kept = []
        for track, seen in zip(self._tracks, inside, strict=True):
            if track.stands_still():
                continue
            if seen and track.misses <= coast_frames:
                kept.append(track)
            elif track.is_sustained(log_limit):
                self._ended.append(track)
        _take(sighting, hits)
        self._tracks = kept

    def _assign(
        self, frame: PastFrame, sighting: Sighting
    ) -> tuple[NDArray[np.intp], NDArray[np.void]]:
        """Rows of tracks, and the spot of each, such that their distances are least in all."""
        if not self._tracks:
            return np.zeros(0, np.intp), np.zeros(0, SPOT_DTYPE)
        from scipy.optimize import linear_sum_assignment  # no frame without tracks waits for it

        row, column, spots, distance = _candidates(self._tracks, frame, sighting)
        # What is beyond the gate must not weigh in what others get.
        good = np.flatnonzero(distance < _GATE_SIGMAS**2)
        row = row[good]
        columns, column = np.unique(column[good], return_inverse=True)
        cost = np.full((len(self._tracks), len(columns)), _NEVER)
        cost[row, column] = distance[good]
        candidate = np.full(cost.shape, -1)
        candidate[row, column] = good
        row, column = linear_sum_assignment(cost)
        best = candidate[row, column]
        return row[best >= 0], spots[best[best >= 0]]

    def _closer_look(
        self, track: Track, frame: PastFrame, history: History, taken: list[Array]
    ) -> Hit | None:
        """A hit under the usual threshold, where the track is expected.

        Its place is that of the track and the spot together, since such a spot's own is poor.
        """
        ((state,), (covariance,)) = predict([track], frame.stamp_ns)
        place = frame.pixels(state[None, :2])[0]
        if not frame.contains(place[None], BORDER_PX)[0]:
            return None
        if np.linalg.norm(covariance[:2, :2], 2) > _SURE_PX**2:
            return None
        hidden = _hidden([track], frame, history, _SELF_PX)[:, 0]
        others = zip(history.others(frame), hidden, strict=True)
        found = self._look(frame, [other for other, itself in others if not itself], place)
        if not len(found):
            return None
        spot = found[0].copy()
        xy = np.array([spot["x"], spot["y"]])
        if any(np.hypot(*(xy - other)) < _PIECE_PX for other in taken):
            return None
        hit = Hit.of(frame, spot)
        if hit.spot["excess"] < _FAINT_SIGMAS or not spot["clean"]:
            own = hit.covariance + (0 if spot["clean"] else _PULLED_PX**2) * np.eye(2)
            gain = covariance[:2, :2] @ np.linalg.inv(covariance[:2, :2] + own)
            sky = state[:2] + gain @ (hit.sky - state[:2])
            spot["x"], spot["y"] = frame.pixels(sky[None])[0]
        taken.append(xy)
        return Hit.of(frame, spot)

    def _refined(
        self,
        tracks: Sequence[Track],
        frame: PastFrame,
        history: History,
        spots: NDArray[np.void],
    ) -> list[Hit]:
        """The hits of tracks at spots, measured again with what is known of the tracks."""
        if not tracks:
            return []
        index = frame.number - history[0].number
        neighbour = history[index - 1 if index else 1]
        motions = (places(tracks, frame) - places(tracks, neighbour)) * (1 if index else -1)
        slow = np.hypot(motions[:, 0], motions[:, 1]) < _SLOW_PX
        long = np.array([track.length for track in tracks]) > _LONGEST_POINT_PX
        rows = np.flatnonzero(~(slow & long))
        hidden = _hidden(tracks, frame, history, _WINGS_PX)[:, rows]
        spots = spots.copy()
        spots[rows] = self._refine(
            frame, history.others(frame), spots[rows], motions[rows], hidden
        )
        return Hit.of_all(frame, spots)

    def _new_tracks(
        self,
        history: History,
        drifts: Sequence[Drift],
        defects: int,
        log_limit: float,
        max_speed_px: float,
    ) -> tuple[list[Track], list[Track]]:
        """Tracks that chance does not explain, and candidates, which it hardly explains."""
        frames = {frame.number: frame for frame in history}
        sightings = {sighting.frame.number: sighting for sighting in self._sightings}
        links = find_links(self._sightings, log_limit + _CANDIDATE_LOG, max_speed_px)
        finds = [
            (drift.log_false, {n: _as_spots(frames[n], [row]) for n, row in drift.rows.items()})
            for drift in drifts
        ]
        finds += [
            (link.log_false, {n: sightings[n].spots[[row]] for n, row in link.rows.items()})
            for link in links
        ]
        born: list[Track] = []
        candidates: list[Track] = []
        for log_false, spots in finds:
            hits = {number: Hit.of_all(frames[number], spot)[0] for number, spot in spots.items()}
            if _is_still(hits):
                # Where many defects are known, more are not.
                log_false += np.log(1 + _UNKNOWN_DEFECTS * defects)
            track = Track(log_false, _frame_seconds(history), hits)
            if any(_same(track, other) for other in (*self._tracks, *born)):
                continue
            track.fit()
            track.hits = {
                number: self._refined([track], frames[number], history, spot)[0]
                for number, spot in spots.items()
            }
            track.fit()
            if log_false > log_limit:
                candidates.append(track)
                continue
            self._look_back(track, history, [*self._tracks, *born])
            self._last_id += 1
            track.track_id = self._last_id
            born.append(track)
            for number, hit in track.hits.items():
                _take(sightings[number], [hit])
        return born, candidates

    def _look_back(self, track: Track, history: History, others: list[Track]) -> None:
        """Find a new track in the frames in which it was below the threshold."""
        for frame in history:
            if frame.number in track.hits:
                continue
            taken = [t.hits[frame.number].xy for t in others if frame.number in t.hits]
            hit = self._closer_look(track, frame, history, taken)
            if hit is not None:
                track.hits[frame.number] = hit
        track.fit()


def _hidden(
    tracks: Sequence[Track], frame: PastFrame, history: History, reach_px: float
) -> NDArray[np.bool_]:
    """Which other frames show N tracks themselves at their places in a frame, (F, N)."""
    ages = np.array([abs(o.stamp_ns - frame.stamp_ns) / 1e9 for o in history.others(frame)])
    speeds = np.array([track.speed for track in tracks])
    return ages[:, None] * speeds <= reach_px


def _frame_seconds(history: History) -> float:
    """Mean time between the frames, s."""
    return (history[-1].stamp_ns - history[0].stamp_ns) / 1e9 / max(1, len(history) - 1)


def _is_still(hits: dict[int, Hit]) -> bool:
    """Whether hits keep to one place in the sensor."""
    return bool(np.hypot(*np.ptp([hit.xy for hit in hits.values()], axis=0)) < _STILL_PX)


def _as_spots(frame: PastFrame, rows: Sequence[int] | NDArray[np.intp]) -> NDArray[np.void]:
    """Objects of a frame as if they were spots."""
    objects = frame.objects[rows]
    spots = np.zeros(len(objects), SPOT_DTYPE)
    for name in ("x", "y", "sigma_x", "sigma_y", "snr", "flux", "length", "angle"):
        spots[name] = objects[name]
    spots["excess"], spots["object_index"] = objects["snr"], rows
    return spots


def _candidates(
    tracks: Sequence[Track], frame: PastFrame, sighting: Sighting
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.void], Array]:
    """What tracks may take: the row of the track, and a number, the spot and its distance.

    Distances are squared and statistical, from where the track is expected.  A fast track takes
    spots, since it would take stars among the objects; a slow one takes objects of its brightness
    and shape, since a spot is only that side of it which has moved.
    """
    states, spread = predict(tracks, frame.stamp_ns)
    expected = states[:, :2]
    step = np.array([track.speed * track.frame_s for track in tracks])
    centre, reach, slow = as_complex(expected), _FARTHEST_PX + step / 2, step <= _SLOW_PX
    index = sighting.spots["object_index"]
    near = [(i, k, d < reach[i]) for i, k, d in sighting.near(centre, reach)]
    row, number, good = (np.concatenate(part) for part in zip(*near, strict=True))
    good &= ~slow[row] | (index[number] >= 0)
    row, number = row[good], number[good]
    rest = np.ones(len(frame.objects), bool)
    rest[index[index >= 0]] = False
    rest = np.flatnonzero(rest)
    objects = as_complex(frame.object_sky[rest])
    slow_row = np.flatnonzero(slow)
    which, column = np.nonzero(np.abs(objects - centre[slow_row, None]) < reach[slow_row, None])
    spots = np.concatenate([sighting.spots[number], _as_spots(frame, rest[column])])
    row = np.concatenate([row, slow_row[which]])
    number = np.concatenate([number, len(sighting.spots) + rest[column]])

    off = frame.sky(np.stack([spots["x"], spots["y"]], axis=1)) - expected[row]
    spread = spread[row, :2, :2] + covariances(frame, spots) + _SPREAD_PX**2 * np.eye(2)
    distance = np.sum(off * np.linalg.solve(spread, off[:, :, None])[:, :, 0], axis=1)
    flux, length = (
        np.array([getattr(track, name) for track in tracks])[row] for name in ("flux", "length")
    )
    ratio = np.log(np.maximum(spots["flux"], 1e-9) / np.maximum(flux, 1e-9)) / np.log(_FLUX_RATIO)
    longer = np.maximum(spots["length"] - length, 0) / _LONGER_PX
    distance += ratio**2 + longer**2
    distance[slow[row] & (np.abs(ratio) > 1)] = _NEVER
    return row, number, spots, distance


def _take(sighting: Sighting, hits: list[Hit]) -> None:
    """Mark the spots that are hits, or pieces of their streaks, as taken."""
    if not hits:
        return
    taken = np.array([hit.spot for hit in hits], SPOT_DTYPE)
    x, y, angle, half = taken["x"], taken["y"], taken["angle"], taken["length"] / 2 + _PIECE_PX
    sky = np.array([hit.sky for hit in hits])
    # A little more than the half diagonal of what a piece is in.
    for hit, row, _ in sighting.near(as_complex(sky), 1 + np.hypot(half, _PIECE_PX)):
        dx, dy = sighting.spots["x"][row] - x[hit], sighting.spots["y"][row] - y[hit]
        cos, sin = np.cos(angle[hit]), np.sin(angle[hit])
        along, across = np.abs(dx * cos + dy * sin), np.abs(dy * cos - dx * sin)
        sighting.free[row[(along <= half[hit]) & (across <= _PIECE_PX)]] = False


def _same(track: Track, other: Track) -> bool:
    """Whether two tracks share at least two of their sights."""
    shared = 0
    for number, hit in track.hits.items():
        if number in other.hits:
            reach = _PIECE_PX + hit.spot["length"] / 2
            shared += math.dist(other.hits[number].xy, hit.xy) < reach
    return shared >= 2
