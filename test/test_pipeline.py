# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The pipeline: order of stages, what is kept of the frames before, and reasons in words."""

import functools
import math
import re
from collections.abc import Iterator

import numpy as np
import pytest
from blobs import blobs, camera

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.parameters import Parameters, preset_names
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.tracking import COASTING, Settled

STEP_NS = 500_000_000
START_NS = 1_767_225_600_123_456_789
SIZE = 256
FIRST = "no previous frame to compare with: "


class Scene:
    """Blobs of sigma 1.2 px on a noisy sky, stars and RSOs with constant velocities, px/frame."""

    def __init__(
        self, star_step: tuple[float, float], rso_steps: list[tuple[float, float]], seed: int = 1
    ) -> None:
        random = np.random.default_rng(seed)
        # A jittered grid, so that no two blobs touch.
        grid = np.stack(np.meshgrid(np.arange(7), np.arange(7)), axis=-1).reshape(-1, 2)
        self.stars = 22 + 34 * grid + random.uniform(-4, 4, grid.shape)
        self.star_flux = random.uniform(8_000, 60_000, len(grid))
        self.star_step = np.array(star_step, float)
        self.rsos = np.array([(39.0, 73.0), (141.0, 175.0), (209.0, 107.0)])[: len(rso_steps)]
        self.rso_steps = np.array(rso_steps, float).reshape(-1, 2)
        self.seed = seed

    def rsos_at(self, frame: int) -> np.ndarray:
        return self.rsos + frame * self.rso_steps

    @functools.cache  # noqa: B019 (a handful of scenes)
    def image(self, frame: int) -> np.ndarray:
        """float64, DN: background 3,000, noise 40; stars of peak SNR 20 to 160."""
        places = np.concatenate([self.stars + frame * self.star_step, self.rsos_at(frame)])
        flux = np.concatenate([self.star_flux, np.full(len(self.rsos), 30_000)])
        y, x = np.arange(SIZE)[None, :, None], np.arange(SIZE)[None, None, :]
        dx, dy = x - places[:, 0, None, None], y - places[:, 1, None, None]
        spots = np.exp(-(dx**2 + dy**2) / (2 * 1.2**2)) / (2 * math.pi * 1.2**2)
        random = np.random.default_rng((self.seed, frame))
        return 3000 + np.tensordot(flux, spots, 1) + random.normal(0, 40, (SIZE, SIZE))


SIDEREAL = Scene((0, 0), [(2.5, 1.0), (-1.5, 2.0), (0.4, -3.0)])
RATE = Scene((2.2, -1.4), [(0, 0), (0, 0), (0, 0)])
SURVEY = Scene((1.5, 0.8), [(-1.5, 1.0), (3.5, 2.0), (1.5, -2.2)])


def as16(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 65535).astype(np.uint16)


def stamp(frame: int) -> int:
    return START_NS + frame * STEP_NS


def run(scene: Scene, count: int = 4, **changes) -> list[FrameResult]:
    pipeline = Pipeline(Parameters.preset(**changes))
    return [pipeline.process(as16(scene.image(i)), stamp(i)) for i in range(count)]


def two_frames(**changes) -> Pipeline:
    """Return a pipeline that compares two frames and says at once what it found."""
    return Pipeline(Parameters(rso_test="vector", **changes))


def rows_of(truth: np.ndarray, detections: np.ndarray) -> np.ndarray:
    """Return the detections in the order of the truth, which they all are, and no others."""
    order = [
        np.argmin(np.hypot(detections["x"] - x, detections["y"] - y)) if len(detections) else -1
        for x, y in truth
    ]
    assert sorted(order) == list(range(len(truth))) == list(range(len(detections)))
    return detections[order]


def columns(table: np.ndarray, first: str, second: str) -> np.ndarray:
    return np.stack([table[first], table[second]], axis=1)


def assert_same(one: FrameResult, other: FrameResult) -> None:
    """All but the times that the stages took."""
    for name in ("stamp_ns", "frame", "shape", "dt_s", "reset", "reason", "noise", "threshold"):
        np.testing.assert_equal(getattr(one, name), getattr(other, name), err_msg=name)
    # As bytes, since NaN differs from itself.
    assert one.objects.tobytes() == other.objects.tobytes()
    assert one.detections.tobytes() == other.detections.tobytes()
    for name, values in vars(one.flow).items():
        np.testing.assert_array_equal(values, getattr(other.flow, name), err_msg=name)


# What is found


SCENES = pytest.mark.parametrize(
    "scene", [SIDEREAL, RATE, SURVEY], ids=["sidereal", "rate", "survey"]
)
ENGINES = pytest.mark.parametrize("engine", ["sparse", "dense"])


