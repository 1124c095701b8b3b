# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The simulated sphere: stars and RSOs are in the image where attitude and camera put them."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import from_radec, to_radec
from ofsat_ros.parameters import ParameterError
from ofsat_ros.simulation import (
    RSO,
    Fixed,
    SimulatedMount,
    SimulatorSettings,
    SphereSimulator,
    Target,
    looking_at,
    scenario,
)

SIDE = 256
SETTINGS = {"width": SIDE, "height": SIDE, "pixel_scale_arcsec": 10, "star_count": 60}
SETTINGS |= {"exposure_s": 0.05, "period_s": 0.1}
NOISELESS = {"noise_mean_percent": 0, "noise_std_percent": 0, "star_count": 0}
CENTRE = (SIDE - 1) / 2
F_PX = 1 / math.radians(10 / 3600)
START = looking_at(0.3, -0.7, 0.5)


class Turning:
    """A camera that turns at an even rate, rad/s in the optical frame."""

    def __init__(self, start: Rotation, rate) -> None:
        self.start, self.rate = start, np.array(rate, float)
        self.asked: list[np.ndarray] = []

    def attitudes(self, times_s: np.ndarray) -> Rotation:
        self.asked.append(times_s)
        return Rotation.from_rotvec(-self.rate * times_s[:, None]) * self.start


class Following:
    """A camera that keeps a direction in one place of the image, and its own axes level."""

    def __init__(self, ra_dec) -> None:
        self.ra_dec = ra_dec

    def attitudes(self, times_s: np.ndarray) -> Rotation:
        looks = [looking_at(ra, dec) for ra, dec in zip(*self.ra_dec(times_s), strict=True)]
        return Rotation.concatenate(looks)


def simulate(motion=None, targets=(), **settings) -> SphereSimulator:
    motion = motion or Fixed(START)
    return SphereSimulator(SimulatorSettings(**{**SETTINGS, **settings}), targets, motion)


def still(simulator: SphereSimulator, x: float, y: float, attitude=START, **flux) -> Target:
    """A target that stands among the stars where the camera sees the pixel at the start."""
    (direction,) = attitude.inv().apply(simulator.camera.lines_of_sight(np.array([[x, y]])))
    return Target(lambda times_s: np.tile(direction, (len(times_s), 1)), **flux)


def places(table) -> np.ndarray:
    return np.stack([table["x_px"], table["y_px"]], axis=-1)


def velocities(table) -> np.ndarray:
    return np.stack([table["vx_px_s"], table["vy_px_s"]], axis=-1)


def matched_stars(before, after):
    """Rows of the stars that both tables hold; a star is known by its flux."""
    _, first, second = np.intersect1d(before["flux"], after["flux"], return_indices=True)
    return before[first], after[second]


def centroid(image, x, y, half=6):
    """Centre of light of the square around (x, y)."""
    column, row = round(x), round(y)
    rows, columns = np.mgrid[row - half : row + half + 1, column - half : column + half + 1]
    light = image[rows, columns].astype(float)
    return np.sum(columns * light) / light.sum(), np.sum(rows * light) / light.sum()


# --- motion -----------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_deg_s", [(0, 0.5, 0), (0.5, 0, 0), (-0.2, 0.3, 0)])
def test_a_star_on_the_boresight_moves_as_the_rate_says(rate_deg_s):
    rate = np.radians(rate_deg_s)
    simulator = simulate(Turning(START, rate), star_count=500)
    simulator.frame()
    frame = simulator.frame()
    expected = F_PX * 0.1 * np.array([-rate[1], rate[0]])
    # 18 px at 20,600 px of focal length: the tangent differs by 5e-6 px.
    np.testing.assert_allclose(frame.displacement_px, expected, atol=1e-4)
    assert frame.rotation_rad == pytest.approx(0, abs=1e-12)
    central = np.hypot(*(places(frame.stars) - CENTRE).T) < 40
    assert central.sum() > 20
    # At 40 px from the boresight a pixel spans 4e-6 less, and a turn about it is of 2e-3.
    np.testing.assert_allclose(
        velocities(frame.stars)[central], [expected / 0.1] * central.sum(), atol=2e-3
    )


