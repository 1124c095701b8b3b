# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Lucas-Kanade against closed-form motion, and the dense engine against a slow reference."""

import dataclasses

import numpy as np
import pytest
from blobs import blobs, camera, flux_of_snr, scattered
from sky import regions_of

from ofsat_ros.optical_flow import (
    DenseLucasKanade,
    Flow,
    FlowInput,
    SparseLucasKanade,
    flow_engine,
    sparse,
)
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline

# A star of PSF sigma 1 px after the smoothing by 1 px.
WIDTH = np.sqrt(2)
SHAPE = (160, 200)
ENGINES = ("sparse", "dense")
STILL = np.zeros((1, 2))


def flow_input(smoothed, xy, noise=1.0, length=0.0, threshold=4.0, pedestal=0.0):
    """What the earlier stages would give, built from what is known; labels by nearest object."""
    xy = np.reshape(xy, (-1, 2)).astype(float)
    mask = (smoothed > threshold * noise).astype(np.uint8)
    labels = np.zeros(smoothed.shape, np.int32)
    y, x = np.nonzero(mask)
    if len(xy):
        labels[y, x] = 1 + np.argmin(
            np.hypot(x[:, None] - xy[:, 0], y[:, None] - xy[:, 1]), axis=1
        )
    return FlowInput(
        smoothed=smoothed.astype(np.float32),
        above=np.flatnonzero(mask),
        pedestal=pedestal,
        regions=regions_of(labels),
        xy=xy,
        sigma=np.full_like(xy, 0.01),
        length=np.full(len(xy), float(length)),
        noise=noise,
    )


def star_inputs(shift, flux=1500.0, streak=(0.0, 0.0), seed=1, spacing=28):
    """Two noiseless frames of stars that moved by `shift`, which end at known places."""
    shift = np.asarray(shift, float)
    before = scattered(np.random.default_rng(seed), SHAPE, spacing)
    frames = [blobs(SHAPE, xy, flux, WIDTH, streak) for xy in (before, before + shift)]
    length = np.hypot(*streak)
    return (
        flow_input(frames[0], before, length=length),
        flow_input(frames[1], before + shift, length=length),
    )


def measure(inputs, guesses=STILL, preset="robust", **changes):
    engine = flow_engine(Parameters.preset(preset, **changes))
    return engine.measure(*inputs, np.asarray(guesses, float))


def in_both_frames(position, shift, margin):
    """Whether objects lie `margin` inside the image, before and after they moved by `shift`."""
    limit = np.array(SHAPE[::-1]) - 1 - margin
    ends = (position, position - shift)
    return np.all([np.all((xy > margin) & (xy < limit), axis=1) for xy in ends], axis=0)


