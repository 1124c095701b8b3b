# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pixels to directions and back: against OpenCV, astropy's WCS, closed forms and differences."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from astropy.io.fits import Header
from astropy.wcs import WCS
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import (
    Astrometry,
    Attitudes,
    Camera,
    CameraError,
    from_radec,
    rotation_of,
    to_radec,
)
from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.parameters import CameraParameters
from ofsat_ros.tracking import TRACK_DTYPE

WIDTH, HEIGHT = 800, 600
MAS = np.radians(1e-3 / 3600)
NS = 1_000_000_000
BARREL = [-0.3, 0.1, 1e-3, -2e-3, -0.01]
# Name: model, coefficients, focal length in px.  Fields of view are 77 to 150 degrees wide.
LENSES = {
    "ideal": ("plumb_bob", [], 500),
    "unnamed": ("", [0.0] * 5, 500),
    "barrel": ("plumb_bob", BARREL, 500),
    "pincushion": ("plumb_bob", [0.2, 0.1, 1e-3, -2e-3], 400),
    "decentred": ("plumb_bob", [-0.1, 0.05, 0.02, -0.03, 0.0], 600),
    "telescope": ("plumb_bob", [-13.0, 2500.0, 1e-3, -1e-3, 0.0], 20626.5),
    "rational": ("rational_polynomial", [8.0, 4.0, 1e-4, -1e-4, 0.2, 8.4, 6.5, 1.2], 500),
    "prism": (
        "rational_polynomial",
        [0.9, 0.2, 1e-4, -1e-4, 0.02, 0.5, 0.1, 0.01, 1e-3, 2e-4, -1e-3, 1e-4],
        700,
    ),
    "tilt of 0": ("rational_polynomial", [0.1, *[0.0] * 13], 500),
    "fisheye": ("equidistant", [-0.02, 0.004, -0.001, 1e-4], 300),
    "equiangular": ("fisheye", [], 300),
}


def matrix_of(focal_px):
    """Not square, not centred, and skewed."""
    return np.array([[focal_px, 0.3, 402.3], [0, 1.01 * focal_px, 297.0], [0, 0, 1]])


def camera_of(model, distortion, focal_px):
    return Camera.from_calibration(WIDTH, HEIGHT, matrix_of(focal_px).ravel(), distortion, model)


@pytest.fixture(params=LENSES)
def lens(request):
    return LENSES[request.param]


@pytest.fixture
def camera(lens):
    return camera_of(*lens)


