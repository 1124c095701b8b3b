# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Evaluation: every rule of the scoring, each with a case made by hand."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from ofsat_ros.detection import CANDIDATE, CONFIRMED, DETECTION_DTYPE
from ofsat_ros.evaluation import (
    DETECTIONS_DTYPE,
    TRUTH_DTYPE,
    EvaluationError,
    count_frames,
    detection_table,
    evaluate,
    merge,
    read_detections,
    read_truth,
)
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.results import ResultWriter
from ofsat_ros.simulation import scenario, write_truth

S = 1_000_000_000
PERIOD_S = 2.0
DIAGONAL = math.sqrt(0.5)


def stamp(frame: int) -> int:
    return 1_767_225_600 * S + int(frame * PERIOD_S * S)


def truth(*rows: dict) -> np.ndarray:
    table = np.zeros(len(rows), TRUTH_DTYPE)
    for at, row in zip(table, rows, strict=True):
        given = {"frame": 1, "id": "1", "x_px": 50, "y_px": 50, "snr": 30, **row}
        for name, value in given.items():
            at[name] = value
        at["stamp_ns"] = stamp(int(at["frame"]))
    return table


def said(*rows: dict) -> np.ndarray:
    table = np.zeros(len(rows), DETECTIONS_DTYPE)
    for at, row in zip(table, rows, strict=True):
        given = {"frame": 1, "x_px": 50, "y_px": 50, "confirmed": True, "snr": 7, **row}
        for name, value in given.items():
            at[name] = value
        at["stamp_ns"] = stamp(int(at["frame"]))
    return table


def counts(evaluation) -> dict[str, int]:
    names = ("found", "missed", "false alarm", "duplicate", "ignored")
    return {name: evaluation.count(name) for name in names if evaluation.count(name)}


def outcome(truths: np.ndarray, detections: np.ndarray, **options) -> dict[str, int]:
    return counts(evaluate(truths, detections, **options))


# ---- what matches


def test_a_detection_within_two_pixels_is_found_and_beyond_is_a_false_alarm():
    assert outcome(truth({}), said({"x_px": 51.99})) == {"found": 1}
    assert outcome(truth({}), said({"x_px": 51.2, "y_px": 51.5})) == {"found": 1}
    assert outcome(truth({}), said({"x_px": 52.01})) == {"missed": 1, "false alarm": 1}
    # a circle, not a square
    assert outcome(truth({}), said({"x_px": 51.9, "y_px": 51.9})) == {
        "missed": 1,
        "false alarm": 1,
    }


@pytest.mark.parametrize(
    ("along", "across", "found"),
    [(9.9, 0, True), (-9.9, 1.9, True), (10.1, 0, False), (0, 1.9, True), (0, 2.1, False)],
)
def test_a_streak_is_matched_along_its_motion(along: float, across: float, found: bool):
    streak = truth({"length_px": 20, "vx_px_s": 10, "vy_px_s": 10})
    x = 50 + DIAGONAL * (along - across)
    y = 50 + DIAGONAL * (along + across)
    expected = {"found": 1} if found else {"missed": 1, "false alarm": 1}
    assert outcome(streak, said({"x_px": x, "y_px": y})) == expected


def test_a_short_streak_has_two_pixels_along_as_well():
    moving = {"vx_px_s": 10}
    just_no_streak = truth({"length_px": 3.9, **moving})
    just_a_streak = truth({"length_px": 4.0, **moving})
    corner = said({"x_px": 51.9, "y_px": 51.9})
    assert outcome(just_no_streak, corner) == {"missed": 1, "false alarm": 1}
    assert outcome(just_a_streak, corner) == {"found": 1}
    assert outcome(just_a_streak, said({"x_px": 52.1})) == {"missed": 1, "false alarm": 1}


def test_a_streak_whose_direction_is_unknown_is_matched_as_a_point():
    streak = truth({"length_px": 20, "vx_px_s": math.nan, "vy_px_s": math.nan})
    assert outcome(streak, said({"x_px": 51})) == {"found": 1}
    assert outcome(streak, said({"x_px": 55})) == {"missed": 1, "false alarm": 1}


def test_assignment_finds_most_where_the_nearest_first_would_lose_one():
    # The nearest pair is (second truth, first detection); it would leave the others unmatched.
    truths = truth({"id": "1", "x_px": 50}, {"id": "2", "x_px": 51.5})
    detections = said({"x_px": 51.0, "track_id": 1}, {"x_px": 53.0, "track_id": 2})
    rows = evaluate(truths, detections).rows("found")
    assert {(row["id"], int(row["track_id"])) for row in rows} == {("1", 1), ("2", 2)}