def texture(rng, shape, shift=(0.0, 0.0), shortest_px=8.0):
    """Periodic random texture without waves shorter than `shortest_px`, moved exactly."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None]
    spectrum = np.fft.fft2(rng.normal(size=shape)) * (np.hypot(fx, fy) < 1 / shortest_px)
    moved = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * (fx * shift[0] + fy * shift[1]))).real
    return 100 + 50 * moved / moved.std()


# --- closed-form motion -----------------------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "shift", [(0, 0), (0.1, 0), (0.25, -0.4), (0.5, 0.5), (-0.73, 0.31), (1.0, -1.0), (1.6, 0.9)]
)
def test_blobs_moved_by_known_subpixel_amounts(engine, shift):
    flow = measure(star_inputs(shift), engine=engine)
    assert flow.valid.all()
    assert len(flow) >= 30
    error = flow.displacement - shift
    # Without noise what is left is method: rounding to 8 bits (sparse), interpolation (dense).  It
    # is a tenth of what noise does at SNR 20, 0.13 px, and must not be the same for all stars.
    assert np.abs(error).max() < 0.03
    assert np.abs(error.mean(axis=0)).max() < 0.005


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("shift", [(0.3, -0.2), (2.4, 1.7), (5.3, -3.1), (19.6, 7.2), (0, -41.5)])
def test_with_a_first_guess_any_motion_is_measured(engine, shift):
    guess = np.rint([shift])
    flow = measure(star_inputs(shift), guess, engine=engine)
    inside = in_both_frames(flow.position, shift, 6)
    assert inside.sum() > 15
    assert flow.valid[inside].all()
    # as above, and the blob's other sub-pixel place
    assert np.abs(flow.displacement - shift)[inside].max() < 0.03


@pytest.mark.parametrize(
    ("preset", "changes", "sees", "does_not_see"),
    [
        # a star must lie within the window, or within that of the third pyramid level
        ("robust", {"engine": "sparse", "pyramid_levels": 0}, (2.0, 1.0), (9.0, 0.0)),
        ("robust", {"engine": "sparse"}, (8.0, 3.0), (60.0, 0.0)),
        # two pyramid levels: four times the star's own width
        ("robust", {"engine": "dense"}, (3.0, 2.0), (14.0, 0.0)),
        # one derivative, no pyramid
        ("robust", {"engine": "dense", "dense_pyramid_levels": 0, "dense_iterations": 1},
         (0.5, 0.3), (6.0, 0.0)),
        # three pyramid levels and a window of 21 px
        ("paper_opencv", {}, (8.0, 3.0), (60.0, 0.0)),
        ("paper_matlab", {}, (0.5, 0.3), (6.0, 0.0)),
    ],
)  # fmt: skip
def test_range_of_motion_without_a_first_guess(preset, changes, sees, does_not_see):
    def median_error(shift):
        flow = measure(star_inputs(shift, spacing=40), preset=preset, **changes)
        good = flow.valid
        return np.hypot(*np.median(flow.displacement[good] - shift, axis=0)) if any(good) else 9

    # 0.1 px is what the star field's motion is wanted to
    assert median_error(sees) < 0.1
    assert median_error(does_not_see) > 1


def test_derivatives_alone_end_at_about_a_pixel():
    once = {"engine": "dense", "dense_pyramid_levels": 0, "dense_iterations": 1}
    for shift, worst in ((0.25, 0.03), (0.5, 0.05), (0.75, 0.1)):
        flow = measure(star_inputs((shift, 0)), **once)
        assert np.abs(np.median(flow.displacement, axis=0) - (shift, 0)).max() < worst
    # a first guess takes the whole pixels away, and derivatives see the rest again
    flow = measure(star_inputs((6.3, -3.2)), [(6, -3)], **once)
    assert np.median(flow.displacement[flow.valid], axis=0) == pytest.approx((6.3, -3.2), abs=0.05)


@pytest.mark.parametrize("shift", [(0.2, 0.1), (-0.45, 0.6), (1.3, -0.7)])
def test_textured_patch_dense(shift):
    images = [texture(np.random.default_rng(3), (96, 128), s) for s in ((0, 0), shift)]
    engine = DenseLucasKanade(Parameters.preset("robust", engine="dense"))
    velocity, solved = engine.velocity_map(*np.float32(images), 0.1, 0.1, np.zeros(2))
    inner = np.s_[12:-12, 12:-12]
    assert solved[inner].all()
    error = (velocity - np.float32(shift))[inner]
    # A window of 5 px on waves of 8 px and more: many windows hold nearly straight waves, whose
    # second eigenvalue is small, and there what iteration has not finished is largest.
    assert np.abs(np.median(error, axis=(0, 1))).max() < 0.01
    assert np.median(np.abs(error)) < 0.025
    assert np.percentile(np.abs(error), 95) < 0.15


@pytest.mark.parametrize("shift", [(0.2, 0.1), (-0.45, 0.6), (1.3, -0.7), (4.4, -3.3)])
def test_textured_patch_sparse(shift):
    images = [texture(np.random.default_rng(3), (96, 128), s) for s in ((0, 0), shift)]
    inputs = [flow_input(image, [(64, 48)], threshold=-1e9) for image in images]
    flow = measure(inputs, preset="paper_opencv")
    inner = np.all((flow.position > 15) & (flow.position < (112, 80)), axis=1)
    assert inner.sum() > 20
    assert flow.valid[inner].all()
    # A window of 21 px holds many waves; 8 bits over the whole range round to 0.4 % of it.
    assert np.abs(flow.displacement - shift)[inner].max() < 0.05


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("length", [5, 10, 20])
def test_streaks_move_along_themselves(engine, length):
    """The aperture problem: only a streak's ends show motion along it."""
    direction = np.array([0.8, 0.6])
    shift = (length + 1.3) * direction
    inputs = star_inputs(shift, flux=60.0 * (length + 3), streak=length * direction, spacing=48)
    flow = measure(inputs, [np.rint(shift)], engine=engine)
    far = in_both_frames(flow.position, shift, length)
    assert far.sum() >= 2
    error = (flow.displacement - shift)[far]
    # Across the streak as for a point.  Along it the dense engine's window of 5 px sees motion at
    # the two ends only, so that its median keeps what the first guess left.
    assert np.abs(error @ (-0.6, 0.8)).max() < 0.05
    assert np.abs(error @ direction).max() < (0.1 if engine == "sparse" else 0.7)