def test_everywhere_stars_are_where_camera_and_attitude_put_them():
    # Wide, quick and rolling, so that a plane would be off by many pixels.
    rate = np.array([0.3, -0.8, 0.5])
    simulator = simulate(Turning(START, rate), pixel_scale_arcsec=600, star_count=400)
    first, second = simulator.frame(), simulator.frame()
    before, after = matched_stars(first.stars, second.stars)
    assert len(before) > 200
    turn = Rotation.from_rotvec(-rate * 0.1)
    camera = simulator.camera
    expected = camera.pixels(turn.apply(camera.lines_of_sight(places(before))))
    np.testing.assert_allclose(places(after), expected, atol=1e-9)
    step = np.stack([after["dx_px"], after["dy_px"]], axis=-1)
    np.testing.assert_allclose(step, places(after) - places(before), atol=1e-9)
    assert np.ptp(step, axis=0).min() > 5
    # A sight s turns by -w x s, and the image follows by the camera's derivative.
    sight = camera.lines_of_sight(places(after))
    moved = camera.pixels(sight - 1e-7 * np.cross(rate, sight))
    derivative = (moved - camera.pixels(sight + 1e-7 * np.cross(rate, sight))) / 2e-7
    # A millionth: what a millisecond to both sides makes of 2.6 ms^2 / 6 at 1 rad/s.
    np.testing.assert_allclose(velocities(after), derivative, rtol=1e-5, atol=1e-3)
    assert np.allclose((second.attitude * first.attitude.inv()).as_matrix(), turn.as_matrix())
    assert np.isnan(first.stars["dx_px"]).all()
    assert np.isnan(first.displacement_px).all()
    assert math.isnan(first.rotation_rad)


def test_stars_keep_their_right_ascension_and_declination():
    mount = SimulatedMount(START, max_acceleration_deg_s2=0.5)
    simulator = simulate(mount, star_count=300)
    found = []
    for number in range(6):
        frame = simulator.frame()
        found.append((frame.stars["flux"], *directions_of(simulator, frame)))
        mount.command(number * 0.1 + 0.06, [2e-3, -1e-3, 3e-2])
    for one, two in itertools.pairwise(found):
        _, first, second = np.intersect1d(one[0], two[0], return_indices=True)
        assert len(first) > 250
        for before, after in zip(one[1:], two[1:], strict=True):
            np.testing.assert_allclose(before[first], after[second], atol=1e-11)


def directions_of(simulator, frame):
    return to_radec(simulator.camera.lines_of_sight(places(frame.stars)), frame.attitude)


def test_the_field_turns_against_the_roll_of_the_camera():
    simulator = simulate(Turning(START, [0, 0, -0.4]), star_count=300)
    first, second = simulator.frame(), simulator.frame()
    before, after = matched_stars(first.stars, second.stars)
    assert second.rotation_rad == pytest.approx(0.04, abs=1e-12)
    np.testing.assert_allclose(second.displacement_px, 0, atol=1e-9)
    c, s = math.cos(0.04), math.sin(0.04)
    turned = (places(before) - CENTRE) @ np.array([[c, s], [-s, c]]) + CENTRE
    np.testing.assert_allclose(places(after), turned, atol=1e-9)


def test_displacement_is_that_of_the_star_now_at_the_centre():
    simulator = simulate(Turning(START, [2, -3, 4]), pixel_scale_arcsec=600, star_count=3000)
    simulator.frame()
    frame = simulator.frame()
    distance = np.hypot(*(places(frame.stars) - CENTRE).T)
    near = np.argsort(distance)[:6]
    assert distance[near].max() < 10
    step = np.stack([frame.stars["dx_px"], frame.stars["dy_px"]], axis=-1)[near]
    # Six stars around it, with a plane through their steps.
    plane = np.column_stack([np.ones(6), places(frame.stars)[near] - CENTRE])
    at_centre = np.linalg.lstsq(plane, step, rcond=None)[0][0]
    np.testing.assert_allclose(frame.displacement_px, at_centre, atol=0.2)
    assert np.hypot(*frame.displacement_px) > 100


