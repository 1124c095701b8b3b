# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Tracks: the filter, their ids, their ends, and what is said of them."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from blobs import blobs, camera, flux_of_snr, scattered
from sky import SECOND_NS, Path, frame_of, noise_spots, spots_at

from ofsat_ros.detection import CANDIDATE, CONFIRMED, DETECTION_DTYPE, Drift
from ofsat_ros.history import History, PastFrame
from ofsat_ros.objects import OBJECT_DTYPE
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.tracking import (
    COASTING,
    TRACK_DTYPE,
    Settled,
    Sighting,
    Tracked,
    Tracker,
    find_links,
)
from ofsat_ros.tracking import track as filter_of_tracks
from ofsat_ros.tracking.track import Hit, Track, add_hits, predict

SIDE = 256
NONE = spots_at([], 5)
# A path of three spots of 20 sigmas is surer than this by far.
LIMIT = math.log(1e-3)


def place(table: np.ndarray) -> np.ndarray:
    return np.stack([table["x"], table["y"]], axis=-1)


def velocity(table: np.ndarray) -> np.ndarray:
    return np.stack([table["vx"], table["vy"]], axis=-1)


class Night:
    """Frames of 1 s for a tracker, of spots alone.

    What `hidden` has by the frame's number is seen by nothing but a closer look.
    """

    def __init__(self, length: int = 9, coast_frames: int = 5, log_limit: float = LIMIT) -> None:
        self.history = History(length)
        self.tracker = Tracker(self._look, lambda frame, others, spots, motions, hidden: spots)
        self.coast_frames, self.log_limit = coast_frames, log_limit
        self.hidden: dict[int, np.ndarray] = {}
        self.known: list[int] = []
        self.settled: list[Settled] = []
        self.count = 0

    def _look(self, frame: PastFrame, _: Sequence[PastFrame], xy: np.ndarray) -> np.ndarray:
        spots = self.hidden.get(frame.number, NONE)
        return spots[np.hypot(*(place(spots) - xy).T) < 2][:1]

    def _drifts(self, known: np.ndarray) -> list[Drift]:
        self.known = known.tolist()
        return []

    def see(
        self,
        spots: np.ndarray,
        to_sky: np.ndarray | None = None,
        defects: int = 0,
        objects: np.ndarray | None = None,
    ) -> Tracked:
        frame = frame_of(self.count, SIDE, to_sky)
        if objects is not None:
            frame = dataclasses.replace(frame, objects=objects)
        self.history.add(frame)
        self.count += 1
        tracked = self.tracker.update(
            self.history,
            [spots],
            self._drifts,
            defects,
            self.log_limit,
            150.0,
            self.coast_frames,
        )
        self.settled += tracked.settled
        return tracked

    def end(self) -> list[Settled]:
        self.settled += self.tracker.clear(self.history)
        self.history.clear()
        return self.settled


def line(start: tuple[float, float], step: tuple[float, float]) -> Path:
    return lambda k: np.array(start) + k * np.array(step)


# The filter


def hits_along(
    path: Path, sigma: float, rng: np.random.Generator, times_s: Sequence[float]
) -> dict[int, Hit]:
    """Hits with centroids off by `sigma` along each axis, as they state."""
    hits = {}
    for number, time_s in enumerate(times_s):
        spot = spots_at(path(time_s) + rng.normal(0, sigma, 2), 20)[0]
        floor = filter_of_tracks._FLOOR_PX
        spot["sigma_x"] = spot["sigma_y"] = math.sqrt(sigma**2 - floor**2)
        hit = Hit.of(frame_of(number), spot)
        hits[number] = Hit(number, round(time_s * SECOND_NS), spot, hit.sky, hit.covariance)
    return hits