# --- noise ------------------------------------------------------------------------------------


def noisy_errors(snr, dtype, seeds=3, shift=(0.37, -0.61), **changes):
    """Errors of stars of PSF sigma 1, and the same over their stated sigma, (N, 2) each."""
    noise = {np.uint8: 3, np.uint16: 10}[dtype]
    errors, normalised = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        before = scattered(rng, (256, 256), 20)
        flux = flux_of_snr(snr, noise, 1.0)
        pipeline = Pipeline(Parameters.preset("robust", **changes))
        for k, xy in enumerate((before, before + shift)):
            result = pipeline.process(camera(blobs((256, 256), xy, flux, 1.0), rng, dtype), k)
        flow = result.flow
        near = np.hypot(*(flow.position[:, None] - before - shift).transpose(2, 0, 1)).min(axis=1)
        good = flow.valid & (near < 2)
        assert good.sum() > 0.95 * len(before)
        error = flow.displacement[good] - shift
        errors.append(error)
        normalised.append(error / flow.sigma[good])
    return np.concatenate(errors), np.concatenate(normalised)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("snr", [10, 20, 50])
def test_scatter_is_what_noise_allows_and_what_sigma_says(engine, dtype, snr):
    errors, normalised = noisy_errors(snr, dtype, engine=engine)
    # The Cramer-Rao bound of the difference of two centroids of PSF sigma s is 2 s / SNR on each
    # axis.  Least squares on images smoothed by k gives (s^2+k^2)^2 / (s^2 (s^2+2k^2)) = 4/3 of
    # it, with s = k = 1; 15 % and 0.02 px for rounding and the grid.
    assert errors.std() < 1.15 * (4 / 3) * 2 / snr + 0.02
    # nearly 500 stars: no bias beyond noise and a fiftieth of a pixel
    assert np.abs(errors.mean(axis=0)).max() < 0.02 + 3 * errors.std() / np.sqrt(len(errors))
    assert 0.7 < normalised.std() < 1.35


# --- the dense engine's solution --------------------------------------------------------------


