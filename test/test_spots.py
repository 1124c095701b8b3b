# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Spots: sources that other frames do not have are found, and what they have is not."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from blobs import blobs, camera, flux, flux_of_snr, scattered
from scipy.ndimage import gaussian_filter, maximum_filter
from sky import past

from ofsat_ros.detection import BORDER_PX, SPOT_DTYPE, find_spots, refine, spot_near
from ofsat_ros.history import PastFrame

SHAPE = (160, 160)
NOISE = 10.0
# White noise smoothed by a Gaussian of sigma 1 px keeps this part, measured on the grid.
SMOOTHED = 0.2821
# 160 x 160 px of noise alone hold 0.002 spots of 5.5 sigmas (Adler's formula, below).
SURE = 5.5


def sequence(rng, count, signal, shift=(0.0, 0.0)):
    """Frames of `signal(k)`; the sky moves by `shift` px per frame, which is known exactly."""
    frames = []
    for number in range(count):
        to_sky = np.eye(3)
        to_sky[:2, 2] = -np.multiply(shift, number)
        frames.append(past(camera(signal(number), rng), number, to_sky))
    return frames


def star_sky(rng, snr, shift=(0.0, 0.0), streak=(0.0, 0.0), count=6, spacing=34):
    """A function of the frame's number: stars enough that the moving field stays filled."""
    reach = np.ceil(np.abs(shift)).astype(int)[::-1] * count + 30
    places = scattered(rng, tuple(SHAPE + 2 * reach), spacing, margin=0) - reach[::-1]

    def signal(number):
        now = places + np.multiply(shift, number)
        near = np.all((now > -25) & (now < np.array(SHAPE[::-1]) + 25), axis=1)
        return blobs(SHAPE, now[near], flux(snr, streak), 1.0, streak)

    return signal


def others(frames, frame):
    return [other for other in frames if other is not frame]


def nearest(spots, xy):
    distance = np.hypot(spots["x"] - xy[0], spots["y"] - xy[1])
    return spots[np.argmin(distance)], float(distance.min())


def nothing(_number):
    return np.zeros(SHAPE)


def frame_of(signal, rng, number):
    return past(camera(signal, rng), number)


# Points that the other frames do not have


@pytest.mark.parametrize("snr", [13, 20, 60])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (7.3, -4.6)])
def test_a_point_that_the_others_do_not_have_is_found(snr, shift):
    rng = np.random.default_rng(snr)
    sky = star_sky(rng, 20, shift)
    places = scattered(rng, SHAPE, 30)
    stars = sky(5)
    # where no star is near: what happens beside one is another test's
    dark = [
        stars[round(y) - 6 : round(y) + 7, round(x) - 6 : round(x) + 7].max() for x, y in places
    ]
    places = places[np.array(dark) < 1]
    assert len(places) >= 10
    new = blobs(SHAPE, places, flux(snr), 1.0)
    frames = sequence(rng, 6, lambda k: sky(k) + (new if k == 5 else 0), shift)
    spots = find_spots(frames[5], frames[:5], SURE)
    assert spots.dtype == SPOT_DTYPE
    assert len(spots) == len(places)
    assert (np.diff(spots["excess"]) <= 0).all()
    for place in places:
        spot, distance = nearest(spots, place)
        # 2 px / SNR on each axis (see test_objects), five times that at the worst
        assert distance < 10 / snr + 0.05
        assert spot["clean"]
        # the object is the spot, and has measured it
        measured = frames[5].objects[spot["object_index"]]
        for name in ("x", "y", "snr", "flux", "length", "sigma_x"):
            assert spot[name] == measured[name]
    # The highest smoothed pixel over its noise is the SNR less 8 % for the size and the phase of
    # the pixels; less what the median of five noises holds above 0, 0.22; scatter 1.
    stated = SMOOTHED * NOISE / frames[5].noise
    assert np.mean(spots["excess"]) == pytest.approx(
        0.92 * snr * stated - 0.2, abs=0.6 + 0.03 * snr
    )
    assert np.std(spots["excess"]) < 1.6 + 0.05 * snr


