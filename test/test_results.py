# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Result files: their columns, and that what is written is what was found."""

import contextlib
import csv
import math
import re
from pathlib import Path

import numpy as np
import pytest

from ofsat_ros import results
from ofsat_ros.detection import CANDIDATE, CONFIRMED, DETECTION_DTYPE
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.results import ResultWriter, detection_lines, in_words
from ofsat_ros.star_field import StarFieldMotion

STAMP = 1_767_225_600_123_456_789
DETECTIONS = (
    "stamp_ns,frame,track_id,confirmed,x_px,y_px,vx_px_s,vy_px_s,rel_vx_px_s,rel_vy_px_s,"
    "sigma_x_px,sigma_y_px,snr,flux,length_px,angle_deg,ra_deg,dec_deg"
)
STAR_FIELD = (
    "stamp_ns,frame,dt_s,dx_px,dy_px,vx_px_s,vy_px_s,rotation_deg,scale,sigma_dx_px,sigma_dy_px,"
    "residual_px,stars,objects,detections,background,noise,threshold,note"
)
# File's column -> field of the array; angles apart.
SAME = {
    **{"x_px": "x", "y_px": "y", "vx_px_s": "vx", "vy_px_s": "vy", "rel_vx_px_s": "rel_vx"},
    **{"rel_vy_px_s": "rel_vy", "sigma_x_px": "sigma_x", "sigma_y_px": "sigma_y", "snr": "snr"},
    **{"flux": "flux", "length_px": "length"},
}
ANGLES = {"angle_deg": "angle", "ra_deg": "ra", "dec_deg": "dec"}


def detections(count: int = 3) -> np.ndarray:
    random = np.random.default_rng(1)
    rows = np.zeros(count, DETECTION_DTYPE)
    for name in DETECTION_DTYPE.names:
        if DETECTION_DTYPE[name].kind == "f":
            rows[name] = random.uniform(-1, 1, count) * 10.0 ** random.integers(-3, 5, count)
    rows["track_id"] = np.arange(count) * 7
    rows["status"] = [CONFIRMED if i % 2 else CANDIDATE for i in range(count)]
    return rows


def motion(stars: int = 12) -> StarFieldMotion:
    return StarFieldMotion(
        centre=np.array([99.5, 49.5]),
        displacement=np.array([1.25, -2.5]),
        rotation=math.radians(0.125),
        scale=1e-4,
        covariance=np.diag([0.01, 0.04, 1e-8, 1e-8]),
        inliers=np.arange(20) < stars,
        residual_px=0.0625,
        residual_sigmas=1.0,
        speed_mean=2.8,
        speed_std=0.1,
        model="similarity",
    )


def result(frame: int = 5, **values) -> FrameResult:
    numbers = {"dt_s": 0.5, "background": 1000.5, "noise": 5.75, "threshold": 23.0}
    return FrameResult(STAMP + frame, frame, (100, 200), **{**numbers, **values})


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_headers_are_the_contract(tmp_path: Path):
    with ResultWriter(tmp_path):
        pass
    assert (tmp_path / "detections.csv").read_bytes() == DETECTIONS.encode() + b"\n"
    assert (tmp_path / "star_field.csv").read_bytes() == STAR_FIELD.encode() + b"\n"


def write(writer: ResultWriter, given: FrameResult) -> None:
    """Write a frame as `ofsat process` does."""
    writer.add_star_field(given)
    writer.add_detections(given.stamp_ns, given.frame, given.detections)


def test_detections_make_the_round_trip(tmp_path: Path):
    first, second = detections(3), detections(2)
    with ResultWriter(tmp_path) as writer:
        write(writer, result(0, detections=first))
        write(writer, result(1))
        write(writer, result(2, detections=second))
    rows = read(tmp_path / "detections.csv")
    assert [int(row["frame"]) for row in rows] == [0, 0, 0, 2, 2]
    for row, found in zip(rows, [*first, *second], strict=True):
        assert list(row) == DETECTIONS.split(",")
        assert int(row["stamp_ns"]) == STAMP + int(row["frame"])
        assert int(row["track_id"]) == found["track_id"]
        assert row["confirmed"] == str(int(found["status"] == CONFIRMED))
        # Nine digits: a ten-thousandth of a pixel on any sensor.
        for column, name in SAME.items():
            assert float(row[column]) == pytest.approx(found[name], rel=1e-8)
        for column, name in ANGLES.items():
            assert float(row[column]) == pytest.approx(math.degrees(found[name]), rel=1e-8)