def test_one_detection_is_not_two_objects():
    truths = truth({"id": "1", "x_px": 50}, {"id": "2", "x_px": 51.5})
    result = evaluate(truths, said({"x_px": 51.4}))
    assert counts(result) == {"found": 1, "missed": 1}
    assert result.rows("missed")["id"] == "1"


def test_detections_are_matched_in_their_own_frame_only():
    result = outcome(truth({"frame": 1}), said({"frame": 2}))
    assert result == {"missed": 1, "false alarm": 1}


# ---- what counts


def test_frame_0_never_counts():
    truths = truth({"frame": 0}, {"frame": 1})
    detections = said({"frame": 0}, {"frame": 0, "x_px": 9}, {"frame": 1})
    result = evaluate(truths, detections)
    assert counts(result) == {"found": 1}
    assert result.frames == 1


def test_a_second_detection_is_a_duplicate_within_one_and_a_half_times_the_tolerance():
    first = {"x_px": 50}
    assert outcome(truth({}), said(first, {"x_px": 52.9})) == {"found": 1, "duplicate": 1}
    assert outcome(truth({}), said(first, {"x_px": 53.1})) == {"found": 1, "false alarm": 1}
    streak = truth({"length_px": 20, "vx_px_s": 10})
    assert outcome(streak, said(first, {"x_px": 64.9})) == {"found": 1, "duplicate": 1}
    assert outcome(streak, said(first, {"x_px": 65.1})) == {"found": 1, "false alarm": 1}
    assert outcome(streak, said(first, {"y_px": 53.1})) == {"found": 1, "false alarm": 1}


def test_the_wider_tolerance_is_for_second_detections_only():
    assert outcome(truth({}), said({"x_px": 52.5})) == {"missed": 1, "false alarm": 1}


def test_duplicates_are_no_matter_of_precision():
    result = evaluate(truth({}), said({}, {"x_px": 51}, {"x_px": 52}))
    assert counts(result) == {"found": 1, "duplicate": 2}
    assert result.precision == 1
    assert result.false_alarms_per_frame == 0


@pytest.mark.parametrize("dont_care", [{"snr": 2.99}, {"edge": True}])
def test_dont_care_is_neither_a_miss_nor_a_false_alarm(dont_care: dict):
    result = evaluate(truth(dont_care), said({}))
    assert counts(result) == {"ignored": 1}
    assert math.isnan(result.precision)
    assert math.isnan(result.recall())
    assert result.objects == (0, 0)
    assert outcome(truth(dont_care), said()) == {}
    assert outcome(truth(dont_care), said({}, {"x_px": 51})) == {"ignored": 1, "duplicate": 1}
    assert outcome(truth(dont_care), said({"x_px": 53})) == {"false alarm": 1}


def test_snr_3_counts():
    assert outcome(truth({"snr": 3.0}), said()) == {"missed": 1}


def test_candidates_count_only_when_asked_for():
    detections = said({"confirmed": False}, {"x_px": 9, "confirmed": False})
    assert outcome(truth({}), detections) == {"missed": 1}
    assert outcome(truth({}), detections, candidates=True) == {"found": 1, "false alarm": 1}


def test_live_counts_from_the_third_visible_frame_on():
    snrs = {0: 10, 1: 2, 2: 10, 3: 10, 4: 10, 5: 2, 6: 10}  # visible in 0, 2, 3, 4, 6
    truths = truth(*({"frame": k, "snr": snr} for k, snr in snrs.items()))
    everywhere = said(*({"frame": k} for k in snrs), {"frame": 1, "x_px": 9})
    result = evaluate(truths, everywhere, live=True)
    assert counts(result) == {"found": 3, "ignored": 3, "false alarm": 1}
    assert result.rows("found")["frame"].tolist() == [3, 4, 6]
    assert outcome(truths, said(), live=True) == {"missed": 3}
    assert outcome(truths, said()) == {"missed": 4}


def test_live_counts_each_object_for_itself_in_any_order_of_rows():
    truths = truth(
        *({"frame": k, "id": "late", "x_px": 9} for k in (6, 5, 4)),
        *({"frame": k, "id": "early"} for k in (2, 1, 0)),
    )
    missed = evaluate(truths, said(), live=True).rows("missed")
    assert [(row["frame"], row["id"]) for row in missed] == [(2, "early"), (6, "late")]


