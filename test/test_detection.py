# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Which vectors are RSOs: on hand-made flow, and on plain images of stars and RSOs."""

import numpy as np
import pytest
from blobs import blobs, camera, flux_of_snr, scattered

from ofsat_ros.detection import CANDIDATE, DETECTION_DTYPE, detect
from ofsat_ros.objects import OBJECT_DTYPE
from ofsat_ros.optical_flow import Flow, FlowInput
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.pixels import Regions
from ofsat_ros.star_field import StarFieldMotion

SHAPE = (100, 120)
# What a point source of PSF sigma 1 px looks like after smoothing by 1 px.
WIDTH = np.sqrt(2)


def field_of(shift=(0.0, 0.0), variance=0.0, residual_sigmas=1.0, speed_mean=0.0, speed_std=1.0):
    return StarFieldMotion(
        centre=np.array([59.5, 49.5]),
        displacement=np.array(shift, float),
        rotation=0.0,
        scale=0.0,
        covariance=np.diag([variance, variance, 0, 0]),
        inliers=np.ones(3, bool),
        residual_px=0.1,
        residual_sigmas=residual_sigmas,
        speed_mean=speed_mean,
        speed_std=speed_std,
        model="shift",
    )


def objects_at(xy, **values):
    objects = np.zeros(len(xy), OBJECT_DTYPE)
    objects["x"], objects["y"] = np.reshape(xy, (-1, 2)).T
    for name, value in values.items():
        objects[name] = value
    return objects


def flow_of(xy, displacement, sigma=0.1, valid=True, index=None):
    xy = np.reshape(xy, (-1, 2)).astype(float)
    return Flow.of_vectors(
        position=xy,
        displacement=np.reshape(displacement, (-1, 2)).astype(float),
        sigma=np.broadcast_to(sigma, xy.shape).astype(float),
        valid=np.broadcast_to(valid, len(xy)),
        object_index=np.arange(len(xy)) if index is None else np.array(index, np.intp),
    )


def frame(*xy, peak=100.0, noise=1.0):
    """A frame with point sources at some places; `detect` reads its brightness and noise only."""
    flux = peak * 2 * np.pi * WIDTH**2
    smoothed = blobs(SHAPE, xy, flux, WIDTH) if xy else np.zeros(SHAPE)
    none = np.zeros((0, 2))
    return FlowInput(
        smoothed=smoothed.astype(np.float32),
        above=np.zeros(0, np.intp),
        pedestal=0.0,
        regions=Regions(SHAPE),
        xy=none,
        sigma=none,
        length=np.zeros(0),
        noise=noise,
    )


def run(xy, displacement, field=None, previous=None, dt_s=1.0, objects=None, **options):
    """Detect among vectors that end at `xy`; the two frames show what the vectors say."""
    xy, displacement = np.reshape(xy, (-1, 2)), np.reshape(displacement, (-1, 2))
    flow_options = {k: options.pop(k) for k in ("sigma", "valid", "index") if k in options}
    return detect(
        objects_at(xy) if objects is None else objects,
        flow_of(xy, displacement, **flow_options),
        field or field_of(),
        frame(*(xy - displacement)) if previous is None else previous,
        frame(*xy),
        dt_s,
        **options,
    )


# --- test vector ------------------------------------------------------------------------------


def test_what_moves_otherwise_is_found_with_its_numbers():
    xy = [(30, 20), (60, 50), (90, 70)]
    objects = objects_at(
        xy, snr=[9, 8, 7], flux=[900, 800, 700], length=[0, 4, 0], angle=0.5, sigma_x=0.1,
        sigma_y=0.2,
    )  # fmt: skip
    found = run(xy, [(2, 1), (5, -3), (2, 1)], field_of((2, 1)), dt_s=0.5, objects=objects)
    assert found.dtype == DETECTION_DTYPE
    assert len(found) == 1
    got = {name: found[name][0] for name in DETECTION_DTYPE.names}
    assert (got["x"], got["y"]) == (60, 50)
    # px per frame over half a second
    assert (got["vx"], got["vy"]) == (10, -6)
    assert (got["rel_vx"], got["rel_vy"]) == (6, -8)
    assert (got["snr"], got["flux"], got["length"], got["angle"]) == (8, 800, 4, 0.5)
    assert (got["sigma_x"], got["sigma_y"]) == (0.1, 0.2)
    assert (got["object_index"], got["flow_index"]) == (1, 1)
    assert (got["track_id"], got["status"]) == (0, CANDIDATE)
    # 5 px of 0.1 px
    assert got["significance"] == pytest.approx(50)
    assert np.isnan([got["ra"], got["dec"]]).all()