def test_what_is_unknown_is_nan():
    rows = detections(1)
    for name in ("snr", "flux", "length", "angle", "ra", "dec"):
        rows[name] = np.nan
    (line,) = detection_lines(STAMP, 3, rows)
    values = dict(zip(DETECTIONS.split(","), line.rstrip("\n").split(","), strict=True))
    nan = {name for name, value in values.items() if value == "nan"}
    assert nan == {"snr", "flux", "length_px", "angle_deg", "ra_deg", "dec_deg"}


def test_no_detection_is_no_line():
    assert detection_lines(STAMP, 3, detections(0)) == []


def test_lines_end_in_one_newline():
    assert all(re.fullmatch(r"[^\n]+\n", line) for line in detection_lines(1, 2, detections(4)))


def test_known_values_as_text():
    row = np.zeros(1, DETECTION_DTYPE)
    row["x"], row["y"], row["vx"], row["angle"] = 1023.5, 0.123456789, -2.0, math.pi / 2
    row["ra"], row["dec"], row["snr"], row["flux"] = math.pi, -math.pi / 6, 12.5, 1e6
    row["track_id"], row["status"] = 4_294_967_295, CONFIRMED
    (line,) = detection_lines(STAMP, 41, row)
    expected = f"{STAMP},41,4294967295,1,1023.5,0.123456789,-2,0,0,0,0,0,12.5,1000000,0,90,180,-30"
    assert line == expected + "\n"


def test_the_star_field_makes_the_round_trip(tmp_path: Path):
    objects = np.zeros(17, [("x", "f8")])
    with ResultWriter(tmp_path) as writer:
        write(writer, result(star_field=motion(), objects=objects, detections=detections(2)))
    (row,) = read(tmp_path / "star_field.csv")
    assert row.pop("note") == ""
    assert {name: float(value) for name, value in row.items() if name != "stamp_ns"} == {
        **{"frame": 5, "dt_s": 0.5, "dx_px": 1.25, "dy_px": -2.5},
        # per second: by dt
        **{"vx_px_s": 2.5, "vy_px_s": -5.0, "rotation_deg": 0.125, "scale": 1e-4},
        **{"sigma_dx_px": 0.1, "sigma_dy_px": 0.2, "residual_px": 0.0625},
        **{"stars": 12, "objects": 17, "detections": 2},
        **{"background": 1000.5, "noise": 5.75, "threshold": 23},
    }
    assert row["stamp_ns"] == str(STAMP + 5)


def test_tracks_are_summed_up_from_their_detections(tmp_path: Path):
    first, second = detections(3), detections(3)
    second["x"], second["snr"], second["vx"] = first["x"] + 5, first["snr"] + 2, first["vx"] + 1
    with ResultWriter(tmp_path) as writer:
        write(writer, result(3, detections=first))
        write(writer, result(4))
        write(writer, result(5, detections=second[:2]))
        # The row without a track id, 0, is no track's.
    rows = read(tmp_path / "tracks.csv")
    assert [int(row["track_id"]) for row in rows] == [7, 14]
    one, other = rows
    assert (one["first_frame"], one["last_frame"], one["detections"]) == ("3", "5", "2")
    assert int(one["last_stamp_ns"]) - int(one["first_stamp_ns"]) == 2
    assert float(one["last_x_px"]) - float(one["first_x_px"]) == pytest.approx(5)
    assert float(one["snr"]) == pytest.approx(first["snr"][1] + 1)
    assert float(one["vx_px_s"]) == pytest.approx(first["vx"][1] + 0.5)
    assert (other["first_frame"], other["last_frame"], other["detections"]) == ("3", "3", "1")