def test_it_is_found_in_an_earlier_frame_too():
    rng = np.random.default_rng(2)
    new = blobs(SHAPE, (70.3, 90.6), flux(15), 1.0)
    frames = sequence(rng, 5, lambda k: new if k == 1 else nothing(k))
    (spot,) = find_spots(frames[1], others(frames, frames[1]), SURE)
    assert (spot["x"], spot["y"]) == pytest.approx((70.3, 90.6), abs=0.5)
    for frame in (frames[0], *frames[2:]):
        assert len(find_spots(frame, others(frames, frame), SURE)) == 0


def test_a_point_below_the_objects_threshold_has_a_spots_measurements():
    """An object's peak is over 4 sigmas; a spot's may be lower, then it has no object."""
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        places = scattered(rng, SHAPE, 26)
        blank = sequence(rng, 5, nothing)
        frame = frame_of(blobs(SHAPE, places, flux(4.2), 1.0), rng, 5)
        spots = find_spots(frame, blank, 3.3)
        alone = spots[spots["object_index"] == -1]
        assert len(alone) > 3
        assert (alone["excess"] < 5).all()
        assert np.array_equal(alone["snr"], alone["excess"])
        found += [(s, np.min(np.hypot(*(places - [s["x"], s["y"]]).T)) < 1.5) for s in alone]
    # The rest is noise: of 26,000 px, some four peaks over 3.3 sigmas a frame.
    true = [s for s, is_true in found if is_true]
    assert len(true) >= 0.5 * len(found)
    # The peak times the smoothed PSF's area, at the SNR that the noise has lifted over 3.3.
    fluxes = np.array([s["flux"] for s in true]) / flux(4.2)
    assert 0.75 < np.median(fluxes) < 1.15


def test_a_streak_is_one_spot_as_long_as_it_is():
    rng = np.random.default_rng(4)
    streak = (14.0, 8.0)
    new = blobs(SHAPE, (80.4, 70.7), flux(25, streak), 1.0, streak)
    frames = sequence(rng, 5, lambda k: new if k == 4 else nothing(k))
    (spot,) = find_spots(frames[4], frames[:4], SURE)
    # some of the ends is lost below the threshold
    assert (spot["x"], spot["y"]) == pytest.approx((80.4, 70.7), abs=0.8)
    assert spot["length"] == pytest.approx(math.hypot(*streak), rel=0.2)
    assert spot["angle"] == pytest.approx(math.atan2(streak[1], streak[0]), abs=0.08)


# Stars


@pytest.mark.parametrize(
    ("shift", "exposure"),
    [((0.0, 0.0), 0), ((0.37, 0.21), 0), ((7.3, -4.6), 0), ((7.3, -4.6), 1), ((8.2, 4.1), 1.5)],
)
def test_a_star_is_no_spot(shift, exposure):
    """Also one below the threshold, and one that leaves a broken streak."""
    rng = np.random.default_rng(1)
    streak = tuple(np.multiply(shift, exposure))
    sky = star_sky(rng, 1, shift, streak, count=5)
    light = [sky(number) for number in range(5)]
    for snr in (3, 8, 40, 400):
        frames = sequence(rng, 5, lambda k, snr=snr: snr * light[k], shift)
        for frame in frames:
            assert len(find_spots(frame, others(frames, frame), SURE)) == 0, snr
        if snr == 3:
            # most of them are no objects
            assert len(frames[2].objects) < 10


def test_what_no_other_frame_can_have_seen_is_no_spot():
    """Stars that the moving field has just brought in."""
    rng = np.random.default_rng(5)
    shift = (12.0, 0.0)
    arrived = blobs(SHAPE, [(6.0, 30.0), (7.5, 90.0)], flux(40), 1.0)
    frames = sequence(rng, 4, lambda k: arrived if k == 3 else nothing(k), shift)
    assert np.count_nonzero(frames[3].objects["snr"] > 20) == 2
    assert len(find_spots(frames[3], frames[:3], SURE)) == 0


