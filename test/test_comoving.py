# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Few stars beside bright RSOs: those are the stars that move alike over several frames."""

from dataclasses import replace

import numpy as np
import pytest
from blobs import blobs, camera, flux
from sky import SECOND_NS, frame_of, spots_at

from ofsat_ros.comoving import CoMoving, find_comoving
from ofsat_ros.following import Paths
from ofsat_ros.history import History
from ofsat_ros.objects import OBJECT_DTYPE
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.simulation import RSO, SimulatorSettings, SkySimulator
from ofsat_ros.star_field import _mean_motion
from ofsat_ros.tracking import Tracker
from ofsat_ros.tracking.sightings import Sighting
from ofsat_ros.tracking.track import Hit, Track, predict

FRAMES, SIDE = 9, 256
MIDDLE = (SIDE - 1) / 2
STARS = np.array([(60.0, 70.0), (180.0, 90.0), (120.0, 200.0), (40.0, 150.0)])
SIGMA = 0.15


def history_of(
    paths: list[np.ndarray],
    wrong: tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
    turn: float = 0.0,
    sigma: float | np.ndarray = SIGMA,
) -> History:
    """Frames of objects with these paths, (FRAMES, 2) px each, and noise of `sigma`.

    The frames' places on the sky follow a field that moves by (2, 1) px a frame and turns by
    `turn` rad, but for what is `wrong`, px per frame.
    """
    rng, history = np.random.default_rng(seed), History(FRAMES)
    for number in range(FRAMES):
        objects = np.zeros(len(paths), OBJECT_DTYPE)
        xy = np.array([path[number] for path in paths]).reshape(-1, 2)
        xy += rng.normal(0, 1, (len(paths), 2)) * np.reshape(sigma, (-1, 1))
        objects["x"], objects["y"] = xy.T
        objects["sigma_x"] = objects["sigma_y"] = sigma
        objects["flux"], objects["snr"] = 1000.0, 10.0
        history.add(replace(frame_of(number, SIDE, sky_of(number, wrong, turn)), objects=objects))
    return history


def sky_of(number: int, wrong: tuple[float, float], turn: float) -> np.ndarray:
    """Matrix from px to the sky plane of a field that turns about the image's middle."""
    cos, sin = np.cos(-turn * number), np.sin(-turn * number)
    matrix = np.eye(3)
    matrix[:2, :2] = [[cos, -sin], [sin, cos]]
    shift = np.add((2.0, 1.0), wrong) * number
    matrix[:2, 2] = MIDDLE - matrix[:2, :2] @ (MIDDLE + shift)
    return matrix


def path(start: np.ndarray, drift: tuple[float, float] = (0, 0), turn: float = 0.0) -> np.ndarray:
    """Where something is that moves by so much against the field, (FRAMES, 2) px."""
    places = []
    for number in range(FRAMES):
        cos, sin = np.cos(turn * number), np.sin(turn * number)
        off = np.array([[cos, -sin], [sin, cos]]) @ (start - MIDDLE)
        places.append(MIDDLE + off + np.add((2.0, 1.0), drift) * number)
    return np.array(places)


def placed(history: History, found: CoMoving) -> np.ndarray:
    """Places of the stars in the sky plane, (FRAMES, N, 2), where it says that the frames are."""
    history.straighten(found.to_sky)
    return np.array([frame.object_sky[found.stars] for frame in history])


def test_what_the_field_was_taken_for_is_the_stray():
    """The frames follow a bright RSO; three stars drift against it."""
    drift = (0.5, -0.4)
    paths = [*map(path, STARS[:3]), path(np.array([130.0, 120.0]), drift)]
    history = history_of(paths, wrong=drift)
    found = find_comoving(history)
    assert found.stars.tolist() == [0, 1, 2]
    assert found.strays.tolist() == [3]
    sky = placed(history, found)
    # The newest frame stays; in the others the mean of three stars is off by what its noise is.
    assert history[-1].to_sky == pytest.approx(sky_of(FRAMES - 1, drift, 0))
    off = (sky - sky[-1]).mean(axis=1)
    assert np.abs(off).max() < 1e-6
    assert np.abs(sky - sky.mean(axis=0)).max() < 5 * SIGMA


def test_a_field_that_is_right_stays_where_it_is():
    paths = [*map(path, STARS[:3]), path(np.array([130.0, 120.0]), (0.5, -0.4))]
    found = find_comoving(history_of(paths))
    assert (found.stars.tolist(), found.strays.tolist()) == ([0, 1, 2], [3])
    assert found.to_sky is None


