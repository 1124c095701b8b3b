"""Linking: paths among spots, and how many of them chance gives."""

import math

import numpy as np
import pytest
from sky import Path, frame_of, noise_spots, spots_at

from ofsat_ros.tracking import Link, Sighting, find_links

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