@pytest.mark.parametrize("snr", [15, 40, 100])
def test_a_star_that_brightens_is_not_clean(snr):
    rng = np.random.default_rng(snr)
    places = scattered(rng, SHAPE, 34)
    for factor in (1.2, 1.8):
        changed = np.full(len(places), flux(snr))
        changed[7] *= factor

        def signal(k, changed=changed):
            return blobs(SHAPE, places, changed if k == 5 else flux(snr), 1.0)

        frames = sequence(rng, 6, signal)
        spots = find_spots(frames[5], frames[:5], SURE)
        # By a fifth, the change is within what seeing does; by 0.8 it stands out of the noise.
        assert len(spots) == (factor == 1.8)
        for spot in spots:
            assert (spot["x"], spot["y"]) == pytest.approx(places[7], abs=1)
            assert not spot["clean"]


def test_a_slow_object_hides_behind_itself():
    """Why `find_drifting` is needed."""
    rng = np.random.default_rng(6)
    places = scattered(rng, SHAPE, 34)
    slow, stars = places[5:6], np.delete(places, 5, axis=0)
    for speed, found in ((0.08, 0), (1.5, 1)):

        def signal(k, speed=speed):
            return blobs(SHAPE, np.concatenate([stars, slow + (speed * k, 0)]), flux(25), 1.0)

        frames = sequence(rng, 9, signal)
        spots = find_spots(frames[8], frames[:8], SURE)
        assert len(spots) == found, speed


