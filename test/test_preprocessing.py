# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Preprocessing: thresholds as published, backgrounds, noise and defects that are known."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from ofsat_ros.parameters import Parameters
from ofsat_ros.preprocessing import Preprocessed, SensorMemory, preprocess

PUBLISHED = {"background": "none", "threshold_statistics": "all", "hot_pixels": "keep"}
# Smoothing lowers white noise to this for sigma 1 px: 1 / (2 sqrt(pi)), sampled on the grid.
SMOOTHED = 0.2821


def run(image: np.ndarray, **changes) -> Preprocessed:
    return preprocess(image, Parameters.preset(**changes))


def mask(pre: Preprocessed) -> np.ndarray:
    """1 where the smoothed image is above the threshold, else 0."""
    image = np.zeros(pre.smoothed.shape, np.uint8)
    image.ravel()[pre.above] = 1
    return image


def noise(
    shape: tuple[int, int] = (512, 512), level: float = 1000, std: float = 20, seed: int = 1
) -> np.ndarray:
    return np.random.default_rng(seed).normal(level, std, shape)


def counts(image: np.ndarray, dtype: type = np.uint16) -> np.ndarray:
    return np.clip(np.rint(image), 0, np.iinfo(dtype).max).astype(dtype)


def integrated_star(
    x: float, y: float, sigma: float, flux: float = 1.0, shape: tuple[int, int] = (15, 15)
) -> np.ndarray:
    """A Gaussian integrated over each pixel, as a sensor does."""

    def share(size: int, centre: float) -> np.ndarray:
        edges = (np.arange(size + 1) - 0.5 - centre) / sigma
        return np.diff(norm.cdf(edges))

    return flux * np.outer(share(shape[0], y), share(shape[1], x))


def with_stars(image: np.ndarray, count: int, flux: float, seed: int = 2) -> np.ndarray:
    random = np.random.default_rng(seed)
    image = image.copy()
    for x, y in random.uniform(8, np.array(image.shape[::-1]) - 9, (count, 2)):
        left, top = round(x) - 7, round(y) - 7
        spot = integrated_star(x - left, y - top, 1.0, flux)
        image[top : top + 15, left : left + 15] += spot
    return image


# As published (AAS 21-364)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize(("sigma", "count"), [(1.0, 3.0), (2.5, 1.0)])
def test_the_published_threshold_is_mean_plus_n_std(dtype, sigma: float, count: float):
    image = counts(with_stars(noise(level=100, std=5), 30, 2000), np.uint8).astype(dtype)
    pre = run(image, smoothing_sigma_px=sigma, threshold_sigmas=count, **PUBLISHED)
    # SciPy cuts the kernel at 4 sigma, as OpenCV does for float32, and mirrors alike.
    smoothed = gaussian_filter(image.astype(float), sigma, mode="mirror", truncate=4)
    np.testing.assert_allclose(pre.smoothed + pre.pedestal, smoothed, atol=0.01)
    threshold = smoothed.mean() + count * smoothed.std()
    assert pre.threshold + pre.pedestal == pytest.approx(threshold, abs=0.005)
    assert pre.noise == pytest.approx(smoothed.std(), abs=0.005)
    clear = np.abs(smoothed - threshold) > 0.02
    assert np.array_equal(mask(pre)[clear] == 1, (smoothed > threshold)[clear])
    assert set(np.unique(mask(pre))) == {0, 1}


def test_without_smoothing_the_image_itself_is_compared():
    image = counts(noise())
    pre = run(image, smoothing_sigma_px=0, threshold_sigmas=1, **PUBLISHED)
    # float32 knows the background of 1000 to 0.0001
    np.testing.assert_allclose(pre.smoothed + pre.pedestal, image, atol=2e-4)
    limit = image.astype(float).mean() + image.astype(float).std()
    assert np.array_equal(mask(pre) == 1, image > limit)


def test_what_is_left_of_the_background_is_told():
    image = counts(noise())
    kept, subtracted = run(image, background="none"), run(image)
    assert kept.background == pytest.approx(1000, abs=0.5)
    assert kept.pedestal == kept.background
    assert subtracted.background == pytest.approx(1000, abs=0.5)
    assert subtracted.pedestal == 0
    # The threshold is over the background in either case.
    expected = 4 * 20 * SMOOTHED
    assert kept.threshold == pytest.approx(expected, rel=0.05)
    assert subtracted.threshold == pytest.approx(expected, rel=0.05)


