# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Streaks measured again: their middle, to what their noise allows, and what is said of it."""

import math
import tracemalloc

import numpy as np
import pytest

from ofsat_ros.detection import SPOT_DTYPE, refine
from ofsat_ros.history import History, PastFrame
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.simulation import RSO, SimulatorSettings, SkySimulator

FRAMES = 24


def errors(step_px: float, streak_px: float, snr: float, seed: int) -> np.ndarray:
    """Errors along the motion over stated stds, across over stated, and along, px, of a pass."""
    angle = 0.3 + 0.7 * seed
    along = np.array([math.cos(angle), math.sin(angle)])
    start = 255.5 - along * step_px * FRAMES / 2
    settings = SimulatorSettings(
        width=512,
        height=512,
        frames=FRAMES,
        exposure_s=streak_px / step_px,
        subsamples=max(10, round(2 * streak_px)),
        star_count=150,
        rsos=(RSO(tuple(start), tuple(5 * step_px * along), snr=snr),),
        seed=seed,
    )
    pipeline, truth, settled = Pipeline(), [], []
    for frame in SkySimulator(settings):
        truth.append(frame.truth)
        settled += pipeline.process(frame.image, frame.stamp_ns).settled
    settled += pipeline.finish()
    across = np.array([-along[1], along[0]])
    found = []
    for last in settled:
        for row, true in zip(last.detections, truth[last.frame], strict=False):
            off = np.array([row["x"] - true["x_px"], row["y"] - true["y_px"]])
            sigma = np.array([row["sigma_x"], row["sigma_y"]])
            stated = [np.hypot(*(sigma * axis)) for axis in (along, across)]
            found.append([off @ along / stated[0], off @ across / stated[1], off @ along])
    return np.array(found)


@pytest.mark.parametrize(
    ("step_px", "streak_px", "snr", "most_px"),
    # Rms of a fit of a template with the known length to the same streaks is 0.22 to 0.25 px at
    # 8 px and SNR 17, and goes with 1 / SNR.
    [(16, 8, 17, 0.28), (10, 8, 30, 0.17), (20, 16, 25, 0.28)],
)
def test_a_streaks_middle_is_as_good_as_is_stated(step_px, streak_px, snr, most_px):
    all_ = np.concatenate([errors(step_px, streak_px, snr, seed) for seed in (1, 2, 4)])
    assert len(all_) >= 3 * FRAMES - 2
    along, across, px = np.sqrt(np.mean(all_**2, axis=0))
    assert px < most_px
    # The std of some 70 values is known to 9 %.
    assert 0.5 < along < 1.3
    assert 0.3 < across < 1.3
    # No bias: 0.03 px is the error of such a mean.
    assert abs(all_[:, 2].mean()) < 0.1


def one_frame(image: np.ndarray) -> tuple[History, PastFrame]:
    """A history of a frame as it comes out of the pipeline."""
    pipeline = Pipeline()
    pipeline.process(image, 0)
    history = pipeline._history
    return history, history[0]


def spot_at(x: float, y: float) -> np.ndarray:
    spots = np.zeros(1, SPOT_DTYPE)
    spots["x"], spots["y"], spots["sigma_x"], spots["sigma_y"] = x, y, 0.1, 0.1
    return spots


def streak(
    first: float,
    last: float,
    size: int = 96,
    star: tuple[float, float] = (0.0, 0.0),
    seed: int = 5,
) -> np.ndarray:
    """An even streak along x in the middle row, between two places, with noise.

    In the same row, between two others, a star's trail is six times as bright.
    """
    across = np.exp(-((np.arange(size) - size // 2) ** 2) / 2)
    image = np.random.default_rng(seed).normal(500, 10, (size, size))
    for peak, (begin, end) in ((400, (first, last)), (2400, star)):
        rise, fall = (
            np.array([math.erf((v - edge) / math.sqrt(2)) for v in np.arange(size)])
            for edge in (begin, end)
        )
        image += across[:, None] * peak * (rise - fall) / 2
    return image.astype(np.uint16)


@pytest.mark.parametrize("middle", [48.0, 48.3, 48.75])
def test_the_middle_lies_between_pixels(middle):
    _, frame = one_frame(streak(middle - 6, middle + 6))
    no_others = np.zeros((0, 1), bool)
    (row,) = refine(frame, [], spot_at(45, 48), np.array([[15.0, 0.0]]), no_others)
    # Slope of the ends 160 DN a pixel, summed over 1.8 rows, noise 10 DN: 0.05 px.
    assert row["x"] == pytest.approx(middle, abs=0.15)
    assert row["y"] == pytest.approx(48, abs=0.05)
    assert row["length"] == pytest.approx(12, abs=1)
    assert row["refined"]


def test_what_the_border_cuts_is_not_said_to_be_known():
    _, frame = one_frame(streak(88, 110))
    no_others = np.zeros((0, 1), bool)
    (row,) = refine(frame, [], spot_at(91, 48), np.array([[24.0, 0.0]]), no_others)
    assert not row["refined"]
    # The middle is at 99, outside of the image.
    assert 2 * row["sigma_x"] > 99 - row["x"]
    assert row["sigma_y"] < 0.2


def test_a_long_gap_costs_no_memory():
    """Ten minutes without a frame, at 100 px/s: the way is 60,000 px."""
    _, frame = one_frame(streak(42, 54))
    no_others = np.zeros((0, 1), bool)
    tracemalloc.start()
    (row,) = refine(frame, [], spot_at(48, 48), np.array([[6e4, 0.0]]), no_others)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 50e6
    assert row["x"] == pytest.approx(48, abs=0.3)


@pytest.mark.parametrize("length", [0.0, 6.0])
def test_a_star_on_the_line_of_motion_is_not_the_streak(length):
    """A field that moves by 40 px a frame: as far as that, stars lie on the line."""
    _, frame = one_frame(streak(45, 51, star=(10, 16)))
    spot = spot_at(48, 48)
    spot["length"] = length
    (row,) = refine(frame, [], spot, np.array([[40.0, 0.0]]), np.zeros((0, 1), bool))
    # The slope of the ends, 160 DN a pixel, summed over 1.8 rows, in noise of 10 DN: 0.05 px.
    assert row["x"] == pytest.approx(48, abs=0.15)
    assert row["length"] == pytest.approx(6, abs=1)


def test_a_star_beyond_an_rso_that_hardly_moves_is_subtracted():
    """The other frames show the RSO itself, but also the star, and that it is one."""
    pipeline = Pipeline(Parameters(history_frames=3))
    for number in range(3):
        # 1.5 px a frame away from a star that begins at its wings.
        image = streak(45 + 1.5 * number, 51 + 1.5 * number, star=(32, 38), seed=number)
        pipeline.process(image, number * 10**9)
    history = pipeline._history
    frame, others = history[2], [history[0], history[1]]
    spot = spot_at(51, 48)
    spot["length"] = 6.0
    (row,) = refine(frame, others, spot, np.array([[40.0, 0.0]]), np.ones((2, 1), bool))
    assert row["x"] == pytest.approx(51, abs=0.15)
    assert row["length"] == pytest.approx(6, abs=1)