def test_a_spot_in_the_light_of_a_bright_star_is_not_clean():
    """Within 2 px of it the star's light is over three times its own."""
    rng = np.random.default_rng(7)
    stars = scattered(rng, SHAPE, 50)
    light = blobs(SHAPE, stars, flux(200), 1.0)
    for distance, clean in ((3.5, False), (9.0, True)):
        new = blobs(SHAPE, stars + (distance, 0), flux(10), 1.0)
        frames = sequence(rng, 6, lambda k, new=new: light + (new if k == 5 else 0))
        spots = find_spots(frames[5], frames[:5], 3.0)
        near = [nearest(spots, star + (distance, 0)) for star in stars]
        found = [spot for spot, off in near if off < 1.8]
        # beside the star its light is known to a twentieth only: three more sigmas of noise
        assert len(found) >= (len(stars) - 1 if clean else len(stars) // 3)
        # where noise moves the peak outwards, the star's light is at the limit
        part = np.mean([spot["clean"] for spot in found])
        assert (part == 1) if clean else (part < 0.35)


def test_an_object_that_is_mostly_a_star_does_not_measure_the_spot():
    rng = np.random.default_rng(8)
    streak = (30.0, 0.0)
    star = blobs(SHAPE, (80, 80), flux(100, streak), 1.0, streak)
    # too little of a peak on the streak to be an object of its own
    new = blobs(SHAPE, (88, 80), flux(17), 1.0)
    frames = sequence(rng, 5, lambda k: star + (new if k == 4 else 0))
    assert np.count_nonzero(frames[4].objects["snr"] > 10) == 1
    (spot,) = find_spots(frames[4], frames[:4], SURE)
    assert (spot["x"], spot["y"]) == pytest.approx((88, 80), abs=0.7)
    assert spot["object_index"] == -1


def test_spots_at_the_border_are_left_out():
    rng = np.random.default_rng(9)
    places = [(2.0, 40.0), (80.0, 157.6), (5.0, 120.0), (80.0, 153.0)]
    new = blobs(SHAPE, places, flux(30), 1.0)
    frames = sequence(rng, 4, lambda k: new if k == 3 else nothing(k))
    spots = find_spots(frames[3], frames[:3], SURE)
    got = sorted((round(s["x"]), round(s["y"])) for s in spots)
    assert got == [(5, 120), (80, 153)]
    assert BORDER_PX < 5


def test_nothing_in_nothing_out():
    rng = np.random.default_rng(10)
    frames = sequence(rng, 2, lambda _: blobs(SHAPE, (80, 80), flux(30), 1.0))
    blank = past(np.full(SHAPE, 1000, np.uint16))
    for frame, rest in ((frames[0], []), (blank, frames)):
        spots = find_spots(frame, rest, 3.0)
        assert (spots.dtype, spots.shape) == (SPOT_DTYPE, (0,))
        assert len(spot_near(frame, rest, np.array([80.0, 80.0]), 2, 2.0)) == 0


# Noise


def adler(sigmas, area):
    """Peaks over a level of white noise smoothed by a Gaussian of sigma 1 px (Adler 1981)."""
    return (2 * math.pi) ** -1.5 / 2 * sigmas * math.exp(-(sigmas**2) / 2) * area


@pytest.mark.parametrize("sigmas", [3.0, 3.5])
def test_noise_alone_gives_the_spots_that_chance_does(sigmas):
    rng = np.random.default_rng(11)
    shape, trials = (400, 400), 5
    area = trials * (shape[0] - 2 * BORDER_PX) * (shape[1] - 2 * BORDER_PX)
    expected = adler(sigmas, area)
    # The formula is of a continuous field, whose peaks lie between pixels: what is left of them
    # on the grid, counted without the package.
    fields = [gaussian_filter(rng.normal(0, 1 / SMOOTHED, shape), 1.0) for _ in range(trials)]
    maxima = sum(np.sum((f == maximum_filter(f, 3)) & (f > sigmas)) for f in fields)
    grid = maxima / (trials * shape[0] * shape[1] / area) / expected
    assert 0.55 < grid < 0.8
    blank = [past(np.full(shape, 1000, np.uint16))] * 4
    quiet = noisy = 0
    for trial in range(trials):
        frames = [past(camera(np.zeros(shape), rng), 4 * trial + k) for k in range(5)]
        quiet += len(find_spots(frames[4], blank, sigmas))
        noisy += len(find_spots(frames[4], frames[:4], sigmas))
    # Both counts are Poisson's; peaks within one group of pixels over 2.5 sigmas, and the noise
    # measured to 1 %, make some per cent.
    assert quiet == pytest.approx(
        grid * expected, abs=3.5 * math.sqrt(2 * grid * expected) + 0.05 * grid * expected
    )
    # Where the median of the others is above 0 it is taken for a star: less is left, and never
    # more than the formula says, by which paths are judged.
    assert 0.3 * expected < noisy < 0.6 * expected


# Where one is expected


def test_a_faint_spot_is_found_where_it_is_expected():
    """2.5 sigmas: not worth a look among 25,600 pixels, but it is at one place."""
    rng = np.random.default_rng(12)
    blank = sequence(rng, 6, nothing)
    found, chance, off = [], [], []
    for number in range(4):
        places = scattered(rng, SHAPE, 26)
        frame = frame_of(blobs(SHAPE, places, flux(2.5), 1.0), rng, 6 + number)
        empty = frame_of(nothing(0), rng, 6 + number)
        for place in places:
            guess = place + rng.uniform(-0.7, 0.7, 2)
            spot = spot_near(frame, blank, guess, 2, 2.0)
            found.append(len(spot))
            chance.append(len(spot_near(empty, blank, guess, 2, 2.0)))
            for row in spot:
                off.append(math.hypot(row["x"] - place[0], row["y"] - place[1]))
                assert row["excess"] >= 2.0
                assert math.hypot(row["x"] - guess[0], row["y"] - guess[1]) < 2.5 + 1
    assert len(found) > 90
    # P(2.5 + max of a few > 2.2): three in four; of noise alone in 21 px of some 4 independent
    # values, 1 - 0.977^4 to 1 - 0.977^8
    assert np.mean(found) > 0.62
    assert np.mean(chance) < 0.22
    # 1.4 px / SNR 2.9 on each axis, for those that are found
    assert np.median(off) < 1.0


def test_not_elsewhere():
    rng = np.random.default_rng(13)
    blank = sequence(rng, 5, nothing)
    place = np.array([80.3, 60.8])
    frame = frame_of(blobs(SHAPE, place, flux(12), 1.0), rng, 5)
    (spot,) = spot_near(frame, blank, place + (1.5, -1), 2, 6.0)
    assert (spot["x"], spot["y"]) == pytest.approx(place, abs=0.6)
    # Nearer than 2.5 px to the peak it is; a wing at 6 px is none.
    for away in ((6, 0), (0, -6), (5, 5), (-40, 20)):
        assert len(spot_near(frame, blank, place + away, 2, 4.0)) == 0
    # It is asked for more than there is.
    assert len(spot_near(frame, blank, place, 2, 20.0)) == 0


@pytest.mark.parametrize("xy", [(-3.0, 50.0), (500.0, 500.0), (0.0, 0.0), (159.0, 80.0)])
def test_a_place_at_the_border_or_outside_has_no_spot(xy):
    frames = sequence(np.random.default_rng(14), 3, nothing)
    assert len(spot_near(frames[2], frames[:2], np.array(xy), 2, 2.0)) == 0


def test_a_star_is_not_taken_for_what_is_expected():
    rng = np.random.default_rng(15)
    shift = (6.2, 3.1)
    sky = star_sky(rng, 30, shift)
    frames = sequence(rng, 6, sky, shift)
    stars = frames[5].objects[frames[5].objects["snr"] > 15]
    inside = (np.abs(stars["x"] - 80) < 45) & (np.abs(stars["y"] - 80) < 60)
    assert np.count_nonzero(inside) > 4
    for star in stars[inside]:
        spot = spot_near(frames[5], frames[:5], np.array([star["x"], star["y"]]), 2, 2.0)
        # noise beside it may reach 2 sigmas, the star its 30 does not
        assert all(spot["excess"] < 3.5)


# Measured again


def cramer_rao(snr, psf=1.0):
    """Least std of a centroid along one axis, px: n / sqrt(sum (dI/dx)^2), flux known or not.

    For a Gaussian in white noise it is sqrt(2) sigma / SNR; pixels add 1/12 to the variance.
    """
    return math.sqrt(2 * (psf**2 + 1 / 12)) / snr


def test_the_bound_by_the_sum_over_pixels():
    step = 1e-3
    slope = (blobs((41, 41), (20.3 + step, 20.1), flux(30), 1.0)) - blobs(
        (41, 41), (20.3 - step, 20.1), flux(30), 1.0
    )
    by_pixels = NOISE / math.sqrt(np.sum((slope / (2 * step)) ** 2))
    # 4 %: `flux` states the SNR of the Gaussian before pixels widen it
    assert cramer_rao(30) == pytest.approx(by_pixels, rel=0.05)


def refined_one(
    frame: PastFrame, others: Sequence[PastFrame], spot: np.void, motion: np.ndarray
) -> np.void:
    hidden = np.zeros((len(others), 1), bool)
    (refined,) = refine(frame, others, np.array([spot]), motion[None], hidden)
    return refined


@pytest.mark.parametrize(("snr", "psf"), [(10, 1.0), (30, 1.0), (10, 1.4), (30, 1.4)])
def test_a_point_is_measured_as_well_as_light_allows(snr, psf):
    rng = np.random.default_rng(round(snr * 10 + psf))
    blank = sequence(rng, 5, nothing)
    errors = []
    for number in range(6):
        places = scattered(rng, SHAPE, 26)
        light = blobs(SHAPE, places, flux_of_snr(snr, NOISE, psf), psf)
        frame = frame_of(light, rng, 5 + number)
        for place in places:
            spots = spot_near(frame, blank, place, 2, 4.0)
            # One in some hundred of SNR 10 is not found or does not settle.
            for spot in spots:
                refined = refined_one(frame, blank, spot, np.array([1.5, 0.5]))
                if refined["refined"]:
                    errors.append((refined["x"] - place[0], refined["y"] - place[1]))
    errors = np.array(errors)
    assert len(errors) > 0.97 * 6 * len(places)
    bound = cramer_rao(snr, psf)
    # The std of 2 x 150 errors is known to 4 %.
    assert errors.std() < 1.5 * bound
    assert errors.std() > 0.9 * bound
    assert np.abs(errors.mean(axis=0)).max() < 4 * bound / math.sqrt(len(errors)) + 0.005


def test_a_star_beside_it_is_subtracted():
    """Without the other frames the star would pull the centroid, or keep it from settling."""
    rng = np.random.default_rng(16)
    place = np.array([80.3, 70.6])
    star = blobs(SHAPE, place + (4.5, 0), flux(60), 1.0)
    errors = {True: [], False: []}
    for _ in range(5):
        frames = sequence(
            rng, 6, lambda k: star + (blobs(SHAPE, place, flux(40), 1.0) if k == 5 else 0)
        )
        spots = find_spots(frames[5], frames[:5], SURE)
        spot, _ = nearest(spots, place)
        for known in (True, False):
            refined = refined_one(frames[5], frames[:5] if known else [], spot, np.zeros(2))
            errors[known].append(refined["x"] - place[0])
    assert abs(np.mean(errors[True])) < 4 * cramer_rao(40) / math.sqrt(5)
    assert abs(np.mean(errors[False])) > 0.15


@pytest.mark.parametrize(
    ("length", "snr", "along_px", "length_px"),
    # Of the matched filter's SNR over the whole streak: 10 is 2.3 sigmas a px at its brightest.
    # At SNR 8 a fifth of such streaks does not stand out from its brightest piece and is a point.
    [(24, 12, 1.2, 2.5), (24, 10, 1.8, 4.5), (30, 10, 1.8, 3.0), (12, 12, 0.9, 2.0)],
)
def test_the_whole_of_a_broken_streak_is_measured_from_a_piece(length, snr, along_px, length_px):
    rng = np.random.default_rng(length + snr)
    blank = sequence(rng, 5, nothing)
    places, lengths, turns, pieces = [], [], [], []
    for number in range(15):
        angle = rng.uniform(0, math.pi)
        direction = np.array([math.cos(angle), math.sin(angle)])
        normal = np.array([-direction[1], direction[0]])
        middle = 80 + rng.uniform(-5, 5, 2)
        profile = blobs(SHAPE, middle, 1.0, 1.0, length * direction)
        profile *= snr * NOISE / math.sqrt(np.sum(profile**2))
        frame = frame_of(profile, rng, 5 + number)
        spots = find_spots(frame, blank, 3.0)
        off = np.stack([spots["x"], spots["y"]], axis=1) - middle
        on = (np.abs(off @ direction) < length / 2) & (np.abs(off @ normal) < 2)
        assert on.any()
        piece = spots[np.flatnonzero(on)[0]]
        refined = refined_one(frame, blank, piece, (length + 1) * direction)
        assert refined["refined"]
        off = np.array([refined["x"], refined["y"]]) - middle
        places.append((off @ direction, off @ normal))
        lengths.append(refined["length"])
        turns.append((refined["angle"] - angle + math.pi / 2) % math.pi - math.pi / 2)
        pieces.append(piece["length"])
        assert -math.pi / 2 < refined["angle"] <= math.pi / 2
    along, across = np.sqrt(np.mean(np.square(places), axis=0))
    assert along < along_px
    assert across < 0.4
    assert np.sqrt(np.mean((np.array(lengths) - length) ** 2)) < length_px
    # It is what the caller says.
    assert np.abs(turns).max() < 1e-9
    # What had been found of it was a piece.
    assert np.mean(pieces) < 0.85 * length


def test_no_streak_is_longer_than_its_way():
    rng = np.random.default_rng(17)
    blank = sequence(rng, 3, nothing)
    frame = frame_of(blobs(SHAPE, (80, 80), flux(60, (40, 0)), 1.0, (40, 0)), rng, 3)
    (spot,) = find_spots(frame, blank, SURE)
    assert refined_one(frame, blank, spot, np.array([20.0, 0.0]))["length"] <= 20 + 2 * 1.4
    refined = refined_one(frame, blank, spot, np.array([60.0, 0.0]))
    assert refined["length"] == pytest.approx(40, abs=2)


def test_a_point_that_moves_fast_stays_a_point():
    """A short exposure of a fast object."""
    rng = np.random.default_rng(18)
    blank = sequence(rng, 4, nothing)
    for angle in np.linspace(0, 2 * math.pi, 7):
        frame = frame_of(blobs(SHAPE, (80.3, 79.6), flux(15), 1.0), rng, 4)
        (spot,) = find_spots(frame, blank, SURE)
        motion = 25 * np.array([math.cos(angle), math.sin(angle)])
        refined = refined_one(frame, blank, spot, motion)
        assert (refined["x"], refined["y"]) == pytest.approx((80.3, 79.6), abs=5 * cramer_rao(15))
        assert (refined["length"], refined["angle"]) == (spot["length"], spot["angle"])


def test_what_the_border_cuts_is_not_refined():
    rng = np.random.default_rng(19)
    blank = sequence(rng, 3, nothing)
    streak = (30.0, 0.0)
    frame = frame_of(blobs(SHAPE, (14, 80), flux(30, streak), 1.0, streak), rng, 3)
    spot = find_spots(frame, blank, SURE)[0]
    assert not refined_one(frame, blank, spot, np.array([31.0, 0.0]))["refined"]
    frame = frame_of(blobs(SHAPE, (4.4, 80), flux(30), 1.0), rng, 3)
    spot = find_spots(frame, blank, SURE)[0]
    refined = refined_one(frame, blank, spot, np.array([1.0, 0.0]))
    assert refined == spot
    assert not refined["refined"]


def test_the_spot_is_not_changed_in_place():
    rng = np.random.default_rng(20)
    blank = sequence(rng, 3, nothing)
    frame = frame_of(blobs(SHAPE, (80.3, 79.6), flux(15), 1.0), rng, 3)
    spots = find_spots(frame, blank, SURE)
    before = spots.copy()
    refined = refined_one(frame, blank, spots[0], np.zeros(2))
    assert refined["refined"]
    assert np.array_equal(spots, before)
    for name in ("excess", "snr", "flux", "length", "clean", "object_index"):
        assert refined[name] == spots[0][name]


def test_spots_are_measured_together_as_each_is_alone():
    """Points, a streak, what the border cuts, and what other frames show at the same place."""
    rng = np.random.default_rng(21)
    places = [(80.3, 79.6), (30.2, 40.9), (120.6, 110.1), (4.4, 80), (60.5, 120.2)]
    motions = np.array([(0, 0), (3.0, 1.0), (20.0, 0), (1.0, 0), (0.2, 0)])
    streaks = [(0, 0), (0, 0), (19.0, 0), (0, 0), (0, 0)]
    light = sum(
        blobs(SHAPE, place, flux(30, way), 1.0, way)
        for place, way in zip(places, streaks, strict=True)
    )
    ghost = blobs(SHAPE, (80.9, 79.6), flux(20), 1.0)
    others = [frame_of(ghost if k < 3 else 0 * ghost, rng, k) for k in range(5)]
    frame = frame_of(light, rng, 5)
    found = find_spots(frame, others[3:], SURE)
    spots = np.array([nearest(found, place)[0] for place in places], SPOT_DTYPE)
    hidden = rng.random((5, 5)) < 0.3
    hidden[:3, 0], hidden[:, 1] = True, True
    together = refine(frame, others, spots, motions, hidden)
    for row, spot in enumerate(spots):
        shown = [other for other, itself in zip(others, hidden[:, row], strict=True) if not itself]
        alone = refined_one(frame, shown, spot, motions[row])
        for name in SPOT_DTYPE.names:
            assert together[row][name] == pytest.approx(alone[name], abs=1e-9), (row, name)
    assert together["refined"].tolist() == [True, True, True, False, True]
    # What is hidden does not pull.
    pulled = refine(frame, others, spots, motions, np.zeros_like(hidden))
    assert abs(together[0]["x"] - 80.3) < 4 * cramer_rao(30) < abs(pulled[0]["x"] - 80.3)
    assert len(refine(frame, others, spots[:0], motions[:0], hidden[:, :0])) == 0