def slow_reference(before, now, limit):
    """Equation 3 of AAS 21-364, pixel by pixel: velocity and the number of eigenvalues used."""
    height, width = now.shape
    weights = np.array([1, 4, 6, 4, 1]) / 16
    derivative = np.array([1, -8, 0, 8, -1]) / 12
    middle = np.pad((before + now) / 2, 2, mode="reflect")
    gradients = np.zeros((height, width, 3))
    for y in range(height):
        for x in range(width):
            along_x = sum(derivative[k] * middle[y + 2, x + k] for k in range(5))
            along_y = sum(derivative[k] * middle[y + k, x + 2] for k in range(5))
            gradients[y, x] = along_x, along_y, now[y, x] - before[y, x]
    padded = np.pad(gradients, ((2, 2), (2, 2), (0, 0)), mode="reflect")
    velocity, used = np.zeros((height, width, 2)), np.zeros((height, width), int)
    for y in range(height):
        for x in range(width):
            matrix, right = np.zeros((2, 2)), np.zeros(2)
            for j in range(5):
                for i in range(5):
                    ix, iy, it = padded[y + j, x + i]
                    weight = weights[j] * weights[i]
                    matrix += weight * np.array([[ix * ix, ix * iy], [ix * iy, iy * iy]])
                    right -= weight * np.array([ix * it, iy * it])
            values, vectors = np.linalg.eigh(matrix)
            for value, vector in zip(values, vectors.T, strict=True):
                if value > limit:
                    velocity[y, x] += vector * (vector @ right) / value
                    used[y, x] += 1
    return velocity, used


def test_dense_equals_the_slow_reference():
    shape, noise, threshold = (40, 36), 1.0, 4.0
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: shape[0], : shape[1]]

    def frame(dx, dy):
        star = 80 * np.exp(-((x - 12 - dx) ** 2 + (y - 9 - dy) ** 2) / 4)
        edge = 40 / (1 + np.exp(-(y - 28 - dy - 0.05 * x) / 0.8))
        return np.float32(star + edge + rng.normal(0, 0.05, shape))

    before, now = frame(0, 0), frame(0.4, -0.3)
    parameters = Parameters.preset("paper_matlab", dense_noise_threshold=threshold)
    velocity, solved = DenseLucasKanade(parameters).velocity_map(
        before, now, noise, noise, np.zeros(2)
    )
    # noise smoothed by 1 px, halved by the mean of two frames: eigenvalue noise^2 / 4
    expected, used = slow_reference(before.astype(float), now.astype(float), threshold / 4)
    assert [np.count_nonzero(used == n) > 50 for n in (0, 1, 2)] == [True] * 3
    np.testing.assert_array_equal(solved, used > 0)
    assert not velocity[used == 0].any()
    # float32 against float64: rounding of 1e-7 grows with the ratio of the eigenvalues
    np.testing.assert_allclose(velocity, expected, atol=2e-4)


def test_dense_one_eigenvalue_gives_the_component_along_the_gradient():
    y, x = np.mgrid[:40, :40]
    normal, shift = np.array([0.6, 0.8]), np.array([0.3, 0.1])

    def edge(offset):
        return np.float32(50 * np.tanh(((x - 20) * 0.6 + (y - 20) * 0.8 - offset) / 3))

    engine = DenseLucasKanade(Parameters.preset("paper_matlab"))
    velocity, solved = engine.velocity_map(edge(0), edge(shift @ normal), 1.0, 1.0, np.zeros(2))
    assert solved[20, 20]
    # the tangent of the edge shows no motion; 1 % for the curvature of tanh over 0.26 px
    assert velocity[20, 20] == pytest.approx((shift @ normal) * normal, rel=0.01, abs=1e-4)


def test_dense_flat_images_have_no_flow():
    engine = DenseLucasKanade(Parameters.preset("robust", engine="dense"))
    flat = np.full((48, 64), 7, np.float32)
    velocity, solved = engine.velocity_map(flat, flat, 1.0, 1.0, np.array([3.0, -2.0]))
    assert velocity.shape == (48, 64, 2)
    assert not solved.any()
    assert not velocity.any()


# --- targets ----------------------------------------------------------------------------------