def test_light_is_where_truth_says_while_the_camera_turns():
    bright = {"star_flux_percent": (100, 101), "star_count": 50, "subsamples": 30}
    simulator = simulate(
        Turning(START, np.radians([0.2, -0.35, 3])),
        **{**NOISELESS, **bright, "width": 512, "height": 512, "exposure_s": 0.1},
    )
    frame = simulator.frame()
    measured = 0
    for star in frame.stars:
        others = np.hypot(*(places(frame.stars) - (star["x_px"], star["y_px"])).T)
        if np.sort(others)[1] < 40 or max(abs(places(star) - 255.5)) > 235:
            continue
        x, y = centroid(frame.image, star["x_px"], star["y_px"], half=16)
        assert (x, y) == pytest.approx((star["x_px"], star["y_px"]), abs=0.02)
        column, row = round(x), round(y)
        patch = frame.image[row - 16 : row + 17, column - 16 : column + 17].astype(float)
        rows, columns = np.mgrid[row - 16 : row + 17, column - 16 : column + 17]
        offsets = np.stack([columns - x, rows - y]).reshape(2, -1)
        spread = (offsets * patch.ravel() / patch.sum()) @ offsets.T
        # Of the PSF, of the pixel, and of the way in 0.1 s.
        way = 0.1 * np.array([star["vx_px_s"], star["vy_px_s"]])
        assert np.hypot(*way) > 10
        expected = (1 + 1 / 12) * np.eye(2) + np.outer(way, way) / 12
        np.testing.assert_allclose(spread, expected, atol=0.1)
        measured += 1
    assert measured >= 4


# --- RSOs -------------------------------------------------------------------------------------


def test_an_rso_is_where_its_direction_is_and_velocity_is_the_derivative():
    def direction(times_s):
        ra, dec = 0.3 + 4e-3 * times_s**2, -0.7 + 3e-3 * times_s
        return Rotation.from_euler("z", ra[:, None]).apply(sights(np.zeros_like(dec), dec))

    rate = np.radians([0.05, 0.1, 1])
    simulator = simulate(Turning(START, rate), [Target(direction, 80)])
    found = [simulator.frame() for _ in range(9)]
    times = 0.025 + 0.1 * np.arange(9)
    truth = np.concatenate([frame.truth for frame in found])
    assert truth["frame"].tolist() == list(range(9))

    def seen(times_s):
        attitudes = Rotation.from_rotvec(-rate * times_s[:, None]) * START
        return simulator.camera.pixels(attitudes.apply(direction(times_s)))

    np.testing.assert_allclose(places(truth), seen(times), atol=1e-8)
    np.testing.assert_allclose(
        velocities(truth), (seen(times + 1e-4) - seen(times - 1e-4)) / 2e-4, atol=1e-4
    )
    np.testing.assert_allclose(truth["length_px"], 0.05 * np.hypot(*velocities(truth).T))
    # Against the stars: the direction's own motion alone, seen by a camera that stands.
    ahead, behind = direction(times + 1e-4), direction(times - 1e-4)
    for frame, one, two in zip(found, ahead, behind, strict=True):
        own = simulator.camera.pixels(frame.attitude.apply([one, two]))
        expected = (own[0] - own[1]) / 2e-4
        np.testing.assert_allclose(frame.relative_velocity_px_s[0], expected, atol=1e-4)
        assert np.hypot(*expected) > 50


def sights(ra, dec):
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def test_what_is_followed_exactly_stands_still_among_streaking_stars():
    def ra_dec(times_s):
        return 0.1 + np.radians(0.4) * times_s, 0.2 - np.radians(0.3) * times_s

    target = Target(lambda times_s: sights(*ra_dec(times_s)), snr=40)
    simulator = simulate(Following(ra_dec), [target])
    for _ in range(4):
        frame = simulator.frame()
        assert places(frame.truth)[0] == pytest.approx((CENTRE, CENTRE), abs=1e-8)
        assert velocities(frame.truth)[0] == pytest.approx((0, 0), abs=1e-5)
        assert frame.truth["length_px"][0] < 1e-6
    # 0.3 deg/s down, 0.4 deg/s times the declination's cosine to the left.
    expected = F_PX * np.radians([-0.4 * math.cos(0.2), 0.3])
    assert frame.relative_velocity_px_s[0] == pytest.approx(expected, rel=2e-3)
    np.testing.assert_allclose(frame.displacement_px, -0.1 * expected, rtol=2e-3)
    assert frame.truth["snr"][0] == pytest.approx(40, rel=0.01)  # at another phase of the pixel
    # As much of its light is in the four pixels in the middle as within a sigma of the PSF.
    point = Target(target.direction, flux_percent=100)
    image = simulate(Following(ra_dec), [point], **NOISELESS).frame().image.astype(float)
    share = image[127:129, 127:129].sum() / image.sum()
    assert share == pytest.approx(math.erf(1 / math.sqrt(2)) ** 2, abs=1e-3)


