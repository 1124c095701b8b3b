# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Annotated pictures: what is drawn, where, and in which colour."""

import math
import subprocess
import sys

import cv2
import numpy as np
import pytest

from ofsat_ros.detection import CANDIDATE, CONFIRMED, DETECTION_DTYPE
from ofsat_ros.optical_flow import Flow
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.report import Tails, annotate, summary
from ofsat_ros.star_field import StarFieldMotion
from ofsat_ros.tracking import COASTING, TRACK_DTYPE

HEIGHT, WIDTH = 500, 640
STARS = np.array([(100.0, 120.0), (400.0, 150.0), (250.0, 400.0)])
STEP = np.array([6.0, -4.0])
RSO = np.array([320.0, 300.0])
RSO_STEP = np.array([-5.0, 2.0])


def dark(shape: tuple[int, int] = (HEIGHT, WIDTH), dtype: type = np.uint16) -> np.ndarray:
    return np.full(shape, 100, dtype)


def test_pictures_of_frames_need_no_recordings_nor_results():
    """The detector node starts without what only a report needs."""
    loaded = "import sys, ofsat_ros.report; print(*(m for m in sys.modules if 'ofsat_ros' in m))"
    told = subprocess.run(
        [sys.executable, "-c", loaded], capture_output=True, text=True, check=True
    )
    modules = told.stdout.split()
    assert "ofsat_ros.report.picture" in modules
    assert not [name for name in modules if "recordings" in name or "results" in name]


def motion(count: int) -> StarFieldMotion:
    return StarFieldMotion(
        centre=np.array([319.5, 249.5]),
        displacement=STEP,
        rotation=0.0,
        scale=0.0,
        covariance=np.zeros((4, 4)),
        inliers=np.arange(count + 1) < count,
        residual_px=0.1,
        residual_sigmas=1.0,
        speed_mean=7.2,
        speed_std=0.1,
        model="shift",
    )


def result(shape: tuple[int, int] = (HEIGHT, WIDTH), found: bool = True, **values) -> FrameResult:
    rows = np.zeros(int(found), DETECTION_DTYPE)
    if found:
        rows["x"], rows["y"] = RSO
        rows["vx"], rows["vy"] = RSO_STEP / 0.5
        rows["snr"] = 25
        rows["track_id"], rows["status"] = 12, CONFIRMED
        rows["object_index"], rows["flow_index"] = 3, -1
    position = np.vstack([STARS, RSO])
    displacement = np.vstack([np.tile(STEP, (len(STARS), 1)), RSO_STEP])
    valid, index = np.ones(4, bool), np.arange(4)
    about = {
        "dt_s": 0.5,
        "flow": Flow.of_vectors(position, displacement, np.ones((4, 2)), valid, index),
        "star_field": motion(len(STARS)),
        "detections": rows,
        "background": 100.0,
        "noise": 2.0,
        "reason": "" if found else "everything moves with the star field (3 stars)",
    }
    return FrameResult(1, 7, shape, **{**about, **values})


def tracks(*statuses: int) -> np.ndarray:
    rows = np.zeros(len(statuses), TRACK_DTYPE)
    rows["x"], rows["y"] = 150, 250
    rows["track_id"], rows["status"] = 31 + np.arange(len(rows)), statuses
    return rows


def red(picture: np.ndarray) -> np.ndarray:
    b, g, r = (picture[..., i].astype(int) for i in range(3))
    return (r > 100) & (r - b > 60) & (r - g > 60)


def blue(picture: np.ndarray) -> np.ndarray:
    b, _, r = (picture[..., i].astype(int) for i in range(3))
    return (b > 100) & (b - r > 60)


def yellow(picture: np.ndarray) -> np.ndarray:
    b, g, r = (picture[..., i].astype(int) for i in range(3))
    return (r > 100) & (abs(r - g) < 50) & (g - b > 60)


def white(picture: np.ndarray) -> np.ndarray:
    return picture.min(axis=2) > 200