@pytest.mark.parametrize("turn", [0.02, -0.008])
def test_a_field_that_turns_is_one(turn):
    paths = [path(start, turn=turn) for start in STARS]
    found = find_comoving(history_of(paths, turn=turn))
    assert found.stars.tolist() == [0, 1, 2, 3]
    assert found.to_sky is None


def test_a_turn_that_few_vectors_made_up_does_no_harm():
    """The stars move alike in the image; on a sky that turns by 1 degree a frame they do not."""
    paths = [*map(path, STARS), path(np.array([130.0, 120.0]), (0.5, -0.4))]
    found = find_comoving(history := history_of(paths, turn=0.02))
    assert (found.stars.tolist(), found.strays.tolist()) == ([0, 1, 2, 3], [4])
    sky = placed(history, found)
    assert np.abs(sky - sky.mean(axis=0)).max() < 5 * SIGMA


def test_stars_that_shake_lead_nothing_astray():
    """Long streaks end anywhere, but no object moves otherwise: the frames stay where they are."""
    shaken = np.random.default_rng(4).normal(0, 1.0, (FRAMES, 2))
    found = find_comoving(history_of([path(start) + shaken for start in STARS]))
    assert found.stars.tolist() == [0, 1, 2, 3]
    assert found.to_sky is None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("faint", [0.6, 0.9])
def test_a_faint_object_that_agrees_with_all_joins_no_rso_to_the_stars(faint, seed):
    drift = (0.2, -0.1)
    rso, star = path(np.array([130.0, 120.0]), drift), path(np.array([90.0, 30.0]))
    sigma = np.array([0.1, 0.1, 0.1, 0.03, faint])
    history = history_of([*map(path, STARS[:3]), rso, star], drift, seed, sigma=sigma)
    found = find_comoving(history)
    assert {0, 1, 2} <= set(found.stars.tolist()) <= {0, 1, 2, 4}
    assert found.strays.tolist() == [3]
    sky = placed(history, found)[:, :3]
    # Not weighed by the RSO, whose way in nine frames is 1.8 px.
    assert np.abs((sky[0] - sky[-1]).mean(axis=0)).max() < 0.4


def test_two_pieces_of_an_rso_are_no_two_stars():
    """In the newest frame noise splits it; before, both pieces are the same object."""
    drift = (0.5, -0.4)
    whole = path(np.array([130.0, 120.0]), drift)
    piece = np.full_like(whole, -50.0)
    piece[-1] = whole[-1] + (2.0, 1.5)
    found = find_comoving(history_of([*map(path, STARS[:2]), whole, piece], drift))
    assert found.stars.tolist() == [0, 1]
    assert 2 in found.strays


@pytest.mark.parametrize("missing", [[4], [0, 1]])
def test_a_frame_without_stars_lies_between_those_that_show_them(missing):
    """Its turn was made up, too: about the image's middle, not about its corner."""
    history = history_of([*map(path, STARS), path(np.array([130.0, 120.0]), (0.5, -0.4))])
    turns = np.random.default_rng(8).normal(0, 0.02, FRAMES)
    frames, history = list(history), History(FRAMES)
    for frame, turn in zip(frames, turns, strict=True):
        made_up = sky_of(1, (-2.0, -1.0), turn)
        objects = frame.objects[: 0 if frame.number in missing else None]
        history.add(replace(frame, to_sky=frame.to_sky @ made_up, objects=objects))
    found = find_comoving(history)
    assert found.stars.tolist() == [0, 1, 2, 3]
    true = [sky_of(frame.number, (0, 0), 0) for frame in history]
    history.straighten(found.to_sky)
    back = np.linalg.inv(true[-1]) @ true
    middle = np.array([MIDDLE, MIDDLE, 1.0])
    now = np.linalg.inv(history[-1].to_sky)
    for frame, matrix in zip(history, back, strict=True):
        assert now @ frame.to_sky @ middle == pytest.approx(matrix @ middle, abs=0.6)


def test_a_star_that_was_missed_is_one():
    paths = [*map(path, STARS[:3]), path(np.array([130.0, 120.0]), (0.5, -0.4))]
    paths[1][[3, 6]] = (10.0, 10.0)
    history = history_of(paths, wrong=(0.5, -0.4))
    found = find_comoving(history)
    assert (found.stars.tolist(), found.strays.tolist()) == ([0, 1, 2], [3])