@pytest.mark.parametrize("snr", [4, 30])
def test_an_rso_that_stands_still_has_the_snr_that_is_asked_for(snr):
    settings = {"star_count": 0, "sky_percent": 5, "gain_std": 0.01, "electrons_per_dn": 0.05}
    camera = simulate()
    simulator = simulate(targets=[still(camera, 30, 60, snr=snr)], **settings)
    (row,) = simulator.frame().truth
    assert row["snr"] == pytest.approx(snr, rel=1e-6)
    # A streak of 7 px of the same flux has less.
    moving = simulate(
        Turning(START, [0, 7 / 0.05 / F_PX, 0]), [still(camera, 30, 60, snr=snr)], **settings
    )
    (other,) = moving.frame().truth
    assert other["flux"] == pytest.approx(row["flux"], rel=1e-6)
    assert 0.4 * snr < other["snr"] < 0.8 * snr


def test_flux_in_percent_arrives():
    simulator = simulate(targets=[still(simulate(), 100.3, 90.6, flux_percent=80)], **NOISELESS)
    frame = simulator.frame()
    assert frame.truth["flux"][0] == pytest.approx(0.8 * 65535)
    assert frame.image.sum(dtype=float) == pytest.approx(0.8 * 65535, abs=36)  # rounding
    assert centroid(frame.image, 100, 91) == pytest.approx((100.3, 90.6), abs=0.01)


def test_what_is_not_in_front_of_the_camera_is_not_seen():
    def behind(times_s):
        return np.tile(START.inv().apply([0, 0, -1]), (len(times_s), 1))

    def nowhere(times_s):
        return np.full((len(times_s), 3), math.nan)

    camera = simulate()
    hidden = [Target(behind, 100), Target(nowhere, 100), still(camera, -9, 50, snr=50)]
    simulator = simulate(targets=[*hidden, still(camera, 30, 60, snr=20)], star_count=0)
    for _ in range(2):
        assert simulator.frame().truth["id"].tolist() == [4]
    blind = simulate(targets=hidden[:2]).frame()
    assert len(blind.truth) == len(blind.relative_velocity_px_s) == 0
    assert np.array_equal(blind.image, simulate().frame().image)


# --- stars ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "place", [(0, 0), (0, math.pi / 2), (1, -math.pi / 2), (2 * math.pi, 1.2), (3, 1.569)]
)
def test_stars_are_everywhere_and_equally_dense(place):
    counts, histogram = [], np.zeros((4, 4))
    for seed in range(8):
        frame = simulate(Fixed(looking_at(*place)), star_count=300, seed=seed).frame()
        counts.append(len(frame.stars))
        histogram += np.histogram2d(*places(frame.stars).T, 4, [(-0.5, SIDE - 0.5)] * 2)[0]
    # Poisson: the mean of 8 has a std of 6.1; a sixteenth of all of them, 150, one of 12.
    assert np.mean(counts) == pytest.approx(300, abs=4 * 6.1)
    np.testing.assert_allclose(histogram, 150, atol=4.5 * 12.2)


@pytest.mark.parametrize("scale_arcsec", [0.01, 600, 2000])
def test_stars_are_as_dense_at_other_scales(scale_arcsec):
    counts = []
    for seed in range(8):
        look = looking_at(1 + seed, 0.9)
        settings = {"pixel_scale_arcsec": scale_arcsec, "star_count": 400}
        frame = simulate(Fixed(look), seed=seed, **settings).frame()
        counts.append(np.sum(np.hypot(*(places(frame.stars) - CENTRE).T) < 50))
    # In the centre, where at 2000 arcsec a pixel spans 1.7 times what it does 50 px from it.
    z = math.cos(math.atan(50 * math.radians(scale_arcsec / 3600)))
    area = 2 * math.pi * (1 - z) / math.radians(scale_arcsec / 3600) ** 2
    expected = 400 * area / SIDE**2
    assert np.mean(counts) == pytest.approx(expected, abs=4 * math.sqrt(expected / 8))