# Noise and threshold


@pytest.mark.parametrize("background", ["mesh", "none"])
@pytest.mark.parametrize(
    ("dtype", "level", "std"),
    [
        *((np.uint8, 60, 0.5), (np.uint8, 60, 3), (np.uint16, 1000, 20)),
        *((np.uint16, 30000, 2000), (np.float32, 0.5, 0.01), (np.float32, 1e6, 3000)),
    ],
)
def test_noise_is_measured(dtype, level: float, std: float, background: str):
    image = noise(level=level, std=std)
    image = image.astype(dtype) if dtype is np.float32 else counts(image, dtype)
    pre = run(image, background=background)
    # Rounding is noise, too; the estimate's own error is 0.5 % (512^2 / 4 samples, clipped).
    truth = image.astype(float).std()
    assert pre.pixel_noise == pytest.approx(truth, rel=0.03)
    assert pre.noise == pytest.approx(truth * SMOOTHED, rel=0.03)


@pytest.mark.parametrize("count", [2.0, 3.0, 4.0])
def test_false_alarms_are_as_many_as_theory_says(count: float):
    pre = run(noise((1024, 1024)).astype(np.float32), threshold_sigmas=count)
    expected = norm.sf(count)
    # Local levels and noises scatter by 3 %, which lets through some 10 % more at 4 sigma;
    # smoothed pixels come in clumps of about 13: 33 alarms at 4 sigma are some 3 independent ones.
    independent = expected * 1024**2 / (4 * math.pi)
    tolerance = 0.1 + 4 / math.sqrt(independent)
    assert mask(pre).mean() == pytest.approx(expected, rel=tolerance)


def test_stars_do_not_raise_the_clipped_threshold():
    sky = noise()
    few, many = (run(counts(with_stars(sky, n, 20_000))) for n in (0, 400))
    # 400 stars cover 7 % of the pixels; of what their wings leave inside 3 sigma, the noise
    # keeps a few per cent.
    assert many.pixel_noise == pytest.approx(few.pixel_noise, rel=0.03)
    assert many.threshold == pytest.approx(few.threshold, rel=0.12)
    published = [run(counts(with_stars(sky, n, 20_000)), **PUBLISHED).threshold for n in (0, 400)]
    assert published[1] - 1000 > 10 * (published[0] - 1000)


def test_one_star_that_fills_a_cell_does_not_hide_its_neighbours():
    y, x = np.mgrid[:512, :512]
    halo = 5000 * np.exp(-((x - 288) ** 2 + (y - 288) ** 2) / (2 * 15**2))
    pre, without = run(counts(noise() + halo)), run(counts(noise()))
    # The star covers 4 cells; two thirds of the halo's neighbours still see a part of it.
    assert pre.noise_ratio.max() < 1.5
    assert pre.pixel_noise == pytest.approx(without.pixel_noise, rel=0.03)


def test_the_noise_map_follows_the_noise():
    x = np.linspace(10, 40, 512)
    random = np.random.default_rng(3)
    image = 1000 + random.normal(0, 1, (512, 512)) * x
    pre = run(counts(image), threshold_sigmas=3)
    measured = pre.noise * pre.noise_ratio.mean(axis=0)
    expected = x.reshape(-1, 64).mean(axis=1) * SMOOTHED
    # The outer cells' medians over 3 x 3 are their own; each mean is over 8 cells of 5 %.
    np.testing.assert_allclose(measured, expected, rtol=0.08)
    assert pre.noise == pytest.approx(25 * SMOOTHED, rel=0.05)
    assert pre.pixel_noise == pytest.approx(25, rel=0.05)
    left, right = mask(pre)[:, :256].mean(), mask(pre)[:, 256:].mean()
    # 177 pixels a half by theory, in clumps: a threshold that was not local would give 0 and
    # some 1,500.
    assert 0.4 < left / norm.sf(3) < 2
    assert 0.4 < right / norm.sf(3) < 2


# Background


def gradient(slope_x: float, slope_y: float, shape: tuple[int, int]) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    return slope_x * x + slope_y * y