@SCENES
@ENGINES
def test_two_frames_show_the_rsos_and_nothing_else(scene: Scene, engine: str):
    for frame, result in enumerate(run(scene, engine=engine, rso_test="vector")):
        # and some of noise: of 256^2 / 13 independent places a few hundredths of a per cent
        assert 49 + 3 <= len(result.objects) <= 49 + 3 + 3
        if frame == 0:
            assert len(result.detections) == 0
            continue
        truth = scene.rsos_at(frame)
        found = rows_of(truth, result.detections)
        # 1.8 px / SNR of about 70, and five times that at most
        np.testing.assert_allclose(columns(found, "x", "y"), truth, atol=0.13)
        # Lucas-Kanade is good to 0.1 px a frame here: 0.2 px/s.
        velocity = columns(found, "vx", "vy")
        np.testing.assert_allclose(velocity, scene.rso_steps / 0.5, atol=0.3)
        expected = (scene.rso_steps - scene.star_step) / 0.5
        np.testing.assert_allclose(columns(found, "rel_vx", "rel_vy"), expected, atol=0.3)
        np.testing.assert_allclose(result.star_field.displacement, scene.star_step, atol=0.05)
        assert result.star_field.star_count >= 45
        assert result.reason == ""
        assert not found["status"].any()
        assert not found["track_id"].any()
        assert len(result.tracks) == 0


@SCENES
@ENGINES
def test_the_default_confirms_the_rsos_in_their_third_frame_and_nothing_else(
    scene: Scene, engine: str
):
    ids = None
    for frame, result in enumerate(run(scene, 7, engine=engine)):
        assert result.star_rows.size == (result.star_field.star_count if frame else 0)
        if frame < 2:
            assert (len(result.detections), len(result.tracks)) == (0, 0)
            continue
        truth = scene.rsos_at(frame)
        found = rows_of(truth, result.detections)
        assert (found["status"] == CONFIRMED).all()
        ids = found["track_id"].tolist() if ids is None else ids
        assert found["track_id"].tolist() == ids
        assert sorted(ids) == [1, 2, 3]
        # As for two frames: the centroids are the same.
        np.testing.assert_allclose(columns(found, "x", "y"), truth, atol=0.13)
        # A line through k places, each off by 0.03 px, and up to 0.1 px near a star: of three,
        # 0.1 sqrt(2) / 2 px a frame, of seven 0.1 / sqrt(28).
        atol = {2: 0.2, 3: 0.12}.get(frame, 0.08)
        velocity = columns(found, "vx", "vy")
        np.testing.assert_allclose(velocity, scene.rso_steps / 0.5, atol=atol)
        expected = (scene.rso_steps - scene.star_step) / 0.5
        np.testing.assert_allclose(columns(found, "rel_vx", "rel_vy"), expected, atol=atol)
        tracks = rows_of(truth, result.tracks)
        assert tracks["track_id"].tolist() == ids
        assert tracks["hits"].tolist() == [frame + 1] * 3
        assert not tracks["misses"].any()
        np.testing.assert_allclose(columns(tracks, "x", "y"), truth, atol=0.13)
        np.testing.assert_allclose(columns(tracks, "vx", "vy"), velocity)
        assert result.spot_count >= 3
        assert result.reason == ""


@pytest.mark.parametrize("preset", ["paper_opencv", "paper_matlab"])
@pytest.mark.parametrize("scene", [SIDEREAL, SURVEY], ids=["sidereal", "survey"])
def test_the_published_presets_run_and_measure_the_field(preset: str, scene: Scene):
    for result in run(scene, name=preset)[1:]:
        # What does not move is no region of the map of speeds.
        moving = preset == "paper_opencv" or scene is SURVEY
        assert np.count_nonzero(result.flow.valid) >= (30 if moving else 3)
        if preset == "paper_opencv":  # derivatives without a pyramid do not see 1.7 px
            step = result.star_field.displacement
            np.testing.assert_allclose(step, scene.star_step, atol=0.1)
        # Detections, right or wrong, are in the image and have a velocity.
        for name in ("x", "y", "vx", "vy"):
            assert np.isfinite(result.detections[name]).all()
        assert ((result.detections["x"] >= 0) & (result.detections["x"] < SIZE)).all()


def test_the_published_sparse_preset_finds_rsos_among_fixed_stars():
    for frame, result in enumerate(run(SIDEREAL, name="paper_opencv")):
        for x, y in SIDEREAL.rsos_at(frame) if frame else []:
            distance = np.hypot(result.detections["x"] - x, result.detections["y"] - y)
            assert distance.min() < 2


def test_without_a_background_mesh_the_rsos_are_still_found():
    for frame, result in enumerate(run(SURVEY, background="none")):
        assert len(result.detections) == (3 if frame >= 2 else 0), result.reason
        # 30,000 DN, of which the wings are lost: not the 3,000 DN of the sky of each pixel.
        assert result.detections["flux"] == pytest.approx(30_000, rel=0.05)


@pytest.mark.parametrize("preset", preset_names())
def test_flux_is_without_the_sky_in_every_preset(preset: str):
    (result,) = run(SURVEY, 1, name=preset)
    x, y = SURVEY.rsos[0]
    (near,) = np.flatnonzero(np.hypot(result.objects["x"] - x, result.objects["y"] - y) < 1)
    assert result.objects["flux"][near] == pytest.approx(30_000, rel=0.1)