def test_significance_by_hand():
    # Variance: (1.5 x 0.2)^2 = 0.09 of the vector, 0.07 of the field: 0.16 on each axis.
    # Relative motion (3, 4): 5 / 0.4 = 12.5 sigmas.
    field = field_of((1, 1), variance=0.07, residual_sigmas=1.5)
    kept = run((60, 50), (4, 5), field, sigma=0.2, sigmas=12.4)
    assert kept["significance"] == pytest.approx([12.5])
    assert len(run((60, 50), (4, 5), field, sigma=0.2, sigmas=12.6)) == 0
    # Axes with errors of their own: (3/0.3)^2 + (4/0.5)^2 = 164
    kept = run((60, 50), (3, 4), sigma=[(0.3, 0.5)])
    assert kept["significance"] == pytest.approx([np.sqrt(164)])


def test_direction_counts_not_only_speed():
    """The weakness of the published test: an RSO with the stars' speed."""
    xy, displacement = [(30, 20), (60, 50), (90, 70)], [(3, 0), (0, 3), (3, 0)]
    assert run(xy, displacement, field_of((3, 0)))["object_index"].tolist() == [1]
    field = field_of((3, 0), speed_mean=3.0, speed_std=0.1)
    assert len(run(xy, displacement, field, test="speed", sigmas=2.0)) == 0


def test_slower_than_the_least_motion_is_not_reported():
    xy = [(60, 50)]
    previous = frame(peak=0)
    options = {"previous": previous, "sigma": 0.01, "min_relative_px": 0.3}
    assert len(run(xy, (0.31, 0), **options)) == 1
    assert len(run(xy, (0.29, 0), **options)) == 0


def test_invalid_vectors_are_not_detections():
    xy, displacement = [(30, 20), (60, 50)], [(5, 0), (5, 0)]
    for test in ("vector", "speed"):
        found = run(xy, displacement, valid=[False, True], test=test, sigmas=2.0)
        assert found["object_index"].tolist() == [1]


def test_objects_cut_by_the_border_are_not_reported():
    xy, displacement = [(30, 20), (60, 50)], [(5, 0), (5, 0)]
    objects = objects_at(xy, edge=[True, False])
    assert run(xy, displacement, objects=objects)["object_index"].tolist() == [1]


def test_field_motion_is_taken_where_the_object_is():
    field = field_of((2, 0))
    turning = StarFieldMotion(**{**vars(field), "rotation": 0.1, "scale": 0.0})
    # 20 px right of the centre a rotation of 0.1 rad adds 2 px downwards
    with_field = run((79.5, 49.5), (2, 2), turning)
    assert len(with_field) == 0
    found = run((79.5, 49.5), (2, 2), field)
    assert (found["rel_vx"][0], found["rel_vy"][0]) == (0, 2)


# --- was it there before? ---------------------------------------------------------------------


def test_a_star_that_was_there_is_no_rso_whatever_its_vector_says():
    xy = np.array([[60.0, 50.0]])
    shift = np.array([4.0, 2.0])
    field = field_of(shift)
    # the wrong vector points to an empty place; the star's own place in the previous frame is lit
    assert len(run(xy, (12, -9), field, previous=frame(*(xy - shift)))) == 0
    assert len(run(xy, (12, -9), field, previous=frame(*(xy - (12, -9))))) == 1


@pytest.mark.parametrize("relative", [0.8, 1.2, 2.0, 4.0])
def test_a_slow_rso_had_not_gone_far(relative):
    """Its own image still covers the place; a star at the same place would be brighter."""
    xy = np.array([[60.3, 50.6]])
    moved = xy - (relative, 0)
    assert len(run(xy, (relative, 0), previous=frame(*moved), sigma=0.02)) == 1
    assert len(run(xy, (relative, 0), previous=frame(*xy), sigma=0.02)) == 0


