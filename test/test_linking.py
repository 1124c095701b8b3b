# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Linking: paths among spots, and how many of them chance gives."""

import dataclasses
import math

import numpy as np
import pytest
from sky import Path, frame_of, noise_spots, spots_at

from ofsat_ros.tracking import Link, Sighting, find_links, linking
from ofsat_ros.tracking.sightings import Vicinity

SIDE = 256
LIMIT = math.log(1e-3)
FASTEST_PX = 150.0


def sightings(tables: list[np.ndarray], to_sky: list[np.ndarray] | None = None) -> list[Sighting]:
    """Return the sightings of frames of 1 s, each with its spots."""
    seen: list[Sighting] = []
    for number, spots in enumerate(tables):
        frame = frame_of(number, SIDE, None if to_sky is None else to_sky[number])
        seen.append(Sighting.of(frame, spots, seen[-1] if seen else None))
    return seen


def links(tables: list[np.ndarray], log_limit: float = LIMIT) -> list[Link]:
    return find_links(sightings(tables), log_limit, FASTEST_PX)


def mover(path: Path, frames: int, excess: float = 6.0) -> list[np.ndarray]:
    return [spots_at(path(k), excess) for k in range(frames)]


def line(start: tuple[float, float], step: tuple[float, float]) -> Path:
    return lambda k: np.array(start) + k * np.array(step)


# What is found


@pytest.mark.parametrize("step", [(4.0, 2.0), (-1.0, 0.5), (12.0, -9.0)])
def test_a_path_among_noise_is_found(step: tuple[float, float]):
    """Spots of 5 sigma in six frames, among the 70 of noise that each frame has."""
    rng = np.random.default_rng(1)
    path = line((125.0, 120.0), step)
    noisy = [noise_spots(rng, SIDE) for _ in range(6)]
    tables = [np.concatenate([noise, spots_at(path(k), 5)]) for k, noise in enumerate(noisy)]
    (found,) = links(tables)
    # The mover's spot is the last of each frame's.
    assert found.rows == {k: len(noise) for k, noise in enumerate(noisy)}
    assert found.log_false < LIMIT


def test_a_spot_may_be_missing():
    tables = mover(line((60, 60), (5, 3)), 7)
    for gone in (1, 4):
        tables[gone] = tables[gone][:0]
    (found,) = links(tables)
    assert found.rows == dict.fromkeys((0, 2, 3, 5, 6), 0)


def test_two_frames_are_no_path():
    assert links(mover(line((60, 60), (5, 3)), 2, excess=50)) == []


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_frames_without_spots_have_no_path(frames: int):
    assert links([spots_at([], 5)] * frames) == []


def test_several_paths_share_no_spot():
    paths = [line((40, 40 + 40 * i), (5, 1 - i)) for i in range(4)]
    tables = [spots_at([path(k) for path in paths], 8) for k in range(6)]
    found = links(tables)
    assert len(found) == 4
    # Each path is of the same row throughout.
    assert sorted(next(iter(set(link.rows.values()))) for link in found) == [0, 1, 2, 3]
    assert all(len(set(link.rows.values())) == 1 for link in found)
    assert [link.log_false for link in found] == sorted(link.log_false for link in found)


def test_where_the_mount_moves_the_path_is_on_the_sky():
    """What stands still in the image of a camera that drifts moves against the stars."""
    to_sky = [np.eye(3) for _ in range(6)]
    for k, matrix in enumerate(to_sky):
        matrix[:2, 2] = 4 * k, -3 * k
    tables = mover(line((100, 100), (0, 0)), 6)
    (found,) = find_links(sightings(tables, to_sky), LIMIT, FASTEST_PX)
    assert found.rows == dict.fromkeys(range(6), 0)
    # And the other way round: it moves in the image as the stars do.
    tables = mover(line((100, 100), (-4, 3)), 6)
    assert find_links(sightings(tables, to_sky), LIMIT, FASTEST_PX) == []


def test_the_longer_and_brighter_the_surer():
    path = line((60, 60), (5, 3))
    by_frames = [links(mover(path, n), 0.0)[0].log_false for n in (3, 4, 6, 8)]
    assert by_frames == sorted(by_frames, reverse=True)
    by_excess = [links(mover(path, 5, excess), 0.0)[0].log_false for excess in (4, 5, 6, 8)]
    assert by_excess == sorted(by_excess, reverse=True)