def test_every_frame_has_its_star_field_line_the_first_too(tmp_path: Path):
    reason = 'no object, "none", is above, alas'
    with ResultWriter(tmp_path) as writer:
        write(writer, result(0, dt_s=math.nan, reset="first frame", reason="no previous frame"))
        write(writer, result(1, reason=reason))
        write(writer, result(2, star_field=motion(), detections=detections(1)))
    rows = read(tmp_path / "star_field.csv")
    assert [row["frame"] for row in rows] == ["0", "1", "2"]
    # A reset says more than that there is no previous frame.
    assert [row["note"] for row in rows] == ["first frame", reason.replace('"', "'"), ""]
    for row in rows[:2]:
        fields = STAR_FIELD.split(",")
        motion_fields = fields[fields.index("dx_px") : fields.index("residual_px") + 1]
        assert {row[name] for name in motion_fields} == {"nan"}
        assert (row["stars"], row["objects"], row["detections"]) == ("0", "0", "0")
    assert [row["dt_s"] for row in rows] == ["nan", "0.5", "0.5"]


def test_lines_are_on_disk_after_each_frame(tmp_path: Path):
    with ResultWriter(tmp_path) as writer:
        for count in range(1, 4):
            write(writer, result(count, star_field=motion(), detections=detections(2)))
            assert len(read(tmp_path / "star_field.csv")) == count
            assert len(read(tmp_path / "detections.csv")) == 2 * count
            assert (tmp_path / "detections.csv").read_bytes().endswith(b"\n")


def test_the_files_are_closed_by_an_exception_too(tmp_path: Path):
    def interrupted() -> ResultWriter:
        with contextlib.suppress(KeyboardInterrupt), ResultWriter(tmp_path) as writer:
            write(writer, result(detections=detections(2)))
            raise KeyboardInterrupt
        return writer

    writer = interrupted()
    with pytest.raises(ValueError, match="closed"):
        write(writer, result(detections=detections(2)))
    assert len(read(tmp_path / "detections.csv")) == 2


def test_older_files_are_replaced(tmp_path: Path):
    for _ in range(2):
        with ResultWriter(tmp_path) as writer:
            write(writer, result(detections=detections(2)))
    assert len(read(tmp_path / "detections.csv")) == 2


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="absent"):
        ResultWriter(tmp_path / "absent")


def test_a_second_file_that_cannot_be_written_leaves_none_open(tmp_path: Path):
    """An open file would warn, and warnings are errors."""
    (tmp_path / "star_field.csv").mkdir()
    with pytest.raises(OSError, match=r"star_field\.csv"):
        ResultWriter(tmp_path)


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ({}, "0 RSO detections"),
        ({0: 4}, "4 RSO detections"),
        ({0: 4, 7: 1}, "5 RSO detections of 1 track and 4 candidates"),
        ({7: 2, 9: 3}, "5 RSO detections of 2 tracks"),
    ],
)
def test_counts_tell_tracks_from_candidates(counts: dict[int, int], words: str):
    assert in_words(counts) == words


def test_a_run_is_written_and_read(tmp_path):
    run = {"recording": "/nächte/eins", "frames": 3, "topic": None, "problems": ["so"], "s": 0.1}
    results.write_run(tmp_path, {"old": True})
    results.write_run(tmp_path, run)
    read = results.read_run(tmp_path)
    assert run.items() <= read.items()
    assert {name for name in read if read[name] is not None} <= run.keys()
    assert read["width"] is None  # every field is there
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_a_run_that_cannot_be_written_leaves_the_former_one(tmp_path):
    results.write_run(tmp_path, {"frames": 3})
    with pytest.raises(ValueError, match="not JSON compliant"):
        results.write_run(tmp_path, {"seconds": math.nan})
    with pytest.raises(TypeError):
        results.write_run(tmp_path, {"path": tmp_path})
    assert results.read_run(tmp_path)["frames"] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "holds no run.json: give a folder that ofsat process has made"),
        ('{"frames": 3', "run.json is damaged: .*; run ofsat process again"),
        ("[1]", "run.json is damaged: it holds no object"),
        ("\xff", "run.json is damaged"),
    ],
)
def test_a_folder_without_a_whole_run_says_so(text, message, tmp_path):
    if text is not None:
        (tmp_path / "run.json").write_text(text, encoding="latin-1")
    with pytest.raises(results.ResultError, match=message):
        results.read_run(tmp_path)