def test_eight_and_sixteen_bit_agree():
    """The same sky, at 1 / 64 of the grey levels: noise of 0.6 DN and rounding to 1 DN."""
    fine, coarse = Pipeline(), Pipeline()
    for frame in range(4):
        image = SURVEY.image(frame)
        a = fine.process(as16(image), stamp(frame))
        b = coarse.process(np.rint(image / 64).clip(0, 255).astype(np.uint8), stamp(frame))
        assert b.background * 64 == pytest.approx(a.background, abs=20)
        # Rounding adds (0.29 / 0.63)^2 / 2 = 11 %.
        assert b.noise * 64 == pytest.approx(1.11 * a.noise, rel=0.05)
        assert len(a.detections) == len(b.detections) == (3 if frame >= 2 else 0)
        for name, tolerance in (("x", 0.1), ("y", 0.1), ("rel_vx", 0.3), ("rel_vy", 0.3)):
            one, other = (np.sort(r.detections[name]) for r in (a, b))
            np.testing.assert_allclose(one, other, atol=tolerance, err_msg=name)


def test_float_and_sixteen_bit_agree():
    fine, whole = Pipeline(), Pipeline()
    for frame in range(3):
        image = as16(SURVEY.image(frame))
        a = whole.process(image, stamp(frame))
        b = fine.process(image.astype(np.float32), stamp(frame))
        assert len(a.detections) == len(b.detections) == (3 if frame >= 2 else 0)
        for name in ("x", "y", "rel_vx", "rel_vy"):
            one, other = (np.sort(r.detections[name]) for r in (a, b))
            np.testing.assert_allclose(one, other, atol=0.02, err_msg=name)


# What a frame's result says


def test_frames_are_counted_and_timed():
    results = run(SIDEREAL, 4)
    assert [r.frame for r in results] == [0, 1, 2, 3]
    assert [r.stamp_ns for r in results] == [stamp(i) for i in range(4)]
    assert math.isnan(results[0].dt_s)
    assert [r.dt_s for r in results[1:]] == [0.5] * 3
    assert {r.shape for r in results} == {(SIZE, SIZE)}
    stages = ["preprocessing", "objects", "optical_flow", "star_field", "detection", "tracking"]
    assert list(results[0].seconds) == stages[:2]
    assert list(results[1].seconds) == stages
    assert all(0 < s < 10 for s in results[1].seconds.values())


def test_levels_are_those_of_the_image():
    (result,) = run(SIDEREAL, 1)
    assert result.background == pytest.approx(3000, abs=4)
    # 40 DN, smoothed by sigma 1
    assert result.noise == pytest.approx(40 * 0.2821, rel=0.05)
    assert result.threshold == pytest.approx(4 * 40 * 0.2821, rel=0.1)


def test_velocities_follow_the_stamps_and_not_the_count():
    pipeline = two_frames()
    times = [0, STEP_NS, 5 * STEP_NS]  # frames 1, 2 and 3 are missing
    results = [
        pipeline.process(as16(SIDEREAL.image(i)), START_NS + t) for i, t in enumerate(times)
    ]
    assert [r.dt_s for r in results[1:]] == [0.5, 2.0]
    speeds = [np.sort(np.hypot(r.detections["vx"], r.detections["vy"])) for r in results[1:]]
    steps = np.sort(np.hypot(*SIDEREAL.rso_steps.T))
    np.testing.assert_allclose(speeds[0], steps / 0.5, atol=0.3)
    np.testing.assert_allclose(speeds[1], steps / 2.0, atol=0.08)


def test_rows_refer_to_each_other():
    result = run(SURVEY, 2, rso_test="vector")[1]
    flow, found = result.flow, result.detections
    for row in found:
        thing = result.objects[row["object_index"]]
        assert (row["x"], row["y"], row["snr"]) == (thing["x"], thing["y"], thing["snr"])
        assert flow.object_index[row["flow_index"]] == row["object_index"]
        moved = flow.displacement[row["flow_index"]]
        assert (row["vx"], row["vy"]) == pytest.approx(tuple(moved / result.dt_s))
    assert len(result.star_field.inliers) == len(flow)
    assert not result.star_field.inliers[found["flow_index"]].any()
    assert np.isnan(found["ra"]).all()


def test_rows_of_tracks_refer_to_objects():
    result = run(SURVEY, 4)[-1]
    for row in result.detections:
        thing = result.objects[row["object_index"]]
        assert np.hypot(row["x"] - thing["x"], row["y"] - thing["y"]) < 0.2
        assert (row["snr"], row["flux"]) == (thing["snr"], thing["flux"])
        assert row["flow_index"] == -1
    assert np.isnan(result.detections["ra"]).all()


def test_the_same_frames_give_the_same_results():
    for one, other in zip(run(SURVEY), run(SURVEY), strict=True):
        assert_same(one, other)


# Input


def test_the_image_is_not_changed():
    pipeline = Pipeline()
    for frame, dtype in enumerate((np.uint16, np.float32, np.float32)):
        image = SURVEY.image(frame).astype(dtype)
        before = image.copy()
        image.flags.writeable = False
        pipeline.process(image, stamp(frame))
        assert np.array_equal(image, before)


def test_a_view_with_strides_gives_what_its_copy_gives():
    a, b = Pipeline(), Pipeline()
    for frame in range(2):
        image = as16(SURVEY.image(frame))
        padded = np.zeros((2 * SIZE, SIZE + 40), np.uint16)
        padded[::2, 20:-20] = image
        assert_same(a.process(padded[::2, 20:-20], stamp(frame)), b.process(image, stamp(frame)))