@pytest.mark.parametrize(
    ("ra", "dec", "rate"),
    [
        (0.0, math.pi / 2 - 0.004, (0.08, 0, 0)),  # over the north pole
        (2.0, -math.pi / 2 + 0.004, (-0.08, 0, 0)),  # over the south pole
        (-0.003, 0.0, (0, -0.08, 0)),  # over right ascension 0
        (math.pi - 0.003, 0.4, (0.02, -0.08, 0.05)),
    ],
)
def test_no_star_comes_or_goes_within_the_image(ra, dec, rate):
    simulator = simulate(Turning(looking_at(ra, dec), rate), star_count=300, exposure_s=0.01)
    last, begin = simulator.frame(), None
    for _ in range(10):
        frame = simulator.frame()
        assert begin is None or len(frame.stars) > 200
        begin = frame
        turn = frame.attitude * last.attitude.inv()
        camera = simulator.camera
        moved = camera.pixels(turn.apply(camera.lines_of_sight(places(last.stars))))
        inside = np.all((moved > 0) & (moved < SIDE - 1), axis=1)
        assert np.isin(last.stars["flux"][inside], frame.stars["flux"]).all()
        back = places(frame.stars) - np.stack([frame.stars["dx_px"], frame.stars["dy_px"]], -1)
        inside = np.all((back > 0) & (back < SIDE - 1), axis=1)
        assert np.isin(frame.stars["flux"][inside], last.stars["flux"]).all()
        last = frame
    assert len(np.unique(frame.stars["flux"])) == len(frame.stars)


def test_the_sky_does_not_depend_on_what_was_rendered_before():
    there, elsewhere = looking_at(5, 1.1), looking_at(2, -0.3)

    class Visiting:
        def attitudes(self, times_s):
            looks = [there if 0.1 <= time < 0.2 else elsewhere for time in times_s]
            return Rotation.concatenate(looks)

    simulator = simulate(Visiting(), star_count=200)
    first, second, third = (simulator.frame().stars for _ in range(3))
    direct = simulate(Fixed(there), star_count=200).frame().stars
    assert np.array_equal(second["flux"], direct["flux"])
    np.testing.assert_allclose(places(second), places(direct), atol=1e-9)
    assert np.array_equal(first["flux"], third["flux"])
    assert len(np.intersect1d(first["flux"], second["flux"])) == 0


def test_stars_outside_the_image_light_its_border():
    settings = {**NOISELESS, "star_flux_percent": (100, 101)}
    whole = simulate(**{**settings, "width": 128, "height": 128, "star_count": 1600}).frame()
    part = simulate(**{**settings, "width": 64, "height": 64, "star_count": 400}).frame()
    # The same sky in an image of half the size: its border must not know of the cut.  Rounding of
    # places, 1e-12 px, turns at most a few pixels' rounding.
    difference = np.abs(part.image.astype(int) - whole.image[32:96, 32:96])
    assert difference.max() <= 1
    assert np.mean(difference > 0) < 1e-3
    assert len(part.stars) < len(whole.stars)


def test_a_field_as_wide_as_a_lens_can_see():
    simulator = simulate(Turning(START, [1, 2, 3]), pixel_scale_arcsec=3600, star_count=2000)
    counts = [len(simulator.frame().stars) for _ in range(3)]
    # A pyramid that sees w x h at unit distance f spans 4 asin(a b / ((1 + a^2)(1 + b^2))^1/2).
    half = SIDE / 2 * math.radians(1)
    angle = 4 * math.asin(half**2 / (1 + half**2))
    expected = 2000 * angle / (SIDE * math.radians(1)) ** 2
    np.testing.assert_allclose(counts, expected, atol=5 * math.sqrt(expected))


# --- frames -----------------------------------------------------------------------------------