def test_live_takes_unknown_snr_and_the_border_as_visible():
    truths = truth(*({"frame": k, "snr": math.nan, "edge": k == 1} for k in range(4)))
    assert evaluate(truths, said(), live=True).rows("missed")["frame"].tolist() == [2, 3]


def test_unknown_snr_counts_in_no_range_of_snr():
    truths = truth({"snr": math.nan}, {"id": "2", "x_px": 9, "snr": math.nan}, {"frame": 2})
    result = evaluate(truths, said({}, {"frame": 2}))
    assert result.recall() == pytest.approx(2 / 3)
    assert result.recall(20) == 1
    assert math.isnan(result.recall(5, 10))


# ---- figures


def test_recall_by_snr_has_its_limits_below():
    snrs = (3, 4.99, 5, 9.99, 10, 19.99, 20, 500)
    truths = truth(*({"id": str(i), "x_px": 20 * i, "snr": s} for i, s in enumerate(snrs)))
    detections = said(*({"x_px": 20 * i} for i in (1, 2, 3, 4, 6, 7)))
    result = evaluate(truths, detections)
    assert result.recall(3, 5) == 0.5
    assert result.recall(5, 10) == 1
    assert result.recall(10, 20) == 0.5
    assert result.recall(20) == 1
    assert result.recall() == 0.75


def test_precision_and_false_alarms_per_frame():
    truths = truth(*({"frame": k} for k in range(5)))
    wrong = [{"frame": 1, "x_px": 9}, {"frame": 3, "x_px": 9}]
    result = evaluate(truths, said(*({"frame": k} for k in range(5)), *wrong))
    assert result.precision == pytest.approx(4 / 6)
    assert result.false_alarms_per_frame == pytest.approx(2 / 4)
    # Ten frames, of which the last ones hold nothing.
    assert evaluate(truths, said(*wrong), frames=10).false_alarms_per_frame == pytest.approx(2 / 9)


def test_a_sequence_without_objects():
    result = evaluate(truth(), said({"frame": 3}), frames=6)
    assert counts(result) == {"false alarm": 1}
    assert result.precision == 0
    assert result.false_alarms_per_frame == pytest.approx(1 / 5)
    assert counts(evaluate(truth(), said(), frames=6)) == {}


def test_the_centroid_error_is_that_of_the_vector_and_of_each_axis():
    truths = truth(*({"frame": k} for k in range(1, 5)))
    offsets = [(0.6, 0.8), (-0.6, 0.8), (0.6, -0.8), (-0.6, -0.8)]
    detections = said(
        *({"frame": k + 1, "x_px": 50 + x, "y_px": 50 + y} for k, (x, y) in enumerate(offsets))
    )
    result = evaluate(truths, detections)
    assert result.centroid_rms_px == pytest.approx(1.0)
    assert result.centroid_rms_xy_px == pytest.approx((0.6, 0.8))


def test_the_centroid_error_leaves_out_the_faint_and_the_streaks():
    truths = truth(
        {"frame": 1},
        {"frame": 2, "snr": 4.9},
        {"frame": 3, "length_px": 4, "vx_px_s": 2},
        {"frame": 4, "edge": True},
    )
    result = evaluate(truths, said(*({"frame": k, "x_px": 50 + k / 4} for k in range(1, 5))))
    assert result.centroid_rms_px == pytest.approx(0.25)


def test_the_velocity_error_is_per_frame_by_the_stamps():
    truths = truth(*({"frame": k, "vx_px_s": 3, "vy_px_s": -1} for k in range(1, 12)))
    errors = [0.1 * k for k in range(11)]  # px/s
    detections = said(
        *(
            {"frame": k + 1, "vx_px_s": 3 + 0.6 * e, "vy_px_s": -1 + 0.8 * e}
            for k, e in enumerate(errors)
        )
    )
    result = evaluate(truths, detections)
    assert result.velocity_error_px() == pytest.approx(0.5 * PERIOD_S)
    assert result.velocity_error_px(0.9) == pytest.approx(0.9 * PERIOD_S)