def test_the_caller_may_reuse_the_buffer():
    pipeline, other = Pipeline(), Pipeline()
    buffer = np.zeros((SIZE, SIZE), np.float32)
    for frame in range(3):
        image = SURVEY.image(frame).astype(np.float32)
        buffer[:] = image
        result = pipeline.process(buffer, stamp(frame))
        buffer[:] = 0
        assert_same(result, other.process(image, stamp(frame)))


NO_TWO = "it must have two dimensions of at least 16 px"
NO_TYPE = "it must be uint8, uint16, float32"


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((40, 50, 3), np.uint8), f"shape (40, 50, 3) cannot be processed: {NO_TWO}"),
        (np.zeros(100, np.uint8), f"shape (100,) cannot be processed: {NO_TWO}"),
        (np.zeros((15, 500), np.uint16), f"shape (15, 500) cannot be processed: {NO_TWO}"),
        (np.zeros((0, 0), np.uint16), f"shape (0, 0) cannot be processed: {NO_TWO}"),
        (np.zeros((40, 40), np.int16), f"of int16 cannot be processed: {NO_TYPE}"),
        (np.zeros((40, 40), np.float64), f"of float64 cannot be processed: {NO_TYPE}"),
        (np.zeros((40, 40), bool), f"of bool cannot be processed: {NO_TYPE}"),
        (np.full((40, 40), np.nan, np.float32), "no pixel of the image is a finite number"),
    ],
    ids=lambda value: "" if isinstance(value, str) else f"{value.dtype}{value.shape}",
)
def test_a_bad_image_is_refused_and_the_previous_frame_stays(image: np.ndarray, message: str):
    pipeline = Pipeline()
    pipeline.process(as16(SURVEY.image(0)), stamp(0))
    with pytest.raises(ImageError, match=re.escape(message)):
        pipeline.process(image, stamp(1))
    result = pipeline.process(as16(SURVEY.image(1)), stamp(1))
    assert_same(result, run(SURVEY, 2)[1])


def test_a_bad_first_image_leaves_the_first_frame_to_come():
    pipeline = Pipeline()
    with pytest.raises(ImageError):
        pipeline.process(np.zeros((4, 4), np.uint8), stamp(0))
    result = pipeline.process(as16(SURVEY.image(0)), stamp(0))
    assert (result.frame, result.reset) == (0, "first frame")


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_smallest_and_dullest_images_go_through(preset: str, dtype):
    pipeline = Pipeline(Parameters.preset(preset))
    random = np.random.default_rng(1)
    shape = (16, 17)
    images = [
        *(np.zeros(shape), np.full(shape, 255), random.uniform(0, 255, shape)),
        *(random.uniform(0, 255, shape), np.eye(*shape) * 255, np.zeros(shape)),
    ]
    for frame, image in enumerate(images):
        result = pipeline.process(image.astype(dtype), stamp(frame))
        assert result.frame == frame
        assert bool(result.reason) == (len(result.detections) == 0)


def test_missing_pixels_do_not_hide_the_rsos():
    pipeline = Pipeline()
    random = np.random.default_rng(9)
    for frame in range(3):
        image = SURVEY.image(frame).astype(np.float32)
        image[random.integers(0, SIZE, 300), random.integers(0, SIZE, 300)] = np.nan
        image[:10] = np.inf
        result = pipeline.process(image, stamp(frame))
    for x, y in SURVEY.rsos_at(2):
        distance = np.hypot(result.detections["x"] - x, result.detections["y"] - y)
        assert distance.min() < 1


# Resets


RESETS = {
    "another size": (
        lambda: as16(SURVEY.image(1))[:200],
        stamp(1),
        "the image's size changed from 256x256 to 256x200",
    ),
    "another type": (
        lambda: SURVEY.image(1).astype(np.float32),
        stamp(1),
        "the image's type changed from uint16 to float32",
    ),
    "gap": (
        lambda: as16(SURVEY.image(1)),
        stamp(0) + 60_000_000_001,
        "a gap of 60 s is longer than max_gap_s = 60 s",
    ),
}  # fmt: skip


@pytest.mark.parametrize("cause", RESETS)
def test_a_reset_names_its_cause_and_the_frame_after_works(cause: str):
    make, at_ns, reason = RESETS[cause]
    pipeline = two_frames(max_gap_s=60)
    pipeline.process(as16(SURVEY.image(0)), stamp(0))
    image = make()
    result = pipeline.process(image, at_ns)
    assert result.reset == reason
    assert result.reason == FIRST + reason
    assert math.isnan(result.dt_s)
    assert result.star_field is None
    assert (len(result.flow), len(result.detections)) == (0, 0)
    assert len(result.objects) > 30
    following = SURVEY.image(2).astype(image.dtype)[: len(image)]
    after = pipeline.process(following, at_ns + STEP_NS)
    assert (after.reset, after.dt_s, after.frame) == ("", 0.5, 2)
    assert len(after.detections) == 3


def test_a_gap_of_just_max_gap_s_is_no_reset():
    pipeline = Pipeline(Parameters(max_gap_s=60))
    pipeline.process(as16(SURVEY.image(0)), stamp(0))
    result = pipeline.process(as16(SURVEY.image(1)), stamp(0) + 60_000_000_000)
    assert (result.reset, result.dt_s) == ("", 60.0)


