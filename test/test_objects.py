# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Objects: centroids, fluxes, SNR and shapes against sources that are known exactly."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, label
from scipy.special import erf
from sky import labels_of

from ofsat_ros.objects import OBJECT_DTYPE, _valleys, find_objects

PSF = 1.0
NOISE = 10.0
# White noise smoothed by a Gaussian of sigma 1 px keeps this part, measured on the grid.
SMOOTHED = 0.2821
ONE = np.ones((1, 1), np.float32)


def point(x: float, y: float, shape: tuple[int, int], sigma: float = PSF) -> np.ndarray:
    """A star of flux 1, integrated over each pixel."""

    def share(size: int, centre: float) -> np.ndarray:
        return np.diff(erf((np.arange(size + 1) - 0.5 - centre) / sigma / math.sqrt(2))) / 2

    return np.outer(share(shape[0], y), share(shape[1], x))


def line(x: float, y: float, length: float, angle: float, shape: tuple[int, int]) -> np.ndarray:
    """A streak of flux 1 whose middle is at (x, y)."""
    steps = (np.arange(60) + 0.5) / 60 - 0.5
    return sum(
        point(x + s * length * math.cos(angle), y + s * length * math.sin(angle), shape)
        for s in steps
    ) / len(steps)


def matched_filter_snr(profile: np.ndarray, noise: float = NOISE) -> float:
    """Best SNR that any linear filter can have: sqrt(sum s^2) / noise."""
    return math.sqrt(np.sum(profile**2)) / noise


def find(image: np.ndarray, noise: float = NOISE, count: float = 4.0, **options):
    image = image.astype(np.float32)
    smoothed = gaussian_filter(image, 1.0)
    mask = (smoothed > count * noise * SMOOTHED).astype(np.uint8)
    return measure(image, smoothed, mask, noise, noise * SMOOTHED, ONE, **options)


def measure(image, smoothed, mask, *noise, **options):
    """Objects of a mask, and the labels of all pixels."""
    pixels = np.flatnonzero(mask)
    values, smoothed = image.ravel()[pixels], smoothed.astype(np.float32)
    objects, regions = find_objects(pixels, values, smoothed, *noise, **options)
    return objects, labels_of(regions)


def measure_points(snr: float, trials: int = 400) -> tuple[np.ndarray, np.ndarray, float]:
    """Objects, true places and true flux of stars of one SNR, one in each tile of an image."""
    random = np.random.default_rng(int(snr))
    size, columns = 24, 20
    rows = trials // columns
    flux = snr * NOISE / math.sqrt(np.sum(point(12, 12, (size, size)) ** 2))
    image, truth = np.zeros((rows * size, columns * size)), np.zeros((rows, columns, 2))
    for row, column in np.ndindex(rows, columns):
        x, y = 12 + random.uniform(-0.5, 0.5, 2)
        tile = np.s_[row * size : (row + 1) * size, column * size : (column + 1) * size]
        image[tile] += flux * point(x, y, (size, size))
        truth[row, column] = column * size + x, row * size + y
    image += random.normal(0, NOISE, image.shape)
    objects, _ = find(image, min_area_px=3)
    truth = truth.reshape(-1, 2)
    distance = np.hypot(objects["x"][:, None] - truth[:, 0], objects["y"][:, None] - truth[:, 1])
    near = distance.min(axis=1) < 2
    return objects[near], truth[distance.argmin(axis=1)[near]], flux


# Points


@pytest.mark.parametrize("snr", [10, 20, 100])
def test_centroids_are_true_and_their_sigmas_honest(snr: float):
    objects, truth, _ = measure_points(snr)
    assert len(objects) >= 0.99 * 400
    for axis, (name, sigma) in enumerate((("x", "sigma_x"), ("y", "sigma_y"))):
        error = objects[name] - truth[:, axis]
        # The mean of 400 is known to a twentieth of one error's std; pixels and the cut at the
        # threshold may pull by 0.01 px.
        assert abs(error.mean()) < 3 * error.std() / 20 + 0.01
        # The Cramer-Rao bound is sqrt(2 (1 + 1/12)) = 1.47 px / SNR; weights as wide as the
        # smoothed star reach 1.8.
        assert error.std() < 2.0 / snr
        # Stated within a fifth of what is; a region of SNR 10 is smaller than its star.
        assert 0.8 < np.std(error / objects[sigma]) < (1.4 if snr == 10 else 1.2)


