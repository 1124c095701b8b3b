"""The tracker: spots over time become tracks with ids that stay.

Frame by frame: tracks take the spots where they are expected (assignment by the statistical
distance of a constant-velocity Kalman filter), and a closer look is taken where there is none;
what is left is searched for new tracks, and a new track labels what it was seen as before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ofsat_ros.detection import BORDER_PX, CANDIDATE, CONFIRMED, DETECTION_DTYPE, SPOT_DTYPE, Drift
from ofsat_ros.history import History, PastFrame
from ofsat_ros.tracking.linking import Sighting, find_links
from ofsat_ros.tracking.rows import TRACK_DTYPE, Settled, detection_row, settled_row, track_row
from ofsat_ros.tracking.track import Hit, Track

Array = NDArray[np.float64]
# Looks in a frame, compared with others, near a point: none or one SPOT_DTYPE.
Look = Callable[[PastFrame, Sequence[PastFrame], Array], NDArray[np.void]]

# Measures a spot of a frame again, compared with others, given its displacement per frame, px.
Refine = Callable[[PastFrame, Sequence[PastFrame], np.void, Array], np.void]

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
        Measures a spot's place once more.
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
        drifts: Sequence[Drift],
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
        drifts : sequence of Drift
            Objects of the current frame that drift.
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
        born, candidates = self._new_tracks(history, drifts, defects, log_limit, max_speed_px)
        self._tracks += born
        now = [
            detection_row(track, track.hits[frame.number], history, status)
            for tracks, status in ((self._tracks, CONFIRMED), (candidates, CANDIDATE))
            for track in tracks
            if frame.number in track.hits
        ]
        rows = [track_row(track, history) for track in self._tracks]
        # The oldest frame makes room for the next one.
        full = len(history) == history.length
        settled = self.settle(history, 1) if full else []
        for track in self._tracks:
            track.forget(oldest - history.length)
        self._ended = [track for track in self._ended if max(track.hits) > oldest]
        return Tracked(np.array(now, DETECTION_DTYPE), np.array(rows, TRACK_DTYPE), settled)

    def settle(self, history: History, count: int) -> list[Settled]:
        """Say the last word on the oldest frames, this many, that it was not said of before."""
        settled = []
        for frame in list(history)[:count]:
            if frame.number < self._next_to_settle:
                continue
            self._next_to_settle = frame.number + 1
            rows = [
                settled_row(track, track.hits[frame.number], history)
                for track in (*self._ended, *self._tracks)
                if frame.number in track.hits
            ]
            detections = np.array(rows, DETECTION_DTYPE)
            settled.append(Settled(frame.number, frame.stamp_ns, detections))
        return settled

    def _follow(self, history: History, log_limit: float, coast_frames: int) -> None:
        """Give each track its spot of the newest frame, and end those that are gone."""
        frame, sighting = history[-1], self._sightings[-1]
        assigned = self._assign(frame, sighting)
        taken = [hit.xy for hit in assigned.values()]
        kept = []
        for row, track in enumerate(self._tracks):
            hit = assigned.get(row)
            gone = not frame.contains(track.place(frame)[None])[0]
            if hit is not None:
                track.misses = 0
                hit = self._refined(track, frame, history, hit)
            elif not gone:
                # What only a closer look finds keeps the track where it is, but not alive.
                track.misses += 1
                hit = self._closer_look(track, frame, history, taken)
                track.missed += hit is None
            if hit is not None:
                track.add(hit)
                sighting.free &= ~_pieces(sighting.spots, hit)
            if not gone and track.misses <= coast_frames and not track.stands_still():
                kept.append(track)
            elif not track.stands_still() and track.is_sustained(log_limit):
                self._ended.append(track)
        self._tracks = kept

    def _assign(self, frame: PastFrame, sighting: Sighting) -> dict[int, Hit]:
        """The hit of each track, by its row, such that their distances are least in all."""
        rest = np.setdiff1d(np.arange(len(frame.objects)), sighting.spots["object_index"])
        pool = np.concatenate([sighting.spots, _as_spots(frame, rest)])
        cost = np.full((len(self._tracks), len(pool)), _NEVER)
        for row, track in enumerate(self._tracks):
            cost[row] = _distances(track, frame, pool, len(sighting.spots))
        # What is beyond the gate must not weigh in what others get.
        cost[cost >= _GATE_SIGMAS**2] = _NEVER
        return {
            int(row): Hit.of(frame, pool[column])
            for row, column in zip(*linear_sum_assignment(cost), strict=True)
            if cost[row, column] < _GATE_SIGMAS**2
        }

    def _closer_look(
        self, track: Track, frame: PastFrame, history: History, taken: list[Array]
    ) -> Hit | None:
        """A hit under the usual threshold, where the track is expected.

        Its place is that of the track and the spot together, since such a spot's own is poor.
        """
        state, covariance = track.predict(frame.stamp_ns)
        place = frame.pixels(state[None, :2])[0]
        if not frame.contains(place[None], BORDER_PX)[0]:
            return None
        if np.linalg.norm(covariance[:2, :2], 2) > _SURE_PX**2:
            return None
        found = self._look(frame, _without(track, frame, history, _SELF_PX), place)
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

    def _refined(self, track: Track, frame: PastFrame, history: History, hit: Hit) -> Hit:
        """The hit, measured again with what is known of the track."""
        frames = list(history)
        index = frame.number - frames[0].number
        neighbour = frames[index - 1 if index else 1]
        motion = (track.place(frame) - track.place(neighbour)) * (1 if index else -1)
        if np.hypot(*motion) < _SLOW_PX and track.length > _LONGEST_POINT_PX:
            return hit
        behind = _without(track, frame, history, _WINGS_PX)
        return Hit.of(frame, self._refine(frame, behind, hit.spot, motion))

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
            (drift.log_false, {n: _as_spots(frames[n], [row])[0] for n, row in drift.rows.items()})
            for drift in drifts
        ]
        finds += [
            (link.log_false, {n: sightings[n].spots[row] for n, row in link.rows.items()})
            for link in links
        ]
        born: list[Track] = []
        candidates: list[Track] = []
        for log_false, spots in finds:
            hits = {number: Hit.of(frames[number], spot) for number, spot in spots.items()}
            if _is_still(hits):
                # Where many defects are known, more are not.
                log_false += np.log(1 + _UNKNOWN_DEFECTS * defects)
            track = Track(log_false, _frame_seconds(history), hits)
            if any(_same(track, other) for other in (*self._tracks, *born)):
                continue
            track.fit()
            track.hits = {
                number: self._refined(track, frames[number], history, hit)
                for number, hit in hits.items()
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
                sightings[number].free &= ~_pieces(sightings[number].spots, hit)
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


def _without(track: Track, frame: PastFrame, history: History, reach_px: float) -> list[PastFrame]:
    """Frames that show what is behind a track in a frame, and not the track itself."""
    place = track.place(frame)[None]
    return [
        other
        for other in history.others(frame)
        if np.hypot(*(track.place(other) - other.pixels_of(frame, place)[0])) > reach_px
    ]


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


def _distances(track: Track, frame: PastFrame, spots: NDArray[np.void], known: int) -> Array:
    """Squared statistical distance of each spot from where the track is expected, (N,).

    The first `known` are spots, the others objects.  A fast track takes spots, since it would
    take stars among the objects; a slow one takes objects of its brightness and shape, since a
    spot is only that side of it which has moved.
    """
    state, covariance = track.predict(frame.stamp_ns)
    xy = np.stack([spots["x"], spots["y"]], axis=1)
    off = frame.sky(xy) - state[:2]
    step = np.hypot(*state[2:]) * track.frame_s
    ratio = np.log(np.maximum(spots["flux"], 1e-9) / max(track.flux, 1e-9)) / np.log(_FLUX_RATIO)
    longer = np.maximum(spots["length"] - track.length, 0) / _LONGER_PX
    distance = np.full(len(spots), _NEVER)
    for row in np.flatnonzero(np.hypot(*off.T) < 50 + step / 2):
        spread = covariance[:2, :2] + Hit.of(frame, spots[row]).covariance
        spread += _SPREAD_PX**2 * np.eye(2)
        distance[row] = off[row] @ np.linalg.solve(spread, off[row])
    distance += ratio**2 + longer**2
    is_object = spots["object_index"] >= 0
    if step > _SLOW_PX:
        distance[known:] = _NEVER
    else:
        distance[~is_object | (np.abs(ratio) > 1)] = _NEVER
    return distance


def _pieces(spots: NDArray[np.void], hit: Hit) -> NDArray[np.bool_]:
    """Which spots are the hit, or pieces of its streak, (N,)."""
    dx, dy = spots["x"] - hit.spot["x"], spots["y"] - hit.spot["y"]
    cos, sin = np.cos(hit.spot["angle"]), np.sin(hit.spot["angle"])
    along, across = np.abs(dx * cos + dy * sin), np.abs(dy * cos - dx * sin)
    return (along <= hit.spot["length"] / 2 + _PIECE_PX) & (across <= _PIECE_PX)


def _same(track: Track, other: Track) -> bool:
    """Whether two tracks share at least two of their sights."""
    shared = 0
    for number, hit in track.hits.items():
        if number in other.hits:
            reach = _PIECE_PX + hit.spot["length"] / 2
            shared += bool(np.hypot(*(other.hits[number].xy - hit.xy)) < reach)
    return shared >= 2