def test_what_can_not_be_told_is_not():
    moving = [path(start, (0.4 * row, -0.3 * row)) for row, start in enumerate(STARS)]
    assert find_comoving(history_of(moving)) is None
    two = [*moving, path(np.array([200.0, 200.0]), (-1.0, 1.0))]
    two[1] = path(STARS[1])
    assert find_comoving(history_of(two)) is None
    assert find_comoving(history_of(two[:4])).stars.tolist() == [0, 1]
    assert find_comoving(history_of([])) is None
    rng = np.random.default_rng(3)
    many = [path(start) for start in rng.uniform(20, 200, (31, 2))]
    found = find_comoving(history_of(many))
    assert (len(found.stars), len(found.strays), found.to_sky) == (0, 0, None)
    short = History(3)
    for frame in list(history_of([*map(path, STARS)]))[:3]:
        short.add(frame)
    assert find_comoving(short) is None


RATES = [(2.2, 10.3), (2.2, 10.3), (2.2, 10.3), (-7.0, 1.0)]
ELSEWHERE = np.array([(20.0, 30.0), (200.0, 40.0), (90.0, 10.0), (150.0, 100.0)])


def tracks_of(rates: list[tuple[float, float]], seed: int = 1) -> Paths:
    """Paths of tracks with these rates against the field, seen in all frames but the newest."""
    noise = np.random.default_rng(seed).normal(0, SIGMA, (len(rates), FRAMES, 2))
    # What misplaces a frame on the sky misplaces all of them.
    shift = np.random.default_rng(seed + 1).normal(0, 0.5, (FRAMES, 2))
    ages = np.arange(FRAMES)
    sky = ELSEWHERE[: len(rates), None] - ages[:, None] * np.reshape(rates, (-1, 1, 2))
    sky = sky + noise + shift
    rows = np.tile(np.arange(len(rates))[:, None], FRAMES)
    rows[:, 0] = -1
    seen = rows >= 0
    newest = (2.0, 1.0) * np.array([FRAMES - 1])[:, None]
    image = sky - shift + newest - ages[:, None] * (2.0, 1.0)
    places, pixels = (np.where(seen, xy[..., 0] + 1j * xy[..., 1], 0) for xy in (sky, image))
    return Paths(-1.0 * ages, rows, places, pixels, np.where(seen, SIGMA**2, 0))


def test_tracks_that_move_alike_are_the_stars_where_no_objects_do():
    """Rate tracking: two RSOs stand nearly still, and the stars are too faint for objects."""
    paths = [path(np.array([130.0, 120.0])), path(np.array([90.0, 60.0]), (0.6, 0.8))]
    history = history_of(paths)
    assert find_comoving(history) is None
    found = find_comoving(history, tracks_of(RATES))
    assert (found.stars.tolist(), found.strays.tolist()) == ([], [0, 1])
    assert found.tracks.tolist() == [0, 1, 2]
    before = np.array([frame.to_sky for frame in history])
    shift = (np.array(found.to_sky) - before)[:, :2, 2]
    ages = FRAMES - 1 - np.arange(FRAMES)
    # What misplaces frames by 0.5 px makes a rate of eight of them wrong by 0.08 px.
    assert shift == pytest.approx(ages[:, None] * np.array(RATES[0]), abs=0.3 * FRAMES)
    # What stood still drifts, in all frames, 11 px in each, known to 0.02 px.
    rows = [dict.fromkeys(range(FRAMES), row) for row in (0, 1)]
    assert [drift.rows for drift in found.drifts] == rows
    assert all(drift.log_false < -1e4 for drift in found.drifts)


def test_two_tracks_of_four_that_move_exactly_alike_are_stars():
    lone = history_of([path(np.array([130.0, 120.0]))])
    found = find_comoving(lone, tracks_of([*RATES[:2], RATES[3], (1.0, 0.5)]))
    assert found.tracks.tolist() == [0, 1]
    assert found.strays.tolist() == [0]


def test_a_train_of_satellites_among_stars_is_not_the_stars():
    found = find_comoving(history_of([*map(path, STARS[:2])]), tracks_of(RATES[:3]))
    assert found.stars.tolist() == [0, 1]
    assert found.to_sky is None


ALMOST = [(2.2, 10.3), (2.7, 10.0), (1.9, 10.9), (2.4, 11.5)]