def test_sparse_native_targets_are_corners_of_the_previous_frame():
    shift = np.array([3.4, -1.8])
    inputs = star_inputs(shift, spacing=40)
    flow = measure(inputs, preset="paper_opencv")
    assert flow.valid.all()
    before = flow.position - flow.displacement
    # one corner at the brightest pixel of each star, none elsewhere
    distance = np.hypot(*(before[:, None] - inputs[0].xy).transpose(2, 0, 1))
    assert (distance.min(axis=1) < 1).all()
    assert sorted(distance.argmin(axis=1)) == list(range(len(inputs[0].xy)))
    # the masked image has an edge around each star, which 8 bits move by up to a step
    assert np.abs(flow.displacement - shift).max() < 0.15
    np.testing.assert_array_equal(flow.object_index, distance.argmin(axis=1))


def test_sparse_native_corners_are_limited_in_number_quality_and_distance():
    inputs = star_inputs((0, 0), flux=np.array([300.0] * 3 + [60.0] * 27))
    assert len(measure(inputs, preset="paper_opencv", max_corners=2)) == 2
    bright = measure(inputs, preset="paper_opencv", corner_quality=0.5)
    assert sorted(bright.object_index) == [0, 1, 2]
    apart = measure(inputs, preset="paper_opencv", corner_distance_px=60)
    distance = np.hypot(*(apart.position[:, None] - apart.position).transpose(2, 0, 1))
    assert distance[distance > 0].min() > 55


def test_dense_native_targets_are_regions_of_the_map_of_speeds(monkeypatch):
    velocity = np.zeros((30, 40, 2), np.float32)
    solved = np.ones((30, 40), bool)
    velocity[5, 10:13] = (1, 0), (3, 0), (0, 8)  # speeds 1, 3, 8
    velocity[20:22, 30:32] = [[(3, 4), (-3, 4)], [(6, 8), (0, 1)]]  # speeds 5, 5, 10, 1
    velocity[15, 5] = (0.05, 0.05)  # too slow
    velocity[25, 5] = (2, 2)  # not solved
    velocity[10, 20] = (2, 2)  # below the threshold of the image
    velocity[2, 2] = (0, -2)
    solved[25, 5] = False
    current = flow_input(np.full((30, 40), 9.0), [(11, 5), (30.5, 20.5)])
    labels = np.zeros((30, 40), np.int32)
    labels[5, 10:13], labels[20:22, 30:32] = 1, 2
    above = np.setdiff1d(current.above, [10 * 40 + 20])
    current = dataclasses.replace(current, above=above, regions=regions_of(labels))
    engine = DenseLucasKanade(Parameters.preset("paper_matlab"))
    monkeypatch.setattr(engine, "velocity_map", lambda *_: (velocity, solved))
    flow = engine.measure(current, current, STILL)

    assert flow.valid.all()
    assert flow.position.tolist() == [[2, 2], [11, 5], [30.5, 20.5]]
    assert flow.object_index.tolist() == [-1, 0, 1]
    # medians of (1, 3, 0) and (0, 0, 8); of (3, -3, 6, 0) and (4, 4, 8, 1)
    assert flow.displacement.tolist() == [[0, -2], [1, 0], [1.5, 4]]
    assert flow.speed_mean.tolist() == [2, 4, 5.25]
    assert flow.speed_median.tolist() == [2, 3, 5]
    assert flow.speed_min.tolist() == [2, 1, 1]
    assert flow.speed_max.tolist() == [2, 8, 10]