def all_pairs(
    newest: Sighting, earlier: list[Sighting], max_speed_px: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return every pair that may start a path, whatever other frames show."""
    pairs = []
    for age, other in enumerate(earlier[:2], 1):
        near = np.abs(newest.places[:, None] - other.places) <= age * max_speed_px
        ratio = newest.excess[:, None] / other.excess
        near &= (ratio < 5) & (ratio > 1 / 5)
        near &= (newest.free & newest.telling)[:, None] & other.free & other.telling
        pairs.append(np.nonzero(near))
    return pairs


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("frames", [3, 4, 7])
def test_no_path_is_lost_for_speed(seed: int, frames: int, monkeypatch: pytest.MonkeyPatch):
    """Of streaks and points, some taken, under a sky that turns, in frames at uneven times."""
    rng = np.random.default_rng(seed)
    seen: list[Sighting] = []
    stamps = np.cumsum(rng.choice([1.0, 1.0, 1.7, 4.0], frames))
    starts, steps = rng.uniform(30, 220, (3, 2)), rng.uniform(-9, 9, (3, 2))
    for number, time_s in enumerate(stamps):
        turn = 0.01 * number
        to_sky = np.array([[np.cos(turn), -np.sin(turn), 3 * number], [0, 0, 0], [0, 0, 1]])
        to_sky[1] = -to_sky[0, 1], to_sky[0, 0], -number
        frame = dataclasses.replace(frame_of(number, SIDE, to_sky), stamp_ns=int(time_s * 1e9))
        moving = spots_at(frame.pixels(starts + time_s * steps) + rng.normal(0, 0.3, (3, 2)), 5)
        spots = np.concatenate([noise_spots(rng, SIDE), moving])
        streaks = rng.uniform(size=len(spots)) < 0.3
        spots["length"] = np.where(streaks, rng.exponential(8, len(spots)), 0)
        seen.append(Sighting.of(frame, spots, seen[-1] if seen else None))
        seen[-1].free[rng.uniform(size=len(spots)) < 0.1] = False
        seen[-1].telling[rng.uniform(size=len(spots)) < 0.1] = False
    quick = find_links(seen, 5.0, 60.0)
    monkeypatch.setattr(linking, "_pairs", all_pairs)
    assert quick == find_links(seen, 5.0, 60.0)
    assert quick or frames == 3


def test_paths_are_found_among_thousands_of_spots():
    """A frame of 2750 px on a side: 8,000 spots of noise, and twelve RSOs of all speeds."""
    rng, side = np.random.default_rng(11), 2750
    starts, steps = rng.uniform(1100, 1700, (12, 2)), rng.uniform(-90, 90, (12, 2))
    seen: list[Sighting] = []
    for number in range(7):
        noise = noise_spots(rng, side)
        moving = spots_at(starts + number * steps + rng.normal(0, 0.1, (12, 2)), 7)
        spots = np.concatenate([moving, noise])
        seen.append(Sighting.of(frame_of(number, side), spots, seen[-1] if seen else None))
    assert len(noise) > 7500
    found = find_links(seen, LIMIT, FASTEST_PX)
    assert [len(set(link.rows.values())) for link in found] == [1] * 12
    assert {link.rows[6] for link in found} == set(range(12))
    assert all(len(link.rows) == 7 for link in found)


@pytest.mark.parametrize("corner", [0, -30_000 + 20_000j])
@pytest.mark.parametrize("asked_count", [300, 20])
def test_all_spots_that_are_near_are_found(asked_count: int, corner: complex):
    """Of many places by an index, of few by looking at all."""
    rng = np.random.default_rng(12)
    places = corner + rng.uniform(-300, 900, 400) + 1j * rng.uniform(50, 500, 400)
    count = asked_count
    asked = corner + rng.uniform(-500, 1100, count) + 1j * rng.uniform(-150, 700, count)
    reach = rng.choice([0.3, 5.0, 8.0, 60.0, 2000.0], count)
    spots = spots_at(np.stack([places.real, places.imag], axis=1), 5)
    sighting = Sighting.of(frame_of(0), spots)
    found = np.zeros((count, 400), int)
    distance = np.abs(asked[:, None] - places)
    for i, row, far in sighting.near(asked, reach):
        np.add.at(found, (i, row), 1)
        np.testing.assert_allclose(far, distance[i, row])
    assert (found[distance <= reach[:, None]] == 1).all()
    assert found.max() == 1
    # And few others: what shares a cell of 50 px with a circle of 60 px is within 131 px.
    assert (distance[(reach == 60)[:, None] & (found > 0)] < 131).all()
    amid = distance.min(axis=1) < 30
    assert (distance[(amid & (reach <= 8))[:, None] & (found > 0)] < 64).all()
    empty = Sighting.of(frame_of(0), spots[:0])
    assert sum(len(i) for i, *_ in empty.near(asked, reach)) == 0


def test_the_map_knows_what_is_near():
    rng = np.random.default_rng(13)
    places = rng.uniform(-300, 900, 300) + 1j * rng.uniform(50, 500, 300)
    asked = (
        places[rng.integers(0, 300, 5000)] + rng.normal(0, 5, 5000) + 1j * rng.normal(0, 5, 5000)
    )
    distance = np.abs(asked[:, None] - places).min(axis=1)
    vicinity = Vicinity(places, np.zeros(300, bool))
    for reach in (1.0, 3.0, 7.0, 30.0):
        near = np.zeros(5000, bool)
        near[vicinity.within(asked, np.full(5000, reach))] = True
        assert near[distance <= reach].all()
        # Cells are 2 px wide: nothing farther than a cell and a half along both axes.
        assert reach > 7 or (distance[near] < np.sqrt(2) * (reach + 4)).all()
    # As a sum of two ways.
    part = rng.uniform(-500, 500, 5000) + 1j * rng.uniform(-500, 500, 5000)
    near = np.zeros(5000, bool)
    near[vicinity.near(vicinity.cells(part) + vicinity.steps(asked - part))] = True
    assert near[distance <= Vicinity.reach_px].all()
    assert not near[distance > 13].any()
    # Wherever it is, it may be near.
    anywhere = np.array([Vicinity.anywhere, 2 * Vicinity.anywhere])
    assert vicinity.near(anywhere + vicinity.cells(asked[:2])).tolist() == [0, 1]


# What is not


def test_faster_than_the_limit_is_no_path():
    tables = mover(line((20, 60), (40, 0)), 5, excess=20)
    seen = sightings(tables)
    assert len(find_links(seen, LIMIT, 41.0)) == 1
    assert find_links(seen, LIMIT, 39.0) == []


def test_a_bend_is_no_path():
    places = [(60, 60), (66, 60), (66, 66), (60, 66), (60, 60), (66, 60)]
    assert links([spots_at(place, 6) for place in places]) == []


def test_what_differs_in_brightness_is_no_path():
    path = line((60, 60), (5, 3))
    tables = [spots_at(path(k), 60 if k % 2 else 6) for k in range(6)]
    for found in links(tables):
        assert len({number % 2 for number in found.rows}) == 1


def test_what_a_track_has_taken_is_no_path():
    seen = sightings(mover(line((60, 60), (5, 3)), 6))
    assert len(find_links(seen, LIMIT, FASTEST_PX)) == 1
    seen[-1].free[:] = False
    assert find_links(seen, LIMIT, FASTEST_PX) == []


def test_repeated_spots_tell_nothing():
    rng = np.random.default_rng(3)
    spots = noise_spots(rng, SIDE)
    shaken = spots.copy()
    shaken["x"] += rng.uniform(-0.2, 0.2, len(spots))
    new = spots_at((100.5, 100.5), 6)
    first, second = sightings([spots, np.concatenate([shaken, new])])
    assert first.telling.all()
    assert second.telling.tolist() == [False] * len(spots) + [True]


def test_repeated_and_unclean_spots_make_no_path():
    """A star that stays, wings of stars, and a video that shows each frame twice."""
    path = line((60, 60), (5, 3))
    assert links(mover(line((60, 60), (0.1, 0.0)), 9, excess=30)) == []
    unclean = mover(path, 9)
    for spots in unclean:
        spots["clean"] = False
    assert links(unclean) == []
    twice = [spots_at(path(2 * (k // 2)), 6) for k in range(4)]
    assert links(twice) == []


# What chance gives


def test_what_chance_expects_is_what_noise_shows():
    """`expected`: peaks of noise by Adler, of which `noise_spots` draws, and the stronger ones."""
    rng = np.random.default_rng(4)
    spots = noise_spots(rng, SIDE)
    (seen,) = sightings([spots])
    weakest = np.argmin(spots["excess"])
    # u exp(-u^2 / 2) (2 pi)^-3/2 / 2 of 256^2 px at u = 3: 69.3, and as many again.
    assert len(spots) == pytest.approx(69.3, abs=4 * math.sqrt(69.3))
    assert seen.expected[weakest] == pytest.approx(69.3 + len(spots), rel=0.1)
    order = np.argsort(spots["excess"])
    assert (np.diff(seen.expected[order]) < 0).all()
    # Where they happen to keep together there are more per px^2, nowhere fewer.
    assert (np.exp(seen.log_density) * SIDE**2 >= 0.999 * seen.expected).all()


def test_where_spots_keep_together_a_path_is_less_sure():
    """Forty spots of the same strength in a corner 80 px wide: a cloud, an artefact."""
    rng = np.random.default_rng(4)
    path = line((30, 30), (5, 3))
    sure = []
    for corner in ((150, 150), (0, 0)):
        crowds = [spots_at(rng.uniform(0, 80, (40, 2)) + corner, 7) for _ in range(6)]
        tables = [np.concatenate([spots_at(path(k), 6), c]) for k, c in enumerate(crowds)]
        found = [link for link in links(tables, 0.0) if set(link.rows.values()) == {0}]
        sure.append(found[0].log_false if found else 0.0)
    assert sure[0] < sure[1] - 2