@pytest.mark.parametrize("rates", [[], RATES[:1], RATES[2:], ALMOST])
def test_tracks_that_are_too_few_or_not_alike_tell_nothing(rates):
    """A mount that follows one RSO sees those beside it move almost as that does."""
    lone = history_of([path(np.array([130.0, 120.0]))])
    assert find_comoving(lone, tracks_of(rates)) is None


# What is placed anew


def test_the_motion_is_the_one_that_the_places_say():
    """A turn, a change of scale and a shift, to a matrix and back."""
    motion = _mean_motion(np.array([[3.0, -2.0]]), np.ones(1), np.array([MIDDLE, MIDDLE]), 2.0)
    motion = replace(motion, rotation=0.03, scale=-0.004)
    history = History(2)
    history.add(frame_of(0, SIDE, sky_of(3, (0.5, 1.0), 0.2)))
    history.add(frame_of(1, SIDE, history.place(motion)))
    back = history[0].from_sky @ history[1].to_sky
    other = replace(motion, displacement=np.zeros(2), rotation=0.0, scale=0.0).led_by(back)
    assert other.displacement == pytest.approx([3.0, -2.0])
    assert (other.rotation, other.scale) == pytest.approx((0.03, -0.004))


def track_of(frames: list, velocity: np.ndarray) -> Track:
    """A track with a hit in each frame, that moves against the sky."""
    spots = [spots_at(frame.pixels(frame.number * velocity[None] + 100.0), 10) for frame in frames]
    hits = [Hit.of_all(frame, spot)[0] for frame, spot in zip(frames, spots, strict=True)]
    track = Track(-20.0, 1.0, {hit.number: hit for hit in hits}, track_id=1)
    track.fit()
    return track


@pytest.mark.parametrize("kept", [8, 3, 1])
def test_a_track_goes_with_its_frames(kept):
    """The sky is shifted by a pixel a frame, and turned about its newest frame."""
    velocity = np.array([5.0, 1.0])
    frames = [frame_of(number, SIDE) for number in range(8)]
    track = track_of(frames, velocity)
    before = np.sqrt(predict([track], frames[-1].stamp_ns)[1][0][0, 0])
    moved = {}
    for frame in frames[-kept:]:
        shift = np.eye(3)
        shift[:2, 2] = (10.0 + frame.number, 4.0)
        moved[frame.number] = replace(frame, to_sky=shift)
    track.see_in(moved)
    (state,), (covariance,) = predict([track], frames[-1].stamp_ns)
    assert state[:2] == pytest.approx(7 * velocity + 100 + (17.0, 4.0), abs=0.1)
    # One hit tells no velocity: what was known of it stays.
    assert state[2:] == pytest.approx(velocity + ((1, 0) if kept > 1 else (0, 0)), abs=0.1)
    assert np.sqrt(covariance[0, 0]) < 2 * before
    assert len(track.hits) == track.hit_count == 8


def test_what_a_wrong_fit_and_a_frame_that_left_told_is_not_asked_again():
    """The scatter was that about the old motion; what is repeated stays known."""
    history = History(2)
    for number in range(2):
        history.add(replace(frame_of(number, SIDE), scatter=8.0))
    history.straighten([np.eye(3), np.eye(3)])
    assert [frame.scatter for frame in history] == [1.0, 1.0]
    spots = spots_at([(50.0, 50.0), (90.0, 40.0)], 10)
    before = Sighting.of(history[0], spots[:1])
    repeated = Sighting.of(history[1], spots, before)
    assert repeated.telling.tolist() == [False, True]
    assert repeated.seen_in(history[1], None).telling.tolist() == [False, True]


def test_a_track_of_other_frames_is_no_path():
    history = history_of([path(np.array([130.0, 120.0]))])
    frames = [frame_of(number, SIDE) for number in range(-8, 0)]
    tracker = Tracker(lambda *_: spots_at([], 1), lambda *_: spots_at([], 1))
    tracker._tracks = [track_of(frames, np.array([5.0, 1.0])), track_of(list(history), STARS[0])]
    assert len(tracker.paths(history).rows) == 1


# In the pipeline


