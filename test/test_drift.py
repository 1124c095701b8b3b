# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Drift: what leaves its place on the sky slowly, and stars, which do not."""

import math
from dataclasses import replace

import numpy as np
import pytest
from blobs import blobs, camera, flux, scattered
from sky import SECOND_NS, past

from ofsat_ros.detection import drift as drift_module
from ofsat_ros.detection import find_drifting
from ofsat_ros.history import History, PastFrame

SHAPE = (180, 180)
LOG_LIMIT = math.log(1e-3)
FRAMES = 8
# Where two objects are in the last frame.
PLACES = np.array([[70.3, 60.6], [115.8, 120.1]])
FIELDS = [(0.0, 0.0), (6.9, -4.0)]


def history_of(
    rng, field, drift=None, snr=20.0, star_snr=40.0, exposure=0.0, dt_s=1.0, wobble=None, seen=None
):
    """Frames of a moving field and, if asked for, of two objects that drift in it.

    `drift` is px per frame against the stars, `exposure` the part of a frame's time that
    streaks last, `wobble(k)` an offset of the objects, `seen` the frames in which they shine.
    """
    reach = math.ceil(max(np.abs(field))) * FRAMES + 20
    size = tuple(np.add(SHAPE, 2 * reach))
    stars = scattered(rng, size, 40, margin=0) - reach
    streak = np.multiply(field, exposure)
    velocity = np.add(field, (0, 0) if drift is None else drift)
    numbers = np.arange(FRAMES)
    objects = PLACES + (numbers[:, None, None] - (FRAMES - 1)) * velocity
    sky = stars[:, None] + numbers[:, None] * np.array(field)
    # no star near an object in any of the frames
    far = np.linalg.norm(sky[:, :, None] - objects, axis=-1).min(axis=(1, 2)) > 14
    history = History(FRAMES + 1)
    for number in numbers:
        now = sky[far, number]
        now = now[np.all((now > -20) & (now < SHAPE[0] + 20), axis=1)]
        light = blobs(SHAPE, now, flux(star_snr, streak), 1.0, streak)
        if drift is not None and (seen is None or number in seen):
            place = objects[number] + (0 if wobble is None else wobble(number))
            own = velocity * exposure
            light = light + blobs(SHAPE, place, flux(snr, own), 1.0, own)
        to_sky = np.eye(3)
        to_sky[:2, 2] = -np.multiply(field, number)
        step_ns = round(dt_s * SECOND_NS)
        history.add(past(camera(light, rng), int(number), to_sky, step_ns))
    return history, objects


def assert_found(history, objects, frames=range(FRAMES), reach_px=1.0):
    """Each of the two once, with its row in each frame in which it shone."""
    drifting = find_drifting(history, LOG_LIMIT)
    assert len(drifting) == 2
    found = set()
    for drift in drifting:
        assert drift.log_false < LOG_LIMIT
        assert sorted(drift.rows) == list(frames)
        last = history[-1].objects[drift.rows[FRAMES - 1]]
        which = int(np.argmin(np.hypot(*(PLACES - (last["x"], last["y"])).T)))
        found.add(which)
        for number, row in drift.rows.items():
            there = history[number].objects[row]
            assert (there["x"], there["y"]) == pytest.approx(objects[number, which], abs=reach_px)
    assert found == {0, 1}
    return drifting


# Drifting objects


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("drift", [(0.6, 0.0), (-0.36, 0.48)])
@pytest.mark.parametrize("snr", [12, 40])
def test_an_object_that_drifts_is_found_with_its_rows(field, drift, snr):
    history, objects = history_of(np.random.default_rng(snr), field, drift, snr)
    # 2 px / SNR on each axis, five times that at the worst
    assert_found(history, objects, reach_px=10 / snr + 0.05)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_drifting_streak_is_found(seed):
    """Everything streaks alike, by 8 px, and the objects leave the stars by 0.6 px a frame."""
    rng = np.random.default_rng(seed)
    history, objects = history_of(rng, FIELDS[1], (0.36, 0.48), 40, exposure=1.0)
    assert_found(history, objects)