def test_the_velocity_error_follows_an_uneven_rate_and_bridges_gaps():
    truths = truth(*({"frame": k} for k in (1, 2, 6)))
    truths["stamp_ns"] = [0, 3 * S, 11 * S]  # 3 s, then four frames of 2 s
    detections = said(*({"frame": k, "vx_px_s": 1} for k in (1, 2, 6)))
    detections["stamp_ns"] = truths["stamp_ns"]
    # The period of the first frame that is known is the next one's.
    assert evaluate(truths, detections).rows("found")["dv_px"].tolist() == [3, 3, 2]


def test_unknown_velocities_and_a_lone_frame_are_no_velocity_error():
    truths = truth(*({"frame": k, "vx_px_s": math.nan} for k in (1, 2)))
    both = said(*({"frame": k} for k in (1, 2)))
    assert math.isnan(evaluate(truths, both).velocity_error_px())
    assert math.isnan(evaluate(truth({}), said({})).velocity_error_px())


def test_objects_are_found_in_half_of_the_frames_that_count():
    half = [{"id": "half", "frame": k, "x_px": 10} for k in range(5)]
    less = [{"id": "less", "frame": k, "x_px": 30} for k in range(6)]
    faint = [{"id": "faint", "frame": k, "x_px": 70, "snr": 2} for k in range(5)]
    detections = said(
        *({"frame": k, "x_px": 10} for k in (0, 1, 2)),
        *({"frame": k, "x_px": 30} for k in (0, 1, 2)),
        *({"frame": k, "x_px": 70} for k in (0, 1, 2)),
    )
    assert evaluate(truth(*half, *less, *faint), detections).objects == (1, 2)


# ---- several sequences, listings and output


def test_sequences_add_up_and_keep_their_objects():
    first = evaluate(truth({}, {"frame": 2}), said({}, {"frame": 2}), name="A")
    second = evaluate(truth({"id": "1"}), said({"x_px": 9}), frames=4, name="B")
    empty = evaluate(truth(), said(), frames=3, name="D")
    total = merge([merge([first, empty]), second])
    assert total.sequences == ("A", "D", "B")
    assert counts(total) == {"found": 2, "missed": 1, "false alarm": 1}
    assert total.frames == 2 + 2 + 3
    assert total.objects == (1, 2)  # both are called 1
    (row,) = total.rows("missed")
    assert total.sequences[row["sequence"]] == "B"
    assert counts(merge([])) == {}
    assert second.rows("missed")["sequence"].tolist() == [0]


def test_misses_and_false_alarms_can_be_looked_up():
    truths = truth({"frame": 3, "id": "7", "x_px": 20, "y_px": 30, "snr": 6, "length_px": 2})
    detections = said({"frame": 2, "x_px": 80, "y_px": 90, "snr": 5.5, "track_id": 12})
    result = evaluate(truths, detections)
    names = ["frame", "id", "track_id", "x_px", "y_px", "snr"]
    assert result.rows("missed")[names].tolist() == [(3, "7", 0, 20, 30, 6)]
    assert result.rows("false alarm")[names].tolist() == [(2, "", 12, 80, 90, 5.5)]
    assert result.rows("missed", "false alarm")["frame"].tolist() == [2, 3]


def test_a_found_row_holds_the_errors():
    truths = truth({"vx_px_s": 1}, {"frame": 2, "vx_px_s": 1})
    detections = said({"x_px": 50.5, "y_px": 49, "vx_px_s": 1.25})
    (row,) = evaluate(truths, detections).rows("found")
    assert (row["dx_px"], row["dy_px"], row["dv_px"]) == (0.5, -1, 0.25 * PERIOD_S)
    assert (row["x_px"], row["y_px"], row["snr"]) == (50.5, 49, 30)