def test_a_variable_star_is_no_rso_unless_it_was_dark():
    """Nearer to constancy than to what 4 px away has left: more than half the brightness."""
    xy = np.array([[60.0, 50.0]])
    noise = 1.0
    for peak, expected in ((60, 0), (55, 0), (45, 1), (20, 1)):
        found = run(xy, (4, 0), previous=frame(*xy, peak=peak, noise=noise))
        assert len(found) == expected, peak


# --- one detection per object -----------------------------------------------------------------


def test_several_vectors_of_one_object_are_one_detection():
    xy = [(58, 50), (60, 50), (62, 50), (20, 20), (90, 70)]
    displacement = [(4, 0), (9, 0), (6, 0), (5, 0), (5, 0)]
    objects = objects_at([(60, 50), (20, 20)], snr=[30, 20])
    for test, sigmas in (("vector", 6.0), ("speed", 2.0)):
        found = run(
            xy, displacement, index=[0, 0, 0, 1, -1], objects=objects, test=test, sigmas=sigmas
        )
        # the most significant of the three, in the vectors' order
        assert found["flow_index"].tolist() == [1, 3, 4]
        assert found["object_index"].tolist() == [0, 1, -1]
        assert found["x"].tolist() == [60, 20, 90]


def test_vectors_without_object_stand_for_themselves():
    xy, displacement = [(30, 20), (60, 50)], [(5, 0), (0, 5)]
    found = run(xy, displacement, index=[-1, -1], objects=objects_at([]), sigma=0.2)
    assert found["flow_index"].tolist() == [0, 1]
    assert found["object_index"].tolist() == [-1, -1]
    assert found[["x", "y"]].tolist() == [(30, 20), (60, 50)]
    assert found["sigma_x"].tolist() == [0.2, 0.2]
    for name in ("snr", "flux", "length", "angle"):
        assert np.isnan(found[name]).all()


# --- test speed, as published -----------------------------------------------------------------


def test_speed_outside_the_fields_mean_and_std():
    xy = [(20, 20), (40, 20), (60, 20), (80, 20)]
    displacement = [(2.9, 0), (0, 4.1), (-5, 0), (0.9, 0)]
    field = field_of((3, 0), speed_mean=3.0, speed_std=0.5)
    found = run(xy, displacement, field, test="speed", sigmas=2.0)
    # |2.9 - 3|, |4.1 - 3|, |5 - 3|, |0.9 - 3| over 0.5
    assert found["object_index"].tolist() == [1, 2, 3]
    assert found["significance"] == pytest.approx([2.2, 4.0, 4.2])
    # relative velocity stays a vector
    assert found["rel_vx"] == pytest.approx([-3, -8, -2.1])


def test_speed_asks_for_the_mean_of_a_regions_pixels():
    flow = flow_of([(20, 20), (40, 20)], [(1, 0), (1, 0)])
    flow = Flow(**{**vars(flow), "speed_mean": np.array([1.0, 2.0])})
    field = field_of(speed_mean=1.0, speed_std=0.1)
    found = detect(
        objects_at([(20, 20), (40, 20)]), flow, field, frame(), frame(), 1.0, "speed", 2.0
    )
    assert found["flow_index"].tolist() == [1]


def test_speed_of_a_field_without_any_spread():
    """All stars alike to rounding: whatever differs is infinitely significant, but finite."""
    field = field_of(speed_mean=3.0, speed_std=0.0)
    found = run([(20, 20), (40, 20)], [(3, 0), (3.1, 0)], field, test="speed", sigmas=2.0)
    assert found["object_index"].tolist() == [1]
    assert np.isfinite(found["significance"]).all()


@pytest.mark.parametrize("test", ["vector", "speed"])
def test_nothing_in_nothing_out(test):
    found = detect(objects_at([]), Flow.empty(), field_of(), frame(), frame(), 1.0, test)
    assert found.dtype == DETECTION_DTYPE
    assert len(found) == 0


# --- from images ------------------------------------------------------------------------------