def pass_of(settings: SimulatorSettings, **parameters: int):
    """Rows found and missed of the RSOs, false ones, and errors of the field's motion, px."""
    pipeline, truth, settled, motions = Pipeline(Parameters(**parameters)), [], [], []
    for frame in SkySimulator(settings):
        result = pipeline.process(frame.image, frame.stamp_ns)
        truth.append(frame.truth)
        settled += result.settled
        motions.append(result.star_field)
    settled += pipeline.finish()
    found, false = 0, 0
    for last in settled:
        true = truth[last.frame]
        for row in last.detections:
            off = np.hypot(true["x_px"] - row["x"], true["y_px"] - row["y"])
            near = np.any(off < 3.5 + true["length_px"] / 2)
            found, false = found + near, false + (not near)
    field = -np.array(settings.camera_rate_arcsec_s) / settings.pixel_scale_arcsec
    off = [np.hypot(*(motion.displacement - field)) for motion in motions[-5:] if motion]
    return found, sum(map(len, truth)), false, off


SPARSE = SimulatorSettings(
    width=400,
    height=400,
    frames=20,
    period_s=1.0,
    pixel_scale_arcsec=5.0,
    noise_mean_percent=5.0,
    noise_std_percent=0.5,
    star_count=18.0,
    star_flux_percent=(2.0, 2000.0),
    psf_sigma_px=1.0,
)


def test_a_bright_rso_that_drifts_among_few_stars_is_found_and_the_stars_are_not():
    """It is brighter than all stars, and drifts by half a pixel a frame."""
    settings = replace(
        SPARSE,
        camera_rate_arcsec_s=(-2.24, 1.63),
        rsos=(RSO((181.0, 180.0), (1.2, 2.2), snr=45),),
        seed=347009404,
    )
    found, of, false, off = pass_of(settings)
    assert (found, false) == (of, 0)
    # Stars of SNR 5 to 10, two to four of them: 0.2 px each, and what is alike in them.
    assert np.median(off) < 0.5


@pytest.mark.parametrize("history_frames", [3, 4])
def test_tracks_outlive_a_short_history(history_frames):
    """They coast for twice as long as it holds frames."""
    settings = replace(SPARSE, rsos=(RSO((181.0, 180.0), (3.0, 2.2), snr=45),), seed=5)
    found, of, _, _ = pass_of(settings, history_frames=history_frames, coast_frames=8)
    assert found >= 0.8 * of


def test_stars_that_streak_past_two_rsos_that_are_followed_are_not_tracks():
    """The mount follows one RSO, the other one drifts; four stars streak, none outshines them."""
    settings = replace(
        SPARSE,
        width=256,
        height=256,
        frames=14,
        exposure_s=0.9,
        camera_rate_arcsec_s=(-12.7, -55.3),
        rsos=(
            RSO((144.2, 108.1), (-12.7, -55.3), snr=42),
            RSO((156.9, 68.5), (-6.6, -47.6), snr=23),
        ),
        electrons_per_dn=2.0,
        psf_sigma_px=1.09,
        star_count=25.0,
        seed=5,
    )
    found, of, false, off = pass_of(settings)
    assert false == 0
    # At first, and while two stars are not seen, no field tells which of them is the stray.
    assert found >= 0.8 * of
    assert np.median(off) < 0.6


@pytest.mark.parametrize("shown", [1, 2])
def test_one_star_is_a_field_where_the_others_are_known_to_be_none(shown):
    """Three stars, then fewer, and three RSOs as bright that drift by 0.7 px a frame."""
    rng, pipeline, step = np.random.default_rng(6), Pipeline(), np.array([0.8, -0.5])
    stars = np.array([(40.0, 50.0), (130.0, 60.0), (80.0, 130.0)])
    rsos = np.array([(100.0, 100.0), (60.0, 90.0), (120.0, 30.0)])
    drifts = np.array([(0.6, 0.3), (-0.5, 0.5), (0.3, -0.6)])
    for number in range(14):
        seen = stars if number < 9 else stars[:shown]
        xy = np.concatenate([seen + number * step, rsos + number * (drifts + step)])
        if number >= 9:
            # One more comes out of the cloud, of which nothing is known yet.
            xy = np.concatenate([xy, [(30.0, 150.0) + (number - 9) * np.array([3.5, 1.5])]])
        result = pipeline.process(
            camera(blobs((180, 180), xy, flux(30), 1.0), rng), number * SECOND_NS
        )
        if number < 6:
            continue
        assert result.star_field is not None, number
        # Two centroids of SNR 30 are known to 0.1 px.
        assert result.star_field.displacement == pytest.approx(step, abs=0.4)
        assert {1, 2, 3} <= set(result.detections["track_id"]), number