def test_dense_object_targets_take_the_median_of_each_objects_pixels(monkeypatch):
    velocity = np.zeros((30, 40, 2), np.float32)
    solved = np.zeros((30, 40), bool)
    inputs = flow_input(np.full((30, 40), 9.0), [(10, 5), (30, 20)])
    labels = np.zeros((30, 40), np.int32)
    labels[5, 8:13], labels[20, 29:32] = 1, 2
    inputs = dataclasses.replace(inputs, regions=regions_of(labels))
    velocity[5, 8:12] = (1, 0), (2, 0), (3, 4), (99, 0)
    solved[5, 8:11] = True
    engine = DenseLucasKanade(Parameters.preset("robust", engine="dense"))
    monkeypatch.setattr(engine, "velocity_map", lambda *_: (velocity, solved))
    flow = engine.measure(inputs, inputs, STILL)
    # the second object has no solved pixel: no vector
    assert flow.valid.tolist() == [True, False]
    assert flow.displacement[0].tolist() == [2, 0]
    assert (flow.speed_mean[0], flow.speed_max[0]) == (pytest.approx(8 / 3), 5)
    assert flow.object_index.tolist() == [0, 1]
    np.testing.assert_array_equal(flow.position, inputs.xy)


# --- which vectors are measurements -----------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES)
def test_a_new_object_has_no_vector(engine):
    previous, current = star_inputs((0.4, 0.2))
    new = np.array([190.0, 150.0])
    image = current.smoothed + blobs(SHAPE, new, 300, WIDTH)
    flow = measure((previous, flow_input(image, [*current.xy, new])), engine=engine)
    assert flow.valid.tolist() == [True] * len(current.xy) + [False]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("ratio", "kept"), [(1.4, True), (0.7, True), (4, False), (0.25, False)])
def test_brightness_must_be_kept(engine, ratio, kept):
    before = blobs(SHAPE, (100.2, 80.4), 500, WIDTH)
    now = blobs(SHAPE, (100.5, 80.1), 500 * ratio, WIDTH)
    inputs = flow_input(before, [(100.2, 80.4)]), flow_input(now, [(100.5, 80.1)])
    assert measure(inputs, engine=engine).valid.tolist() == [kept]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_star_from_outside_the_image_has_no_vector(engine):
    shift = np.array([12.0, 0.0])
    before, now = np.array([[-6.0, 60], [80, 60]]), np.array([[6.0, 60], [92, 60]])
    inputs = [flow_input(blobs(SHAPE, xy, 300, WIDTH), xy) for xy in (before, now)]
    flow = measure(inputs, [shift], engine=engine)
    assert flow.valid.tolist() == [False, True]


@pytest.mark.parametrize("engine", ENGINES)
def test_each_object_takes_the_guess_that_fits_it(engine):
    """Rate tracking: the stars move by many pixels, the RSO stands still."""
    shift = np.array([17.3, -6.2])
    stars = scattered(np.random.default_rng(2), SHAPE, 36, margin=26)
    rso = np.array([100.3, 8.6])
    images = [blobs(SHAPE, [*xy, rso], 300, WIDTH) for xy in (stars, stars + shift)]
    inputs = [flow_input(images[0], [*stars, rso]), flow_input(images[1], [*(stars + shift), rso])]
    flow = measure(inputs, [shift, (0, 0)], engine=engine, rso_test="vector")
    inside = in_both_frames(flow.position[:-1], shift, 6)
    assert flow.valid[:-1][inside].all()
    assert flow.valid[-1]
    # 24 grey levels make a star of 24 sigmas: rounding moves it by a little more than a bright one
    assert np.abs(flow.displacement[-1]).max() < 0.05
    assert np.abs(flow.displacement[:-1] - shift)[inside].max() < 0.05


# --- tiles around objects instead of whole images ---------------------------------------------


def sizes_given_to_opencv(monkeypatch):
    """Record the pixels of the images that OpenCV follows points through."""
    sizes, follow = [], sparse.cv2.calcOpticalFlowPyrLK

    def recorded(start, *rest, **options):
        sizes.append(start.size)
        return follow(start, *rest, **options)

    monkeypatch.setattr(sparse.cv2, "calcOpticalFlowPyrLK", recorded)
    return sizes