def distance_to_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of points (N, 2) from the line between a and b, px."""
    along = np.clip((points - a) @ (b - a) / np.sum((b - a) ** 2), 0, 1)
    return np.hypot(*(points - a - along[:, None] * (b - a)).T)


def pixels(mask: np.ndarray) -> np.ndarray:
    """Places (x, y) of what is set."""
    return np.argwhere(mask)[:, ::-1].astype(float)


@pytest.mark.parametrize(
    ("shape", "zoom"),
    [
        *(((500, 640), 1), ((480, 480), 1), ((479, 900), 2), ((256, 256), 2), ((120, 700), 4)),
        *(((16, 16), 30), ((1000, 481), 1)),
    ],
)
def test_small_images_are_enlarged(shape: tuple[int, int], zoom: int):
    picture = annotate(dark(shape), result(shape))
    assert picture.shape == (shape[0] * zoom, shape[1] * zoom, 3)
    assert picture.dtype == np.uint8


def test_stars_vectors_are_blue_and_begin_at_the_star():
    picture = annotate(dark(), result(), scale=5.0)
    places = pixels(blue(picture))
    distances = np.stack([distance_to_segment(places, s, s + 5 * STEP) for s in STARS])
    # Nothing blue off the lines and the circles of 2 px on the stars.
    assert distances.min(axis=0).max() < 4
    for star in STARS:
        tip = star + 5 * STEP
        for part in np.linspace(0.1, 0.95, 12):
            near = np.hypot(*(places - (star + part * (tip - star))).T)
            assert near.min() < 1.2
        # The circle's ring is on the star, and nothing at the tip.
        assert np.count_nonzero(np.hypot(*(places - star).T) < 4) > 10
        assert np.count_nonzero(np.hypot(*(places - tip).T) < 4) < 10


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_vectors_are_as_long_as_the_scale_says(scale: float):
    picture = annotate(dark(), result(), scale=scale)
    for star in STARS:
        window = np.hypot(*(pixels(blue(picture)) - star).T)
        assert window[window < 90].max() == pytest.approx(max(scale * np.hypot(*STEP), 3), abs=2)


def test_an_rso_has_a_red_box_and_vector():
    picture = annotate(dark(), result(), scale=5.0)
    mask = red(picture)
    x, y = RSO.astype(int)
    # The box: 8 px to each side, and open inside.
    for offset in (-8, 8):
        assert mask[y + offset, x - 6 : x + 7].mean() > 0.8
        assert mask[y - 6 : y + 7, x + offset].mean() > 0.8
    # The vector goes where the object moves.
    tip = RSO + 5 * RSO_STEP
    for part in (0.1, 0.7, 0.95):
        place = np.rint(RSO + part * (tip - RSO)).astype(int)
        assert mask[place[1] - 1 : place[1] + 2, place[0] - 1 : place[0] + 2].any()
    # On the other side is nothing, inside the box.
    beyond = np.rint(RSO - RSO_STEP).astype(int)
    assert not mask[beyond[1] - 1 : beyond[1] + 2, beyond[0] - 1 : beyond[0] + 2].any()


def test_of_a_candidates_box_only_the_corners_are_drawn():
    found = result()
    found.detections["status"], found.detections["track_id"] = CANDIDATE, 0
    mask = red(annotate(dark(), found, scale=1.0))
    x, y = RSO.astype(int)
    for offset in (-8, 8):
        for line in (mask[y + offset, x - 8 : x + 9], mask[y - 8 : y + 9, x + offset]):
            assert line[:4].all()
            assert line[-4:].all()
            assert not line[6:11].any()


def test_a_coasting_track_has_a_yellow_box_where_it_is_expected():
    found = result(tracks=tracks(COASTING, CONFIRMED))
    found.tracks["x"][1] = 500  # what is seen is drawn as a detection
    picture = annotate(dark(), found)
    mask = yellow(picture)
    for offset in (-8, 8):
        assert mask[250 + offset, 144:157].mean() > 0.8
        assert mask[244:257, 150 + offset].mean() > 0.8
    assert not mask[244:257, 144:157].any()
    assert not mask[:, 450:].any()
    assert not red(picture)[240:261, 140:161].any()


def test_a_streaks_box_is_as_much_larger_as_it_is_long():
    found = result()
    found.detections["length"] = 40
    mask = red(annotate(dark(), found))
    x, y = RSO.astype(int)
    assert mask[y - 28, x - 20 : x + 20].mean() > 0.8
    assert mask[y - 20 : y + 20, x + 28].mean() > 0.8


def test_a_detection_without_shape_has_the_small_box():
    found = result()
    found.detections["length"] = np.nan
    x, y = RSO.astype(int)
    assert red(annotate(dark(), found))[y - 8, x - 6 : x + 7].mean() > 0.8


def test_zoomed_places_are_those_of_the_pixels():
    """The centre of pixel x is at 4 x + 1.5 of a picture four times as large."""
    shape = (120, 160)
    found = result(shape)
    found.detections["x"], found.detections["y"] = 100, 60
    found.detections["vx"] = found.detections["vy"] = 0
    places = pixels(red(annotate(dark(shape), found)))
    centre = np.array([401.5, 241.5])
    box = places[np.abs(places - centre).max(axis=1) < 34]
    # The box is 8 px of the image to each side.
    assert box.min(axis=0) == pytest.approx(centre - 32, abs=1)
    assert box.max(axis=0) == pytest.approx(centre + 32, abs=1)


def test_the_caption_is_bright_text_on_top():
    for found in (True, False):
        picture = annotate(dark(), result(found=found))
        caption = white(picture[:24])
        assert 150 < np.count_nonzero(caption) < 0.4 * caption.size
        assert not white(picture[30:]).any()
        assert pixels(caption)[:, 0].min() < 15


def test_the_caption_counts_the_rsos_or_gives_the_reason(monkeypatch: pytest.MonkeyPatch):
    written = []
    put = cv2.putText

    def remember(picture, text, *rest):
        written.append(text)
        return put(picture, text, *rest)

    monkeypatch.setattr(cv2, "putText", remember)
    annotate(dark(), result())
    # Several times each: a dark rim, then the text.
    assert set(written) == {
        "#12 10.77 px/s SNR 25",
        "frame 7: 1 RSO; 3 stars move (+6.00, -4.00) px",
    }
    written.clear()
    annotate(dark(), result(found=False))
    assert set(written) == {"frame 7: no RSO: everything moves with the star field (3 stars)"}
    written.clear()
    two = result(tracks=tracks(COASTING))
    two.detections = np.repeat(two.detections, 2)
    two.detections["track_id"], two.detections["status"] = (12, 0), (CONFIRMED, CANDIDATE)
    annotate(dark(), two)
    assert {"#12 10.77 px/s SNR 25", "10.77 px/s SNR 25", "#31 coasting"} < set(written)
    assert "frame 7: 1 RSO, 1 candidate, 1 coasting; 3 stars move (+6.00, -4.00) px" in written


@pytest.mark.parametrize(
    ("statuses", "words"),
    [
        ([CONFIRMED], "1 RSO"),
        ([CONFIRMED, CONFIRMED, CANDIDATE], "2 RSOs, 1 candidate"),
        ([CANDIDATE, CANDIDATE], "no confirmed RSO, 2 candidates"),
    ],
)
def test_the_summary_tells_confirmed_rsos_from_candidates(statuses: list[int], words: str):
    rows = np.zeros(len(statuses), DETECTION_DTYPE)
    rows["status"] = statuses
    assert summary(result(detections=rows)) == words


def frame_with(*places: tuple[int, float, float], **values) -> FrameResult:
    """A frame whose tracks (id, x, y) are confirmed."""
    rows = tracks(*[CONFIRMED] * len(places))
    for name, values_ in zip(("track_id", "x", "y"), zip(*places, strict=True), strict=True):
        rows[name] = values_
    return result(tracks=rows, **values)


def test_tails_are_where_the_tracks_of_the_last_frame_were():
    tails = Tails(frames=3)
    assert tails.places() == {}
    for number in range(5):
        tails.add(frame_with((7, 10 * number, 50), *[(8, 300, number)] * (number > 3)))
    places = tails.places()
    assert places.keys() == {7, 8}
    np.testing.assert_array_equal(places[7], [(20, 50), (30, 50), (40, 50)])
    np.testing.assert_array_equal(places[8], [(300, 4)])
    tails.add(frame_with((8, 301, 5)))
    assert tails.places().keys() == {8}


def test_a_reset_ends_all_tails():
    tails = Tails()
    tails.add(frame_with((1, 10, 10)))
    tails.add(frame_with((1, 400, 10), reset="the clock was set back"))
    np.testing.assert_array_equal(tails.places()[1], [(400, 10)])


def test_a_tail_is_a_red_line_that_fades_and_a_coasting_one_is_yellow():
    places = np.array([(100.0, 450.0), (200.0, 430.0), (300.0, 410.0), (400.0, 390.0)])
    found = frame_with((12, 400, 390))
    picture = annotate(dark(), found, tails={12: places})
    bare = annotate(dark(), found)
    drawn = (picture != bare).any(axis=2)
    assert distance_to_segment(pixels(drawn), places[0], places[-1]).max() < 1.5
    brightness = [
        picture[y - 1 : y + 2, x, 2].max() for x, y in ((150, 440), (250, 420), (350, 400))
    ]
    assert brightness[0] < brightness[1] < brightness[2]
    assert red(picture)[399:402, 349:352].any()
    found.tracks["status"] = COASTING
    picture = annotate(dark(), found, tails={12: places})
    assert yellow(picture)[399:402, 349:352].any()


def test_a_track_of_one_place_has_no_tail():
    found = frame_with((12, 400, 390))
    picture = annotate(dark(), found, tails={12: np.array([(400.0, 390.0)])})
    np.testing.assert_array_equal(picture, annotate(dark(), found))


def test_the_footer_is_bright_text_at_the_bottom():
    picture = annotate(dark(), result(found=False), footer="9.8 Hz  0 dropped")
    assert np.count_nonzero(white(picture[-22:])) > 60
    assert not white(picture[30:-24]).any()
    assert not white(annotate(dark(), result(found=False))[-22:]).any()


def test_a_large_picture_has_thick_lines_and_large_letters():
    """A screen shows every fourth pixel of it."""
    shape = (4000, 4100)
    found = result(shape)
    picture = annotate(dark(shape), found, scale=1.0)
    assert picture.shape == (*shape, 3)
    x, y = RSO.astype(int)
    # The box: 32 px to each side, its lines 4 px wide.
    across = red(picture)[y - 32 - 6 : y - 32 + 7, x]
    assert across.sum() == pytest.approx(4, abs=1.5)
    caption = pixels(white(picture[:100]))
    height = caption[:, 1].max() - caption[:, 1].min()
    small = pixels(white(annotate(dark(), result())[:25]))
    assert height == pytest.approx(4 * (small[:, 1].max() - small[:, 1].min()), rel=0.25)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_faint_stars_show_on_a_bright_slope(dtype):
    """Moonlight of 200 sigma across the image, and a vignette, leave the sky dark and even."""
    random = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    slope = 0.6 * x - ((x - 320) ** 2 + (y - 250) ** 2) / 2000
    image = random.normal(1000, 6, (HEIGHT, WIDTH)) + slope
    for column in (50, 600):
        image[200:203, column - 1 : column + 2] += 40
    plain = FrameResult(1, 0, image.shape, background=float(np.median(image)), noise=2.0)
    gray = annotate(np.rint(image).astype(dtype), plain)[..., 0]
    for column in (50, 600):
        around = gray[150:250, column - 30 : column + 30]
        assert 15 <= np.median(around) < 45
        assert gray[201, column] > np.median(around) + 50


def test_without_a_star_field_the_rso_is_still_drawn():
    picture = annotate(dark(), result(star_field=None))
    assert not blue(picture).any()
    assert red(picture).any()


def test_a_first_frame_is_a_picture_with_a_caption():
    first = FrameResult(1, 0, (HEIGHT, WIDTH), reset="first frame", reason="no previous frame")
    picture = annotate(dark(), first)
    assert not blue(picture).any()
    assert not red(picture).any()
    assert white(picture[:24]).any()


@pytest.mark.parametrize(
    "corner", [(0, 0), (WIDTH - 1, 0), (0, HEIGHT - 1), (WIDTH - 1, HEIGHT - 1)]
)
def test_an_rso_in_a_corner_keeps_its_label_inside(corner: tuple[int, int]):
    found = result()
    found.detections["x"], found.detections["y"] = corner
    found.detections["vx"] = found.detections["vy"] = 0
    mask = red(annotate(dark(), found))
    inside = slice(24, None) if corner[1] == 0 else slice(None)  # the caption lies over the top
    text = pixels(mask[inside])
    # The label's 20 characters are some 130 px wide, the box 9.
    reach = text[:, 0].max() - text[:, 0].min() if len(text) else 0
    if corner[1]:
        assert reach > 80
    assert mask.any()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_stars_are_brighter_than_noise_than_black(dtype):
    random = np.random.default_rng(1)
    image = random.normal(100, 6, (HEIGHT, WIDTH))
    image[200:203, 50:53] = 140  # 7 sigma of the pixel noise
    image[200:203, 150:153] = 250
    image = np.rint(image).astype(dtype)
    plain = FrameResult(1, 0, image.shape, background=100.0, noise=2.0)
    gray = annotate(image, plain)[..., 0]
    sky = np.median(gray[100:])
    assert 15 <= sky < 40
    assert sky + 50 < gray[201, 51] < gray[201, 151] < 255


def test_types_give_the_same_picture():
    random = np.random.default_rng(1)
    image = random.integers(0, 256, (HEIGHT, WIDTH))
    pictures = [annotate(image.astype(t), result()) for t in (np.uint8, np.uint16, np.float32)]
    assert np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38])
def test_missing_pixels_are_drawn_over(bad: float):
    image = dark(dtype=np.float32)
    image[::7] = bad
    image[100] = 1e5
    picture = annotate(image, result())
    assert red(picture).any()
    assert picture[100, 600, 0] > 200


def test_without_levels_the_image_gives_them():
    image = dark()
    image[250, 100] = 5000
    unknown = FrameResult(1, 0, image.shape, background=math.nan, noise=math.nan)
    gray = annotate(image, unknown)[..., 0]
    assert gray[250, 200] < 40
    assert gray[250, 100] == 255


def test_neither_image_nor_result_is_changed():
    image, found = dark(), result()
    image.flags.writeable = False
    before = found.flow.position.copy(), found.detections.copy()
    annotate(image, found)
    assert np.array_equal(found.flow.position, before[0])
    assert np.array_equal(found.detections, before[1])
