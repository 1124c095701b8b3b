# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""History: frames of known motion and brightness, put on the sky and read between the pixels."""

import math

import numpy as np
import pytest
from sky import regions_of

from ofsat_ros.history import History, PastFrame
from ofsat_ros.objects import OBJECT_DTYPE
from ofsat_ros.pixels import Regions
from ofsat_ros.star_field import StarFieldMotion, estimate_motion

SHAPE = (90, 120)
CENTRE = np.array([59.5, 44.5])
# What a point source of PSF sigma 1 px looks like after smoothing by 1 px.
WIDTH = math.sqrt(2)


def past(number=0, smoothed=None, to_sky=None, objects=(), labels=None, noise=1.0, ratio=((1,),)):
    smoothed = np.zeros(SHAPE) if smoothed is None else smoothed
    table = np.zeros(len(objects), OBJECT_DTYPE)
    for row, (x, y) in zip(table, objects, strict=True):
        row["x"], row["y"] = x, y
    return PastFrame(
        number=number,
        stamp_ns=number * 10**9,
        smoothed=smoothed.astype(np.float32),
        noise=noise,
        noise_ratio=np.array(ratio, np.float32),
        objects=table,
        regions=Regions(SHAPE) if labels is None else regions_of(labels),
        to_sky=np.eye(3) if to_sky is None else np.array(to_sky, float),
    )


def brightness(frame, xy):
    """What a frame shows at points of its own."""
    (seen,), (x,), (y,) = frame.seen_by([frame], xy)
    np.testing.assert_allclose(np.stack([x, y], axis=1), xy, atol=1e-3, rtol=1e-6)
    return seen


def similarity(degrees, zoom, shift):
    """Where a star goes from one frame to the next: turned and zoomed about the centre."""
    a = math.radians(degrees)
    turn = zoom * np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    return lambda xy: (xy - CENTRE) @ turn.T + CENTRE + shift


def motion_of(degrees, zoom, shift):
    """The same as the star field states it: the displacement as a function of the place after.

    Before = centre + T^-1 (after - centre - shift) with the turn T by a and the zoom z, hence
    displacement = (1 - T^-1) (after - centre) + T^-1 shift.
    """
    a = math.radians(degrees)
    cos, sin = math.cos(a) / zoom, math.sin(a) / zoom
    back = np.array([[cos, sin], [-sin, cos]])
    return StarFieldMotion(
        centre=CENTRE,
        displacement=back @ shift,
        rotation=sin,
        scale=1 - cos,
        covariance=np.zeros((4, 4)),
        inliers=np.ones(1, bool),
        residual_px=0.1,
        residual_sigmas=1.0,
        speed_mean=0.0,
        speed_std=1.0,
        model="similarity",
    )


STEPS = [
    (0, 1, (12.5, -7.25)),
    (2.5, 1.0, (0, 0)),
    (0, 1.02, (0, 0)),
    (-1.5, 0.99, (-30.0, 4.0)),
    (10, 1.1, (3.3, 150.0)),
]


def stars(count=50):
    return np.random.default_rng(1).uniform((0, 0), SHAPE[::-1], (count, 2))


# The sky plane


def test_a_star_stays_at_its_place_of_the_sky_whatever_the_field_does():
    history = History(len(STEPS) + 1)
    history.add(past(0, to_sky=history.place(None)))
    places = [stars()]
    for number, step in enumerate(STEPS, start=1):
        places.append(similarity(*step)(places[-1]))
        history.add(past(number, to_sky=history.place(motion_of(*step))))
    for frame, place in zip(history, places, strict=True):
        # float64 leaves 1e-13 of what is about 300 px
        assert frame.sky(place) == pytest.approx(places[0], abs=1e-9)
        assert frame.pixels(places[0]) == pytest.approx(place, abs=1e-9)
        for other, there in zip(history, places, strict=True):
            assert other.pixels(frame.sky(place)) == pytest.approx(there, abs=1e-9)


def test_the_motion_that_the_stars_show_puts_them_back():
    """From measured vectors to the sky: signs and centre are those of `estimate_motion`."""
    before = stars()
    after = similarity(1.5, 1.01, (4.0, -2.0))(before)
    moved = after - before
    motion = estimate_motion(
        after, moved, np.full(moved.shape, 0.1), np.hypot(*moved.T), SHAPE, "similarity"
    )
    history = History(3)
    history.add(past())
    frame = past(1, to_sky=history.place(motion))
    # the fit ends when no parameter changes by more than 1e-4
    assert frame.sky(after) == pytest.approx(before, abs=1e-3)


def test_the_first_frame_is_the_sky_and_an_unknown_motion_is_none():
    history = History(3)
    assert np.array_equal(history.place(None), np.eye(3))
    # there is nothing that the field moved from
    assert np.array_equal(history.place(motion_of(*STEPS[0])), np.eye(3))
    history.add(past(to_sky=[[1, 0, -4], [0, 1, 9], [0, 0, 1]]))
    assert np.array_equal(history.place(None), history[-1].to_sky)