def test_without_manoeuvres_the_filter_is_a_least_squares_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(filter_of_tracks, "_WANDER_PX", 0.0)
    monkeypatch.setattr(filter_of_tracks, "_MANOEUVRE", 0.0)
    times = np.array([0.0, 1.0, 2.5, 3.0, 6.0, 7.0])
    sigma = 0.3
    hits = hits_along(line((50, 60), (3, -2)), sigma, np.random.default_rng(1), times)
    track = Track(-50.0, 1.0, hits)
    track.fit()

    design = np.stack([np.ones(6), times - 7.0], axis=1)
    seen = np.array([hit.sky for hit in hits.values()])
    expected = np.linalg.lstsq(design, seen, rcond=None)[0]
    covariance = np.linalg.inv(design.T @ design) * sigma**2
    # The first velocity is known to 1,000 px/s only: it counts 1e-7 of the hits.
    np.testing.assert_allclose(track.state, expected.ravel(), atol=1e-4)
    np.testing.assert_allclose(track.covariance, np.kron(covariance, np.eye(2)), atol=1e-6)
    # And where it will be.
    ((state,), (spread,)) = predict([track], 10 * SECOND_NS)
    np.testing.assert_allclose(state[:2], expected[0] + 3 * expected[1], atol=1e-4)
    at_ten = np.array([1.0, 3.0])
    np.testing.assert_allclose(spread[0, 0], at_ten @ covariance @ at_ten, rtol=1e-4)


def test_adding_hits_is_fitting_them_all():
    hits = hits_along(line((50, 60), (3, -2)), 0.2, np.random.default_rng(2), range(8))
    whole = Track(-50.0, 1.0, dict(hits))
    whole.fit()
    grown = Track(-50.0, 1.0, {k: hits[k] for k in range(3)})
    grown.fit()
    for k in range(3, 8):
        add_hits([grown], [hits[k]])
    np.testing.assert_allclose(grown.state, whole.state)
    np.testing.assert_allclose(grown.covariance, whole.covariance)
    assert (grown.hit_count, grown.born_ns) == (whole.hit_count, whole.born_ns) == (8, 0)


@pytest.mark.parametrize("ahead_s", [0, 3])
def test_the_covariance_is_honest(ahead_s: int):
    """Normalised squared errors of what wanders as the filter expects: chi^2 of 4."""
    random, count = np.random.default_rng(3), 400
    wander = filter_of_tracks._WANDER_PX + filter_of_tracks._MANOEUVRE * math.hypot(2, 1)
    errors = []
    for _ in range(count):
        # A velocity that walks at random, integrated in small steps.
        steps = random.normal(0, wander * math.sqrt(0.05), (20 * (10 + ahead_s), 2))
        rates = np.array([2.0, 1.0]) + np.cumsum(steps, axis=0)
        places = np.array([50.0, 60.0]) + np.cumsum(rates, axis=0) / 20

        def path(time_s: float, places: np.ndarray = places) -> np.ndarray:
            return places[round(20 * time_s)]

        hits = hits_along(path, 0.15, random, range(10))
        track = Track(-50.0, 1.0, hits)
        track.fit()
        ((state,), (covariance,)) = predict([track], (9 + ahead_s) * SECOND_NS)
        at = 20 * (9 + ahead_s)
        off = np.concatenate([places[at], rates[at]]) - state
        errors.append(off @ np.linalg.solve(covariance, off))
    # The mean of 400 has a std of sqrt(2 * 4 / 400) = 0.14; three of them, and 5 % for the
    # speed that the noise is taken from, which is itself measured.
    assert np.mean(errors) == pytest.approx(4, abs=0.42 + 0.2)
    # Of a chi^2 of 4, 5 % lie above 9.49: 20 +- 4.4.
    assert 7 <= np.count_nonzero(np.array(errors) > 9.49) <= 36


