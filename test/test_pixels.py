# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Lists of pixels: the same regions, labels and values as images of them give."""

import cv2
import numpy as np
import pytest
from sky import labels_of, regions_of

from ofsat_ros.pixels import (
    Regions,
    connected,
    inside,
    interpolate,
    rows_and_columns,
    streak_of,
)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("shape", [(50, 37), (1, 40), (40, 1), (2, 2), (120, 300)])
def test_regions_are_those_that_opencv_labels(shape: tuple[int, int], share: float):
    mask = (np.random.default_rng(shape[1]).random(shape) < share).astype(np.uint8)
    pixels = np.flatnonzero(mask)
    labels, count = connected(pixels, shape[1])
    expected_count, expected = cv2.connectedComponents(mask, connectivity=8)
    assert count == expected_count - 1
    # Both number them by their first pixels, row by row.
    first = np.unique(labels, return_index=True)[1]
    assert np.all(np.diff(first) > 0)
    pairs = np.unique(np.stack([labels, expected.ravel()[pixels]]), axis=1)
    assert pairs.shape[1] == count


def test_the_end_of_a_row_does_not_touch_the_start_of_the_next_one():
    # 5 px wide: (0, 4) and (1, 0); (2, 4) and (4, 0).
    labels, count = connected(np.array([4, 5, 14, 20]), 5)
    assert (labels.tolist(), count) == ([0, 1, 2, 3], 4)


def test_a_spiral_is_one_region():
    """Its ends meet only through all of it."""
    spiral = np.zeros((41, 41), np.uint8)
    y, x, dy, dx = 20, 20, 0, 1
    for length in range(2, 40, 2):
        for _ in range(2):
            for _ in range(length):
                spiral[y, x] = 1
                y, x = y + dy, x + dx
            dy, dx = dx, -dy
    assert connected(np.flatnonzero(spiral), 41)[1] == 1


def test_no_pixel_is_no_region():
    labels, count = connected(np.zeros(0, np.intp), 10)
    assert (labels.shape, count) == ((0,), 0)


def test_rows_and_columns():
    pixels = np.array([0, 6, 7, 13, 4096 * 4096 - 1])
    y, x = rows_and_columns(pixels, 7)
    assert np.array_equal(y, pixels // 7)
    assert np.array_equal(x, pixels % 7)


def test_regions_know_whose_each_pixel_is():
    labels = np.zeros((6, 8), np.int32)
    labels[1, 2:5], labels[4:6, 7] = 2, 1
    regions = regions_of(labels)
    y, x = np.indices(labels.shape)
    assert np.array_equal(regions.at(y, x), labels - 1)
    assert np.array_equal(labels_of(regions), labels)
    assert Regions((6, 8)).at(y, x).tolist() == np.full((6, 8), -1).tolist()


# More points than one row of cv2.remap takes.
@pytest.mark.parametrize("count", [0, 1, 1000, 1024, 5000, 70_000])
# OpenCV knows 32nds of a pixel, and its cubic kernel bends a slope by 0.05 px.
@pytest.mark.parametrize(("how", "error_px"), [(cv2.INTER_LINEAR, 0.016), (cv2.INTER_CUBIC, 0.07)])
def test_a_plane_is_interpolated_at_any_number_of_points(count: int, how: int, error_px: float):
    y, x = np.mgrid[:60, :80].astype(np.float32)
    random = np.random.default_rng(count)
    px, py = random.uniform(2, 77, count), random.uniform(2, 57, count)
    values = interpolate(3 * x - 2 * y, px, py, how)
    assert values.shape == (count,)
    np.testing.assert_allclose(values, 3 * px - 2 * py, atol=5 * error_px)


def test_beyond_its_border_a_plane_goes_on_as_it_is_there():
    plane = np.arange(12, dtype=np.float32).reshape(3, 4)
    x, y = np.array([-5.0, 9.0, 1.0]), np.array([0.0, 2.0, 70.0])
    assert interpolate(plane, x, y, cv2.INTER_LINEAR).tolist() == [0, 11, 9]


def test_inside_is_up_to_the_outermost_pixels_centres():
    xy = np.array([[0, 0], [7, 5], [7.01, 5], [3, -0.01], [2, 2], [1.9, 2], [5, 3], [5, 3.1]])
    assert inside(xy, (6, 8)).tolist() == [True, True, False, False, True, True, True, True]
    assert inside(xy[4:], (6, 8), 2.0).tolist() == [True, False, True, False]


@pytest.mark.parametrize("degrees", [0, 30, 90, -60])
def test_a_streak_is_as_long_as_the_line_of_its_moments(degrees: float):
    """Of a point's variance of 2 px^2, and L^2/12 along the line."""
    along = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    moments = 2 * np.eye(2) + 12**2 / 12 * np.outer(along, along)
    # What rounding leaves of the mixed moment of an upright line must not turn it round.
    mixed = moments[0, 1] if degrees % 90 else -1e-20
    length, angle = streak_of(*np.array([[moments[0, 0]], [moments[1, 1]], [mixed], [50.0]]))
    assert length == pytest.approx(12)
    assert np.degrees(angle) == pytest.approx(degrees, abs=1e-9)


def test_what_may_be_round_by_its_snr_has_no_length():
    same = np.full(2, 2.0)
    length, _ = streak_of(same + 0.5, same, np.zeros(2), np.array([5.0, 500.0]))
    assert length.tolist() == [0, 0]
    length, _ = streak_of(same + 4.0, same, np.zeros(2), np.array([5.0, 500.0]))
    # A variance 4 px^2 larger along a line is one of sqrt(48) px, unless chance makes it so.
    assert length == pytest.approx([0, np.sqrt(48)])