def test_the_longer_the_drift_the_surer():
    """Drift over the error of a line through eight centroids, squared and halved, at SNR 20."""
    logs = []
    for speed in (0.3, 0.5, 0.9):
        history, objects = history_of(np.random.default_rng(4), FIELDS[0], (speed, 0.0), 20)
        logs.append(np.mean([d.log_false for d in assert_found(history, objects)]))
    # sum of squared times 42 s^2; the centroid's std, 1.8 px / 20 by `objects`
    expected = [-(speed**2) * 42 / 2 / (1.8 / 20) ** 2 for speed in (0.3, 0.5, 0.9)]
    # stated stds are 20 % off at most, their squares 45 %
    np.testing.assert_allclose(logs, expected, rtol=0.45)


@pytest.mark.parametrize("dt_s", [0.02, 30.0])
def test_any_frame_rate_gives_the_same(dt_s):
    drifts = [
        find_drifting(history_of(np.random.default_rng(5), FIELDS[1], (0.6, 0.0), dt_s=dt)[0],
                      LOG_LIMIT)
        for dt in (1.0, dt_s)
    ]  # fmt: skip
    assert len(drifts[0]) == len(drifts[1]) == 2
    for one, other in zip(*drifts, strict=True):
        assert one.rows == other.rows
        assert one.log_false == pytest.approx(other.log_false, rel=1e-6)


def test_one_frame_may_be_missing():
    seen = [0, 1, 2, 3, 5, 6, 7]
    history, objects = history_of(np.random.default_rng(6), FIELDS[1], (0.6, 0.0), seen=seen)
    assert_found(history, objects, seen)


def test_an_object_that_came_lately_has_the_rows_since():
    seen = range(3, FRAMES)
    history, objects = history_of(np.random.default_rng(7), FIELDS[0], (0.6, 0.0), 40, seen=seen)
    assert_found(history, objects, seen)


def test_the_limit_of_false_ones_decides():
    history, _ = history_of(np.random.default_rng(8), FIELDS[0], (0.3, 0.0), 20)
    logs = sorted(drift.log_false for drift in find_drifting(history, LOG_LIMIT))
    assert len(logs) == 2
    assert len(find_drifting(history, (logs[0] + logs[1]) / 2)) == 1
    assert find_drifting(history, logs[0] - 1) == []


def test_objects_that_tracks_have_are_not_looked_at():
    history, objects = history_of(np.random.default_rng(15), FIELDS[1], (0.6, 0.0), 20)
    both = assert_found(history, objects)
    rows = [drift.rows[FRAMES - 1] for drift in both]
    assert find_drifting(history, LOG_LIMIT, rows) == []
    # nor does it change what is said of the other
    assert find_drifting(history, LOG_LIMIT, rows[:1]) == both[1:]
    assert find_drifting(history, LOG_LIMIT, np.array(rows[1:])) == both[:1]


@pytest.mark.parametrize("speed", [0.2, 0.6])
def test_stars_that_stand_still_are_not_followed(monkeypatch, speed):
    history, objects = history_of(np.random.default_rng(16), FIELDS[0], (speed, 0.0), 40)
    followed, follow = [], drift_module.follow

    def recorded(frame, earlier, rows):
        followed.extend(rows)
        return follow(frame, earlier, rows)

    monkeypatch.setattr(drift_module, "follow", recorded)
    found = {drift.rows[FRAMES - 1] for drift in assert_found(history, objects)}
    assert found <= set(followed)
    # beside the two: what is at the border, or was not seen in the two oldest frames
    assert len(followed) <= 2 + 4 < len(history[-1].objects)