def test_spots_together_have_the_covariances_that_each_has():
    spots = spots_at(np.ones((5, 2)), [5, 10, 20, 40, 80])
    spots["length"], spots["angle"] = [0, 4, 20, 20, 9], [0, 1, -1, 0.3, 1.5]
    spots["refined"][::2] = True
    turned = np.array([[0.8, -0.6, 5], [0.6, 0.8, 7], [0, 0, 1]])
    frame = frame_of(0, SIDE, turned)
    together = filter_of_tracks.covariances(frame, spots)
    for spot, covariance in zip(spots, together, strict=True):
        np.testing.assert_allclose(Hit.of(frame, spot).covariance, covariance, rtol=1e-12)
    assert filter_of_tracks.covariances(frame, spots[:0]).shape == (0, 2, 2)


def test_a_streak_is_less_sure_along_itself():
    spot = spots_at((50, 60), 20)[0]
    spot["length"], spot["angle"] = 20.0, math.pi / 6
    covariance = Hit.of(frame_of(0), spot).covariance
    along = np.array([math.cos(math.pi / 6), math.sin(math.pi / 6)])
    across = np.array([-along[1], along[0]])
    assert across @ covariance @ across == pytest.approx(0.07**2 + 0.05**2)
    # 0.12 of the length
    assert along @ covariance @ along == pytest.approx(0.07**2 + 0.05**2 + 2.4**2)
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    on_sky = Hit.of(frame_of(0, SIDE, turned), spot)
    np.testing.assert_allclose(on_sky.sky, [-60, 50])
    np.testing.assert_allclose(
        on_sky.covariance, turned[:2, :2] @ covariance @ turned[:2, :2].T, atol=1e-12
    )


# Birth


def test_a_track_is_confirmed_in_its_third_frame():
    night, path = Night(), line((60, 60), (5, 3))
    for k in range(2):
        tracked = night.see(spots_at(path(k), 20))
        assert (len(tracked.detections), len(tracked.tracks)) == (0, 0)
    tracked = night.see(spots_at(path(2), 20))
    (row,), (found,) = tracked.tracks, tracked.detections
    assert (tracked.tracks.dtype, tracked.detections.dtype) == (TRACK_DTYPE, DETECTION_DTYPE)
    assert (found["track_id"], found["status"]) == (1, CONFIRMED)
    assert (row["track_id"], row["status"]) == (1, CONFIRMED)
    assert (row["age"], row["hits"], row["misses"]) == (2.0, 3, 0)
    for name in ("snr", "flux", "length"):
        assert row[name] == found[name] == {"snr": 20, "flux": 2000, "length": 0}[name]
    assert row["log_false"] < LIMIT
    np.testing.assert_allclose(place(found), path(2))
    np.testing.assert_allclose(place(row), path(2), atol=1e-3)
    for vx, vy in (("vx", "vy"), ("rel_vx", "rel_vy")):
        for one in (row, found):
            assert (one[vx], one[vy]) == pytest.approx((5, 3), abs=1e-3)
    # Three places good to 0.086 px along each axis: a line's slope to that / sqrt(2).
    assert row["sigma_x"] == pytest.approx(0.086 * math.sqrt(5 / 6), rel=0.1)
    assert row["sigma_vx"] == pytest.approx(0.086 / math.sqrt(2), rel=0.4)
    assert np.isnan([row["ra"], row["dec"], found["ra"], found["dec"]]).all()


def test_what_is_less_sure_is_a_candidate_without_an_id():
    rng, path = np.random.default_rng(5), line((60, 60), (5, 3))
    tables = [np.concatenate([noise_spots(rng, SIDE), spots_at(path(k), 4.5)]) for k in range(4)]
    seen: list[Sighting] = []
    for k, spots in enumerate(tables):
        seen.append(Sighting.of(frame_of(k), spots, seen[-1] if seen else None))
    surest = find_links(seen, 0.0, 150.0)[0].log_false
    for beyond, status in ((0.1, CONFIRMED), (-0.1, CANDIDATE), (-2.5, CANDIDATE), (-3.5, None)):
        night = Night(log_limit=surest + beyond)
        for spots in tables:
            tracked = night.see(spots)
        # Thirty times less sure, ln 30 = 3.4, and it is not said at all.
        near = np.hypot(*(place(tracked.detections) - path(3)).T) < 1
        (rows,) = (tracked.detections[near],)
        assert rows["status"].tolist() == ([] if status is None else [status])
        assert rows["track_id"].tolist() == ([] if status is None else [int(status == CONFIRMED)])
        assert len(tracked.tracks) == (status == CONFIRMED)