def test_a_reset_that_was_asked_for():
    pipeline = Pipeline()
    for frame, words in enumerate(("first frame", "", "the mount slewed", "")):
        if frame == 2:
            pipeline.reset("the mount slewed")
        result = pipeline.process(as16(SURVEY.image(frame)), stamp(frame))
        assert result.reset == words
        assert result.frame == frame
    pipeline.reset()
    result = pipeline.process(as16(SURVEY.image(4)), stamp(4))
    assert result.reset == "reset asked for"


def test_a_reset_before_the_first_frame_gives_its_own_reason():
    pipeline = Pipeline()
    pipeline.reset("it was disabled")
    assert pipeline.process(as16(SURVEY.image(0)), stamp(0)).reset == "it was disabled"


# Parameters


def test_parameters_change_from_frame_to_frame():
    pipeline = two_frames()
    for frame, changes in enumerate(
        (
            {},
            {"engine": "dense"},
            {"engine": "sparse", "star_field_model": "shift"},
            {"min_relative_px": 10.0},
        )
    ):
        pipeline.parameters = Parameters(rso_test="vector", **changes)
        result = pipeline.process(as16(SURVEY.image(frame)), stamp(frame))
        assert bool(result.reset) == (frame == 0)
        assert len(result.detections) == {0: 0, 3: 0}.get(frame, 3)
    assert result.reason == "everything moves with the star field (49 stars)"


def test_frames_that_were_preprocessed_differently_are_not_compared():
    pipeline = two_frames()
    pipeline.process(as16(SURVEY.image(0)), stamp(0))
    pipeline.parameters = pipeline.parameters.replace(smoothing_sigma_px=2.0, background="none")
    result = pipeline.process(as16(SURVEY.image(1)), stamp(1))
    assert result.reset == "background and smoothing_sigma_px changed"
    after = pipeline.process(as16(SURVEY.image(2)), stamp(2))
    assert (after.reset, len(after.detections)) == ("", 3)


@pytest.mark.parametrize("preset", ["paper_opencv", "paper_matlab"])
def test_a_preset_may_take_over(preset: str):
    pipeline = Pipeline()
    pipeline.process(as16(SIDEREAL.image(0)), stamp(0))
    pipeline.parameters = Parameters.preset(preset)
    changed = pipeline.process(as16(SIDEREAL.image(1)), stamp(1))
    assert changed.reset.endswith(" changed")
    assert len(pipeline.process(as16(SIDEREAL.image(2)), stamp(2)).flow) > 0


# Reasons


def sky(*places: tuple[float, float], seed: int = 1) -> np.ndarray:
    scene = Scene((0, 0), [], seed)
    scene.stars = np.array(places, float).reshape(-1, 2)
    scene.star_flux = np.full(len(places), 30_000.0)
    return as16(scene.image(seed))


def reasons(*images: np.ndarray) -> list[str]:
    pipeline = Pipeline()
    return [pipeline.process(image, stamp(i)).reason for i, image in enumerate(images)]


def test_why_nothing_on_an_empty_sky():
    none = "no object is above the threshold"
    assert reasons(sky(), sky(seed=2)) == [none, none]


def test_why_nothing_in_the_first_frame():
    assert reasons(sky((50, 50)))[0] == FIRST + "first frame"


def test_why_nothing_when_all_is_new():
    found = reasons(sky(), sky((50, 50), (150, 90), (70, 190), seed=2))
    assert found[1] == f"{FIRST}the frame before showed no star field"
    found = reasons(sky(), sky((50, 50), (150, 90), seed=2))
    assert found[1] == "none of 2 objects was found in the previous frame"


def test_why_nothing_when_all_moves_alike():
    result = run(Scene((1.0, -2.0), []), 3, spot_sigmas=10.0)[-1]
    assert result.reason == "everything moves with the star field (49 stars)"
    assert result.star_field.star_count == 49
    assert result.spot_count == 0


def test_why_nothing_when_only_noise_moves():
    """256^2 px have some 15 peaks over 3 sigma (see `Sighting.expected`), none on a path."""
    result = run(Scene((1.0, -2.0), []), 4)[-1]
    assert 5 < result.spot_count < 40
    assert result.reason == (
        f"49 stars; none of {result.spot_count} spots beside them lies on a path that noise would"
        " not explain"
    )


def test_why_nothing_with_one_object():
    found = reasons(sky((50, 50)), sky((51, 52), seed=2))
    one = "only one object was found in the previous frame: no star field to compare it with"
    assert found[1] == one
    found = reasons(sky((50, 50)), sky((51, 52), (150, 90), seed=2))
    assert found[1] == one


def test_why_nothing_when_no_two_agree():
    steps = [(4, 0), (-4, 0)]
    places = [(50, 50), (150, 60)]
    moved = [(x + dx, y + dy) for (x, y), (dx, dy) in zip(places, steps, strict=True)]
    pipeline = Pipeline(Parameters(first_guess="zero", window_px=21))
    pipeline.process(sky(*places), stamp(0))
    result = pipeline.process(sky(*moved, seed=2), stamp(1))
    assert result.star_field is None
    valid = np.count_nonzero(result.flow.valid)
    assert result.reason == f"the {valid} flow vectors do not agree on a motion of the star field"