def image_grid(width=WIDTH, height=HEIGHT, step=20):
    """The whole image, with its edges and corners."""
    x, y = (np.linspace(-0.5, size - 0.5, size // step + 1) for size in (width, height))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def opencv_pixels(model, distortion, focal_px, sight):
    """Project with OpenCV, which does it its own way for directions in front of the camera."""
    plane, zero = (sight / sight[:, 2:])[:, None], np.zeros(3)
    if model in ("equidistant", "fisheye"):
        # Its fisheye model has the skew as a fraction of the focal length.
        matrix, four = matrix_of(focal_px), np.array([*distortion, 0, 0, 0, 0][:4], float)
        alpha, matrix[0, 1] = matrix[0, 1] / focal_px, 0
        pixels, _ = cv2.fisheye.projectPoints(plane, zero, zero, matrix, four, alpha=alpha)
        return pixels.reshape(-1, 2)
    # It has no skew.
    pixels, _ = cv2.projectPoints(plane, zero, zero, np.eye(3), np.array(distortion or [0.0] * 4))
    return pixels.reshape(-1, 2) @ matrix_of(focal_px)[:2, :2].T + matrix_of(focal_px)[:2, 2]


# Lines of sight ---------------------------------------------------------------------------------


def test_axes_of_an_ideal_camera():
    camera = Camera.ideal(101, 51, 0.01)
    sight = camera.lines_of_sight([[50, 25], [51, 25], [50, 26], [150, 25]])
    forward, right, down, far_right = sight
    assert forward.tolist() == [0, 0, 1]
    # f is 100 px.
    np.testing.assert_allclose(right / right[2], [0.01, 0, 1], rtol=1e-14)
    np.testing.assert_allclose(down / down[2], [0, 0.01, 1], rtol=1e-14)
    np.testing.assert_allclose(far_right, [0.5**0.5, 0, 0.5**0.5], rtol=1e-14)
    np.testing.assert_allclose(camera.matrix, [[100, 0, 50], [0, 100, 25], [0, 0, 1]])
    assert (camera.width, camera.height, camera.model) == (101, 51, "plumb_bob")


def test_round_trip_over_the_whole_image(camera):
    xy = image_grid()
    sight = camera.lines_of_sight(xy)
    np.testing.assert_allclose(np.linalg.norm(sight, axis=1), 1, rtol=1e-14)
    # 1e-4 is asked for; 1e-6 is what the inversion allows itself.
    np.testing.assert_allclose(camera.pixels(sight), xy, rtol=0, atol=1e-6)
    np.testing.assert_allclose(camera.pixels(7 * sight), xy, rtol=0, atol=1e-6)


def test_opencv_projects_our_lines_of_sight_onto_the_pixels_they_come_from(camera, lens):
    xy = image_grid()
    sight = camera.lines_of_sight(xy)
    ahead = sight[:, 2] > 0.01
    assert ahead.mean() > 0.8
    np.testing.assert_allclose(opencv_pixels(*lens, sight[ahead]), xy[ahead], rtol=0, atol=1e-6)


def test_distortion_is_strong_in_these_tests():
    """What distortion moves a corner by, px: else the tests above would show little."""
    moved = {}
    for name, lens in LENSES.items():
        sight = camera_of(*lens).lines_of_sight([[-0.5, -0.5]])
        plane = sight[:, :2] / sight[:, 2:]
        moved[name] = np.abs(plane * lens[2] + matrix_of(1)[:2, 2] - [-0.5, -0.5]).max()
    assert min(moved[name] for name in ("barrel", "pincushion", "prism", "fisheye")) > 40
    assert moved["telescope"] > 2


def test_a_fisheye_looks_backwards():
    camera = camera_of("fisheye", [], 200)
    # 100 degrees from the axis, to the right: f theta from the principal point.
    beside = 402.3 + 200 * np.radians(100)
    sight = camera.lines_of_sight([[beside, 297.0]])[0]
    angle = np.radians(100)
    np.testing.assert_allclose(sight, [np.sin(angle), 0, np.cos(angle)], atol=1e-14)
    assert sight[2] < -0.17
    np.testing.assert_allclose(camera.pixels([sight]), [[beside, 297.0]], rtol=1e-14)
    # Right behind there are all directions of the image at once, and beyond there is nothing.
    assert np.isnan(camera.pixels([[0, 0, -1.0]])).all()
    assert np.isnan(camera.lines_of_sight([[402.3 + 200 * 3.15, 297.0]])).all()


def test_what_no_direction_leads_to_is_unknown():
    camera = camera_of("plumb_bob", BARREL, 500)
    behind = [[0, 0, -1.0], [1, 0, 0], [0.1, 0.1, -1], [0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1]]
    assert np.isnan(camera.pixels(behind)).all()
    assert np.isnan(Camera.ideal(9, 9, 0.1).pixels(behind)).all()
    unknown = [[np.nan, 3], [np.inf, 3], [3, -np.inf], [1e300, 0]]
    for each in (camera, camera_of("fisheye", [0.1, 0, 0, 0], 300)):
        sight, jacobians = each.sights_with_jacobians(unknown)
        assert np.isnan(sight).all()
        assert np.isnan(jacobians).all()
    assert Camera.ideal(9, 9, 0.1).lines_of_sight(np.zeros((0, 2))).shape == (0, 3)
    assert camera.pixels(np.zeros((0, 3))).shape == (0, 2)


def test_beyond_the_fold_of_a_barrel_nothing_is_known():
    """The radius r (1 - r^2 / 2) grows up to r = sqrt(2 / 3), then falls."""
    camera = Camera.from_calibration(
        WIDTH, HEIGHT, [500, 0, 400, 0, 500, 300, 0, 0, 1], [-0.5, 0, 0, 0], "plumb_bob"
    )
    fold = (2 / 3) ** 0.5
    edge_px = 500 * fold * (1 - fold**2 / 2)
    x = 400 + edge_px * np.array([0.1, 0.9, 0.999, 1.0001, 1.1])
    sight = camera.lines_of_sight(np.stack([x, np.full(5, 300.0)], -1))
    assert np.isnan(sight[:, 0]).tolist() == [False, False, False, True, True]
    assert (sight[:3, 0] / sight[:3, 2] < fold).all()
    # OpenCV takes a direction beyond for a pixel well inside the image.
    beyond = np.array([[1.2, 0, 1]])
    wrong, _ = cv2.projectPoints(
        beyond, np.zeros(3), np.zeros(3), camera.matrix, np.array([-0.5, 0, 0, 0])
    )
    assert 400 < wrong.reshape(2)[0] < 600
    assert np.isnan(camera.pixels(beyond)).all()


def test_a_second_branch_beyond_the_fold_is_not_taken():
    """The radius r (1 - r^2 + 0.4 r^4) falls between 0.71 and 1, then grows for ever."""
    camera = Camera.from_calibration(
        WIDTH, HEIGHT, [500, 0, 400, 0, 500, 300, 0, 0, 1], [-1.0, 0.4, 0, 0], "plumb_bob"
    )
    far = np.array([[2.0, 0, 1]])
    assert np.isnan(camera.pixels(far)).all()
    image = 500 * 2 * (1 - 4 + 0.4 * 16) + 400
    assert np.isnan(camera.lines_of_sight([[image, 300]])).all()


@pytest.mark.parametrize(
    ("ratio", "known", "unknown"),
    [
        # (1 - 0.98 r^2 / 0.36) / (1 - r^2 / 0.36): up to infinity at 0.6, then up from below 0.
        (0.98, (0.3, 0.59, 0.5999), (0.6, 0.601, 0.604, 0.62, 5.0)),
        # With 1.02: down to 0 at 0.594, where it has long been falling.
        (1.02, (0.3, 0.5), (0.594, 0.597, 0.6, 0.62, 5.0)),
    ],
)
def test_a_pole_and_a_zero_that_lie_close_together_are_found(ratio, known, unknown):
    """Numerator and denominator nearly cancel: the model breaks within 1 % of the radius."""
    distortion = [-ratio / 0.36, 0, 0, 0, 0, -1 / 0.36, 0, 0]
    camera = camera_of("rational_polynomial", distortion, 400)
    assert np.isnan(camera.pixels([(radius, 0, 1) for radius in unknown])).all()
    sight = camera.lines_of_sight(camera.pixels([(radius, 0, 1) for radius in known]))
    np.testing.assert_allclose(sight[:, 0] / sight[:, 2], known, rtol=1e-8)


# Coefficients times powers of the field's radius: what they do at the image's corner.
RADIAL = st.floats(-0.8, 0.8)
SMALL = st.floats(-0.03, 0.03)
FOCAL = st.floats(150, 40000)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    radial=st.lists(RADIAL, min_size=6, max_size=6),
    small=st.lists(SMALL, min_size=6, max_size=6),
    focal_px=FOCAL,
    kind=st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant"]),
    seed=st.integers(0, 2**31),
)
@example([-0.5, 0.4, -0.1, 0.0, 0.0, 0.0], [0.0] * 6, 300.0, "plumb_bob", 1)
@example([-0.6, 0.6, -0.2, -0.62, 0.6, -0.2], [0.03] * 6, 300.0, "rational_polynomial", 1)
def test_a_direction_is_right_or_unknown(radial, small, focal_px, kind, seed):
    inverse_r2 = (focal_px / 500) ** 2
    (k1, k2, k3, k4, k5, k6), (p1, p2, *prism) = radial, small
    first, last = [k1 * inverse_r2, k2 * inverse_r2**2], k3 * inverse_r2**3
    tangential = [p1 * inverse_r2**0.5, p2 * inverse_r2**0.5]
    distortion = [*first, *tangential, last]
    if kind == "rational_polynomial":
        distortion += [k4 * inverse_r2, k5 * inverse_r2**2, k6 * inverse_r2**3]
        distortion += [s * inverse_r2 ** (0.5 + i % 2) for i, s in enumerate(prism)]
    if kind == "equidistant":
        distortion = [*first, last, k4 * inverse_r2**4]
    camera = camera_of(kind, distortion, focal_px)
    random = np.random.default_rng(seed)
    # From the image and back.
    xy = random.uniform(-0.5, [WIDTH - 0.5, HEIGHT - 0.5], (300, 2))
    sight = camera.lines_of_sight(xy)
    known = np.isfinite(sight[:, 0])
    # What is known is so both ways, and leads back.
    np.testing.assert_allclose(camera.pixels(sight[known]), xy[known], rtol=0, atol=2e-6)
    # From the sky and back: whatever appears in the image was seen from there and nowhere else.
    radius = np.tan(np.minimum(random.uniform(0, 1200 / focal_px, 300), 1.5))
    turn = random.uniform(0, 2 * np.pi, 300)
    sky = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.ones(300)], -1)
    sky /= np.linalg.norm(sky, axis=1)[:, None]
    pixels = camera.pixels(sky)
    inside = (np.abs(pixels - [WIDTH / 2, HEIGHT / 2]) < [WIDTH, HEIGHT]).all(1)
    seen, jacobians = camera.sights_with_jacobians(pixels[inside])
    found = np.isfinite(seen[:, 0])
    assert found.mean() > 0.9 or not inside.any()
    error = np.linalg.norm(seen - sky[inside], axis=1)[found]
    allowed = 1e-5 * np.linalg.norm(jacobians, axis=(1, 2))[found] + 1e-12
    assert (error <= allowed).all()