@pytest.mark.parametrize("snr", [10, 20, 100])
def test_snr_is_the_matched_filters(snr: float):
    objects, _, _ = measure_points(snr)
    # A pixel's centre is up to half a pixel off the peak (- 6 %), the highest of several noisy
    # ones is high (+ 1 sigma at most).
    assert np.median(objects["snr"]) == pytest.approx(snr, rel=0.05, abs=0.8)
    # The SNR of one measurement scatters by 1; phases within the pixel add some per cent.
    assert objects["snr"].std() < 1.3 + 0.03 * snr


@pytest.mark.parametrize(
    ("snr", "part"), [(10, (0.8, 0.95)), (20, (0.93, 1.0)), (100, (0.985, 1.015))]
)
def test_flux_is_that_inside_the_region(snr: float, part: tuple[float, float]):
    objects, _, flux = measure_points(snr)
    # The wings below the threshold are not counted: fewer, the brighter a star is.
    assert part[0] < np.median(objects["flux"]) / flux < part[1]


def test_a_point_is_no_streak():
    for snr in (10, 20, 100):
        objects, _, _ = measure_points(snr)
        # 3 % by chance, and three times the scatter of 400 draws
        assert np.mean(objects["length"] == 0) > 0.94, snr


def test_a_noise_free_point_is_measured_exactly():
    image = 1e6 * point(20.3, 17.8, (40, 40))
    objects, labels = find(image)
    assert len(objects) == 1
    (found,) = objects
    assert (found["x"], found["y"]) == pytest.approx((20.3, 17.8), abs=1e-3)
    assert found["flux"] == pytest.approx(1e6, rel=1e-3)
    assert found["peak"] == pytest.approx(gaussian_filter(image, 1.0).max(), rel=1e-5)
    assert found["snr"] == pytest.approx(matched_filter_snr(image), rel=0.05)
    assert (found["length"], found["edge"]) == (0, False)
    assert found["area"] == np.count_nonzero(labels)


def test_local_noise_counts():
    image = np.zeros((64, 128))
    for x in (32, 96):
        image += 3000 * point(x, 32, image.shape)
    smoothed = gaussian_filter(image, 1.0).astype(np.float32)
    mask = (smoothed > 20).astype(np.uint8)
    ratio = np.array([[1.0, 2.0]], np.float32)
    objects, _ = measure(image.astype(np.float32), smoothed, mask, NOISE, 2.8, ratio)
    assert objects["x"] == pytest.approx([32, 96], abs=1e-3)
    assert objects["snr"][0] == pytest.approx(2 * objects["snr"][1], rel=0.01)
    assert objects["sigma_x"][1] == pytest.approx(2 * objects["sigma_x"][0], rel=0.01)


# Streaks


@pytest.mark.parametrize("degrees", [-89, -75, -60, -45, -20, 0, 10, 30, 45, 71, 89, 90])
@pytest.mark.parametrize("length", [8, 20])
def test_length_and_angle_of_a_line(degrees: float, length: float):
    angle = math.radians(degrees)
    profile = line(40.2, 39.6, length, angle, (80, 80))
    image = 60 * NOISE * profile / math.sqrt(np.sum(profile**2))
    image += np.random.default_rng(degrees + 90).normal(0, NOISE, image.shape)
    objects, _ = find(image)
    found = objects[0]
    # A streak of SNR 60: some of its ends is lost below the threshold.
    assert found["length"] == pytest.approx(length, rel=0.1)
    difference = (found["angle"] - angle + math.pi / 2) % math.pi - math.pi / 2
    assert math.degrees(abs(difference)) < 2.5
    assert -math.pi / 2 < found["angle"] <= math.pi / 2
    along, across = (
        (found["x"] - 40.2) * math.cos(angle) + (found["y"] - 39.6) * math.sin(angle),
        (found["y"] - 39.6) * math.cos(angle) - (found["x"] - 40.2) * math.sin(angle),
    )
    # Across, a streak is known as well as a point; along, by its length over its SNR.
    assert abs(across) < 4 * 1.47 / 60
    assert abs(along) < 4 * length / 60
    # The region's pixels hold nearly all of it.
    assert found["snr"] == pytest.approx(60, rel=0.06)


@pytest.mark.parametrize(("turn", "expected"), [(0, 0), (1, 90), (2, 0), (3, 90)])
def test_an_angle_wraps_to_plus_ninety_degrees(turn: int, expected: float):
    image = np.rot90(1e5 * line(30, 30, 15, 0, (61, 61)), turn)
    objects, _ = find(image)
    assert math.degrees(objects[0]["angle"]) == pytest.approx(expected, abs=1e-6)