def vignetting(shape: tuple[int, int]) -> np.ndarray:
    """Light falling to 60 % in the corners, cos^4-like."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    r2 = ((x - shape[1] / 2) ** 2 + (y - shape[0] / 2) ** 2) / (shape[0] ** 2 + shape[1] ** 2) * 4
    return 3000 * (1 - 0.4 * r2)


@pytest.mark.parametrize("slopes", [(2, 0), (2, -2), (-1, 3)])
@pytest.mark.parametrize("shape", [(512, 512), (500, 333), (608, 968)])
def test_a_gradient_is_removed_up_to_the_border(shape: tuple[int, int], slopes):
    slope = gradient(*slopes, shape)
    sky = noise(shape, level=4000)
    flat, pre = run(counts(sky)), run(counts(sky + slope))
    residual = pre.image - flat.image
    # Cells' levels are known to 4 % of the noise and the map to one pixel of the slope; in the
    # corners, continued by 1.5 of one cell less 0.5 of another each way, to three times that.
    one_pixel = sum(map(abs, slopes))
    assert np.sqrt(np.mean(residual**2)) < 0.06 * 20 + one_pixel
    assert np.abs(residual).max() < 3 * (0.06 * 20 + one_pixel)
    assert pre.pixel_noise == pytest.approx(20, rel=0.03)
    assert pre.noise == pytest.approx(flat.noise, rel=0.03)
    assert mask(pre).mean() < 4 * norm.sf(4)
    assert pre.background == pytest.approx(np.median(sky + slope), abs=32 * one_pixel)


def test_vignetting_is_removed():
    shape = (1024, 1024)
    sky = noise(shape, level=0) + vignetting(shape)
    pre = run(counts(sky))
    residual = pre.image - noise(shape, level=0)
    # Cells' levels have second differences of 18.7 DN each way; lines between means of a
    # parabola are an eighth of that off, 4.7 DN for both, which the local threshold takes in.
    assert np.sqrt(np.mean(residual**2)) < 6
    assert np.abs(residual).max() < 20
    assert pre.pixel_noise == pytest.approx(20, rel=0.03)
    assert mask(pre).mean() < 3 * norm.sf(4)


def test_the_shadow_of_an_occulter_is_not_continued_beyond_the_border():
    image = noise(level=1000)
    image[448:] -= 900  # the last row of cells
    pre = run(counts(image))
    # A line through the last two cells' levels would go on to -350 and leave a ghost of +450.
    assert abs(pre.smoothed[-20:].mean()) < 5
    assert mask(pre)[-20:].mean() < 10 * norm.sf(4)


@pytest.mark.parametrize("cell", [8, 64, 1024])
def test_cells_of_any_size_fit_any_image(cell: int):
    image = counts(noise((101, 237)))
    pre = run(image, background_cell_px=cell)
    assert pre.image.shape == pre.smoothed.shape == mask(pre).shape == image.shape
    assert pre.noise_ratio.shape == (max(1, round(101 / cell)), max(1, round(237 / cell)))
    assert pre.background == pytest.approx(1000, abs=1)
    assert pre.pixel_noise == pytest.approx(20, rel=0.1)


# Defects


@pytest.mark.parametrize("sigma", [0.6, 0.8, 1.0, 2.0])
@pytest.mark.parametrize("flux", [500, 50_000])
def test_stars_stay_as_they_are(sigma: float, flux: float):
    """Noise-free stars at 10 x 10 phases within the pixel, one image of them all."""
    image = np.full((300, 300), 1000.0)
    for i in range(10):
        for j in range(10):
            spot = integrated_star(7 + i / 10, 7 + j / 10, sigma, flux, (20, 20))
            image[30 * i + 5 : 30 * i + 25, 30 * j + 5 : 30 * j + 25] += spot
    image = (image + np.random.default_rng(5).normal(0, 0.5, image.shape)).astype(np.float32)
    keep = run(image, hot_pixels="keep", background="none")
    kept, replaced = keep.image, run(image, hot_pixels="replace", background="none").image
    assert np.array_equal(kept, image - np.float32(keep.background))
    assert np.array_equal(replaced, kept)


def test_faint_stars_in_noise_lose_next_to_nothing():
    image = counts(with_stars(noise((1024, 1024)), 2000, 900))  # peaks of 7 sigma
    kept, replaced = (run(image, hot_pixels=choice) for choice in ("keep", "replace"))
    # A centred star of sigma 1 has neighbours of 0.61 of its peak; all eight of them have to
    # fall under 0.25 of it by chance.
    assert np.count_nonzero(kept.image != replaced.image) <= 2


def test_hot_pixels_are_replaced():
    random = np.random.default_rng(6)
    sky = noise()
    hot = sky.copy()
    # On a grid with random places in it: no two touch; the border and the corners are among them.
    y, x = (g.ravel() + random.integers(0, 4, 1024) for g in np.mgrid[:512:16, :512:16])
    y = np.concatenate([y, [0, 0, 511, 511, 0, 511, 200, 310]])
    x = np.concatenate([x, [9, 511, 10, 511, 250, 250, 511, 511]])
    hot[y, x] = 1000 + random.uniform(10 * 20, 60_000, y.size)
    pre = run(counts(hot))
    left = pre.image[y, x]
    # A median of eight neighbours is what stands there now.
    assert np.abs(left).max() < 3.5 * 20
    assert left.std() < 0.6 * 20
    untouched = np.ones(hot.shape, bool)
    untouched[y, x] = False
    kept = run(counts(hot), hot_pixels="keep")
    assert np.array_equal(pre.image[untouched], kept.image[untouched])
    assert mask(pre).mean() < 4 * norm.sf(4)
    assert pre.pixel_noise == pytest.approx(20, rel=0.03)


def test_a_hot_pixel_is_replaced_without_a_mesh_too():
    image = noise()
    image[100, 100] = 9000
    pre = run(counts(image), background="none")
    assert pre.image[100, 100] == pytest.approx(0, abs=60)


@pytest.mark.parametrize("wild", [1e8, -1e9, 1e10])
def test_one_wild_pixel_of_a_float_image_blinds_nothing(wild: float):
    """A division by a bad flat field makes such pixels; the noise must not be measured by them."""
    image = noise().astype(np.float32)
    expected = run(image)
    image[100, 100] = wild
    pre = run(image)
    assert pre.noise == pytest.approx(expected.noise, rel=0.01)
    assert pre.threshold == pytest.approx(expected.threshold, rel=0.02)


# Images of every kind


def test_types_agree():
    image = counts(with_stars(noise(level=100, std=5), 20, 1000), np.uint8)
    results = [run(image.astype(dtype)) for dtype in (np.uint8, np.uint16, np.float32)]
    for other in results[1:]:
        # A float image is taken to be rounded more finely, which changes the clipping a little:
        # 2 % of the noise.
        np.testing.assert_allclose(other.smoothed, results[0].smoothed, atol=0.1)
        assert other.noise == pytest.approx(results[0].noise, rel=0.02)
        assert np.mean(mask(other) != mask(results[0])) < 1e-4


def test_either_byte_order_reads_the_same():
    image = counts(noise())
    swapped = image.astype(">u2")
    assert np.array_equal(run(image).smoothed, run(swapped).smoothed)


def test_the_image_is_not_changed():
    image = with_stars(noise(), 20, 20_000).astype(np.float32)
    image[3, 3], image[4, 9] = np.nan, 60_000
    before = image.copy()
    run(image)
    assert np.array_equal(image, before, equal_nan=True)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e20])
def test_missing_pixels_count_as_background(bad: float):
    image = noise().astype(np.float32)
    reference = run(image)
    image[::16, ::16] = bad  # 1,024 pixels, a quarter of them among the samples of the cells
    image[200:230, 100:140] = bad
    pre = run(image)
    assert np.isfinite(pre.smoothed).all()
    assert pre.background == pytest.approx(reference.background, abs=1)
    assert pre.noise == pytest.approx(reference.noise, rel=0.03)
    # Background with its noise of 20, within three sigmas: without it, the noise would be too low.
    assert np.abs(pre.image[200:230, 100:140]).max() < 3.2 * 20
    assert np.std(pre.image[200:230, 100:140]) == pytest.approx(20, rel=0.1)
    assert mask(pre).mean() < 4 * norm.sf(4)
    # Single pixels hide nothing around them; an area, and what smoothing mixes with it, does.
    assert pre.blind is not None
    there = np.argwhere(pre.blind)
    assert (there.min(axis=0).tolist(), there.max(axis=0).tolist()) == ([195, 95], [234, 144])


def test_half_an_image_of_one_value_is_no_sky_and_leaves_the_noise_as_it_is():
    image = counts(noise())
    reference = run(image)
    assert reference.blind is None
    for value in (0, 65535):
        image[100:] = value
        pre = run(image)
        assert pre.noise == pytest.approx(reference.noise, rel=0.05)
        assert pre.blind is not None
        assert np.array_equal(np.flatnonzero(pre.blind.all(axis=1)), np.arange(95, len(image)))
        assert not pre.veiled


@pytest.mark.parametrize(
    ("bad", "what"),
    [
        *((bad, "a finite number") for bad in (np.nan, np.inf, -np.inf)),
        (3e38, "below 1e15, as DN are"),
    ],
)
def test_an_image_without_a_usable_pixel_is_refused(bad: float, what: str):
    with pytest.raises(ValueError, match=f"^no pixel of the image is {what}$"):
        run(np.full((32, 32), bad, np.float32))


@pytest.mark.parametrize("preset", ["robust", "paper_opencv", "paper_matlab"])
@pytest.mark.parametrize(
    ("dtype", "value"),
    [(np.uint8, 0), (np.uint8, 255), (np.uint16, 65535), (np.float32, 0), (np.float32, -7.25)],
)
def test_an_image_of_one_value_has_no_object_and_a_noise(preset: str, dtype, value: float):
    pre = preprocess(np.full((80, 64), value, dtype), Parameters.preset(preset))
    assert not mask(pre).any()
    assert pre.background == value
    assert (pre.pixel_noise > 0, pre.noise > 0) == (True, True)
    assert np.isfinite(pre.noise_ratio).all()
    assert pre.noise_ratio.min() > 0
    if dtype is not np.float32:
        # What rounding leaves: 1 DN / sqrt(12), and of that, smoothed.
        assert pre.pixel_noise == pytest.approx(1 / math.sqrt(12), rel=1e-5)
        assert pre.noise == pytest.approx(SMOOTHED / math.sqrt(12), rel=1e-3)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_stars_on_a_black_sky_without_noise_are_found(dtype):
    """As compressed video has it."""
    image = np.zeros((256, 256))
    centres = [(40.3, 50.1), (128.0, 200.5), (220.7, 90.2)]
    for x, y in centres:
        image += integrated_star(x, y, 1.0, 1200, image.shape)
    image = np.rint(image).astype(dtype)
    pre = run(image)
    assert pre.background == 0
    assert 0 < pre.noise < 1
    near = np.zeros(image.shape, bool)
    for x, y in centres:
        assert mask(pre)[round(y), round(x)] == 1
        near[round(y) - 7 : round(y) + 8, round(x) - 7 : round(x) + 8] = True
    assert not mask(pre)[~near].any()


@pytest.mark.parametrize("shape", [(16, 16), (16, 500), (17, 31), (65, 63), (200, 97)])
@pytest.mark.parametrize("background", ["mesh", "none"])
def test_images_of_any_size(shape: tuple[int, int], background: str):
    image = noise(shape, seed=8)
    x, y = shape[1] // 2, shape[0] // 2
    image += integrated_star(x, y, 1.0, 6000, shape)
    pre = run(counts(image), background=background)
    assert mask(pre).shape == shape
    assert mask(pre)[y, x] == 1
    # 256 pixels know their noise to 5 %, and the star is among them.
    assert pre.pixel_noise == pytest.approx(20, rel=0.2)
    assert pre.background == pytest.approx(1000, abs=5)


def test_a_view_with_strides_is_read_as_a_copy():
    image = counts(noise((600, 700)))
    view = image[::2, 100:612]
    assert np.array_equal(mask(run(view)), mask(run(view.copy())))


def test_half_the_image_saturated():
    image = noise()
    image[:, :256] = 65535
    pre = run(counts(image))
    assert np.isfinite(pre.smoothed).all()
    right = mask(pre)[:, 330:]
    assert right.mean() < 4 * norm.sf(4)


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_a_float_image_may_have_any_unit(scale: float):
    image = with_stars(noise(), 30, 3000).astype(np.float32)
    plain, scaled = run(image), run(image * np.float32(scale))
    assert np.mean(mask(plain) != mask(scaled)) < 1e-4
    assert scaled.noise == pytest.approx(plain.noise * scale, rel=1e-3)


# What the sensor shows in every frame

SENSOR = (128, 128)
# Rows and columns on a grid; none touches another or the border.
GRID = tuple(axis.ravel() for axis in np.mgrid[12:128:15, 12:128:15])


def remember(
    static: np.ndarray,
    frames: int,
    memory: SensorMemory | None = None,
    seed: int = 1,
    passing=None,
) -> tuple[SensorMemory, Preprocessed]:
    """Show a memory frames of a fixed pattern and noise; return the last preprocessed."""
    memory = memory or SensorMemory()
    for number in range(frames):
        image = noise(static.shape, seed=1000 * seed + number) + static
        if passing is not None:
            image += passing(number)
        pre = preprocess(counts(image), Parameters(), memory)
    return memory, pre


def pattern(*pixels: tuple[int, int, float]) -> np.ndarray:
    """At each place of the grid, pixels one step (dy, dx) away hold this many DN."""
    image = np.zeros(SENSOR)
    for dy, dx, value in pixels:
        image[GRID[0] + dy, GRID[1] + dx] = value
    return image


def field(sigma: float, flux: float, spacing: int = 25, shift: tuple[float, float] = (0, 0)):
    """Point sources at all phases within the pixel, on a grid that has moved."""
    image = np.zeros(SENSOR)
    places = np.arange(20, 105, spacing)
    for i, x in enumerate(places):
        for j, y in enumerate(places):
            sx, sy = x + i / len(places) + shift[0], y + j / len(places) + shift[1]
            image += integrated_star(sx, sy, sigma, flux, SENSOR)
    return image


def test_the_memory_finds_hot_pixels_too_faint_for_one_frame():
    """3 sigmas a frame: over 6 sigmas of the mean from the fifth frame on, surely by the 16th."""
    hot = pattern((0, 0, 60))
    _, first = remember(hot, 1)
    assert first.defects == 0
    assert first.image[GRID].mean() == pytest.approx(60, abs=7)
    _, last = remember(hot, 16)
    assert 0.97 * len(GRID[0]) <= last.defects <= 1.03 * len(GRID[0])
    # Medians of eight neighbours stand there now: 20 DN of noise over some 2.3.
    assert last.image[GRID].mean() == pytest.approx(0, abs=4)
    assert last.image[GRID].std() < 12
    # What is no defect stays as it is.
    untouched = np.ones(SENSOR, bool)
    untouched[GRID] = False
    plain = run(counts(noise(SENSOR, seed=1015) + hot))
    assert np.count_nonzero(last.image[untouched] != plain.image[untouched]) <= 3


@pytest.mark.parametrize("second", [(0, 1), (1, 0), (1, 1), (-1, 1)])
@pytest.mark.parametrize("level", [200, 20_000])
def test_the_memory_finds_pairs_of_hot_pixels(second: tuple[int, int], level: float):
    """Neither stands alone, so that one frame by itself would keep them."""
    pair = pattern((0, 0, level), (*second, 0.9 * level))
    alone = run(counts(noise(SENSOR) + pair))
    assert alone.image[GRID].mean() > 0.9 * level
    _, pre = remember(pair, 8)
    assert pre.defects == pytest.approx(2 * len(GRID[0]), rel=0.03)
    there = pre.image[pair > 0]
    # Of the median's eight neighbours one is the other of the pair: it stands for less noise.
    assert there.mean() == pytest.approx(0, abs=10)
    assert there.max() < 4 * 20


def test_the_memory_finds_what_leaks_from_a_saturated_pixel():
    """0.5 % of the charge, in the pixel that is read out next: 15 sigmas; and 0.15 % sideways."""
    leak = pattern((0, 0, 64_000), (1, 0, 300), (0, 1, 100))
    alone = run(counts(noise(SENSOR) + leak))
    assert alone.image[GRID[0] + 1, GRID[1]].mean() > 250
    _, pre = remember(leak, 8)
    for dy, dx in ((0, 0), (1, 0), (0, 1)):
        assert pre.image[GRID[0] + dy, GRID[1] + dx].mean() == pytest.approx(0, abs=10)
        assert pre.image[GRID[0] + dy, GRID[1] + dx].max() < 4 * 20
    assert 3 * len(GRID[0]) <= pre.defects <= 3.1 * len(GRID[0])


@pytest.mark.parametrize("sigma", [0.8, 1.0, 1.4, 2.0])
@pytest.mark.parametrize("peak_sigmas", [3, 30, 1000])
@pytest.mark.parametrize("stars", ["none", "points", "streaks"])
def test_a_source_that_stands_still_in_the_sensor_is_no_defect(
    sigma: float, peak_sigmas: float, stars: str
):
    """An RSO in rate tracking, and every star in sidereal tracking."""
    unit = field(sigma, 1)
    still = peak_sigmas * 20 * unit / unit.max()

    def passing(number: int) -> np.ndarray:
        light = np.zeros(SENSOR)
        for step in range(8 if stars == "streaks" else 1):
            x = (37 * number + 9) % 128 + step
            y = (23 * number + 61) % 128 + step / 2
            light += integrated_star(x, y, sigma, 40_000, SENSOR)
        return light

    _, pre = remember(still, 12, passing=None if stars == "none" else passing)
    # The mean's own noise may make a pixel of a faint wide one stand out.
    assert pre.defects <= (1 if peak_sigmas == 3 else 0)
    # And nothing else takes a part of it.
    assert pre.image[still > 0.8 * still.max()].mean() > 0.7 * still.max()


def test_hot_pixels_are_found_among_stars_that_pass():
    hot = pattern((0, 0, 100))
    _, pre = remember(hot, 20, passing=lambda k: field(1.0, 4000, shift=(1.7 * k - 17, 0.9 * k)))
    there = pre.image[GRID]
    # Those in the trail of a star may have to wait.
    assert np.mean(there < 60) > 0.8
    assert pre.defects > 0.8 * len(GRID[0])


def test_a_cosmic_ray_is_forgotten():
    """One of 20 sigmas is a defect for that frame at most: the mean has lost it in the next."""
    memory = SensorMemory()
    struck = np.zeros(SENSOR)
    struck[60, 60:63] = 400
    remember(np.zeros(SENSOR), 10, memory)
    remember(struck, 1, memory, seed=2)
    _, pre = remember(np.zeros(SENSOR), 40, memory, seed=3)
    assert pre.defects == 0
    plain = run(counts(noise(SENSOR, seed=3039)))
    assert np.array_equal(pre.image, plain.image)


def test_another_size_starts_afresh():
    memory, pre = remember(pattern((0, 0, 100)), 12)
    assert pre.defects >= 60
    _, other = remember(np.zeros((128, 130)), 1, memory)
    assert other.defects == 0
    # And back again: what was learned is gone.
    _, back = remember(np.zeros(SENSOR), 1, memory)
    assert back.defects == 0


def test_the_memory_is_of_the_background_subtracted():
    """Another background, another exposure: the pattern stays what it was."""
    memory, _ = remember(pattern((0, 0, 100)), 8)
    for level in (200, 9000):
        image = counts(noise(SENSOR, level=level) + pattern((0, 0, 100)))
        assert preprocess(image, Parameters(), memory).defects == pytest.approx(64, abs=3)


def test_hot_pixels_are_kept_where_that_is_asked_for():
    memory = SensorMemory()
    image = counts(noise(SENSOR) + pattern((0, 0, 500)))
    for _ in range(5):
        pre = preprocess(image, Parameters(hot_pixels="keep"), memory)
    assert pre.defects == 0
    assert pre.image[GRID].mean() == pytest.approx(500, abs=10)
    assert run(image).defects == 0


def test_the_memory_does_not_change_the_image():
    memory = SensorMemory()
    image = (noise(SENSOR, level=0) + pattern((0, 0, 300))).astype(np.float32)
    before = image.copy()
    for _ in range(3):
        first, last = memory.begin(image.shape, 20.0, np.dtype(np.uint16))
        for row in range(first, last, 40):
            memory.add(image[row : row + 40], row)
        # and what is beside them, over 6 sigmas by chance
        assert {*memory.finish().tolist()} >= {*np.ravel_multi_index(GRID, SENSOR).tolist()}
    assert np.array_equal(image, before)
