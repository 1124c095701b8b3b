# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A sky that jumps: slews, gusts, dither, another field, a mount that flips; none invents an RSO.

Each scene has RSOs that are really there, before and after, so that what is counted as false is
measured where something true could be mistaken.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ofsat_ros.comparison import why_not_placed
from ofsat_ros.detection import CONFIRMED
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import FrameResult, Pipeline
from ofsat_ros.tracking import Tracker

SIZE, WIDTH, NOISE = 256, 1.1, 30.0
SECOND_NS, START_NS = 10**9, 1_767_225_600 * 10**9
FRAMES, JUMP = 14, 6
MIDDLE = (SIZE - 1) / 2
# Where the stars of a frame are at a time in frames: a field, its shift px, and its turn, rad.
Pointing = Callable[[float], tuple[int, np.ndarray, float]]


class Sky:
    """Fields of stars of SNR 8 to some thousand, and RSOs of SNR 40 that move evenly in the image.

    Each field has its own stars, and two RSOs in view, the second one standing still in the image.
    """

    def __init__(self, seed: int, pointing: Pointing, per_px2: float = 1e-3) -> None:
        self.seed, self.pointing, self.per_px2, self.exposure = seed, pointing, per_px2, 0.3
        self.rsos = np.array([(80.0, 90.0), (160.0, 170.0)])
        self.steps = np.array([(4.0, -2.5), (0.0, 0.0)])
        # They are in view anew from then on.
        self.anew = JUMP
        # What the mount adds in each frame, to stars and RSOs alike, px.
        self.shakes = np.zeros((FRAMES + 1, 2))

    def stars(self, field: int) -> tuple[np.ndarray, np.ndarray]:
        random, side = np.random.default_rng((self.seed, field)), 4 * SIZE
        count = random.poisson(self.per_px2 * side**2)
        flux = np.minimum(900 / random.uniform(0, 1, count), 4e5)
        return random.uniform(-1.5 * SIZE, 2.5 * SIZE, (count, 2)), flux

    def places(self, xy: np.ndarray, time: float) -> np.ndarray:
        _, shift, turn = self.pointing(time)
        cos, sin = np.cos(turn), np.sin(turn)
        turned = (xy - MIDDLE + shift) @ np.array([[cos, sin], [-sin, cos]])
        return turned + MIDDLE + self.shakes[int(time + 0.5)]

    def truth(self, frame: int) -> np.ndarray:
        """Places of the RSOs that are there, px."""
        since = frame - (self.anew if frame >= self.anew else 0)
        return self.rsos + since * self.steps + self.shakes[frame]

    def image(self, frame: int) -> np.ndarray:
        xy, flux = self.stars(self.pointing(frame)[0])
        half = self.exposure / 2
        light = np.zeros((SIZE, SIZE))
        _expose(light, *(self.places(xy, frame + t) for t in (-half, half)), flux)
        here, way = self.truth(frame), half * self.steps
        bright = np.full(len(here), 40 * NOISE * 2 * np.sqrt(np.pi) * WIDTH)
        _expose(light, here - way, here + way, bright)
        random = np.random.default_rng((self.seed, 7, frame))
        light = 1000 + gaussian_filter(light, WIDTH) + random.normal(0, NOISE, light.shape)
        return np.clip(np.rint(light), 0, 65535).astype(np.uint16)


def _expose(light: np.ndarray, start: np.ndarray, stop: np.ndarray, flux: np.ndarray) -> None:
    """Spread the flux of each source evenly along its way."""
    longest = np.hypot(*(stop - start).T).max(initial=0)
    steps = np.linspace(0, 1, 1 + 2 * int(np.ceil(longest)))
    xy = (start[:, None] + steps[:, None] * (stop - start)[:, None]).reshape(-1, 2)
    flux = np.repeat(flux / len(steps), len(steps))
    near = np.all((xy >= 0) & (xy < SIZE - 1), axis=1)
    (x, y), flux = xy[near].T, flux[near]
    column, row = x.astype(int), y.astype(int)
    fx, fy = x - column, y - row
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (fx if right else 1 - fx) * (fy if down else 1 - fy)
        np.add.at(light, (row + down, column + right), flux * share)