def test_same_seed_same_bytes():
    def frames(seed):
        simulator = scenario("guide_leo", seed, width=96, height=80, frames=4)
        for number, frame in enumerate(simulator):
            simulator.motion.command(number * 0.1 + 0.06, [1e-3, -2e-3, 0])
            yield frame

    for a, b, c in zip(frames(5), frames(5), frames(6), strict=True):
        assert a.image.shape == (80, 96)
        for name in ("image", "truth", "stars", "displacement_px"):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
        assert a.image.tobytes() != c.image.tobytes()
        assert a.stamp_ns == c.stamp_ns


def test_a_frame_asks_for_no_time_outside_of_its_exposure():
    for settings in ({"subsamples": 1}, {"exposure_s": 1e-4}, {"exposure_s": 0.1}):
        motion = Turning(START, [0, 0.01, 0])
        simulator = simulate(motion, **settings)
        simulator.frame()
        simulator.frame()
        for number, times in enumerate(motion.asked):
            assert (np.diff(times) >= 0).all()
            assert times[0] >= number * 0.1
            assert times[-1] <= number * 0.1 + simulator.settings.exposure_s
        assert len(motion.asked) == 2


def test_stamps_and_attitudes_are_of_the_middle_of_the_exposures():
    simulator = simulate(Turning(START, [0, 0.01, 0]), frames=3, exposure_s=0.06)
    frames = list(simulator)
    assert len(simulator) == 3
    start = simulator.settings.start_stamp_ns
    assert [frame.stamp_ns - start for frame in frames] == [30_000_000, 130_000_000, 230_000_000]
    assert [frame.frame for frame in frames] == [0, 1, 2]
    for frame in frames:
        seconds = (frame.stamp_ns - start) * 1e-9
        expected = Rotation.from_rotvec([0, -0.01 * seconds, 0]) * START
        np.testing.assert_allclose(frame.attitude.as_matrix(), expected.as_matrix(), atol=1e-15)
    assert simulator.frame().frame == 3  # it goes on when asked for more


def test_jitter_shifts_stars_and_rsos_alike_and_the_attitude_knows_nothing_of_it():
    target = still(simulate(), 100, 90, snr=40)
    shaken, steady = (
        simulate(Turning(START, [0, 1e-3, 0.1]), [target], jitter_std_px=std) for std in (0.8, 0)
    )
    last = np.full(2, math.nan)
    for _ in range(20):
        frame, quiet = shaken.frame(), steady.frame()
        error = (places(frame.truth) - places(quiet.truth))[0]
        before, after = matched_stars(quiet.stars, frame.stars)
        np.testing.assert_allclose(places(after) - places(before), [error] * len(before), 0, 1e-9)
        more = after["dx_px"] - before["dx_px"], after["dy_px"] - before["dy_px"]
        np.testing.assert_allclose(np.transpose(more), [error - last] * len(before), 0, 1e-9)
        # The star now at the centre is another, which the roll of 10 mrad moves otherwise.
        moved = frame.displacement_px - quiet.displacement_px
        np.testing.assert_allclose(moved, error - last, atol=0.04)
        assert np.array_equal(frame.attitude.as_quat(), quiet.attitude.as_quat())
        last = error
    assert 0.1 < np.hypot(*last) < 5


def test_all_that_spoils_a_frame_acts_here_too():
    plain = simulate(star_count=0).frame().image.astype(float)
    cases = [
        {"sky_percent": 10, "vignetting": 0.5},
        {"hot_pixel_fraction": 0.01},
        {"cloud_cover": 0.5, "cloud_glow_percent": 5},
        {"cosmic_ray_count": 5},
    ]
    for more in cases:
        assert not np.array_equal(simulate(star_count=0, **more).frame().image, plain)


# --- scenarios --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("name", "rate_deg_s"), [("guide_drift", 0.2), ("guide_leo", 0.1)])
def test_uncommanded_the_rso_crosses_a_sidereal_field(name, rate_deg_s, seed):
    simulator = scenario(name, seed, width=SIDE, height=SIDE)
    frames = [simulator.frame() for _ in range(20)]
    truth = np.concatenate([frame.truth for frame in frames])
    assert truth["frame"].tolist() == list(range(20))  # in the field from the start
    speed = np.hypot(*velocities(truth).T)
    assert speed[0] == pytest.approx(F_PX * math.radians(rate_deg_s), rel=0.01)
    distance = np.hypot(*(places(truth) - CENTRE).T)
    assert (np.diff(distance[:9]) < 0).all()
    # It passes the centre by at less than a tenth of the image.
    position, way = places(truth)[0] - CENTRE, velocities(truth)[0] / speed[0]
    assert abs(position[0] * way[1] - position[1] * way[0]) < 0.11 * SIDE
    assert truth["snr"].min() > 30
    # The mount tracks the stars but for its periodic error: 8 arcsec in 40 s, 0.013 px a frame.
    assert max(np.hypot(*frame.displacement_px) for frame in frames[1:]) < 0.013


