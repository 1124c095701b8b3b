# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The table of parameters: what it says, what it refuses, and what derives from it."""

import dataclasses
import math
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import yaml

import ofsat_ros
from ofsat_ros.parameters import (
    DEFAULT_PRESET,
    TABLES,
    CameraParameters,
    Description,
    DetectorParameters,
    GuideParameters,
    ParameterError,
    Parameters,
    PlayerParameters,
    RecorderParameters,
    SimulatorParameters,
    Table,
    TdmWriterParameters,
    TrackingDataParameters,
    markdown_table,
    preset_names,
)

PRESETS = Path(ofsat_ros.__file__).parent / "presets"
ALL = {f"{table.__name__}.{p.name}": p for table in TABLES for p in table.describe()}
STAGES = {
    *("preprocessing", "objects", "optical_flow", "star_field"),
    *("detection", "tracking", "pipeline"),
}
UNITS = {
    **{"_px": "px", "_pixels": "px", "_deg_s": "deg/s", "_deg_s2": "deg/s^2"},
    **{"_hz": "Hz", "_mag": "mag", "_s": "s"},
}
# Numbers that count or scale, and so have no unit.
PURE = {
    *("threshold_sigmas", "outlier_sigmas", "rso_sigmas", "spot_sigmas", "max_objects"),
    *("max_corners", "false_tracks"),
    *("corner_quality", "pyramid_levels", "dense_pyramid_levels", "dense_iterations"),
    *("target_id", "least_detections"),
    *("dense_noise_threshold", "marker_scale", "rate", "wait_for_subscribers", "seed", "frames"),
}


def in_file(preset: str) -> dict:
    return yaml.safe_load((PRESETS / f"{preset}.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("about", ALL.values(), ids=ALL)
def test_every_description_agrees_with_itself(about: Description):
    assert about.check(about.default) == about.default
    assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", about.name)
    # A phrase of several words that fits behind a colon and into a table's cell.
    assert len(about.meaning.split()) >= 3
    assert not about.meaning.endswith(".")
    assert "\n" not in about.meaning
    assert "  " not in about.meaning
    kinds = [about.low is not None, bool(about.choices), isinstance(about.default, bool)]
    assert sum(kinds) <= 1
    assert (about.low is None) == (about.high is None)
    if isinstance(about.default, bool):
        assert about.allowed == "true | false"
    elif isinstance(about.default, int | float):
        assert about.low < about.high
        assert about.low <= about.default <= about.high
        assert about.allowed == f"{about.low:.10g} to {about.high:.10g}"
    elif about.choices:
        assert about.default == about.choices[0]
        assert len(set(about.choices)) == len(about.choices) >= 2
        assert about.allowed == " | ".join(about.choices)
        # The meaning explains each word.
        assert all(f"{choice}:" in about.meaning for choice in about.choices)
    else:
        assert about.allowed == "text"


@pytest.mark.parametrize("about", ALL.values(), ids=ALL)
def test_a_number_has_its_unit(about: Description):
    number = isinstance(about.default, int | float) and not isinstance(about.default, bool)
    if not number or about.name in PURE:
        assert about.unit == ""
    else:
        suffix = next((s for s in UNITS if about.name.endswith(s)), None)
        assert about.unit == (UNITS[suffix] if suffix else "frames")


def test_stages_are_the_pipelines_and_the_nodes():
    assert {p.stage for p in Parameters.describe()} == STAGES
    nodes = {
        "detector": DetectorParameters,
        "player": PlayerParameters,
        "simulator": SimulatorParameters,
        "recorder": RecorderParameters,
        "camera": CameraParameters,
        "guide": GuideParameters,
        "tracking_data": TrackingDataParameters,
        "tdm_writer": TdmWriterParameters,
    }
    for stage, table in nodes.items():
        assert {p.stage for p in table.describe()} == {stage}
    assert set(TABLES) == {Parameters, *nodes.values()}


@pytest.mark.parametrize(
    "tables",
    [
        (Parameters, CameraParameters, DetectorParameters),
        (Parameters, CameraParameters, TrackingDataParameters),
        (TrackingDataParameters, TdmWriterParameters),
    ],
    ids=["detector", "ofsat process", "tdm_writer"],
)
def test_nobody_reads_a_name_twice(tables: tuple[type[Table], ...]):
    names = [about.name for table in tables for about in table.describe()]
    assert len(set(names)) == len(names)


def test_the_table_is_in_the_order_of_the_fields():
    assert list(Parameters().as_dict()) == [p.name for p in Parameters.describe()]


def test_presets_are_listed_with_the_default_first():
    assert preset_names() == ["robust", "paper_matlab", "paper_opencv"]
    assert preset_names()[0] == DEFAULT_PRESET == DetectorParameters().preset


@pytest.mark.parametrize("name", preset_names())
def test_a_preset_is_a_ros_parameters_file(name: str):
    content = in_file(name)
    assert list(content) == ["/**"]
    assert list(content["/**"]) == ["ros__parameters"]
    values = content["/**"]["ros__parameters"]
    for key, value in values.items():
        # ROS refuses an integer for a float parameter: the type must be that of the table.
        assert type(value) is type(ALL[f"Parameters.{key}"].default), key


@pytest.mark.parametrize("name", preset_names())
def test_a_preset_is_the_default_but_for_its_file(name: str):
    loaded, default = Parameters.preset(name).as_dict(), Parameters().as_dict()
    assert loaded == default | in_file(name)["/**"]["ros__parameters"]


def test_the_default_preset_is_the_tables_defaults():
    assert Parameters.preset() == Parameters.preset("robust") == Parameters()
    assert Parameters().rso_test == "history"


@pytest.mark.parametrize(
    ("name", "engine"), [("paper_opencv", "sparse"), ("paper_matlab", "dense")]
)
def test_the_papers_presets_are_the_published_choices(name: str, engine: str):
    p = Parameters.preset(name)
    assert (p.engine, p.flow_targets, p.first_guess) == (engine, "native", "zero")
    assert (p.background, p.hot_pixels, p.threshold_statistics) == ("none", "keep", "all")
    # AAS 21-364: two sigma for outliers and for the RSOs.
    assert (p.star_field_model, p.outlier_sigmas) == ("mean", 2.0)
    assert (p.rso_test, p.rso_sigmas) == ("speed", 2.0)


def test_a_preset_takes_changes():
    changed = Parameters.preset("paper_matlab", rso_sigmas=3, window_px=11)
    expected = dataclasses.replace(Parameters.preset("paper_matlab"), rso_sigmas=3.0, window_px=11)
    assert changed == expected


def test_an_unknown_preset_is_answered_with_those_there_are():
    message = "there is no preset 'best'; there are robust, paper_matlab, paper_opencv"
    with pytest.raises(ParameterError, match=f"^{message}$"):
        Parameters.preset("best")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"window_px": 200}, "window_px must be within 3 to 101 px, not 200"),
        ({"window_px": 2}, "window_px must be within 3 to 101 px, not 2"),
        ({"window_px": 9.5}, "window_px must be an integer (3 to 101), not 9.5"),
        ({"window_px": True}, "window_px must be an integer (3 to 101), not True"),
        ({"window_px": "9"}, "window_px must be an integer (3 to 101), not '9'"),
        ({"window_px": None}, "window_px must be an integer (3 to 101), not None"),
        ({"window_px": [9]}, "window_px must be an integer (3 to 101), not [9]"),
        ({"window_px": 10**400}, "window_px must be within 3 to 101 px, not 1000"),
        ({"window_px": math.nan}, "window_px must be within 3 to 101 px, not nan"),
        ({"rso_sigmas": math.nan}, "rso_sigmas must be within 0.5 to 100, not nan"),
        ({"rso_sigmas": math.inf}, "rso_sigmas must be within 0.5 to 100, not inf"),
        ({"rso_sigmas": 10**400}, "rso_sigmas must be within 0.5 to 100, not 1000"),
        ({"rso_sigmas": False}, "rso_sigmas must be a number (0.5 to 100), not False"),
        ({"rso_sigmas": np.True_}, "rso_sigmas must be a number (0.5 to 100), not "),
        ({"rso_sigmas": 1j}, "rso_sigmas must be a number (0.5 to 100), not 1j"),
        ({"engine": "fast"}, "engine must be one of sparse | dense, not 'fast'"),
        ({"engine": 1}, "engine must be text (sparse | dense), not 1"),
        ({"engin": "dense"}, "there is no parameter 'engin'; did you mean engine?"),
        ({"xyz": 1}, "there is no parameter 'xyz'"),
    ],
)
def test_what_is_wrong_is_said(changes: dict, message: str):
    with pytest.raises(ParameterError, match=f"^{re.escape(message)}"):
        Parameters.of(changes)
    with pytest.raises(ParameterError, match=f"^{re.escape(message)}"):
        Parameters.preset("paper_opencv", **changes)