def test_where_defects_abound_more_is_asked_of_what_stands_still():
    """In a camera that drifts, an RSO tracked by the mount looks like a hot pixel."""
    for step, defects, found in (((0, 0), 0, 1), ((0, 0), 10**9, 0), ((4, 3), 10**9, 1)):
        night = Night()
        for k in range(4):
            to_sky = np.eye(3)
            to_sky[:2, 2] = -6 * k, 2 * k
            tracked = night.see(spots_at(line((90, 90), step)(k), 6), to_sky, defects)
        assert len(tracked.tracks) == found


# What is said later of frames before


def test_what_was_seen_before_its_track_was_confirmed_has_its_id():
    night, path = Night(length=6), line((40, 60), (5, 3))
    for k in range(12):
        night.see(spots_at(path(k), 20))
    # Those of which a track could still turn out to be none wait: 6 of the history, 5 that coast.
    assert [one.frame for one in night.settled] == [0]
    assert [one.frame for one in night.end()] == list(range(12))
    assert night.end() == night.settled
    for one in night.settled:
        (row,) = one.detections
        assert one.stamp_ns == one.frame * SECOND_NS
        assert (row["track_id"], row["status"]) == (1, CONFIRMED)
        np.testing.assert_allclose(place(row), path(one.frame))
        np.testing.assert_allclose(velocity(row), (5, 3), atol=1e-9)


def test_a_new_track_is_looked_for_where_it_was_below_the_threshold():
    night, path = Night(), line((40, 60), (5, 3))
    for k in range(7):
        spots = spots_at(path(k), 4.5)
        if k < 3 or k == 4:
            night.hidden[k], spots = spots, NONE
        tracked = night.see(spots)
    assert tracked.detections["track_id"].tolist() == [1]
    (row,) = tracked.tracks
    assert (row["age"], row["hits"], row["misses"]) == (6.0, 7, 0)
    for one in night.end():
        assert one.detections["track_id"].tolist() == [1], one.frame
        np.testing.assert_allclose(place(one.detections)[0], path(one.frame))


def test_of_a_jittering_mount_the_velocity_is_where_the_rso_goes():
    """0.7 px of jitter change each frame's place, and neither velocity."""
    night, rng = Night(), np.random.default_rng(6)
    path, drift = line((60, 60), (5, 3)), np.array([1.0, -0.5])
    shifts = rng.normal(0, 0.7, (16, 2)) + drift * np.arange(16)[:, None]
    for k in range(16):
        to_sky = np.eye(3)
        to_sky[:2, 2] = shifts[k]
        night.see(spots_at(path(k) - shifts[k] + rng.normal(0, 0.05, 2), 20), to_sky)
    for one in night.end():
        (row,) = one.detections
        # A line through 7 places, each off by 0.05 px: 0.05 / sqrt(28), four times.
        against = np.array([row["rel_vx"], row["rel_vy"]])
        np.testing.assert_allclose(against, (5, 3), atol=0.04)
        # The drift itself is known from 7 frames that jitter: 0.7 / sqrt(28), three times.
        np.testing.assert_allclose(velocity(row), np.array([5, 3]) - drift, atol=0.4)