def test_the_angle_of_an_upright_streak_is_never_minus_ninety_degrees():
    random = np.random.default_rng(7)
    for _ in range(50):
        image = np.zeros((40, 40), np.float32)
        x, column = random.integers(5, 34), random.uniform(1, 9, 20)
        image[10:30, x] = image[10:30, x + 1] = column
        mask = (image > 0).astype(np.uint8)
        objects, _ = measure(image, image, mask, 1.0, 1.0, ONE)
        assert -math.pi / 2 < objects["angle"][0] <= math.pi / 2
        assert abs(objects["angle"][0]) == pytest.approx(math.pi / 2, abs=1e-9)


def test_angles_go_from_x_to_y():
    """Down is positive: a line from the upper left to the lower right is at +45 degrees."""
    image = np.zeros((40, 40))
    image[range(10, 30), range(10, 30)] = 1e4
    objects, _ = find(image)
    assert math.degrees(objects[0]["angle"]) == pytest.approx(45, abs=1e-6)


# Regions


def test_an_empty_mask_gives_nothing():
    zero = np.zeros((20, 30), np.float32)
    objects, labels = measure(zero, zero, zero.astype(np.uint8), 1.0, 1.0, ONE)
    assert (objects.dtype, objects.shape) == (OBJECT_DTYPE, (0,))
    assert (labels.dtype, labels.shape) == (np.int32, (20, 30))
    assert not labels.any()


def test_a_full_mask_is_one_object():
    image = np.full((20, 30), 50, np.float32)
    objects, labels = measure(image, image, np.ones((20, 30), np.uint8), 1.0, 1.0, ONE)
    assert len(objects) == 1
    assert (objects["x"][0], objects["y"][0]) == pytest.approx((14.5, 9.5))
    assert (objects["area"][0], objects["edge"][0]) == (600, True)
    assert objects["flux"][0] == 50 * 600
    assert (labels == 1).all()


def test_regions_below_the_background_are_measured():
    """A published threshold of mean + 0 std may lie below the level that was subtracted."""
    image = np.full((20, 20), -5.0, np.float32)
    mask = np.zeros((20, 20), np.uint8)
    mask[5:8, 10:13] = 1
    image[5, 10] = -1
    objects, _ = measure(image, image, mask, 1.0, 1.0, ONE)
    # Over the region's lowest, the corner is all there is.
    assert (objects["x"][0], objects["y"][0]) == pytest.approx((10, 5), abs=1e-3)
    assert objects["flux"][0] == -5 * 8 - 1
    for name in ("snr", "sigma_x", "sigma_y", "length", "angle"):
        assert np.isfinite(objects[name]).all()
    assert objects["sigma_x"][0] > 0


def test_touching_stars_are_one_object_and_separate_ones_two():
    for distance, count in ((3, 1), (12, 2)):
        image = 5000 * (point(20, 20, (40, 60)) + point(20 + distance, 20, (40, 60)))
        objects, labels = find(image)
        assert len(objects) == count == labels.max()
        assert objects["x"].mean() == pytest.approx(20 + distance / 2, abs=0.01)
        assert objects["y"] == pytest.approx(20, abs=0.01)


# Several peaks in one region