def watch(sky: Sky, **changes: object) -> list[FrameResult]:
    """Process all; nothing that is confirmed, live or in the look back, is not there."""
    pipeline = Pipeline(Parameters.preset(**changes))
    results = [pipeline.process(sky.image(i), START_NS + i * SECOND_NS) for i in range(FRAMES)]
    settled = [last for result in results for last in result.settled] + pipeline.finish()
    assert [last.frame for last in settled] == list(range(FRAMES))
    for number, detections in [
        *((r.frame, r.detections[r.detections["status"] == CONFIRMED]) for r in results),
        *((last.frame, last.detections) for last in settled),
    ]:
        for found in detections:
            off = np.hypot(*(sky.truth(number) - (found["x"], found["y"])).T)
            # within a source's width of where it is
            assert off.min() < 3, (number, found)
    return results


def assert_found(sky: Sky, result: FrameResult, rows: slice = slice(None)) -> None:
    """The RSOs have confirmed detections."""
    found = result.detections[result.detections["status"] == CONFIRMED]
    for x, y in sky.truth(result.frame)[rows]:
        assert np.hypot(found["x"] - x, found["y"] - y).min(initial=np.inf) < 1, result.frame


def drifting(step: tuple[float, float]) -> Pointing:
    return lambda time: (0, np.array(step) * time, 0.0)


def elsewhere(step: tuple[float, float]) -> Pointing:
    """Another part of the sky, from one frame to the next."""
    return lambda time: (int(time > JUMP - 0.5), np.array(step) * time, 0.0)


TRACKINGS = pytest.mark.parametrize("step", [(0.0, 0.0), (9.0, -5.0)], ids=["sidereal", "rate"])
# Of the two RSOs, the one that stands still is no RSO where the stars stand still, too.
MOVING = slice(0, 1)


@TRACKINGS
@pytest.mark.parametrize(
    ("engine", "per_px2", "seeds"),
    [("sparse", 1e-3, 1), ("dense", 1e-3, 1), ("sparse", 4e-4, 1), ("sparse", 4e-3, 1)],
)
def test_another_field_pauses_with_a_reason_and_is_known_in_three_frames(
    step, engine, per_px2, seeds
):
    for seed in range(seeds):
        sky = Sky(seed, elsewhere(step), per_px2)
        results = watch(sky, engine=engine)
        jump = results[JUMP]
        assert jump.reset.startswith("the star field jumped: no motion leads from the ")
        assert jump.reason == f"no previous frame to compare with: {jump.reset}"
        assert jump.star_field is None
        assert np.isnan(jump.dt_s)
        assert not len(jump.tracks) + len(jump.detections) + len(jump.flow)
        assert [bool(r.reset) for r in results] == [i in (0, JUMP) for i in range(FRAMES)]
        for result in results[JUMP + 1 :]:
            assert result.star_field.displacement == pytest.approx(step, abs=0.1)
        for frame in (JUMP - 1, JUMP + 2, FRAMES - 3):
            assert_found(sky, results[frame], MOVING)
        old, new = (results[frame].tracks["track_id"] for frame in (JUMP - 1, FRAMES - 3))
        assert set(old).isdisjoint(new)


@TRACKINGS
def test_half_an_image_further_is_the_same_sky(step):
    """Where the frames overlap, the stars say so; the tracks go on."""
    far = np.array((0.45 * SIZE, 0.1 * SIZE))

    def pointing(time):
        return 0, np.array(step) * time + far * (time > JUMP - 0.5), 0.0

    results = watch(Sky(4, pointing))
    assert not results[JUMP].reset
    assert results[JUMP].star_field.displacement == pytest.approx(far + step, abs=0.2)


@pytest.mark.parametrize(("frames", "far"), [(2, 1.5), (4, 4.0)])
def test_nothing_is_invented_while_the_mount_slews(frames, far):
    """The stars are streaks, of up to all of the image, or too faint to be seen."""

    def pointing(time):
        part = np.clip((time - JUMP + 0.6) / frames, 0, 1)
        return 0, np.array((0.8, 0.6)) * far * SIZE * part * part * (3 - 2 * part) - SIZE, 0.0

    sky = Sky(1, pointing)
    sky.exposure = 0.6
    results = watch(sky)
    assert any("jumped" in r.reset for r in results[JUMP : JUMP + frames + 1])
    for result in results[JUMP + frames + 1 :]:
        assert result.star_field.displacement == pytest.approx((0, 0), abs=0.1)


def test_a_motion_that_changed_and_is_not_well_known_places_no_frame():
    sky = Sky(1, drifting((9.0, -5.0)))
    pipeline = Pipeline()
    motion = [pipeline.process(sky.image(i), START_NS + i * SECOND_NS) for i in range(2)][1]
    motion = replace(motion.star_field, covariance=0.3**2 * np.eye(4))
    far = replace(motion, displacement=motion.displacement + (40.0, 0.0))
    said = "the star field's motion has changed, and is known to 0.3 px only"
    assert why_not_placed(motion, far) == said
    # Few stars that go on as they did show no more, and are no slew; nor does a first motion tell.
    assert why_not_placed(motion, motion) == ""
    assert why_not_placed(motion, None) == ""
    # Half an image further, with all stars: known as well as ever.
    assert why_not_placed(replace(motion, covariance=0.02**2 * np.eye(4)), far) == ""