def test_of_an_accelerating_rso_the_velocity_is_that_of_the_moment():
    night = Night()
    acceleration = np.array([0.1, -0.05])
    live = {}
    for k in range(16):
        spots = spots_at((30 + 3 * k, 150 - 2 * k) + acceleration * k**2 / 2, 20)
        for row in night.see(spots).detections:
            live[k] = row
    for one in night.end():
        (row,) = one.detections
        truth = np.array([3, -2]) + one.frame * acceleration
        if 4 <= one.frame <= 11:
            # Nine places around it: exact for a constant acceleration.
            np.testing.assert_allclose(velocity(row), truth, atol=0.005)
        else:
            # At the ends the middle of the nine is up to four frames away.
            np.testing.assert_allclose(velocity(row), truth, atol=0.42)
        if one.frame >= 8:
            # Live, the filter lags behind by a few frames.
            lag = np.hypot(*(velocity(live[one.frame]) - truth)) / np.hypot(*acceleration)
            assert lag < 5
            np.testing.assert_allclose(place(live[one.frame]), place(row))


# Life


def test_a_track_coasts_through_a_gap_and_keeps_its_id():
    night, path, sigma = Night(), line((40, 60), (5, 3)), 0.0
    for k in range(14):
        gone = 5 <= k < 9
        tracked = night.see(NONE if gone else spots_at(path(k), 20))
        if k < 2:
            continue
        (row,) = tracked.tracks
        assert row["track_id"] == 1
        assert row["status"] == (COASTING if gone else CONFIRMED)
        assert row["misses"] == min(max(k - 4, 0), 4)
        assert row["hits"] == k + 1 - row["misses"]
        assert row["age"] == k
        assert len(tracked.detections) == (not gone)
        np.testing.assert_allclose(place(row), path(k), atol=0.01)
        if gone:
            # It is less and less sure where it is, and of what it was it keeps the last.
            assert row["sigma_x"] > sigma
            assert row["snr"] == 20
        sigma = row["sigma_x"]
    assert [len(one.detections) for one in night.end()] == [1] * 5 + [0] * 4 + [1] * 5


@pytest.mark.parametrize("coast_frames", [0, 2])
def test_a_track_ends_when_it_is_not_seen_for_longer(coast_frames: int):
    night, path = Night(coast_frames=coast_frames), line((40, 60), (5, 3))
    for k in range(6):
        night.see(spots_at(path(k), 20))
    lives = [len(night.see(NONE).tracks) for _ in range(8)]
    assert lives == [1] * coast_frames + [0] * (8 - coast_frames)
    # It was one nevertheless.
    assert [len(one.detections) for one in night.end()] == [1] * 6 + [0] * 8


def test_a_closer_look_keeps_a_track_in_place_but_not_alive():
    night, path = Night(coast_frames=3), line((40, 60), (5, 3))
    for k in range(12):
        night.hidden[k] = spots_at(path(k), 4.5)
        tracked = night.see(spots_at(path(k), 20) if k < 6 else NONE)
        if 6 <= k < 9:
            (row,) = tracked.tracks
            assert (row["status"], row["misses"], row["hits"]) == (CONFIRMED, 0, k + 1)
            assert tracked.detections["track_id"].tolist() == [1]
    assert len(tracked.tracks) == 0


def test_an_id_is_never_used_again():
    night, path, ids = Night(coast_frames=1), line((40, 60), (5, 3)), []
    for start in range(4):
        for k in range(4):
            tracked = night.see(spots_at(path(k), 20))
        ids += tracked.tracks["track_id"].tolist()
        if start % 2:
            night.end()
        for _ in range(3):
            night.see(NONE)
    assert ids == [1, 2, 3, 4]
    assert [one.frame for one in night.end()] == list(range(28))


def test_leaving_the_image_ends_a_track():
    night, path = Night(), line((215, 100), (6, 1))
    for k in range(10):
        # The last place inside is 251, for k = 6.
        tracked = night.see(spots_at(path(k), 20) if k <= 6 else NONE)
        assert len(tracked.tracks) == (2 <= k <= 6), k
    assert [len(one.detections) for one in night.end()] == [1] * 7 + [0] * 3