def test_the_figures_as_text_and_as_json():
    truths = truth({}, {"frame": 2, "snr": 6, "vx_px_s": 0.5}, {"frame": 3, "snr": 6})
    detections = said({"x_px": 50.3}, {"frame": 2, "y_px": 49.6}, {"frame": 3, "x_px": 9})
    result = evaluate(truths, detections, name="night 1")
    assert str(result).splitlines() == [
        "                      found     of  recall",
        "all                       2      3   0.667",
        "SNR >= 20                 1      1   1.000",
        "SNR 10 to 20              0      0       -",
        "SNR 5 to 10               1      2   0.500",
        "SNR 3 to 5                0      0       -",
        "precision            0.667",
        "false alarms         1 in 3 frames: 0.333 per frame",
        "apart                0 duplicates, 0 detections of what does not count",
        "centroid error, rms  0.354 px (x 0.212, y 0.283)",
        "velocity error       median 0.500, 90 % 0.900 px per frame",
        "objects              1 of 1 found in at least half of their frames",
    ]
    assert json.loads(json.dumps(result.as_dict(), allow_nan=False)) == {
        "sequences": ["night 1"],
        "frames": 3,
        "truths": 3,
        "found": 2,
        "recall": pytest.approx(2 / 3),
        "recall_by_snr": {">= 20": 1, "10 to 20": None, "5 to 10": 0.5, "3 to 5": None},
        "precision": pytest.approx(2 / 3),
        "false_alarms": 1,
        "false_alarms_per_frame": pytest.approx(1 / 3),
        "duplicates": 0,
        "ignored": 0,
        "centroid_rms_px": pytest.approx(math.hypot(0.3, 0.4) / math.sqrt(2)),
        "centroid_rms_x_px": pytest.approx(0.3 / math.sqrt(2)),
        "centroid_rms_y_px": pytest.approx(0.4 / math.sqrt(2)),
        "velocity_error_median_px_per_frame": 0.5,
        "velocity_error_90_percent_px_per_frame": pytest.approx(0.9),
        "objects": 1,
        "objects_found_in_half_their_frames": 1,
    }


# ---- tables and files


def test_optional_fields_of_the_truth_may_be_absent():
    sky = scenario("survey", frames=3, width=128, height=128)
    frames = list(sky)
    truths = np.concatenate([frame.truth for frame in frames])
    perfect = said(
        *(
            {"frame": row["frame"], "x_px": row["x_px"], "y_px": row["y_px"], "confirmed": True}
            for row in truths
        )
    )
    perfect["stamp_ns"] = truths["stamp_ns"]
    result = evaluate(truths, perfect)
    expected = np.count_nonzero((truths["frame"] > 0) & (truths["snr"] >= 3))
    assert result.count("found") == expected > 0
    assert not result.count("false alarm")


@pytest.mark.parametrize(
    ("place", "cut"),
    [
        ({"x_px": 3.9}, True),
        ({"x_px": 4.0}, False),
        ({"y_px": 95.1}, True),  # the last row is 99
        ({"y_px": 95.0}, False),
        ({"x_px": 195.1}, True),
        ({"x_px": 195.0}, False),
        ({"x_px": 13.9, "length_px": 20, "vx_px_s": -5}, True),
        ({"x_px": 14.1, "length_px": 20, "vx_px_s": -5}, False),
        ({"x_px": 5, "length_px": 20, "vy_px_s": 5}, False),
    ],
)
def test_the_border_follows_from_the_images_size(place: dict, cut: bool):
    assert outcome(truth(place), said(), shape=(100, 200)) == ({} if cut else {"missed": 1})


def test_detections_of_the_pipeline_become_one_table():
    found = np.zeros(2, DETECTION_DTYPE)
    found["x"], found["y"], found["vx"], found["snr"] = [50, 9], 50, 1, 8
    found["track_id"], found["status"] = [4, 0], [CONFIRMED, CANDIDATE]
    none = np.zeros(0, DETECTION_DTYPE)
    table = detection_table([none, found, none], [stamp(k) for k in range(3)])
    assert table["frame"].tolist() == [1, 1]
    assert table["stamp_ns"].tolist() == [stamp(1)] * 2
    assert outcome(truth({}), table) == {"found": 1}
    assert outcome(truth({}), table, candidates=True) == {"found": 1, "false alarm": 1}


def test_what_process_writes_can_be_evaluated(tmp_path: Path):
    found = np.zeros(1, DETECTION_DTYPE)
    found["x"], found["y"], found["status"], found["track_id"] = 50.5, 50, CONFIRMED, 3
    with ResultWriter(tmp_path) as writer:
        for k in range(5):
            detections = found if k == 1 else found[:0]
            writer.add_star_field(FrameResult(stamp(k), k, (100, 100)))
            writer.add_detections(stamp(k), k, detections)
    assert count_frames(tmp_path) == 5
    for path in (tmp_path, tmp_path / "detections.csv"):
        result = evaluate(truth({}), read_detections(path), frames=count_frames(tmp_path))
        assert counts(result) == {"found": 1}
        assert result.rows("found")["track_id"].tolist() == [3]
        assert result.frames == 4


def test_frames_are_unknown_without_star_field_file(tmp_path: Path):
    assert count_frames(tmp_path) is None