@pytest.mark.parametrize("length", [0, 5, 10])
def test_tiles_give_what_whole_images_give(monkeypatch, length):
    """In noise, with a guess that is 1.5 px off, away from the border."""
    direction, shift = np.array([0.8, 0.6]), np.array([7.4, -3.7])
    rng = np.random.default_rng(length)
    inputs = star_inputs(shift, flux=500.0 + 60 * length, streak=length * direction, spacing=40)
    noisy = [
        dataclasses.replace(f, smoothed=f.smoothed + rng.normal(0, 1, SHAPE).astype(np.float32))
        for f in inputs
    ]
    sizes = sizes_given_to_opencv(monkeypatch)
    tiles = measure(noisy, [(8.5, -4.7)])
    monkeypatch.setattr(sparse, "_ROOM_PX", max(SHAPE))
    whole = measure(noisy, [(8.5, -4.7)])
    assert sizes[0] < SHAPE[0] * SHAPE[1] == sizes[1]
    np.testing.assert_array_equal(tiles.valid, whole.valid)
    inside = in_both_frames(tiles.position, shift, 10 + length) & tiles.valid
    assert inside.sum() >= 4
    # OpenCV's points are float32: 1e-5 px at 200 px, and the iteration may end a step sooner
    np.testing.assert_allclose(tiles.displacement[inside], whole.displacement[inside], atol=0.01)


@pytest.mark.parametrize("shift", [(0.4, 0.0), (0.0, -0.6), (0.5, 0.5), (6.3, 0.2)])
def test_objects_at_the_border_are_measured_as_others(shift):
    """Their windows reach over the border, their light does hardly."""
    places = np.array([[4.2, 80.3], [195.4, 40.6], [90.8, 4.4], [60.1, 155.3], [100.4, 80.2]])
    inputs = [flow_input(blobs(SHAPE, xy, 300, WIDTH), xy) for xy in (places - shift, places)]
    flow = measure(inputs, np.rint([shift]))
    seen = in_both_frames(flow.position, shift, 3)
    assert seen.sum() >= 3
    assert flow.valid[seen].all()
    assert np.abs(flow.displacement - shift)[seen].max() < 0.05


def test_the_work_depends_on_the_objects_not_on_the_pixels(monkeypatch):
    sizes = sizes_given_to_opencv(monkeypatch)
    for side in (400, 800):
        xy = np.array([[100.2, 50.4], [200.6, 120.3], [300.1, 350.7]])
        inputs = [flow_input(blobs((side, side), xy + d, 300, WIDTH), xy + d) for d in (0, 0.4)]
        assert measure(inputs).valid.all()
    assert len(sizes) == 2
    assert sizes[0] == sizes[1] < 4 * 30**2


def test_guesses_are_tried_until_one_is_the_fields(monkeypatch):
    inputs = star_inputs((0.4, -0.3))
    sizes = sizes_given_to_opencv(monkeypatch)
    flow = measure(inputs, [(60, 20), (0, 0)])
    assert flow.valid.all()
    # the wrong one alone, then each
    assert len(sizes) == 3
    # another star may stand where the wrong guess points
    right = np.abs(flow.displacement - (0.4, -0.3)).max(axis=1) < 0.03
    assert right.mean() > 0.9
    # the first guess is the field's: the second is not tried
    measure(inputs, [(0, 0), (60, 20)])
    assert len(sizes) == 4


# --- shapes, empties, interface ---------------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("targets", ["objects", "native"])
def test_no_objects_no_vectors(engine, targets):
    nothing = flow_input(np.zeros(SHAPE), [])
    flow = measure((nothing, nothing), engine=engine, flow_targets=targets)
    assert len(flow) == 0
    for item in dataclasses.fields(Flow):
        empty = getattr(Flow.empty(), item.name)
        assert getattr(flow, item.name).shape == empty.shape
        assert getattr(flow, item.name).dtype == empty.dtype