def test_objects_that_come_back_are_found_again():
    """A cloud hides all; the frame after it is compared with the one before it."""
    pipeline = two_frames()
    for frame in range(5):
        image = SURVEY.image(frame)
        if frame == 2:
            image = np.random.default_rng(5).normal(9000, 90, image.shape)
        result = pipeline.process(as16(image), stamp(frame))
        assert len(result.detections) == (3 if frame in (1, 3, 4) else 0), frame
        if frame == 3:
            assert result.dt_s == 2 * STEP_NS / 1e9
    assert result.reset == ""


# The last word


def settle(pipeline: Pipeline, images: list[np.ndarray], stamps: list[int]) -> list[Settled]:
    """Process all; each frame settled is of its number and stamp, and no later than it may be."""
    settled: list[Settled] = []
    for number, (image, stamp_ns) in enumerate(zip(images, stamps, strict=True)):
        result = pipeline.process(image, stamp_ns)
        settled += result.settled
        assert len(settled) <= number + 1
        if pipeline.parameters.rso_test == "history":
            # Those that are not settled yet are still in the history, or wait for what becomes of
            # their tracks.
            parameters = pipeline.parameters
            waiting = parameters.history_frames + parameters.coast_frames
            assert number + 1 - len(settled) <= waiting
    settled += pipeline.finish()
    assert pipeline.finish() == []
    assert [one.frame for one in settled] == list(range(len(images)))
    assert [one.stamp_ns for one in settled] == stamps
    return settled


def test_what_is_settled_was_there_before_it_was_confirmed():
    frames = range(7)
    settled = settle(
        Pipeline(), [as16(SURVEY.image(i)) for i in frames], [stamp(i) for i in frames]
    )
    ids = rows_of(SURVEY.rsos_at(6), settled[6].detections)["track_id"].tolist()
    assert sorted(ids) == [1, 2, 3]
    for one in settled:
        truth = SURVEY.rsos_at(one.frame)
        found = rows_of(truth, one.detections)
        assert found["track_id"].tolist() == ids
        assert (found["status"] == CONFIRMED).all()
        np.testing.assert_allclose(columns(found, "x", "y"), truth, atol=0.13)
        # A line through seven places: see the default's test.
        velocity = columns(found, "vx", "vy")
        np.testing.assert_allclose(velocity, SURVEY.rso_steps / 0.5, atol=0.05)


def test_a_frame_is_settled_when_its_tracks_could_have_ended():
    results = run(SURVEY, 9, history_frames=4, coast_frames=2)
    numbers = [[one.frame for one in result.settled] for result in results]
    assert numbers == [[], [], [], [], [], [], [0], [1], [2]]


def test_finish_before_anything_and_a_new_start_after_it():
    pipeline = Pipeline()
    assert pipeline.finish() == []
    for start in (0, 3):
        for frame in range(3):
            result = pipeline.process(as16(SURVEY.image(frame)), stamp(start + frame))
            assert result.reset == ("finished" if frame == 0 else "")
        assert (result.detections["status"] == CONFIRMED).all()
        # No id is used twice.
        assert sorted(result.detections["track_id"]) == [start + 1, start + 2, start + 3]
        assert [one.frame for one in pipeline.finish()] == [start, start + 1, start + 2]


INTERRUPTIONS = {
    "size": lambda image, at: (image[:240], at),
    "type": lambda image, at: (image.astype(np.float32), at),
}


@pytest.mark.parametrize("cause", INTERRUPTIONS)
@pytest.mark.parametrize("length", [1, 4, 10])
def test_each_frame_is_settled_once_in_order_across_a_reset(cause: str, length: int):
    """`length` frames on either side of it: less and more than the history holds."""
    images, stamps = [], []
    for frame in range(2 * length):
        image, at = as16(SURVEY.image(frame)), stamp(frame)
        if frame >= length:
            image, at = INTERRUPTIONS[cause](image, at)
        images.append(image)
        stamps.append(at)
    settled = settle(Pipeline(), images, stamps)
    ids: list[set[int]] = [set(), set()]
    for one in settled:
        assert len(one.detections) == (3 if length > 2 else 0), one.frame
        ids[one.frame >= length] |= set(one.detections["track_id"].tolist())
    # A track does not outlive a reset, nor is its id used again.
    assert ids == ([{1, 2, 3}, {4, 5, 6}] if length > 2 else [set(), set()])


def test_a_reset_that_was_asked_for_loses_no_frame():
    pipeline, numbers = Pipeline(), []
    for frame in range(8):
        if frame in (3, 4):
            pipeline.reset()
        result = pipeline.process(as16(SURVEY.image(frame)), stamp(frame))
        # What was in the history goes with the next frame.
        numbers.append([one.frame for one in result.settled])
    assert numbers == [[], [], [], [0, 1, 2], [3], [], [], []]
    assert [one.frame for one in pipeline.finish()] == [4, 5, 6, 7]


@pytest.mark.parametrize("preset", ["paper_opencv", "paper_matlab"])
def test_two_frames_settle_at_once_what_they_detect(preset: str):
    pipeline = Pipeline(Parameters.preset(preset))
    seen = 0
    for frame in range(4):
        result = pipeline.process(as16(SURVEY.image(frame)), stamp(frame))
        (one,) = result.settled
        assert (one.frame, one.stamp_ns) == (frame, stamp(frame))
        assert one.detections.tobytes() == result.detections.tobytes()
        seen += len(one.detections)
    assert pipeline.finish() == []
    assert seen > 0