def test_truth_of_the_simulator_makes_the_round_trip(tmp_path: Path):
    frames = list(scenario("geo", frames=2, width=128, height=128))
    write_truth(tmp_path / "truth.csv", [frame.truth for frame in frames])
    read, made = read_truth(tmp_path / "truth.csv"), np.concatenate([f.truth for f in frames])
    assert read["id"].tolist() == [str(number) for number in made["id"]]
    for name in ("stamp_ns", "frame"):
        assert read[name].tolist() == made[name].tolist()
    for name in ("x_px", "vy_px_s", "snr", "length_px"):
        np.testing.assert_allclose(read[name], made[name], atol=1e-3)  # digits of the file
    assert not read["edge"].any()


TRUTH_HEADER = "stamp_ns,frame,id,x_px,y_px,vx_px_s,vy_px_s,rel_vx_px_s,snr,flux,length_px,edge"


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_empty_cells_are_unknown(tmp_path: Path):
    path = write(
        tmp_path / "truth.csv",
        TRUTH_HEADER,
        "10,0,2713_Luxembourg,1.5,2.5,,,,,,,1",
        "20,1,2713_Luxembourg,1.5,2.5,-0.5,0.25,,12,,4,0",
    )
    table = read_truth(path)
    assert table["id"].tolist() == ["2713_Luxembourg"] * 2
    for name in ("vx_px_s", "vy_px_s", "snr", "length_px"):
        assert np.isnan(table[name]).tolist() == [True, False]
    assert table["edge"].tolist() == [True, False]
    table["frame"], table["edge"] = 1, False
    result = evaluate(table[:1], said(), shape=(10, 10))
    assert counts(result) == {}  # cut by the border; without a length it is a point
    assert counts(evaluate(table[:1], said())) == {"missed": 1}


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("10,0,1,1.5,", r"truth\.csv, line 3: 5 cells under 12 columns; was the file cut off"),
        ("10,0,1,,2,0,0,,9,,0,0", r"line 3, column x_px: it must be a number, not ''"),
        ("10,0,1,1,nan,0,0,,9,,0,0", r"line 3, column y_px: it must be a number, not 'nan'"),
        ("10,0,1,1,2,0,0,,high,,0,0", r"line 3, column snr: it must be a number, not 'high'"),
        ("10,0.5,1,1,2,0,0,,9,,0,0", r"line 3, column frame: it must be a whole number"),
        ("10,-1,1,1,2,0,0,,9,,0,0", r"line 3, column frame: it must be a whole number"),
        ("1e9,0,1,1,2,0,0,,9,,0,0", r"line 3, column stamp_ns: it must be a whole number"),
        ("10,0,1,1,2,0,0,,9,,0,2", r"line 3, column edge: it must be 0 or 1, not '2'"),
    ],
)
def test_a_bad_cell_is_named_with_its_place(tmp_path: Path, row: str, message: str):
    path = write(tmp_path / "truth.csv", TRUTH_HEADER, "10,0,1,1,2,0,0,,9,,0,0", row)
    with pytest.raises(EvaluationError, match=message):
        read_truth(path)


def test_a_file_of_something_else_is_named(tmp_path: Path):
    path = write(tmp_path / "detections.csv", "stamp_ns,frame,x,y", "1,0,2,3")
    with pytest.raises(EvaluationError, match=r"line 1: no column x_px, y_px; is this the file"):
        read_detections(path)
    with pytest.raises(EvaluationError, match="no column stamp_ns"):
        read_truth(write(tmp_path / "empty.csv"))
    with pytest.raises(EvaluationError, match="is a folder; give the CSV file"):
        read_truth(tmp_path)
    with pytest.raises(FileNotFoundError, match="absent"):
        read_truth(tmp_path / "absent.csv")


def test_an_array_of_something_else_is_named():
    with pytest.raises(EvaluationError, match="the table of truth has no field id"):
        evaluate(said({}), said({}))


def test_stamps_that_contradict_each_other_are_an_error():
    truths = truth(*({"frame": k} for k in range(4)))
    shifted = said({"frame": 2})
    shifted["stamp_ns"] = stamp(3)  # a frame was lost
    with pytest.raises(EvaluationError, match=r"night: frame 2 has stamp \d+ ns in the truth but"):
        evaluate(truths, shifted, name="night")
    shifted["stamp_ns"] = stamp(2) + 1000  # rounded elsewhere
    assert outcome(truths, shifted) == {"found": 1, "missed": 2}