@pytest.mark.parametrize("engine", ENGINES)
def test_objects_in_the_current_frame_only(engine):
    previous, current = flow_input(np.zeros(SHAPE), []), star_inputs((0, 0))[1]
    flow = measure((previous, current), engine=engine)
    assert len(flow) == len(current.xy)
    assert not flow.valid.any()
    assert not flow.displacement.any()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("targets", ["objects", "native"])
@pytest.mark.parametrize("shape", [(16, 16), (17, 90)])
def test_small_images_are_no_special_case(engine, targets, shape):
    xy = np.array([[8.2, 7.9]])
    inputs = [flow_input(blobs(shape, xy + d, 300, WIDTH), xy + d) for d in (0, 0.5)]
    flow = measure(inputs, engine=engine, flow_targets=targets)
    assert flow.valid.tolist() == [True]
    # a region of the map of speeds ends where the star's image does, and 16 px hold little more
    assert flow.displacement[0] == pytest.approx((0.5, 0.5), abs=0.1)


@pytest.mark.parametrize("engine", ENGINES)
def test_inputs_are_left_alone(engine):
    inputs = star_inputs((0.3, 0.3))
    copies = [{k: np.copy(v) for k, v in vars(frame).items()} for frame in inputs]
    measure(inputs, engine=engine)
    for frame, copy in zip(inputs, copies, strict=True):
        for name, value in copy.items():
            np.testing.assert_array_equal(getattr(frame, name), value)


def test_the_parameter_names_the_engine():
    assert isinstance(flow_engine(Parameters(engine="sparse")), SparseLucasKanade)
    assert isinstance(flow_engine(Parameters(engine="dense")), DenseLucasKanade)


def test_single_vectors_are_their_own_statistics():
    pair = np.array([[3.0, 4.0], [0.0, -2.0]])
    flow = Flow.of_vectors(pair, pair, pair, np.ones(2, bool), np.arange(2))
    for name in ("speed_mean", "speed_median", "speed_min", "speed_max"):
        assert getattr(flow, name).tolist() == [5, 2]


def test_brightness_is_interpolated_and_continued_beyond_the_border():
    frame = flow_input(np.arange(12.0).reshape(3, 4), [])
    xy = np.array([[0, 0], [3, 2], [1.5, 1.0], [2.25, 0.5], [-5, 1], [1, 9]])
    assert frame.brightness_at(xy) == pytest.approx([0, 11, 5.5, 4.25, 4, 9])
    assert frame.brightness_at(np.zeros((0, 2))).shape == (0,)


def test_published_filtered_image_holds_the_background():
    image = np.zeros((32, 32))
    image[10:13, 10:13] = 50
    frame = flow_input(image, [(11, 11)], threshold=4.0, noise=1.0, pedestal=300.0)
    filtered = frame.filtered
    assert filtered[11, 11] == 350
    assert np.count_nonzero(filtered) == 9


def test_a_satellite_faster_than_the_window_is_found_with_the_pyramid():
    """12 px a frame among fixed stars, with a window of 9 px and no guess near."""
    stars = scattered(np.random.default_rng(4), SHAPE, 60)
    rso, step = np.array([[150.0, 110.0]]), np.array([12.0, -3.0])
    keep = np.hypot(*(stars - rso).T) > 40
    before, now = np.vstack([stars[keep], rso - step]), np.vstack([stars[keep], rso])
    inputs = [flow_input(blobs(SHAPE, xy, 1500.0, WIDTH), xy) for xy in (before, now)]
    flow = measure(inputs, rso_test="vector")
    assert flow.valid[-1]
    # The pyramid ends at the full image: as sharp as any other.
    np.testing.assert_allclose(flow.displacement[-1], step, atol=0.1)
    assert not measure(inputs, rso_test="vector", pyramid_levels=0).valid[-1]
    # Tests of more frames find it without its vector, and the stars' are there without pyramid.
    field_only = measure(inputs)
    assert field_only.valid[:-1].all()
    assert not field_only.valid[-1]