def test_objects_on_the_sky_and_their_light():
    labels = np.zeros(SHAPE, np.int32)
    labels[10:12, 20:23], labels[40, 50] = 1, 2
    smoothed = np.full(SHAPE, 3.0)
    smoothed[10, 20], smoothed[40, 50] = 8, 100
    frame = past(
        smoothed=smoothed,
        to_sky=[[1, 0, -4], [0, 1, 9], [0, 0, 1]],
        objects=[(21, 10.5), (50, 40), (80, 70)],
        labels=labels,
    )
    assert frame.object_sky.tolist() == [[17, 19.5], [46, 49], [76, 79]]
    # the third has no pixel
    assert frame.object_light.tolist() == [5 * 3 + 8, 100, 0]
    assert past().object_sky.shape == (0, 2)
    assert past().object_light.shape == (0,)


# The window


def test_the_oldest_frame_is_forgotten():
    history = History(3)
    assert (len(history), history.length) == (0, 3)
    for number in range(5):
        history.add(past(number))
    assert [frame.number for frame in history] == [2, 3, 4]
    assert (len(history), history[0].number, history[-1].number) == (3, 2, 4)
    assert [frame.number for frame in history.others(history[1])] == [2, 4]
    history.clear()
    assert (len(history), list(history), history.length) == (0, [], 3)
    assert np.array_equal(history.place(None), np.eye(3))


def test_the_sky_stays_that_of_the_first_frame_when_it_is_forgotten():
    history = History(2)
    for number in range(6):
        history.add(past(number, to_sky=history.place(motion_of(0, 1, (5.0, -3.0)))))
    assert history[-1].sky(np.array([[70.0, 20.0]])) == pytest.approx(np.array([[45.0, 35.0]]))


# Brightness


def gaussian(xy, places, peak=1000.0):
    distance2 = np.sum((np.asarray(xy)[..., None, :] - places) ** 2, axis=-1)
    return peak * np.exp(-distance2 / (2 * WIDTH**2)).sum(axis=-1)


def gaussian_frame(places):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return past(smoothed=gaussian(np.stack([x, y], axis=-1), places))


@pytest.mark.parametrize("count", [1, 1023, 1024, 1025, 5000])
def test_brightness_between_the_pixels(count):
    place = np.array([[60.3, 40.8]])
    xy = np.random.default_rng(count).uniform(place - 4, place + 4, (count, 2))
    got = brightness(gaussian_frame(place), xy)
    assert got.dtype == np.float32
    # Cubic interpolation of so narrow a Gaussian errs by 2 % of its peak; OpenCV rounds places to
    # 1/32 px, which at the steepest, 0.43 of the peak per px and axis, is 0.9 % more.
    np.testing.assert_allclose(got, gaussian(xy, place), atol=0.03 * 1000)


def test_brightness_on_the_pixels_is_theirs():
    smoothed = np.random.default_rng(2).normal(0, 10, SHAPE).astype(np.float32)
    frame = past(smoothed=smoothed)
    y, x = np.mgrid[2 : SHAPE[0] - 2, 2 : SHAPE[1] - 2]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    np.testing.assert_allclose(brightness(frame, xy), smoothed[2:-2, 2:-2].ravel(), atol=1e-4)


def test_at_the_border_there_is_nothing_to_interpolate_between():
    frame = past(smoothed=np.full(SHAPE, 7.0))
    right, bottom = SHAPE[1] - 1, SHAPE[0] - 1
    inside = [(2, 2), (right - 2, 2), (2, bottom - 2), (right - 2, bottom - 2), (60.5, 40.1)]
    outside = [
        *((1.99, 40), (60, 1.99), (right - 1.99, 40), (60, bottom - 1.99), (0, 0)),
        *((-5, 40), (60, -5), (200, 40), (60, 1e6), (-1e6, -1e6)),
    ]
    got = brightness(frame, np.array(inside + outside, float))
    assert got[: len(inside)] == pytest.approx(7, abs=1e-5)
    assert np.isnan(got[len(inside) :]).all()
    assert brightness(frame, np.zeros((0, 2))).shape == (0,)


def test_a_point_is_contained_up_to_the_last_pixels_centre():
    frame = past()
    xy = np.array([(0, 0), (119, 89), (119.1, 50), (50, 89.1), (-0.1, 50), (3.5, 3.5), (3.4, 50)])
    assert frame.contains(xy).tolist() == [True, True, False, False, False, True, True]
    assert frame.contains(xy, 3.5).tolist() == [False] * 5 + [True, False]


def test_the_envelope_is_the_brightest_within_two_pixels():
    smoothed = np.zeros(SHAPE)
    smoothed[40, 60], smoothed[0, 0] = 500, 80
    frame = past(smoothed=smoothed)
    y, x = np.indices(SHAPE).reshape(2, -1)
    lit = np.argwhere(frame.envelope_at(x, y).reshape(SHAPE) == 500)
    assert (lit.min(axis=0).tolist(), lit.max(axis=0).tolist()) == ([38, 58], [42, 62])
    assert len(lit) == 25
    xy = [(60, 40), (62.4, 42.4), (62.6, 40), (60, 37.4), (2, 2), (3, 0), (-1, 0), (60, 300)]
    assert frame.envelope_at(*np.array(xy).T).tolist() == [500, 500, 0, 0, 80, 0, 0, 0]


def test_the_noise_is_that_of_the_cell():
    frame = past(noise=4.0, ratio=[[1, 2, 3], [0.5, 1, 1.5]])
    pixels = np.array([(0, 0), (39, 44), (40, 44), (119, 0), (0, 45), (119, 89)], np.intp)
    assert frame.noise_at(pixels).tolist() == [4, 4, 8, 12, 2, 6]