def test_the_test_may_change_while_running():
    """From a history to two frames and back: each frame is settled once, in order."""
    pipeline, settled = Pipeline(), []
    for frame in range(15):
        test = "vector" if 5 <= frame < 10 else "history"
        pipeline.parameters = Parameters(rso_test=test)
        settled += pipeline.process(as16(SURVEY.image(frame)), stamp(frame)).settled
    settled += pipeline.finish()
    assert [one.frame for one in settled] == list(range(15))


# The history


def clouded(scene: Scene, frame: int, hidden: range) -> np.ndarray:
    if frame in hidden:
        return as16(np.random.default_rng(frame).normal(3000, 40, (SIZE, SIZE)))
    return as16(scene.image(frame))


@pytest.mark.parametrize("hidden", [range(4, 5), range(4, 6)], ids=len)
def test_the_fields_motion_is_taken_to_go_on_for_three_frames(hidden: range):
    """A cloud hides all; the tracks coast under it and have their ids after it."""
    pipeline, ids = Pipeline(), None
    for frame in range(10):
        result = pipeline.process(clouded(SURVEY, frame, hidden), stamp(frame))
        if frame < 2:
            continue
        if frame in hidden:
            assert result.star_field is None
        elif frame - 1 in hidden:
            # Compared with the last frame before the cloud.
            assert result.dt_s == pytest.approx((1 + len(hidden)) * STEP_NS / 1e9)
            step = (1 + len(hidden)) * SURVEY.star_step
            assert result.star_field.displacement == pytest.approx(step, abs=0.1)
        tracks = rows_of(SURVEY.rsos_at(frame), result.tracks)
        ids = tracks["track_id"].tolist() if ids is None else ids
        assert tracks["track_id"].tolist() == ids
        assert (tracks["status"] == (COASTING if frame in hidden else CONFIRMED)).all(), frame
        assert len(result.detections) == (0 if frame in hidden else 3)
    assert sorted(ids) == [1, 2, 3]
    assert tracks["misses"].tolist() == [len(hidden)] * 3


def test_when_the_field_is_lost_for_longer_all_starts_afresh():
    pipeline, settled, hidden = Pipeline(), [], range(4, 9)
    for frame in range(13):
        result = pipeline.process(clouded(SURVEY, frame, hidden), stamp(frame))
        settled += result.settled
        if frame in (4, 5, 6):
            assert result.tracks["status"].tolist() == [COASTING] * 3
        if frame in (7, 8, 9):
            assert len(result.tracks) == 0
    assert sorted(result.detections["track_id"]) == [4, 5, 6]
    settled += pipeline.finish()
    assert [one.frame for one in settled] == list(range(13))
    for one in settled:
        assert len(one.detections) == (0 if one.frame in hidden else 3), one.frame


FAST = np.array((36.0, -18.0))
FOLLOWED = np.array((128.0, 127.0))


def followed(number: int, gone: np.ndarray, rso: np.ndarray, brightest: int) -> np.ndarray:
    """Stars of SNR 8 to 80 that have gone so far, px, since the first frame, and an RSO.

    A cloud leaves only so many of the stars in the image, the brightest ones.
    """
    places = np.random.default_rng(12).uniform(-600, 856, (1000, 2)) + gone
    flux = np.geomspace(60_000, 6_000, len(places))
    inside = np.flatnonzero(np.all((places > -10) & (places < SIZE + 10), axis=1))[:brightest]
    places, flux = np.vstack([places[inside], rso]), np.append(flux[inside], 30_000)
    return camera(blobs((SIZE, SIZE), places, flux, 1.2), np.random.default_rng(number), noise=40)


def follow(
    steps: list[np.ndarray], clouds: dict[int, int], seconds: dict[int, float]
) -> Iterator[FrameResult]:
    """Yield results of frames before which the stars went so far, 1 s apart or as said.

    The RSO, which moves evenly on the sky, is found where it is, and is the first track still.
    """
    pipeline, gone, now_s = Pipeline(), np.zeros(2), 0.0
    for number, step in enumerate(steps):
        gone, now_s = gone + step, now_s + seconds.get(number, 1.0)
        rso = FOLLOWED + gone - FAST * now_s
        image = followed(number, gone, rso, clouds.get(number, 1000))
        result = pipeline.process(image, START_NS + round(now_s * 1e9))
        if number >= 3:
            assert result.tracks["track_id"].tolist() == [1], number
            # 1.8 px / SNR of about 70 and what star light behind it adds; a step is 40 px
            place = columns(result.tracks, "x", "y")[0]
            assert place == pytest.approx(rso, abs=0.5), number
        yield result


@pytest.mark.parametrize("seen", [4, 5, 6])
def test_few_fast_stars_are_sought_where_the_mount_led_so_far(seen: int):
    """They are too few for a vote of their own, and the RSO stands still before them."""
    for result in follow([FAST] * 10, {6: seen, 7: seen}, {}):
        if result.frame:
            # some ten stars of 0.1 px each, or three
            assert result.star_field.displacement == pytest.approx(FAST, abs=0.3), result.frame