def test_what_stops_is_a_star_after_all():
    """Its last ten hits show less than a pixel of motion: the track ends, and none is born."""
    night = Night()
    ended = None
    for k in range(30):
        tracked = night.see(spots_at((60 + 3 * min(k, 6), 80), 20))
        if k >= 2 and not len(tracked.tracks) and ended is None:
            ended = k
        assert len(tracked.tracks) == (k >= 2 and ended is None)
    assert 6 + 5 <= ended <= 6 + 10


def test_objects_that_tracks_took_are_known_to_the_search_for_drifts():
    """A fast track takes the spot of an object; a slow one an object that is no spot."""
    night, fast, slow = Night(), line((40, 60), (5, 3)), line((150, 150), (1.5, 1.0))
    for k in range(8):
        spots = spots_at([fast(k), slow(k)], 20)
        objects = np.zeros(4, OBJECT_DTYPE)
        for row, source in ((1, spots[0]), (3, spots[1])):
            for name in ("x", "y", "sigma_x", "sigma_y", "snr", "flux"):
                objects[row][name] = source[name]
        # The others are stars, far away.
        objects["x"][[0, 2]], objects["flux"][[0, 2]] = (20, 230), 2000
        spots["object_index"] = 1, 3
        tracked = night.see(spots if k < 5 else spots[:1], objects=objects)
        assert sorted(night.known) == ([] if k < 3 else [1, 3])
    assert tracked.tracks["status"].tolist() == [CONFIRMED] * 2
    # What was taken as an object, not as a spot, is where the object is.
    (row,) = tracked.detections[tracked.detections["object_index"] == 3]
    np.testing.assert_allclose(place(row), slow(7))


@pytest.mark.parametrize("angle", [25.0, 60.0, 90.0, 150.0])
def test_rsos_that_cross_keep_their_ids(angle: float):
    """They meet in one place at one time, where only one spot is seen."""
    turn = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    paths = [line((128 - 32, 128), (4, 0)), line(tuple(128 - 8 * 4 * turn), tuple(4 * turn))]
    night, ids = Night(), None
    for k in range(17):
        places = np.array([path(k) for path in paths])
        apart = np.hypot(*(places[0] - places[1]))
        spots = spots_at(places, 20) if apart > 2 else spots_at(places.mean(axis=0), 30)
        tracked = night.see(spots)
        if k < 2:
            continue
        assert len(tracked.tracks) == 2
        distance = np.hypot(*(place(tracked.tracks)[None] - places[:, None]).transpose(2, 0, 1))
        order = np.argmin(distance, axis=1)
        if apart > 2:
            ids = tracked.tracks["track_id"][order].tolist() if ids is None else ids
            assert tracked.tracks["track_id"][order].tolist() == ids
        # Where they meet, what is seen is between them.
        assert distance.min(axis=1).max() < (0.5 if apart > 2 else 2)
    assert sorted(ids) == [1, 2]


def test_a_stray_spot_beside_the_path_is_not_taken():
    night, path, rng = Night(), line((40, 60), (5, 3)), np.random.default_rng(7)
    for k in range(24):
        # A cosmic ray of the same brightness, 4 px aside; the RSO itself is good to 0.1 px.
        angle = rng.uniform(0, 2 * math.pi)
        stray = path(k) + 4 * np.array([math.cos(angle), math.sin(angle)])
        seen = path(k) + rng.normal(0, 0.1, 2)
        spots = [spots_at(stray, 20)] * (k % 4 == 0) + [spots_at(seen, 20)]
        tracked = night.see(np.concatenate(spots))
        if k >= 4:
            (row,) = tracked.detections[tracked.detections["track_id"] == 1]
            np.testing.assert_allclose(place(row), seen, atol=1e-6)