# Covariances and rates --------------------------------------------------------------------------


def test_jacobians_are_the_derivatives_of_the_lines_of_sight(camera):
    xy = np.concatenate([image_grid(step=50), [[402.3, 297.0]]])  # and on the axis
    jacobians, step = camera.jacobians(xy), 1e-3
    for axis in (0, 1):
        shift = step * np.eye(2)[axis]
        ends = camera.lines_of_sight(xy + shift) - camera.lines_of_sight(xy - shift)
        # A thousandth of a px: rounding gives 1e-13 of a rad, curvature less than 1e-6 of it all.
        np.testing.assert_allclose(
            jacobians[:, :, axis],
            ends / (2 * step),
            atol=1e-5 * np.abs(jacobians).max(),
            rtol=0,
        )
    across = np.einsum("nij,ni->nj", jacobians, camera.lines_of_sight(xy))
    np.testing.assert_allclose(across, 0, atol=1e-12)


def test_rates_are_those_of_a_point_that_moves(camera):
    xy, velocity = image_grid(step=100), np.array([30.0, -70.0])
    rates = camera.rates(xy, np.broadcast_to(velocity, xy.shape))
    ends = [camera.lines_of_sight(xy + sign * 1e-4 * velocity) for sign in (-1, 1)]
    expected = (ends[1] - ends[0]) / 2e-4
    np.testing.assert_allclose(rates, expected, atol=1e-5 * np.abs(expected).max(), rtol=0)


# Calibrations -----------------------------------------------------------------------------------

K = [500.0, 0, 400, 0, 500, 300, 0, 0, 1]


def test_a_binned_pixel_looks_where_its_pixels_do_on_average():
    whole = Camera.from_calibration(WIDTH, HEIGHT, K, BARREL, "plumb_bob")
    part = Camera.from_calibration(
        WIDTH, HEIGHT, K, BARREL, "plumb_bob", binning=(2, 4), roi=(100, 40, 600, 400)
    )
    assert (part.width, part.height) == (300, 100)
    # Binned pixel (5, 7) holds the columns 110, 111 and the rows 68 to 71.
    np.testing.assert_allclose(
        part.lines_of_sight([[5, 7]]), whole.lines_of_sight([[110.5, 69.5]]), rtol=1e-8
    )
    np.testing.assert_allclose(part.pixels(whole.lines_of_sight([[110.5, 69.5]])), [[5, 7]])


