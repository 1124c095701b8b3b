# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Charts of the report: what stands where, and words and numbers as people write them."""

import math
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from ofsat_ros.report import words
from ofsat_ros.report.charts import Series, chart, sparkline

NUMBER = r"-?[\d.]+"


def drawn(svg: str, kind: str) -> ElementTree.Element:
    root = ElementTree.fromstring(svg)
    return next(path for path in root.iter("path") if path.get("class").startswith(kind))


def points(svg: str, kind: str = "line") -> np.ndarray:
    found = re.findall(rf"[ML]({NUMBER}) ({NUMBER})", drawn(svg, kind).get("d"))
    return np.array(found, float)


def labels(svg: str, kind: str, along: str) -> dict[float, float]:
    """Values on an axis, and where they stand in the drawing."""
    found = {}
    for text in ElementTree.fromstring(svg).iter("text"):
        words = text.text.replace("\u2212", "-").replace(",", "")
        if text.get("class") == kind and re.fullmatch(NUMBER, words):
            found[float(words)] = float(text.get(along))
    return found


def test_points_stand_where_the_axes_say():
    t, values = np.array([0.0, 10, 20, 40]), np.array([-3.0, 1, 2, 5])
    svg = chart(t, [Series("", values)], "s")
    across, up = labels(svg, "t", "x"), labels(svg, "v", "y")
    assert len(across) > 2
    assert len(up) > 2
    for at, value, marks in ((0, t, across), (1, values, up)):
        slope, offset = np.polyfit(list(marks), list(marks.values()), 1)
        shift = 3.5 if at else 0  # of a label's base line
        expected = slope * value + offset - shift
        assert points(svg)[:, at] == pytest.approx(expected, abs=0.15)  # a tenth is written


def test_magnitudes_grow_downwards():
    svg = chart([0, 1], [Series("", [1.0, 2.0])], "s", upside_down=True)
    (_, bright), (_, faint) = points(svg)
    assert bright < faint


def test_unknown_leaves_a_gap_and_a_lone_value_is_a_dot():
    svg = chart(range(6), [Series("", [1, 2, math.nan, 3, math.nan, 4])], "s")
    assert re.sub(r"[\d. ]+", "", drawn(svg, "line").get("d")) == "MLMhMh"
    assert "nan" not in svg


@pytest.mark.parametrize("values", [[5.0], [5.0, 5.0], [0.0, 0.0], [1e-9, 2e-9], [1e8, 1e8 + 1]])
def test_any_values_have_axes(values: list[float]):
    svg = chart(range(len(values)), [Series("", values)], "s", from_zero=False)
    assert len(labels(svg, "v", "y")) >= 2
    assert np.isfinite(points(svg)).all()


@pytest.mark.parametrize("values", [[], [math.nan, math.nan]])
def test_nothing_to_show_is_no_chart(values: list[float]):
    assert chart(range(len(values)), [Series("", values)], "s") == ""
    assert sparkline(values, "c0") == ""


def test_of_many_points_those_that_stand_out_are_kept():
    values = np.zeros(20_000)
    values[12_345] = 7
    svg = chart(range(20_000), [Series("", values)], "s")
    assert len(svg) < 12_000
    top = points(svg)[:, 1].argmin()
    x = labels(svg, "t", "x")
    slope, offset = np.polyfit(list(x), list(x.values()), 1)
    assert points(svg)[top, 0] == pytest.approx(slope * 12_345 + offset, abs=0.2)


def test_band_lies_about_zero():
    svg = chart(range(3), [Series("", [0.0, 0, 0], dots=True)], "s", band=[1.0, 2, 1])
    band, zero = points(svg, "band"), points(svg, "dots")[0, 1]
    assert band[:, 1].mean() == pytest.approx(zero, abs=0.1)
    assert np.ptp(band[:, 1]) > 100


def test_words_in_a_chart_are_escaped():
    svg = chart(range(2), [Series("", [1, 2])], "s", label='<b> & "quotes"')
    assert ElementTree.fromstring(svg).get("aria-label") == '<b> & "quotes"'


@pytest.mark.parametrize(
    ("value", "digits", "written"),
    [
        *((math.nan, 3, "\u2013"), (0.0, 3, "0"), (1234567.0, 3, "1\u202f234\u202f567")),
        *((3.14159, 3, "3.14"), (-0.0256, 2, "\u22120.026"), (99.6, 2, "100")),
    ],
)
def test_numbers(value: float, digits: int, written: str):
    assert words.number(value, digits) == written


@pytest.mark.parametrize(
    ("ra_deg", "dec_deg", "written"),
    [
        (0.0, 0.0, "00h 00m 00.0s +00\u00b0 00\u2032 00\u2033"),
        (83.8221, -5.3911, "05h 35m 17.3s \u221205\u00b0 23\u2032 28\u2033"),  # M 42
        (359.99999, 89.99999, "00h 00m 00.0s +90\u00b0 00\u2032 00\u2033"),
        (math.nan, 0.0, ""),
    ],
)
def test_directions(ra_deg: float, dec_deg: float, written: str):
    assert words.sexagesimal(ra_deg, dec_deg) == written


@pytest.mark.parametrize(
    ("seconds", "written"),
    [(0.5, "0.500 s"), (119.0, "119 s"), (500.0, "8 min 20 s"), (7260.0, "2 h 01 min")],
)
def test_time_spans(seconds: float, written: str):
    assert words.duration(seconds) == written


def test_instants():
    assert words.instant(1_767_225_601_234_567_890) == "2026-01-01 00:00:01.234"
