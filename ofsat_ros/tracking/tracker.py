# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
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

from ofsat_ros.detection import (
    BORDER_PX,
    CANDIDATE,
    CONFIRMED,
    DETECTION_DTYPE,
    SPOT_DTYPE,
    WINGS_PX,
    Drift,
)
from ofsat_ros.following import Paths
from ofsat_ros.history import History, PastFrame
from ofsat_ros.pixels import as_complex, positions
from ofsat_ros.tracking.assignment import SLOW_PX, as_spots, assign
from ofsat_ros.tracking.last_word import LastWord
from ofsat_ros.tracking.linking import find_links
from ofsat_ros.tracking.rows import TRACK_DTYPE, Settled, detection_rows, track_rows
from ofsat_ros.tracking.sharpness import is_sharper_than_stars
from ofsat_ros.tracking.sightings import Sighting
from ofsat_ros.tracking.staying import moves_on
from ofsat_ros.tracking.track import Hit, Track, add_hits, paths_of, places, predict

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

# Spots this near to a track's are pieces of it, px beside its streak.
_PIECE_PX = 2.5
# A track whose hits are longer is a streak, whose ends its centroid needs, px.
_LONGEST_POINT_PX = 4.0
# Where a track is expected less surely than this, nothing faint is looked for, px.
_SURE_PX = 1.5
# What is fainter than the track by more than this is noise, or a cloud has hidden it.
_FADED = 5.0
# A spot fainter than this has a poor place of its own, sigmas.
_FAINT_SIGMAS = 4.0
# What is left of a star beside a spot may pull it by this, px.
_PULLED_PX = 1.0
# A frame in which the track itself was as near as this doesn't show what is behind it, px.
_SELF_PX = 2.5
# Of what is beside a star, so many hits tell whether it moves; of others, how.
_LEAST_HITS, _RATE_HITS = 2, 4
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
        self._last_word = LastWord()

    def clear(self, history: History) -> list[Settled]:
        """End all tracks and return what is said last of the history's frames.

        The ids are not used again.
        """
        try:
            self.settle(history, len(history))
        finally:
            self._tracks, self._ended, self._sightings = [], [], []
        return self._last_word.said()

    def paths(self, history: History) -> Paths:
        """Where the tracks that were seen for a while were in a history's frames."""
        return paths_of(self._seen_for_a_while(history), list(history)[::-1])

    def _seen_for_a_while(self, history: History) -> list[Track]:
        numbers = {frame.number for frame in history}
        return [t for t in self._tracks if len(t.hits.keys() & numbers) >= _RATE_HITS]

    def straighten(
        self, history: History, stars: Array, followed: Sequence[int] | NDArray[np.intp]
    ) -> None:
        """Take the new places of a history's frames, whose newest one has no sightings yet.

        Tracks that are stars are withdrawn: those that stand still on the new sky, sooner if they
        are at the places `stars`, (N, 2) px in the newest frame, and those of the rows `followed`
        of `paths`.
        """
        gone = {self._seen_for_a_while(history)[row].track_id for row in followed}
        frames = {frame.number: frame for frame in history}
        for track in (*self._tracks, *self._ended):
            track.see_in(frames)
        sightings, self._sightings = self._sightings, []
        for sighting in sightings:
            if (frame := frames.get(sighting.frame.number)) is not None:
                before = self._sightings[-1] if self._sightings else None
                self._sightings.append(sighting.seen_in(frame, before))
        for track, place in zip(self._tracks, places(self._tracks, history[-1]), strict=True):
            is_near = np.any(np.hypot(*(stars - place).T) < _PIECE_PX)
            if track.stands_still(_LEAST_HITS) if is_near else track.stands_still():
                gone.add(track.track_id)
        gone |= {track.track_id for track in self._ended if track.stands_still()}
        for track_id in gone:
            self._last_word.withdraw(track_id)
        self._tracks = [track for track in self._tracks if track.track_id not in gone]
        self._ended = [track for track in self._ended if track.track_id not in gone]

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
        if full:
            self.settle(history, 1)
        for track in self._tracks:
            track.forget(oldest - history.length)
        self._ended = [track for track in self._ended if max(track.hits) > oldest]
        # By then, a track that has not been seen since its birth has ended.
        settled = self._last_word.said(oldest - coast_frames)
        return Tracked(np.concatenate(now), rows, settled)

    def settle(self, history: History, count: int) -> None:
        """Write down what will be said last of the oldest frames, this many: they are leaving."""
        self._last_word.take(history, count, (*self._ended, *self._tracks))

    def _known_objects(self, frame: PastFrame) -> NDArray[np.intp]:
        """Rows of the objects that tracks took in a frame."""
        hits = [track.hits[frame.number] for track in self._tracks if frame.number in track.hits]
        rows = np.array([hit.spot["object_index"] for hit in hits], np.intp)
        return rows[rows >= 0]

    def _follow(self, history: History, log_limit: float, coast_frames: int) -> None:
        """Give each track its spot of the newest frame, and end those that are gone."""
        frame, sighting = history[-1], self._sightings[-1]
        inside = frame.contains(places(self._tracks, frame))
        rows, spots = assign(self._tracks, frame, sighting)
        taken = list(positions(spots))
        sure = [self._tracks[row] for row in rows]
        hits = self._refined(sure, frame, history, spots)
        add_hits(sure, hits)
        for track in sure:
            track.unsure = 0
        for row in sorted(set(np.flatnonzero(inside)) - set(rows)):
            # What only a closer look finds keeps the track where it is, but not alive.
            track = self._tracks[row]
            track.unsure += 1
            hit = self._closer_look(track, frame, history, taken)
            if hit is None:
                track.misses += 1
            else:
                add_hits([track], [hit])
                hits.append(hit)
        kept = []
        for track, seen in zip(self._tracks, inside, strict=True):
            star = track.stands_still()
            if seen and track.unsure <= coast_frames and not star:
                kept.append(track)
            elif track.is_sustained(log_limit) and not star:
                self._ended.append(track)
            else:
                self._last_word.withdraw(track.track_id)
        _take(sighting, hits)
        self._tracks = kept

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
        if spot["flux"] * _FADED < track.flux:
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
        slow = np.hypot(motions[:, 0], motions[:, 1]) < SLOW_PX
        long = np.array([track.length for track in tracks]) > _LONGEST_POINT_PX
        rows = np.flatnonzero(~(slow & long))
        hidden = _hidden(tracks, frame, history, WINGS_PX)[:, rows]
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
        finds = [
            (drift.log_false, {n: as_spots(frames[n], [row]) for n, row in drift.rows.items()})
            for drift in drifts
        ]
        finds += self._paths(frames, sightings, log_limit, max_speed_px)
        born: list[Track] = []
        candidates: list[Track] = []
        for log_false, spots in finds:
            hits = {number: Hit.of_all(frames[number], spot)[0] for number, spot in spots.items()}
            if _is_still(hits):
                if is_sharper_than_stars({n: spot[0] for n, spot in spots.items()}, frames):
                    continue
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
            self._name(track)
            born.append(track)
            for number in track.hits.keys() & sightings.keys():
                _take(sightings[number], [track.hits[number]])
        return born, candidates

    def _paths(
        self,
        frames: dict[int, PastFrame],
        sightings: dict[int, Sighting],
        log_limit: float,
        max_speed_px: float,
    ) -> list[tuple[float, dict[int, NDArray[np.void]]]]:
        """How many times chance gives each path (logarithm), and its spots by frame, (1,)."""
        links = find_links(self._sightings, log_limit + _CANDIDATE_LOG, max_speed_px)
        paths = [{n: sightings[n].spots[row] for n, row in link.rows.items()} for link in links]
        return [
            (link.log_false, {n: np.array([spot], SPOT_DTYPE) for n, spot in path.items()})
            for link, path, moves in zip(links, paths, moves_on(paths, frames), strict=True)
            if moves
        ]

    def _name(self, track: Track) -> None:
        """Give a new track its id: that of the track that had ended where it begins, if one has.

        What was lost behind a star is found again.
        """
        for ended in self._ended:
            if _same(track, ended):
                self._ended.remove(ended)
                track.go_on_from(ended)
                return
        self._last_id += 1
        track.track_id = self._last_id

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
    ages = np.array([abs(other.seconds_since(frame)) for other in history.others(frame)])
    speeds = np.array([track.speed for track in tracks])
    return ages[:, None] * speeds <= reach_px


def _frame_seconds(history: History) -> float:
    """Mean time between the frames, s."""
    return history[-1].seconds_since(history[0]) / max(1, len(history) - 1)


def _is_still(hits: dict[int, Hit]) -> bool:
    """Whether hits keep to one place in the sensor."""
    return bool(np.hypot(*np.ptp([hit.xy for hit in hits.values()], axis=0)) < _STILL_PX)


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