@pytest.mark.parametrize("name", ["guide_drift", "guide_leo"])
def test_a_mount_that_is_told_the_rsos_rate_holds_it(name):
    simulator = scenario(name, 2, width=SIDE, height=SIDE, star_count=0)
    frames = 150
    for number in range(frames):
        frame = simulator.frame()
        assert len(frame.truth) == 1, number
        offset = places(frame.truth)[0] - CENTRE
        u, v = frame.relative_velocity_px_s[0] + offset
        simulator.motion.command(number * 0.1 + 0.05, np.array([-v, u, 0]) / F_PX)
    # The latency of 50 ms and the frame's age: about 0.1 s of at most 0.0175 deg/s^2.
    assert np.hypot(*offset) < 1.5
    assert frame.truth["length_px"][0] < 0.1
    assert frame.truth["snr"][0] == pytest.approx(50, rel=0.02)


def test_the_rate_of_a_pass_rises_and_falls():
    simulator = scenario("guide_leo", star_count=0, width=64, height=64)
    assert len(simulator) == 900  # 90 s
    times = np.arange(0, 90.01, 0.5)
    (target,) = simulator.targets
    found = target.direction(times)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    ahead = target.direction(times + 1e-3)
    speed = np.degrees(np.linalg.norm(ahead - found, axis=1) / 1e-3)
    assert (speed[0], speed[90], speed[-1]) == pytest.approx((0.1, 0.6, 0.1), abs=1e-4)
    assert times[speed.argmax()] == 45
    # On a great circle.
    pole = np.cross(found[0], found[90])
    np.testing.assert_allclose(found @ pole, 0, atol=1e-12)


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "plane",
    [{"rsos": (RSO(),)}, {"camera_rate_arcsec_s": (1, 0)}, {"field_rotation_rad_s": 0.1}],
)
def test_settings_of_a_plane_sky_are_refused(plane):
    with pytest.raises(ParameterError, match="are settings of a plane sky; on the sphere, the"):
        simulate(**plane)


def test_bad_targets_are_refused():
    def direction(times_s):
        return np.array([0.0, 0.0, 1.0])

    with pytest.raises(ParameterError, match="a flux_percent or an snr: give one"):
        Target(direction)
    with pytest.raises(ParameterError, match="not both"):
        Target(direction, 5, 5)
    with pytest.raises(ParameterError, match="snr must be a number within"):
        Target(direction, snr=math.nan)
    simulator = simulate(targets=[Target(direction, 5)])
    with pytest.raises(ParameterError, match=r"array of shape \(3,\), not \(13, 3\)"):
        simulator.frame()


def test_a_motion_too_fast_to_render_is_refused():
    simulator = simulate(Turning(START, [0, 30, 0]))
    with pytest.raises(ParameterError, match="moves the field by 27846 px in one exposure"):
        simulator.frame()


def test_looking_at_is_where_the_sky_says():
    for ra, dec, angle in [(0, 0, 0), (1, 0.5, 0), (4, -1.2, 2.5)]:
        attitude = looking_at(ra, dec, angle)
        sight = from_radec(ra, dec, attitude)
        np.testing.assert_allclose(sight, [[0, 0, 1]], atol=1e-12)
        north = from_radec(ra, dec + 1e-6, attitude)[0, :2] / 1e-6
        east = from_radec(ra + 1e-6 / math.cos(dec), dec, attitude)[0, :2] / 1e-6
        # North up and east left, then turned from x towards y.
        c, s = math.cos(angle), math.sin(angle)
        np.testing.assert_allclose(north, [s, -c], atol=1e-5)
        np.testing.assert_allclose(east, [-c, -s], atol=1e-5)