# Stars


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("star_snr", [6, 15, 40, 300])
def test_stars_do_not_drift(field, star_snr):
    history, _ = history_of(np.random.default_rng(star_snr), field, star_snr=star_snr)
    assert find_drifting(history, LOG_LIMIT) == []


@pytest.mark.parametrize(("exposure", "star_snr"), [(1.0, 12), (2.0, 7), (1.0, 100)])
def test_pieces_of_broken_star_streaks_do_not_drift(exposure, star_snr):
    """The pieces come and go along the streak, frame by frame; the streak does not."""
    history, _ = history_of(
        np.random.default_rng(9), FIELDS[1], star_snr=star_snr, exposure=exposure
    )
    assert find_drifting(history, LOG_LIMIT) == []


def test_what_only_trembles_does_not_drift():
    def tremble(number):
        return np.array([0.5, 0.0]) if number % 2 else np.array([-0.5, 0.0])

    history, _ = history_of(np.random.default_rng(10), FIELDS[0], (0.0, 0.0), 30, wobble=tremble)
    assert find_drifting(history, LOG_LIMIT) == []


def test_less_than_a_pixels_drift_is_not_told_from_errors_of_registration():
    """0.08 px per frame, 0.56 px in all, at an SNR that would make it significant."""
    history, _ = history_of(np.random.default_rng(11), FIELDS[0], (0.08, 0.0), 100)
    assert find_drifting(history, LOG_LIMIT) == []


def test_a_change_of_scale_that_the_field_missed_is_no_drift():
    """Registration off by 0.02 px per frame everywhere: what all do, none does alone."""
    history, _ = history_of(np.random.default_rng(12), FIELDS[1], star_snr=100)
    wrong = History(FRAMES + 1)
    for frame in history:
        to_sky = frame.to_sky.copy()
        to_sky[0, 2] += 0.02 * frame.number
        values = {name: getattr(frame, name) for name in PastFrame.__dataclass_fields__}
        del values["from_sky"]
        wrong.add(PastFrame(**{**values, "to_sky": to_sky}))
    assert find_drifting(wrong, LOG_LIMIT) == []


# Too little to say


def test_two_frames_show_no_drift():
    full, _ = history_of(np.random.default_rng(13), FIELDS[0], (1.2, 0.0), 40)
    history = History(FRAMES)
    found = []
    for frame in full:
        history.add(frame)
        found.append(len(find_drifting(history, LOG_LIMIT)))
    assert found[:2] == [0, 0]
    # three frames of 1.2 px are 2.4 px in all
    assert found[2:] == [2] * (FRAMES - 2)


def test_frames_without_objects_show_no_drift():
    rng = np.random.default_rng(14)
    history = History(FRAMES)
    for number in range(4):
        history.add(past(np.full(SHAPE, 1000, np.uint16), number))
        assert find_drifting(history, LOG_LIMIT) == []
    light = blobs(SHAPE, PLACES, flux(40, (0, 0)), 1.0)
    history.add(past(camera(light, rng), 4))
    assert find_drifting(history, LOG_LIMIT) == []


def smeared(history: History) -> History:
    """The same, but for the stars of the last frame but two, which scatter six times as much."""
    copy = History(FRAMES + 1)
    for frame in history:
        copy.add(replace(frame, scatter=6.0 if frame.number == FRAMES - 3 else 1.0))
    return copy


def test_centroids_that_scatter_as_the_stars_of_their_frame_show_no_drift():
    """A slew within the exposure smears bright and faint stars unevenly; one frame is enough."""
    history, objects = history_of(np.random.default_rng(31), FIELDS[1], (0.25, 0.1))
    assert_found(history, objects)
    assert find_drifting(smeared(history), LOG_LIMIT) == []
    # It does not count against what was not seen in that frame.
    others = [number for number in range(FRAMES) if number != FRAMES - 3]
    history, objects = history_of(np.random.default_rng(31), FIELDS[1], (0.25, 0.1), seen=others)
    assert_found(smeared(history), objects, others)