def test_binning_and_region_of_0_are_none():
    plain = Camera.from_calibration(WIDTH, HEIGHT, K, BARREL, "plumb_bob")
    zeros = Camera.from_calibration(
        WIDTH, HEIGHT, K, BARREL, "plumb_bob", binning=(0, 0), roi=(0, 0, 0, 0)
    )
    assert (zeros.width, zeros.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(plain.matrix, np.reshape(K, (3, 3)))
    np.testing.assert_array_equal(zeros.matrix, plain.matrix)


@pytest.mark.parametrize("case", [str.lower, str.upper], ids=["ROS 2", "ROS 1"])
def test_from_message(case):
    message = SimpleNamespace(
        width=WIDTH,
        height=HEIGHT,
        distortion_model="plumb_bob",
        binning_x=2,
        binning_y=0,
        roi=SimpleNamespace(x_offset=20, y_offset=30, width=400, height=0, do_rectify=False),
    )
    setattr(message, case("k"), np.array(K))
    setattr(message, case("d"), np.array(BARREL))
    camera = Camera.from_message(message)
    assert (camera.width, camera.height) == (200, 570)
    np.testing.assert_allclose(
        camera.matrix, [[250, 0, (400 - 20 + 0.5) / 2 - 0.5], [0, 500, 270], [0, 0, 1]]
    )
    np.testing.assert_array_equal(camera.distortion, BARREL)


def test_a_camera_cannot_be_changed():
    camera = Camera.from_calibration(WIDTH, HEIGHT, K, BARREL, "plumb_bob")
    with pytest.raises(ValueError, match="read-only"):
        camera.matrix[0, 0] = 1.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"k": [0.0] * 9}, r"not calibrated: K\[0\] is 0"),
        ({"k": K[:8]}, "9 values, not 8"),
        ({"k": [np.nan, *K[1:]]}, "not numbers"),
        ({"k": [-500.0, *K[1:]]}, "focal lengths must be positive"),
        ({"k": [*K[:4], 0.0, *K[5:]]}, "focal lengths must be positive"),
        ({"k": [*K[:8], 2.0]}, "0 0 1"),
        ({"k": [*K[:3], 1.0, *K[4:]]}, "fx s cx"),
        ({"d": [0.1] * 6}, "plumb_bob has 0 or 4 or 5 distortion coefficients, but there are 6"),
        ({"d": [0.1, np.inf, 0, 0]}, "not numbers"),
        ({"d": [0, 0, 1e9, 0]}, "is no distortion: .* folds over next to"),
        ({"d": [0.1] * 5, "model": ""}, "names no model"),
        ({"d": [0.1] * 4, "model": "rational_polynomial"}, "8 or 12 or 14"),
        ({"d": [0.0] * 13 + [0.1], "model": "rational_polynomial"}, "tilted sensor"),
        ({"d": [0.1] * 5, "model": "fisheye"}, "equidistant has 0 or 4"),
        ({"model": "omnidirectional"}, "unknown distortion model 'omnidirectional'; known are"),
        ({"width": 0}, "not within an image of 0 x 600"),
        ({"roi": (700, 0, 200, 0)}, "not within an image of 800 x 600"),
        ({"binning": (900, 1)}, "0 x 600 px is empty"),
    ],
)
def test_what_is_no_calibration(changes, words):
    values = {"width": WIDTH, "height": HEIGHT, "k": K, "d": [], "model": "plumb_bob"}
    with pytest.raises(CameraError, match=words):
        Camera.from_calibration(**{**values, **changes})


@pytest.mark.parametrize("scale", [0.0, -1e-3, np.nan, np.inf])
def test_an_ideal_camera_needs_a_scale(scale):
    with pytest.raises(CameraError, match="cannot span"):
        Camera.ideal(10, 10, scale)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    k=st.lists(st.floats(), min_size=9, max_size=9)
    | st.tuples(*[st.just(x) if x in (0, 1) else st.floats(1e-3, 1e9) for x in K]),
    d=st.lists(st.floats() | st.floats(-1, 1), max_size=14),
    model=st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant", "fisheye", ""]),
    pixel=st.tuples(st.floats(), st.floats()),
)
def test_any_numbers_make_a_camera_or_are_refused(k, d, model, pixel):
    try:
        camera = Camera.from_calibration(WIDTH, HEIGHT, k, d, model)
    except CameraError:
        return
    sight = camera.lines_of_sight([pixel])
    assert sight.shape == (1, 3)
    assert np.isnan(sight).all() or np.linalg.norm(sight) == pytest.approx(1)
    assert camera.pixels(sight).shape == (1, 2)


# Right ascension and declination ----------------------------------------------------------------


def attitude_to(ra_deg, dec_deg, roll_deg=0.0):
    """Return the attitude of a camera that looks there.

    With north up and east to the left, then turned so that north goes from up to the right.
    """
    ra, dec = np.radians([ra_deg, dec_deg])
    east = np.array([-np.sin(ra), np.cos(ra), 0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    upright = Rotation.from_matrix([-east, -north, np.cross(-east, -north)])
    return Rotation.from_rotvec([0, 0, np.radians(roll_deg)]) * upright


def test_signs_of_an_attitude():
    camera = Camera.ideal(101, 101, 1e-3)
    attitude = attitude_to(50, 20)
    ra, dec = to_radec(camera.lines_of_sight([[50, 50], [60, 50], [50, 40]]), attitude)
    np.testing.assert_allclose(np.degrees([ra[0], dec[0]]), [50, 20], rtol=1e-14)
    assert ra[1] < ra[0]  # east is to the left
    assert dec[2] > dec[0]  # north is up
    # Turned by 90 degrees north is to the right.
    ra, dec = to_radec(camera.lines_of_sight([[50, 50], [60, 50]]), attitude_to(50, 20, 90))
    assert dec[1] > dec[0]
    assert ra[1] == pytest.approx(ra[0], abs=1e-12)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    ra=st.floats(0, 2 * np.pi, exclude_max=True),
    dec=st.floats(-np.pi / 2, np.pi / 2),
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
)
@example(0.0, 0.0, (0.0, 0.0, 0.0))
@example(0.0, np.pi / 2, (0.0, 0.0, 1e-300))
def test_radec_round_trip(ra, dec, rotation):
    attitude = Rotation.from_rotvec(rotation)
    sight = from_radec(ra, dec, attitude)
    assert sight.shape == (1, 3)
    ra_back, dec_back = to_radec(sight, attitude)
    assert 0 <= ra_back[0] < 2 * np.pi
    assert dec_back[0] == pytest.approx(dec, abs=1e-12)
    turn = (ra_back[0] - ra + np.pi) % (2 * np.pi) - np.pi
    assert turn * np.cos(dec) == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(from_radec(ra_back, dec_back, attitude), sight, atol=1e-14)


def test_right_ascension_is_never_a_whole_turn():
    ra, _ = to_radec([[1.0, -1e-17, 0]], Rotation.identity())
    assert ra.tolist() == [0.0]


# World coordinate systems -----------------------------------------------------------------------

SCALE_ARCSEC = 10.0
SIZE = 512
POINTINGS = [
    *((0.001, 0.0, 0.0), (83.6, 22.0, 30.0), (201.4, -43.0, -137.0)),
    *((359.9, 75.0, 90.0), (120.0, 89.9, 200.0), (10.0, 90.0, 45.0), (250.0, -89.99, 10.0)),
]


def tan_header(camera, ra_deg, dec_deg, roll_deg):
    """Return FITS cards of the same camera: pixels count from 1, xi to the east, eta north."""
    scale = np.degrees(1 / camera.matrix[0, 0])
    turn = np.radians(roll_deg)
    # North up, east left; the field turned clockwise on the screen (x towards y).
    cd = scale * np.array([[-np.cos(turn), -np.sin(turn)], [np.sin(turn), -np.cos(turn)]])
    header = Header()
    header["CTYPE1"], header["CTYPE2"] = "RA---TAN", "DEC--TAN"
    header["CRVAL1"], header["CRVAL2"] = ra_deg, dec_deg
    header["CRPIX1"], header["CRPIX2"] = camera.matrix[:2, 2] + 1
    for i, j in np.ndindex(2, 2):
        header[f"CD{i + 1}_{j + 1}"] = cd[i, j]
    header["LONPOLE"] = 180.0  # at a pole the default is another
    header["RADESYS"] = "ICRS"
    return header


def unit_vectors(ra, dec):
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)