# On images


@pytest.mark.parametrize(("false_tracks", "frames"), [(1.0, 60), (0.1, 100)])
def test_noise_has_no_more_tracks_than_stated(false_tracks: float, frames: int):
    rng, shape = np.random.default_rng(9), (128, 128)
    stars = scattered(rng, shape, 40)
    scene = blobs(shape, stars, flux_of_snr(rng.uniform(20, 200, len(stars)), 10, 1.2), 1.2)
    pipeline, ids = Pipeline(Parameters(false_tracks=false_tracks)), set()
    spots = 0
    for k in range(frames):
        result = pipeline.process(camera(scene, rng, noise=10), k * SECOND_NS)
        ids |= set(result.tracks["track_id"].tolist())
        spots += result.spot_count
    expected = false_tracks * frames
    assert len(ids) <= expected + 3 * math.sqrt(expected)
    # Noise had its chance: 128^2 px have some 17 peaks over 3 sigma, of which the comparison with
    # the other frames' noise leaves a part.
    assert spots > 3 * frames


def test_an_rso_that_passes_over_a_star_keeps_its_id():
    rng, shape, noise = np.random.default_rng(8), (200, 200), 10.0
    stars = scattered(rng, shape, 34)
    stars = stars[np.hypot(*(stars - 100).T) > 22]
    # In its path, and six times as bright as the RSO.
    stars = np.concatenate([stars, [(100.0, 100.0)]])
    flux = np.append(flux_of_snr(rng.uniform(40, 120, len(stars) - 1), noise, 1.2), 0)
    flux[-1] = flux_of_snr(180, noise, 1.2)
    path = line((100 - 7 * 3.1, 100 - 7 * 1.2), (3.1, 1.2))
    pipeline = Pipeline(Parameters())
    settled = []
    for k in range(15):
        scene = blobs(shape, stars, flux, 1.2)
        scene += blobs(shape, path(k), flux_of_snr(30, noise, 1.2), 1.2)
        result = pipeline.process(camera(scene, rng, noise=noise), k * SECOND_NS)
        settled += result.settled
        if k >= 2:
            assert result.tracks["track_id"].tolist() == [1], k
            # Within 3 px of the star it may be hidden, or only the side away from it be seen, and
            # noise decides how far that pulls (0.26 px rms over 16 skies); its place is known.
            hidden = abs(k - 7) <= 1
            near = 1.0 if hidden else 0.5
            np.testing.assert_allclose(place(result.tracks)[0], path(k), atol=near)
            assert hidden or result.tracks["status"].tolist() == [CONFIRMED], k
    settled += pipeline.finish()
    for one in settled:
        assert set(one.detections["track_id"].tolist()) <= {1}
        assert abs(one.frame - 7) <= 1 or len(one.detections) == 1
        for row in one.detections:
            # 3 px from the star, only the side away from it stands out.
            atol = 2.0 if abs(one.frame - 7) <= 1 else 0.5
            np.testing.assert_allclose(place(row), path(one.frame), atol=atol)
            np.testing.assert_allclose(velocity(row), (3.1, 1.2), atol=0.05)


def test_what_was_confirmed_stays_settled_when_a_track_ends():
    n, path = Night(), line((40, 60), (4, 2))
    for k in range(40):
        n.see(spots_at(path(k), 20))
    for _ in range(8):
        n.see(NONE)
    assert [len(s.detections) for s in n.end()] == [1] * 40 + [0] * 8


def test_a_spot_on_the_path_is_taken_whatever_the_other_track_lacks():
    n = Night()
    a, b = line((40, 60), (5, 3)), line((44.5, 60), (5, 3))
    for k in range(6):
        n.see(spots_at([a(k), b(k)], 20))
    t = n.see(spots_at([a(6), a(6) - [4.5, 0]], 20))
    assert t.tracks["status"].tolist().count(CONFIRMED) == 1