def test_a_name_unlike_any_other_gets_no_suggestion():
    with pytest.raises(ParameterError, match=r"^there is no parameter 'xyz'$"):
        Parameters.of({"xyz": 1})


def test_a_bad_value_is_refused_when_built_directly():
    with pytest.raises(ParameterError, match="min_area_px must be within 1 to 10000 px, not 0"):
        Parameters(min_area_px=0)


def test_a_switch_takes_no_number():
    with pytest.raises(ParameterError, match=re.escape("loop must be a switch (true | false)")):
        PlayerParameters(loop=1)


@pytest.mark.parametrize("value", [3, 3.0, np.int64(3), np.float32(3), Fraction(3)])
def test_a_whole_number_stands_for_an_integer_and_for_a_float(value):
    p = Parameters(window_px=value, rso_sigmas=value)
    assert (p.window_px, p.rso_sigmas) == (3, 3.0)
    assert (type(p.window_px), type(p.rso_sigmas)) == (int, float)


@pytest.mark.parametrize("about", ALL.values(), ids=ALL)
def test_the_ends_of_a_range_belong_to_it(about: Description):
    if about.low is None:
        return
    for end in (about.low, about.high):
        assert about.check(end) == end
    for beyond in (about.low - 1, about.high + 1):
        with pytest.raises(
            ParameterError, match=re.escape(f"{about.name} must be within {about.allowed}")
        ):
            about.check(beyond)


def test_a_change_leaves_the_original_as_it_was():
    before = Parameters()
    after = before.replace(engine="dense")
    assert (before.engine, after.engine) == ("sparse", "dense")
    assert after.replace(engine="sparse") == before
    with pytest.raises(dataclasses.FrozenInstanceError):
        before.engine = "dense"


def test_the_markdown_table_has_every_parameter_once():
    lines = markdown_table().splitlines()
    assert lines[0] == "| parameter | default | range | unit | read by | meaning |"
    assert set(lines[1]) == {"|", "-"}
    # An escaped bar is text, the others are borders.
    rows = [[c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[2:]]
    assert [row[0] for row in rows] == [f"`{p.name}`" for p in ALL.values()]
    for row, about in zip(rows, ALL.values(), strict=True):
        name, default, allowed, unit, stage, meaning = row
        assert allowed.replace("\\|", "|") == about.allowed
        assert (unit, stage) == (about.unit, about.stage)
        assert meaning == about.meaning + ("" if about.live else " (set at start)")
        assert yaml.safe_load(default or "''") == about.default, name