def radec_of_wcs(wcs, xy):
    return np.radians(wcs.all_pix2world(xy, 0)).T


@pytest.mark.parametrize("pointing", POINTINGS)
def test_agrees_with_astropy_tan(pointing):
    camera = Camera.ideal(SIZE, SIZE, np.radians(SCALE_ARCSEC / 3600))
    attitude = attitude_to(*pointing)
    wcs = WCS(tan_header(camera, *pointing))
    xy = image_grid(SIZE, SIZE)
    ra, dec = to_radec(camera.lines_of_sight(xy), attitude)
    theirs = radec_of_wcs(wcs, xy)
    off = np.linalg.norm(unit_vectors(ra, dec) - unit_vectors(*theirs), axis=1)
    assert off.max() < 1e-3 * MAS
    pixels = camera.pixels(from_radec(*theirs, attitude))
    np.testing.assert_allclose(pixels, xy, rtol=0, atol=1e-6)


@pytest.mark.parametrize("pointing", POINTINGS)
@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", [-14.0, 300.0, 2e-3, -3e-3]),
        ("plumb_bob", [14.0, -300.0, 0.0, 0.0, 1e4]),
        ("rational_polynomial", [20.0, 0, 1e-3, 1e-3, 0, 30.0, 500.0, 0]),
    ],
)
def test_agrees_with_astropy_tan_sip(model, distortion, pointing):
    """A SIP polynomial is fitted to where OpenCV projects a grid of directions to.

    SIP adds a polynomial of the distorted pixel and gives the undistorted one: the way that has
    no closed form in our models, so none of our inversion is in the comparison.
    """
    f = 1 / np.radians(SCALE_ARCSEC / 3600)
    middle = (SIZE - 1) / 2
    k = np.array([[f, 0, middle], [0, f, middle], [0, 0, 1]])
    camera = Camera.from_calibration(SIZE, SIZE, k.ravel(), distortion, model)
    ideal = image_grid(SIZE + 40, SIZE + 40, 8) - SIZE / 2 - 19.5
    directions = np.concatenate([ideal / f, np.ones((len(ideal), 1))], 1)
    distorted, _ = cv2.projectPoints(
        directions[:, None], np.zeros(3), np.zeros(3), k, np.array(distortion)
    )
    offset = distorted.reshape(-1, 2) - middle
    assert 1 < np.linalg.norm(offset - ideal, axis=1).max() < 10
    order = 7
    powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    terms = np.stack([(offset[:, 0] / SIZE) ** i * (offset[:, 1] / SIZE) ** j for i, j in powers])
    fitted, *_ = np.linalg.lstsq(terms.T, ideal - offset, rcond=None)
    header = tan_header(camera, *pointing)
    header["CTYPE1"], header["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
    header["A_ORDER"] = header["B_ORDER"] = order
    for (i, j), (a, b) in zip(powers, fitted, strict=True):
        header[f"A_{i}_{j}"] = a / SIZE ** (i + j)
        header[f"B_{i}_{j}"] = b / SIZE ** (i + j)
    xy = image_grid(SIZE, SIZE)
    theirs = radec_of_wcs(WCS(header), xy)
    ra, dec = to_radec(camera.lines_of_sight(xy), attitude_to(*pointing))
    off = np.linalg.norm(unit_vectors(ra, dec) - unit_vectors(*theirs), axis=1)
    assert off.max() < MAS


# Attitudes over time ----------------------------------------------------------------------------

RATE = np.array([0.02, -0.05, 0.3])  # rad/s, optical frame
START = attitude_to(80, 30, 20)


def turning(seconds, rate=RATE):
    """Return the attitude after a while of turning at a constant rate, in closed form."""
    return Rotation.from_rotvec(-np.asarray(rate) * seconds) * START


def angle_between(one, other):
    return (one * other.inv()).magnitude()


def attitudes_at(*seconds):
    attitudes = Attitudes()
    for each in seconds:
        attitudes.add(round(each * NS), turning(each))
    return attitudes


@pytest.mark.parametrize("at", [0.0, 0.25, 1e-9, 0.7, 0.999_999_999, 1.0, 1.5])
def test_interpolation_is_exact_for_a_constant_rate(at):
    attitude, why = attitudes_at(0, 1, 2).at(round(at * NS), 1.0)
    assert why == ""
    assert angle_between(attitude, turning(at)) < 1e-9


@pytest.mark.parametrize("at", [2.000_000_001, 2.3, 3.0])
def test_extrapolation_is_exact_for_a_constant_rate(at):
    attitude, why = attitudes_at(0, 1, 2).at(round(at * NS), 1.0)
    assert why == ""
    assert angle_between(attitude, turning(at)) < 1e-9


@pytest.mark.parametrize("rate", [[0, 0, 0], [1e-12, 0, 0], [0, 1e-7, 0], [0, 0, 3.1]])
def test_rates_from_none_to_almost_a_half_turn(rate):
    attitudes = Attitudes()
    for each in (0, 1):
        attitudes.add(each * NS, turning(each, rate))
    attitude, _ = attitudes.at(NS // 3, 1.0)
    assert angle_between(attitude, turning(1 / 3, rate)) < 2e-9


def test_a_quaternion_and_its_opposite_are_the_same():
    attitudes = Attitudes()
    for each in range(5):
        quaternion = turning(each).as_quat() * (-1) ** each
        attitudes.add(each * NS, rotation_of(*quaternion))
    for at in (0.5, 1.25, 3.9, 4.5):
        attitude, _ = attitudes.at(round(at * NS), 1.0)
        assert angle_between(attitude, turning(at)) < 1e-9


def test_a_little_disorder_does_not_matter_and_the_last_of_a_stamp_counts():
    attitudes = Attitudes()
    for each in (0.6, 0.0, 0.4, 0.8, 0.2):
        attitudes.add(round(each * NS), Rotation.identity())
        attitudes.add(round(each * NS), turning(each))
    for at in (0.1, 0.3, 0.5, 0.7, 0.9):
        attitude, _ = attitudes.at(round(at * NS), 1.0)
        assert angle_between(attitude, turning(at)) < 1e-9


def test_time_that_runs_backwards_leaves_no_attitude_of_before():
    """A bag begins anew, or a clock is set back, and the camera looks elsewhere by then."""
    attitudes = attitudes_at(0, 1, 2, 3, 4, 5)
    other = [1e-3, 0, 0]
    for each in (1.5, 2.0, 2.5):
        attitudes.add(round(each * NS), turning(each, other))
    attitude, why = attitudes.at(round(2.9 * NS), 1.0)
    assert why == ""
    assert angle_between(attitude, turning(2.9, other)) < 1e-9
    assert attitudes.at(round(4.5 * NS), 1.0)[0] is None


def test_one_stamp_in_the_future_harms_no_later_attitude():
    attitudes = attitudes_at(0, 1)
    attitudes.add(10**9 * NS, Rotation.identity())
    for each in (2, 3):
        attitudes.add(each * NS, turning(each))
    attitude, _ = attitudes.at(round(3.5 * NS), 1.0)
    assert angle_between(attitude, turning(3.5)) < 1e-9


def test_a_full_memory_takes_what_comes_after_time_has_run_backwards():
    attitudes = Attitudes(keep=3)
    for each in (10, 11, 12, 13, 0, 1, 2):
        attitudes.add(each * NS, turning(each))
    attitude, _ = attitudes.at(round(1.5 * NS), 1.0)
    assert angle_between(attitude, turning(1.5)) < 1e-9


@pytest.mark.parametrize(
    ("stamps", "at", "max_age_s", "words"),
    [
        ([], 0.0, 1.0, "no attitude has come"),
        ([1, 2], 0.99, 1.0, "no attitude from before the frame"),
        ([0, 1], 2.001, 1.0, "newest attitude is older than attitude_max_age_s"),
        ([0, 1], 1.5, 0.4, "newest attitude is older than attitude_max_age_s"),
        ([0, 1], 1.5, 0.9, "newest attitude has none before it, within attitude_max_age_s"),
        ([1], 1.1, 1.0, "newest attitude has none before it, within attitude_max_age_s"),
        # Near one of two, but what happened up to the other nobody knows.
        ([0, 3], 0.2, 1.0, "beside the frame is farther away than attitude_max_age_s"),
        ([0, 3], 2.9, 1.0, "beside the frame is farther away than attitude_max_age_s"),
        ([0, 1], 0.5, 0.0, "beside the frame is farther away than attitude_max_age_s"),
    ],
)
def test_what_is_stale_or_missing_is_unknown_and_said(stamps, at, max_age_s, words):
    attitude, why = attitudes_at(*stamps).at(round(at * NS), max_age_s)
    assert attitude is None
    assert words in why


@pytest.mark.parametrize("at", [0.0005, 1.0, 0.9995, 5.0, 5.001, 4.9991])
def test_an_attitude_counts_for_its_own_time_whatever_is_around_it(at):
    near = round(at)
    attitude, why = attitudes_at(*sorted({0, 1, near})).at(round(at * NS), 0.01)
    assert why == ""
    assert angle_between(attitude, turning(near)) < 1e-15


def test_a_single_attitude_counts_only_for_its_own_time():
    attitudes = attitudes_at(1)
    assert attitudes.at(NS + 1_000_000, 1.0)[1] == ""
    assert attitudes.at(NS - 1_000_000, 1.0)[1] == ""
    assert attitudes.at(NS + 1_000_001, 1.0)[0] is None


def test_the_rate_is_not_taken_from_two_attitudes_of_almost_the_same_time():
    """Their noise would be carried on a thousandfold."""
    attitudes = attitudes_at(0.0, 0.5, 1.0)
    noisy = Rotation.from_rotvec([1e-5, 0, 0]) * turning(1.001)
    attitudes.add(round(1.001 * NS), noisy)
    attitude, _ = attitudes.at(round(1.5 * NS), 1.0)
    assert angle_between(attitude, turning(1.5)) < 3e-5
    # Without older ones, there is nothing better.
    attitudes = attitudes_at(1.0, 1.001)
    assert angle_between(attitudes.at(round(1.5 * NS), 1.0)[0], turning(1.5)) < 1e-9


def test_memory_is_bounded_and_the_oldest_go():
    attitudes = Attitudes(keep=10)
    for each in range(100):
        attitudes.add(each * NS, turning(each))
    assert attitudes.at(89 * NS, 1.0)[0] is None
    assert attitudes.at(90 * NS, 1.0)[1] == ""


def test_rotation_of_a_message():
    quaternion = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_quat()
    for scale in (1, -1, 1.0009, 0.9991):
        given = rotation_of(*(scale * quaternion))
        assert angle_between(given, Rotation.from_rotvec([0.1, 0.2, 0.3])) < 1e-15


@pytest.mark.parametrize(
    "quaternion",
    [(0, 0, 0, 0), (0, 0, 0, 2), (0, 0, 0, 0.99), (np.nan, 0, 0, 1), (np.inf, 0, 0, 0)],
)
def test_what_is_no_rotation(quaternion):
    with pytest.raises(CameraError, match="is no rotation; it must be 1"):
        rotation_of(*map(float, quaternion))


# Both together ----------------------------------------------------------------------------------


def rows_at(xy, dtype=DETECTION_DTYPE, sigma=(0.1, 0.2)):
    rows = np.zeros(len(xy), dtype)
    rows["x"], rows["y"] = np.transpose(xy)
    rows["sigma_x"], rows["sigma_y"] = sigma
    return rows


def astrometry_with(camera, *attitudes, **parameters):
    astrometry = Astrometry(CameraParameters.of(parameters))
    astrometry.camera = camera
    for seconds, attitude in attitudes:
        astrometry.add_attitude(round(seconds * NS), attitude)
    return astrometry


FIELDS = ("sight", "ra", "dec", "sigma_ra", "sigma_dec")
NARROW = Camera.ideal(SIZE, SIZE, np.radians(SCALE_ARCSEC / 3600))
PIXEL = np.radians(SCALE_ARCSEC / 3600)
CENTRE = (SIZE - 1) / 2


@pytest.mark.parametrize("dtype", [DETECTION_DTYPE, TRACK_DTYPE], ids=["detections", "tracks"])
def test_locate_fills_in_what_the_parts_say(dtype):
    xy = [[10.0, 20], [500, 100], [255.5, 255.5]]
    rows = rows_at(xy, dtype)
    astrometry = astrometry_with(NARROW, (0, turning(0)), (1, turning(1)))
    assert astrometry.locate(rows, NS // 2) == ""
    sight = NARROW.lines_of_sight(xy)
    np.testing.assert_array_equal(rows["sight"], sight)
    np.testing.assert_allclose([rows["ra"], rows["dec"]], to_radec(sight, turning(0.5)))
    # Directions along with the image's, where north is turned by the roll.
    assert (rows["sigma_ra"] > 0.1 * 0.99 * PIXEL).all()
    assert (rows["sigma_ra"] < 0.2 * PIXEL).all()
    np.testing.assert_allclose(
        rows["sigma_ra"] ** 2 + rows["sigma_dec"] ** 2,
        np.full(3, (0.1**2 + 0.2**2) * PIXEL**2),
        rtol=1e-3,  # of a narrow field, 0.7 degrees from the axis
    )
    for name in set(dtype.names) - {*FIELDS, "x", "y", "sigma_x", "sigma_y"}:
        assert not rows[name].any()


@pytest.mark.parametrize(("roll_deg", "swapped"), [(0, False), (90, True), (180, False)])
@pytest.mark.parametrize("dec_deg", [0, 60, -85])
def test_sigmas_are_along_east_and_north(roll_deg, swapped, dec_deg):
    rows = rows_at([[CENTRE, CENTRE]], sigma=(0.1, 0.3))
    astrometry = astrometry_with(NARROW, (0, attitude_to(33, dec_deg, roll_deg)))
    assert astrometry.locate(rows, 0) == ""
    sigmas = np.array([rows["sigma_ra"][0], rows["sigma_dec"][0]]) / PIXEL
    np.testing.assert_allclose(sigmas, [0.3, 0.1] if swapped else [0.1, 0.3], rtol=1e-12)


@pytest.mark.parametrize("dec_deg", [40.0, 89.9, -89.5])
def test_sigmas_are_the_scatter_of_the_angles(dec_deg):
    """Positions are drawn in the image, and angles scatter, in a strongly distorted corner."""
    camera = camera_of("plumb_bob", BARREL, 20_000)
    camera = Camera.from_calibration(
        WIDTH, HEIGHT, camera.matrix.ravel(), [-200.0, 0, 0.02, 0.1], "plumb_bob"
    )
    astrometry = astrometry_with(camera, (0, attitude_to(120, dec_deg, 25)))
    random = np.random.default_rng(8)
    true = rows_at([[780.0, 15.0]], sigma=(0.05, 0.15))
    drawn = rows_at(random.normal([780, 15], [0.05, 0.15], (20_000, 2)))
    assert astrometry.locate(true, 0) == ""
    assert astrometry.locate(drawn, 0) == ""
    east = (drawn["ra"] - true["ra"]) * np.cos(true["dec"])
    north = drawn["dec"] - true["dec"]
    # The std of a std of 20,000 is 0.5 %.
    assert east.std() == pytest.approx(true["sigma_ra"][0], rel=0.02)
    assert north.std() == pytest.approx(true["sigma_dec"][0], rel=0.02)


@pytest.mark.parametrize("dec_deg", [90.0, -90.0])
def test_at_a_pole_sigmas_stay_finite_and_right(dec_deg):
    """At the pole itself, and a pixel beside it: along the circle and along the radius."""
    rows = rows_at(
        [[CENTRE, CENTRE], [CENTRE + 1, CENTRE], [CENTRE, CENTRE + 1]], sigma=(0.1, 0.3)
    )
    astrometry = astrometry_with(NARROW, (0, attitude_to(0, dec_deg, 0)))
    assert astrometry.locate(rows, 0) == ""
    assert np.isfinite(rows["ra"]).all()
    np.testing.assert_allclose(np.abs(rows["dec"]), np.pi / 2 - PIXEL * np.array([0, 1, 1]))
    sigmas = np.stack([rows["sigma_ra"], rows["sigma_dec"]], -1) / PIXEL
    np.testing.assert_allclose(sigmas[1:], [[0.3, 0.1], [0.1, 0.3]], rtol=1e-6)
    # At the pole any right ascension will do, and east goes with it: the image's two directions.
    assert sorted(sigmas[0]) == pytest.approx([0.1, 0.3], rel=1e-6) or (
        np.square(sigmas[0]).sum() == pytest.approx(0.1)
    )


def test_what_is_unknown_is_nan_and_said():
    xy = [[100.0, 100.0]]
    for astrometry, words, sight_known in (
        (astrometry_with(None, (0, START)), "not calibrated", False),
        (astrometry_with(NARROW), "no attitude has come", True),
        (astrometry_with(NARROW, (-2, START), (-1.5, START)), "older than", True),
    ):
        rows = rows_at(xy)
        for name in FIELDS:
            rows[name] = 1.0  # what an earlier call has left
        assert words in astrometry.locate(rows, 0)
        assert np.isfinite(rows["sight"]).all() == sight_known
        assert all(np.isnan(rows[name]).all() for name in FIELDS[1:])
        assert np.isnan(astrometry.radec_rates(rows, 0)).all()
        # And without rows, the reason all the same.
        assert words in astrometry.locate(rows[:0], 0)


def test_pixels_beyond_the_fold_are_unknown_and_said():
    camera = Camera.from_calibration(
        WIDTH, HEIGHT, [500, 0, 400, 0, 500, 300, 0, 0, 1], [-0.5, 0, 0, 0], "plumb_bob"
    )
    rows = rows_at([[400, 300], [10, 10]])
    why = astrometry_with(camera, (0, START)).locate(rows, 0)
    assert "cannot be inverted at some of the pixels" in why
    for name in FIELDS:
        assert np.isfinite(rows[name][0]).all()
        assert np.isnan(rows[name][1]).all()


def test_unknown_sigmas_stay_unknown():
    rows = rows_at([[100.0, 100.0]], sigma=(np.nan, np.nan))
    assert astrometry_with(NARROW, (0, START)).locate(rows, 0) == ""
    assert np.isfinite([rows["ra"], rows["dec"]]).all()
    assert np.isnan([rows["sigma_ra"], rows["sigma_dec"]]).all()


def test_the_age_that_counts_may_change_while_running():
    astrometry = astrometry_with(NARROW, (0, START), (3, START))
    rows = rows_at([[100.0, 100.0]])
    assert "farther away" in astrometry.locate(rows, NS)
    astrometry.parameters = astrometry.parameters.replace(attitude_max_age_s=2.0)
    assert astrometry.locate(rows, NS) == ""


@pytest.mark.parametrize(
    ("reference", "expected_ns"),
    [("middle", 700_000_000), ("start", 700_000_000 + NS), ("end", 700_000_000 - NS)],
)
def test_middle_of_an_exposure(reference, expected_ns):
    astrometry = astrometry_with(
        None, exposure_time_s=2.0, stamp_reference=reference, stamp_offset_s=0.7
    )
    stamp_ns = 1_767_225_600_123_456_789
    assert astrometry.middle_ns(stamp_ns) - stamp_ns == expected_ns


@pytest.mark.parametrize("camera_rate", [[0, 0, 0], [1e-3, -2e-3, 0], [1e-3, -2e-3, 0.05]])
@pytest.mark.parametrize("dec_deg", [10.0, 88.0])
def test_radec_rates_against_the_stars(camera_rate, dec_deg):
    """An object goes along a great circle at 0.2 deg/s; the camera stands, or turns."""
    start = attitude_to(150, dec_deg, 40)
    lens = ("plumb_bob", [-40.0, 0, 0.01, 0.02], 8000)
    camera = camera_of(*lens)

    def attitude(seconds):
        return Rotation.from_rotvec(-np.array(camera_rate) * seconds) * start

    def pixel_of(icrs, seconds):
        return camera.pixels(attitude(seconds).apply(icrs)[None])[0]

    sight = camera.lines_of_sight([[600.0, 150.0]])[0]
    star = start.inv().apply(sight)
    axis = np.cross(star, [0.3, 0.5, -0.8])
    spin = np.radians(0.2) * axis / np.linalg.norm(axis)

    def rso(seconds):
        return Rotation.from_rotvec(spin * seconds).apply(star)

    step = 1e-3
    v = (pixel_of(rso(step), step) - pixel_of(rso(-step), -step)) / (2 * step)
    star_v = (pixel_of(star, step) - pixel_of(star, -step)) / (2 * step)
    rows = rows_at([[600.0, 150.0]])
    rows["rel_vx"], rows["rel_vy"] = v - star_v
    astrometry = astrometry_with(camera, *((s, attitude(s)) for s in (-0.1, 0.1)))
    rates = astrometry.radec_rates(rows, 0)[0]
    ends = [np.ravel(to_radec(rso(s)[None], Rotation.identity())) for s in (-step, step)]
    dec = np.arcsin(star[2])
    expected = (ends[1] - ends[0]) / (2 * step) * [np.cos(dec), 1]
    assert np.hypot(*rates) == pytest.approx(np.radians(0.2), rel=1e-6)
    np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-6 * np.radians(0.2))