def pair(
    random: np.random.Generator, snrs: tuple[float, float], distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Image of two stars of these SNR, in noise, and their places."""
    shape, angle = (64, 64), random.uniform(0, 2 * math.pi)
    one = math.sqrt(np.sum(point(32, 32, shape) ** 2))
    first = 32 + random.uniform(-0.5, 0.5, 2)
    places = np.stack([first, first + distance * np.array([math.cos(angle), math.sin(angle)])])
    light = sum(snr / one * point(x, y, shape) for snr, (x, y) in zip(snrs, places, strict=True))
    return NOISE * (light + random.normal(0, 1, shape)), places


@pytest.mark.parametrize(
    ("snrs", "distance", "centroid_px"),
    # The brighter one's wings pull: at 8 px they are nothing, at 6 px a part of the fainter.
    [((100, 30), 8, 0.25), ((400, 30), 10, 0.25), ((60, 60), 6, 0.35), ((30, 15), 7, 0.6)],
)
def test_a_faint_object_beside_a_bright_one_is_one_of_its_own(
    snrs: tuple[float, float], distance: float, centroid_px: float
):
    random = np.random.default_rng(round(sum(snrs) + distance))
    errors, fluxes = [], []
    for _ in range(25):
        image, places = pair(random, snrs, distance)
        objects, labels = find(image, min_area_px=3)
        for snr, place in zip(snrs, places, strict=True):
            off = np.hypot(objects["x"] - place[0], objects["y"] - place[1])
            best = int(np.argmin(off))
            assert off[best] < 1.5
            errors.append(off[best])
            true = snr * NOISE / math.sqrt(np.sum(point(32, 32, (64, 64)) ** 2))
            fluxes.append(objects["flux"][best] / true)
            # the place belongs to it in the labels, too
            x, y = np.rint(place).astype(int)
            assert labels[y, x] == best + 1
    # two axes of 1.8 px / SNR, and what the other's light pulls
    assert np.median(errors) < centroid_px
    assert 0.75 < np.median(fluxes) < 1.1


def test_objects_of_one_region_share_no_pixel():
    image, _ = pair(np.random.default_rng(3), (100, 30), 7)
    smoothed = gaussian_filter(image.astype(np.float32), 1.0)
    objects, labels = find(image, min_area_px=3)
    assert len(objects) >= 2
    for number, found in enumerate(objects, 1):
        assert np.count_nonzero(labels == number) == found["area"]
    # The valley between them belongs to none: what is labelled is over the threshold.
    assert (smoothed[labels > 0] > 4 * NOISE * SMOOTHED).all()


def test_three_in_a_row_are_three():
    image = 5000 * sum(point(x, 20, (40, 60)) for x in (20, 26, 32))
    objects, _ = find(image)
    assert sorted(objects["x"]) == pytest.approx([20, 26, 32], abs=0.35)


def test_the_mask_is_not_split_in_the_callers_array():
    image, _ = pair(np.random.default_rng(4), (100, 30), 7)
    smoothed = gaussian_filter(image.astype(np.float32), 1.0)
    mask = (smoothed > 4 * NOISE * SMOOTHED).astype(np.uint8)
    before = mask.copy()
    measure(image.astype(np.float32), smoothed, mask, NOISE, NOISE * SMOOTHED, ONE)
    assert np.array_equal(mask, before)


def test_corners_connect():
    mask = np.zeros((20, 20), np.uint8)
    mask[5, 5] = mask[6, 6] = 1
    image = 10.0 * mask.astype(np.float32)
    objects, _ = measure(image, image, mask, 1.0, 1.0, ONE)
    assert objects["area"].tolist() == [2]
    assert (objects["x"][0], objects["y"][0]) == pytest.approx((5.5, 5.5))


def test_one_pixel_has_a_finite_measurement():
    mask = np.zeros((20, 20), np.uint8)
    mask[5, 7] = 1
    image = 30.0 * mask.astype(np.float32)
    objects, _ = measure(image, image, mask, 1.0, 1.0, ONE)
    found = objects[0]
    assert (found["x"], found["y"], found["area"], found["length"]) == (7, 5, 1, 0)
    # The pixel's own moment, and twice as much std for what the threshold may have cut: the
    # factor is largest, sqrt((1 - q) / (1 - q + q ln q)) at q = 0.9, where nothing tells more.
    factor = math.sqrt(0.1 / (0.1 + 0.9 * math.log(0.9)))
    expected = math.sqrt(2 / 12 * factor) / 30
    assert found["sigma_x"] == found["sigma_y"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("x", "y", "edge"),
    [
        *((30, 20, False), (0.3, 20, True), (59, 20, True), (30, 0, True), (30, 39.4, True)),
        (0, 0, True),
    ],
)
def test_what_touches_the_border_is_marked(x: float, y: float, edge: bool):
    objects, _ = find(5000 * point(x, y, (40, 60)))
    assert objects["edge"].tolist() == [edge]


# Choice of objects


def several() -> np.ndarray:
    """Six stars from bright to faint, the faintest two of one or two pixels."""
    image = np.zeros((60, 200))
    for number, flux in enumerate((8000, 600, 4000, 260, 2000, 1000)):
        image += flux * point(16 + 32 * number, 30, image.shape)
    return image


def test_the_brightest_come_first():
    objects, _ = find(several())
    assert objects["x"] == pytest.approx([16, 80, 144, 176, 48, 112], abs=0.01)
    assert (np.diff(objects["snr"]) <= 0).all()


@pytest.mark.parametrize(
    ("min_area_px", "max_objects"), [(1, 5000), (12, 5000), (1, 3), (12, 2), (10**4, 10)]
)
def test_labels_agree_with_the_objects_that_are_kept(min_area_px: int, max_objects: int):
    everything, _ = find(several())
    objects, labels = find(several(), min_area_px=min_area_px, max_objects=max_objects)
    kept = everything[everything["area"] >= min_area_px][:max_objects]
    assert np.array_equal(objects, kept)
    assert set(np.unique(labels)) == set(range(len(objects) + 1))
    for number, found in enumerate(objects, 1):
        yx = np.argwhere(labels == number)
        assert len(yx) == found["area"]
        assert np.abs(yx - [found["y"], found["x"]]).max() < 8
        assert labels[round(found["y"]), round(found["x"])] == number


def test_inputs_are_not_changed():
    image = several().astype(np.float32)
    smoothed = gaussian_filter(image, 1.0)
    mask = (smoothed > 12).astype(np.uint8)
    before = image.copy(), smoothed.copy(), mask.copy()
    measure(image, smoothed, mask, NOISE, 2.8, ONE, 3, 2)
    for old, new in zip(before, (image, smoothed, mask), strict=True):
        assert np.array_equal(old, new)


def test_any_nonzero_mask_counts():
    image = several().astype(np.float32)
    smoothed = gaussian_filter(image, 1.0)
    mask = (smoothed > 12).astype(np.uint8)
    one, _ = measure(image, smoothed, mask, NOISE, 2.8, ONE)
    other, _ = measure(image, smoothed, 255 * mask, NOISE, 2.8, ONE)
    assert np.array_equal(one, other)


@pytest.mark.parametrize("flip", ["left", "top", "right", "bottom"])
@pytest.mark.parametrize("inset", [0, 1, 2])
def test_a_pair_at_the_border_stays_two_objects_that_it_cuts(flip, inset):
    turns = {"left": 0, "top": -1, "right": 2, "bottom": 1}[flip]
    image = 5000 * point(inset, 20, (41, 41)) + 3000 * point(inset + 7, 20, (41, 41))
    objects, _ = find(np.rot90(image, turns))
    assert len(objects) == 2
    assert objects["edge"][0]
    place = {
        "left": (inset, 20),
        "top": (20, inset),
        "right": (40 - inset, 20),
        "bottom": (20, 40 - inset),
    }
    assert (objects["x"][0], objects["y"][0]) == pytest.approx(place[flip], abs=0.5)


@pytest.mark.parametrize(
    ("length", "sigmas"), [(12, 8), (12, 20), (30, 10), (30, 20), (30, 40), (60, 10), (60, 20)]
)
def test_a_noisy_streak_is_not_split(length: float, sigmas: float):
    """Its brightness along it goes up and down by the noise, without a valley."""
    for seed in range(12):
        random = np.random.default_rng(seed)
        x, y = 60 + random.uniform(-0.5, 0.5, 2)
        profile = line(x, y, length, random.uniform(0, math.pi), (120, 120))
        image = sigmas * NOISE * SMOOTHED * profile / gaussian_filter(profile, 1.0).max()
        objects, _ = find(image + random.normal(0, NOISE, image.shape))
        # lone pixels of noise beside it have less
        assert np.count_nonzero(objects["snr"] > 7) == 1, seed
        assert (objects["x"][0], objects["y"][0]) == pytest.approx((x, y), abs=0.1 * length)


def test_a_valley_is_the_best_ways_lowest_point():
    """Against its definition: the highest level above which a way to a brighter pixel stays."""
    random = np.random.default_rng(3)
    light = gaussian_filter(random.normal(0, 1, (14, 17)), 1.0).astype(np.float32)
    light[4:6, 5:8] = light.max() + 1
    light[light < np.quantile(light, 0.3)] = -9
    pixels = np.flatnonzero(light > -9)
    values = light.ravel()[pixels]
    brightest_first = np.argsort(-values, kind="stable")
    expected = np.full(pixels.size, -np.inf)
    for level in np.unique(values):
        regions, _ = label(light >= level, np.ones((3, 3)))
        region = regions.ravel()[pixels]
        led = set()
        for pixel in brightest_first[region[brightest_first] > 0]:
            if region[pixel] in led:
                expected[pixel] = level
            led.add(region[pixel])
    np.testing.assert_array_equal(_valleys(pixels, values, light.shape[1]), expected)