@pytest.mark.parametrize("hidden", [1, 2])
def test_an_rso_that_is_followed_is_no_star_field(hidden: int):
    """Alone in the image, it is where it was, and the unseen stars go on as they did."""
    clouds = {6 + i: 0 for i in range(hidden)}
    for result in follow([FAST] * 10, clouds, {}):
        if result.frame in clouds:
            assert result.star_field is None
        elif result.frame:
            assert result.star_field.displacement == pytest.approx(FAST * result.dt_s, abs=0.3)


def test_unseen_stars_go_on_for_as_long_as_the_stamps_say():
    steps, seconds = [FAST] * 10, {6: 1.5, 7: 0.7}
    for number, dt in seconds.items():
        steps[number] = FAST * dt
    for result in follow(steps, {6: 0}, seconds):
        if result.frame >= 3:
            # The history puts the RSO on the sky, where it moves against the stars.
            rate = columns(result.tracks, "rel_vx", "rel_vy")[0]
            assert rate == pytest.approx(-FAST, abs=0.5), result.frame


@pytest.mark.parametrize(
    "new", [(0.0, 0.0), (-21.0, 13.0), (60.0, 2.0)], ids=["stops", "turns", "speeds up"]
)
def test_another_motion_that_many_stars_show_is_taken_at_once(new: tuple[float, float]):
    for result in follow([FAST] * 6 + [np.array(new)] * 2, {}, {}):
        if result.frame:
            truth = FAST if result.frame < 6 else new
            assert result.star_field.displacement == pytest.approx(truth, abs=0.3), result.frame


def test_three_stars_are_a_field_from_the_first_frames_on_and_when_they_stop():
    places, pipeline, step = np.array([(40.0, 60), (90, 190), (150, 80)]), Pipeline(), (5.5, 3.0)
    for frame in range(9):
        gone = np.array(step) * min(frame, 5)
        result = pipeline.process(sky(*(places + gone), seed=frame), stamp(frame))
        if frame:
            truth = step if frame <= 5 else (0, 0)
            assert result.star_field.star_count >= 3
            assert result.star_field.displacement == pytest.approx(truth, abs=0.2)


@pytest.mark.parametrize(("before", "after"), [(9, 4), (4, 9), (4, 3), (3, 4), (9, 3)])
def test_the_history_may_change_its_length_while_running(before: int, after: int):
    pipeline, settled = Pipeline(Parameters(history_frames=before)), []
    for frame in range(16):
        if frame == 10:
            pipeline.parameters = Parameters(history_frames=after)
        result = pipeline.process(as16(SURVEY.image(frame)), stamp(frame))
        assert result.reset == ("first frame" if frame == 0 else "")
        settled += result.settled
        if frame >= 3:
            assert {1, 2, 3} <= set(result.tracks["track_id"].tolist())
    settled += pipeline.finish()
    assert [one.frame for one in settled] == list(range(16))


def test_any_order_of_the_pixels_in_memory_will_do():
    plain, turned = Pipeline(), Pipeline()
    for frame in range(4):
        image = as16(SURVEY.image(frame))
        one = plain.process(image, stamp(frame))
        other = turned.process(np.asfortranarray(image), stamp(frame))
    assert one.objects.tobytes() == other.objects.tobytes()
    assert one.detections.tobytes() == other.detections.tobytes()
    assert len(one.detections) == 3


def test_the_light_goes_out_and_comes_back():
    """Frames without any light, after which all stars are as they were: no RSO, and no warning."""
    pipeline, ids = Pipeline(), set()
    for frame in range(16):
        image = as16(SURVEY.image(0))
        dark = frame in (8, 9)
        result = pipeline.process(np.zeros_like(image) if dark else image, stamp(frame))
        ids |= set(result.detections["track_id"].tolist())
    assert ids == set()


def test_what_was_learned_of_another_camera_is_forgotten():
    pipeline = Pipeline()
    random = np.random.default_rng(4)
    for frame in range(12):
        pipeline.process(random.normal(1000, 300, (64, 64)).astype(np.uint16), stamp(frame))
    for frame in range(12, 16):
        image = random.normal(100, 5, (64, 64)).astype(np.uint8)
        image[20, 30] = 180
        pipeline.process(image, stamp(frame))
    memory = pipeline._sensor
    memory.begin((64, 64), 5.0, np.dtype(np.uint8))
    memory.add(np.zeros((64, 64), np.float32), 0)
    assert memory.finish().tolist() == [20 * 64 + 30]


def test_after_a_change_of_the_test_frames_are_compared_as_ever():
    """A full history hands on the memory of frames that leave it: to one frame only."""
    changed, fresh = Pipeline(), Pipeline(Parameters(rso_test="vector"))
    images = [as16(SURVEY.image(frame)) for frame in range(16)]
    for frame, image in enumerate(images):
        if frame == 12:
            changed.parameters = Parameters(rso_test="vector")
        a, b = (pipeline.process(image, stamp(frame)) for pipeline in (changed, fresh))
        if frame > 12:
            np.testing.assert_array_equal(a.flow.displacement, b.flow.displacement)
            assert a.detections.tobytes() == b.detections.tobytes()
    assert np.hypot(*a.star_field.displacement) > 0.5