def test_a_field_that_flips_is_another_one():
    """As behind a German mount's meridian; the stars are the same, turned by half a turn."""
    results = watch(Sky(5, lambda time: (0, np.zeros(2), np.pi * (time > JUMP - 0.5))))
    assert "jumped" in results[JUMP].reset
    assert results[JUMP + 1].star_field is not None


@pytest.mark.parametrize("hidden", [1, 2, 3])
def test_a_slew_behind_clouds(hidden, monkeypatch):
    sky, shown = Sky(6, elsewhere((2.0, 1.0))), Sky.image

    def image(self, frame):
        dark = JUMP - hidden <= frame < JUMP
        random = np.random.default_rng(frame)
        night = random.normal(1000, NOISE, (SIZE, SIZE)).astype(np.uint16)
        return night if dark else shown(self, frame)

    monkeypatch.setattr(Sky, "image", image)
    results = watch(sky)
    assert "jumped" in results[JUMP].reset
    assert_found(sky, results[JUMP + 2], MOVING)


def test_few_stars_and_as_many_rsos_jump():
    """The RSOs keep their places in the image and the stars do not: the field is the stars'."""
    sky = Sky(7, elsewhere((11.0, 6.0)), per_px2=1.5e-4)
    sky.rsos = np.array([(80.0, 90.0), (160.0, 170.0), (40.0, 200.0)])
    sky.steps = np.zeros((3, 2))
    for result in watch(sky)[1:]:
        if result.star_field is not None:
            assert result.star_field.displacement == pytest.approx((11, 6), abs=1)


def test_two_stars_are_a_field_when_they_show_a_motion_twice(monkeypatch):
    """Two of four objects may agree by chance, but not on the same motion again."""
    sky = Sky(0, drifting((3.0, -2.0)))
    sky.anew, sky.steps = FRAMES, np.array([(-4.0, -2.5), (0.0, 0.0)])
    stars = np.array([(40.0, 200.0), (190.0, 60.0)]), np.full(2, 2e4)
    monkeypatch.setattr(Sky, "stars", lambda *_: stars)
    results = watch(sky)
    assert [bool(r.reset) for r in results] == [i == 0 for i in range(FRAMES)]
    for result in results[4:]:
        assert result.star_field.displacement == pytest.approx((3, -2), abs=0.3)
        assert_found(sky, result)


@pytest.mark.parametrize("px", [3.0, 12.0], ids=["wind", "dither"])
def test_a_field_that_shakes_is_one_field(px):
    """What is found is found as without: in its third frame, with one id, everywhere."""
    sky = Sky(8, drifting((2.0, 1.0)))
    sky.anew = FRAMES
    # A dithering mount rests for some frames.
    each = 1 if px == 3 else 4
    sky.shakes = np.random.default_rng(8).normal(0, px, (FRAMES + 1, 2)).repeat(each, axis=0)
    ids = set()
    for result in watch(sky):
        assert bool(result.reset) == (result.frame == 0)
        if result.frame >= 2:
            assert_found(sky, result)
            ids |= set(result.tracks["track_id"])
    assert len(ids) == 2


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_leaves_a_clean_start(error, monkeypatch):
    """Whatever fails amid a frame, no later one sees the half of it."""
    sky, update = Sky(9, drifting((2.0, 1.0))), Tracker.update
    pipeline, settled = Pipeline(), []

    def fail(*_):
        raise error("broken")

    for frame in range(FRAMES):
        monkeypatch.setattr(Tracker, "update", fail if frame == JUMP else update)
        if frame == JUMP:
            with pytest.raises(error, match="broken"):
                pipeline.process(sky.image(frame), START_NS + frame * SECOND_NS)
            continue
        result = pipeline.process(sky.image(frame), START_NS + frame * SECOND_NS)
        settled += result.settled
        if frame == JUMP + 1:
            assert result.reset == "an error in the frame before"
            before = set(np.concatenate([one.detections["track_id"] for one in settled]))
    settled += pipeline.finish()
    assert [one.frame for one in settled] == list(range(FRAMES))
    assert before.isdisjoint(result.tracks["track_id"])