SIDE = 300
RSOS = np.array([[60.0, 210.0], [200.4, 90.3], [151.7, 148.2]])


def sequence(star_v, rso_v, dtype, frames=3, dt_s=2.0, exposure_s=0.0, seed=1, snr=40):
    """Images of stars and of RSOs, velocities in px/s; and where the RSOs are in each."""
    rng = np.random.default_rng(seed)
    noise = {np.uint8: 3, np.uint16: 10}[dtype]
    stars = scattered(rng, (SIDE, SIDE), 30)
    # no star may cover an RSO in any of the frames
    drift = np.subtract(star_v, rso_v) * dt_s * np.arange(frames)[:, None, None, None]
    distance = np.linalg.norm(stars[:, None] + drift - RSOS, axis=-1)
    stars = stars[distance.min(axis=(0, 2)) > 14]
    images, places = [], []
    for k in range(frames):
        signal = np.zeros((SIDE, SIDE))
        for xy, velocity in ((stars, star_v), (RSOS, rso_v)):
            streak = np.multiply(velocity, exposure_s)
            flux = flux_of_snr(snr, noise, 1.0) * np.sqrt(1 + np.hypot(*streak) / 3)
            place = xy + np.multiply(velocity, k * dt_s)
            signal += blobs((SIDE, SIDE), place, flux, 1.0, streak)
        places.append(place)
        images.append(camera(signal, rng, dtype))
    return images, places, dt_s


def process(images, dt_s, **changes):
    pipeline = Pipeline(Parameters.preset("robust", rso_test="vector", **changes))
    return [pipeline.process(image, round(k * dt_s * 1e9)) for k, image in enumerate(images)]


def assert_all_found(results, places, star_v, rso_v, reach_px, speed_px_s):
    for result, place in zip(results[1:], places[1:], strict=True):
        found = result.detections
        assert len(found) == len(RSOS)
        for x, y in place:
            nearest = found[np.argmin(np.hypot(found["x"] - x, found["y"] - y))]
            assert (nearest["x"], nearest["y"]) == pytest.approx((x, y), abs=reach_px)
            assert (nearest["vx"], nearest["vy"]) == pytest.approx(rso_v, abs=speed_px_s)
            relative = np.subtract(rso_v, star_v)
            assert (nearest["rel_vx"], nearest["rel_vy"]) == pytest.approx(
                relative, abs=speed_px_s
            )
            assert nearest["significance"] > 7


@pytest.mark.parametrize("engine", ["sparse", "dense"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_sidereal_tracking_stars_stand_and_rsos_cross(engine, dtype):
    star_v, rso_v = (0.0, 0.0), (1.1, -0.7)
    images, places, dt_s = sequence(star_v, rso_v, dtype)
    results = process(images, dt_s, engine=engine)
    # SNR 40: 0.04 px per centroid, 0.07 px per vector and axis; four of those, over 2 s
    assert_all_found(results, places, star_v, rso_v, 0.2, 0.15)


@pytest.mark.parametrize("engine", ["sparse", "dense"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_rate_tracking_rsos_stand_and_stars_streak(engine, dtype):
    star_v, rso_v = (4.7, 2.1), (0.0, 0.0)
    images, places, dt_s = sequence(star_v, rso_v, dtype, exposure_s=0.8)
    results = process(images, dt_s, engine=engine)
    # the stars are streaks of 4 px: their vectors are worse than points', the RSOs' are not
    assert_all_found(results, places, star_v, rso_v, 0.2, 0.15)
    for result in results[1:]:
        moved = result.star_field.displacement / result.dt_s
        # 0.1 px per frame
        assert moved == pytest.approx(star_v, abs=0.05)


@pytest.mark.parametrize("engine", ["sparse", "dense"])
@pytest.mark.parametrize("star_v", [(0.0, 0.0), (3.3, -1.2)])
def test_stars_alone_are_no_rsos(engine, star_v):
    images, _, dt_s = sequence(star_v, star_v, np.uint16, frames=4, snr=20)
    results = process(images, dt_s, engine=engine)
    assert [len(result.detections) for result in results] == [0] * 4
    assert "everything moves with the star field" in results[1].reason
