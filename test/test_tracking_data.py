# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Tracking data: other readers find in the files what was put in; files are whole or absent."""

import math
import re
import subprocess
import sys
from collections import defaultdict
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from ccsds_ndm.models import ndmxml2, ndmxml4
from ccsds_ndm.ndm_io import NdmIo
from xsdata.formats.dataclass.parsers import XmlParser
from xsdata.formats.dataclass.parsers.config import ParserConfig

from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.parameters import ParameterError, TrackingDataParameters
from ofsat_ros.tracking_data import SUFFIXES, TRACKING_DATA, Arc, TrackArcs, files, write_arcs

START_NS = 1_790_000_000_123_456_789
STEP_NS = 100_000_000
ARCSEC = math.radians(1 / 3600)


def rows(*tracks: tuple, dtype: np.dtype = DETECTION_DTYPE) -> np.ndarray:
    """Detections of (track, ra deg, dec deg, ...), unknown where nothing is given."""
    made = np.zeros(len(tracks), dtype)
    for name in set(made.dtype.names) - {"track_id", "status", "object_index", "flow_index"}:
        made[name] = np.nan
    for row, (track_id, ra, dec, *more) in zip(made, tracks, strict=True):
        row["track_id"], row["ra"], row["dec"] = track_id, np.radians(ra), np.radians(dec)
        for name, value in zip(("sigma_ra", "sigma_dec", "flux", "snr"), more, strict=False):
            row[name] = value
    return made


# Two tracks: one over 0 h and the equator with all that is known, one in the south with gaps.
FIRST = [
    (359.9 + 0.05 * k, -0.1 + 0.03 * k, (0.5 + k / 10) * ARCSEC, 0.4 * ARCSEC) for k in range(6)
]
FLUX = [1000.0, 990.0, np.nan, -5.0, 1010.0, 1020.0]
SECOND = [(120.123456789 - 1e-5 * k, -71.987654321) for k in range(4)]


def collected(**parameters) -> TrackArcs:
    arcs = TrackArcs(TrackingDataParameters(**parameters))
    for k in range(6):
        found = [(3, *FIRST[k], FLUX[k], 25.0)]
        if k >= 2:
            found.append((17, *SECOND[k - 2]))
        found += [(0, 10.0, 10.0), (4, np.nan, np.nan), (5, 50.0, 5.0)][: 2 + (k < 2)]
        arcs.add(START_NS + k * STEP_NS, rows(*found))
    return arcs


def stamp(k: int) -> str:
    """The time of a frame as an independent formatter writes it, rounded to microseconds."""
    ns = START_NS + k * STEP_NS + 500
    whole = datetime.fromtimestamp(ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{whole}.{ns % 10**9 // 1000:06d}"


def written(folder: Path, name: str, **parameters) -> Path:
    path = folder / TRACKING_DATA[name]
    assert collected(**parameters).write(path, name) == 2
    return path


def observations(segment) -> dict[str, dict[str, float]]:
    """Values by keyword and epoch; none may occur twice."""
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for observation in segment.data.observation:
        for name in ("angle_1", "angle_2", "mag"):
            value = getattr(observation, name)
            if value is not None:
                assert observation.epoch not in found[name]
                found[name][observation.epoch] = getattr(value, "value", value)
    return found


class TestTdm:
    @pytest.fixture(params=["kvn", "xml"])
    def message(self, request, tmp_path):
        given = {"station": "Hill & <Dale>", "originator": "ME", "object_names": "3= ISS (ZARYA) "}
        path = written(tmp_path, request.param, zero_point_mag=18.5, **given)
        return NdmIo().from_path(path)

    def test_another_reader_finds_the_angles(self, message):
        first, second = map(observations, message.body.segment)
        for found, truth, start in ((first, FIRST, 0), (second, SECOND, 2)):
            epochs = [stamp(start + k) for k in range(len(truth))]
            assert list(found["angle_1"]) == list(found["angle_2"]) == epochs
            # What 8 decimals leave: 5e-9 deg.
            assert list(found["angle_1"].values()) == pytest.approx(
                [ra % 360 for ra, *_ in truth], abs=6e-9
            )
            assert list(found["angle_2"].values()) == pytest.approx(
                [dec for _, dec, *_ in truth], abs=6e-9
            )

    def test_magnitudes_are_those_of_the_flux(self, message):
        first, second = map(observations, message.body.segment)
        expected = {stamp(k): 18.5 - 2.5 * math.log10(f) for k, f in enumerate(FLUX) if f > 0}
        assert first["mag"] == pytest.approx(expected, abs=6e-4)
        assert "mag" not in second
        types = [segment.metadata.data_types for segment in message.body.segment]
        assert types == ["ANGLE_1,ANGLE_2,MAG", "ANGLE_1,ANGLE_2"]

    def test_metadata_say_what_the_standard_asks_for(self, message):
        assert message.header.originator == "ME"
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}", message.header.creation_date)
        metadata = [segment.metadata for segment in message.body.segment]
        assert [m.participant_2 for m in metadata] == ["ISS (ZARYA)", "UNKNOWN-17"]
        assert [(m.start_time, m.stop_time) for m in metadata] == [
            (stamp(0), stamp(5)),
            (stamp(2), stamp(5)),
        ]
        assert [m.track_id for m in metadata] == [
            "20260921_141320123457-3",
            "20260921_141320323457-17",
        ]
        for m in metadata:
            assert m.participant_1 == "Hill & <Dale>"
            assert (m.time_system, m.path) == ("UTC", "2,1")
            chosen = (m.mode, m.timetag_ref, m.angle_type, m.reference_frame, m.data_quality)
            words = [getattr(word, "value", word) for word in chosen]
            assert words == ["SEQUENTIAL", "RECEIVE", "RADEC", "ICRF", "RAW"]
            assert m.integration_interval is m.corrections_applied is m.correction_angle_1 is None

    def test_uncertainties_stand_in_comments(self, message):
        first, second = message.body.segment
        assert "TIME_SIGMA 0.01 s" in first.metadata.comment
        lines = [line.split() for line in first.data.comment]
        assert [line[1] for line in lines] == ["epoch,", "rms", *map(stamp, range(6))]
        assert [float(line[2]) for line in lines[2:]] == pytest.approx(
            [s[2] / ARCSEC for s in FIRST], abs=6e-5
        )
        assert {float(line[3]) for line in lines[2:]} == {0.4}
        rms = math.sqrt(np.mean(np.square([s[2] / ARCSEC for s in FIRST])))
        assert float(lines[1][2]) == pytest.approx(rms, abs=6e-5)
        assert second.data.comment == ["SIGMA unknown"]

    def test_text_keeps_to_the_rules_for_lines(self, tmp_path):
        text = written(tmp_path, "kvn", zero_point_mag=18.5).read_text("ascii")
        lines = text.splitlines()
        assert lines[0].split() == ["CCSDS_TDM_VERS", "=", "2.0"]
        assert all(line.isprintable() and len(line) <= 254 for line in lines)
        assert "-0.00000000" not in text
        words = [line for line in lines if re.fullmatch("(META|DATA)_(START|STOP)", line)]
        assert words == ["META_START", "META_STOP", "DATA_START", "DATA_STOP"] * 2
        # Comments only where a section begins.
        for here, following in pairwise(lines):
            if following.startswith("COMMENT"):
                assert re.match("COMMENT|META_START|DATA_START|CCSDS_TDM_VERS", here)
        order = [line.split()[0] for line in lines if re.match(r"ANGLE_\d", line)]
        assert order == ["ANGLE_1", "ANGLE_2"] * 10

    @pytest.mark.parametrize("models", [ndmxml2, ndmxml4], ids=["ndmxml2", "ndmxml4"])
    def test_xml_has_the_elements_of_the_schema_in_their_order(self, tmp_path, models):
        path = written(tmp_path, "xml", zero_point_mag=18.5)
        assert path.read_text().startswith('<?xml version="1.0" encoding="UTF-8"?>\n<tdm ')
        strict = ParserConfig(fail_on_unknown_properties=True, fail_on_converter_warnings=True)
        message = XmlParser(config=strict).from_string(path.read_text(), models.Tdm)
        root = ElementTree.parse(path).getroot()
        assert dict(root.items())["id"] == "CCSDS_TDM_VERS"
        assert dict(root.items())["version"] == "2.0"
        fields = [f.metadata["name"] for f in _fields(type(message.body.segment[0].metadata))]
        for metadata in root.iter("metadata"):
            tags = list(dict.fromkeys(child.tag for child in metadata))
            assert tags == [name for name in fields if name in tags]
        for observation in root.iter("observation"):
            assert observation[0].tag == "EPOCH"
            assert len(observation) == 2

    def test_ra_just_below_360_degrees_is_0(self, tmp_path):
        arcs = TrackArcs(TrackingDataParameters(least_detections=1))
        arcs.add(START_NS, rows((1, 360 - 1e-10, -1e-10)))
        arcs.write(tmp_path / "a.tdm", "kvn")
        (segment,) = NdmIo().from_path(tmp_path / "a.tdm").body.segment
        assert observations(segment) == {"angle_1": {stamp(0): 0.0}, "angle_2": {stamp(0): 0.0}}
        assert "-0" not in (tmp_path / "a.tdm").read_text().partition("DATA_START")[2].replace(
            "-09-21", ""
        )


def _fields(model: type) -> list:
    return list(model.__dataclass_fields__.values())


def read_iod(line: str) -> dict:
    """Read a line as the IOD Observation Format Description has its columns; format 3 only."""

    def columns(first: int, last: int) -> str:
        return line.ljust(80)[first - 1 : last]

    def mx(first: int) -> float:
        field = columns(first, first + 1)
        return int(field[0]) * 10.0 ** (int(field[1]) - 8) if field.strip() else math.nan

    assert columns(45, 46) == "35"  # HHMMmmm+DDdddd, J2000
    assert all(columns(n, n) == " " for n in (6, 9, 16, 21, 23, 41, 44, 47, 62, 65, 71, 74))
    ra = int(columns(48, 49)) * 15 + int(columns(50, 54)) / 1000 / 60 * 15
    dec = int(columns(56, 61)) / 10_000
    when = datetime.strptime(columns(24, 37), "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    return {
        "object": columns(1, 15),
        "station": columns(17, 20),
        "status": columns(22, 22),
        "time": when.timestamp() + int(columns(38, 40)) / 1000,
        "time_sigma": mx(42),
        "ra": ra,
        "dec": {"+": dec, "-": -dec}[columns(55, 55)],
        "sigma": mx(63),
        "behaviour": columns(66, 66),
        "mag": int(columns(67, 70)) / 10 if columns(67, 70).strip() else math.nan,
        "mag_sigma": int(columns(72, 73)) / 10 if columns(72, 73).strip() else math.nan,
    }


class TestIod:
    def test_the_reader_reads_a_published_line(self):
        # From SeeSat-L, 20 November 2003 (message 0119).
        line = "23533 95 015A   8305 G 20031120011047590 56 35 2027142-289077 26"
        found = read_iod(line)
        assert (found["object"], found["station"], found["status"]) == (
            "23533 95 015A  ",
            "8305",
            "G",
        )
        assert found["time"] == datetime(2003, 11, 20, 1, 10, 47, 590_000, UTC).timestamp()
        assert (found["time_sigma"], found["sigma"]) == pytest.approx((0.05, 0.02))
        assert found["ra"] == pytest.approx(15 * (20 + 27.142 / 60))
        assert found["dec"] == pytest.approx(-28.9077)

    def test_a_reader_of_the_format_finds_the_values(self, tmp_path):
        path = written(
            tmp_path, "iod", station="4171", object_names="3=25544 1998-067A", zero_point_mag=18.5
        )
        lines = path.read_text("ascii").splitlines()
        assert all(len(line) <= 80 for line in lines)
        found = [read_iod(line) for line in lines]
        truth = [(k, *FIRST[k], FLUX[k]) for k in range(6)]
        truth += [(k + 2, *SECOND[k], math.nan, math.nan, math.nan) for k in range(4)]
        assert len(found) == len(truth)
        for line, (k, ra, dec, sigma_ra, _, flux) in zip(found, truth, strict=True):
            assert (line["station"], line["status"], line["behaviour"]) == ("4171", " ", " ")
            # Half a step of each: 1 ms, 0.001 min of right ascension, 0.0001 deg.
            assert abs(line["time"] - (START_NS + k * STEP_NS) / 1e9) <= 0.000_501
            assert abs((line["ra"] - ra + 180) % 360 - 180) <= 0.000_126
            assert abs(line["dec"] - dec) <= 0.000_051
            assert line["time_sigma"] == pytest.approx(0.01)
            sigma = math.hypot(math.degrees(sigma_ra), 0.00025 / math.sqrt(12))
            # One digit is off by a third at most.
            assert line["sigma"] == pytest.approx(sigma, rel=0.34, nan_ok=True)
            if flux > 0:
                assert line["mag"] == pytest.approx(18.5 - 2.5 * math.log10(flux), abs=0.051)
                assert line["mag_sigma"] == 0.1  # 1.09 / 25, rounded up
            else:
                assert math.isnan(line["mag"])
        assert {line["object"] for line in found[:6]} == {"25544 98 067A  "}
        # Unknown, seen on the 264th day of 2026.
        assert {line["object"] for line in found[6:]} == {"90017 26 764UNK"}

    @pytest.mark.parametrize(
        ("name", "columns"),
        [
            ("694", "00694          "),
            ("2019-029ABC", "      19 029ABC"),
            ("GEO-1", "90003 26 764UNK"),
            ("123456", "90003 26 764UNK"),
        ],
    )
    def test_names_of_objects(self, tmp_path, name, columns):
        path = written(tmp_path, "iod", station="0001", object_names=f"3={name}")
        assert read_iod(path.read_text().splitlines()[0])["object"] == columns

    @pytest.mark.parametrize(
        ("sigma", "code"),
        [(0.0, "15"), (0.00095, "15"), (0.0951, "17"), (0.024, "26"), (60, "69")],
    )
    def test_uncertainty_of_the_time(self, tmp_path, sigma, code):
        # M times 10 to the (X - 8) s, not below the format's own step of 1 ms.
        path = written(tmp_path, "iod", station="0001", time_sigma_s=sigma)
        assert path.read_text()[41:43] == code

    @pytest.mark.parametrize(
        ("mag", "columns"),
        [
            (-99.94, "-999 01"),
            (-99.96, ""),
            (99.94, "+999 01"),
            (99.96, ""),
            (110.0, ""),
            (-0.01, "+000 01"),
        ],
    )
    def test_a_magnitude_that_has_no_room_is_left_out(self, tmp_path, mag, columns):
        arcs = TrackArcs(
            TrackingDataParameters(station="0001", zero_point_mag=10.0, least_detections=1)
        )
        arcs.add(START_NS, rows((3, 10, 10, np.nan, np.nan, 10 ** ((10 - mag) / 2.5), 25.0)))
        arcs.write(tmp_path / "a.iod", "iod")
        assert (tmp_path / "a.iod").read_text().splitlines()[0][66:] == columns

    def test_the_station_must_be_a_number(self, tmp_path):
        with pytest.raises(ParameterError, match=r"station must be four digits.*'OFSAT'"):
            TrackArcs(TrackingDataParameters(), ["kvn", "iod"])
        with pytest.raises(ParameterError, match="station must be four digits"):
            collected().write(tmp_path / "a.iod", "iod")
        assert not list(tmp_path.iterdir())


class TestArcs:
    def labels(self, arcs: list[Arc]) -> dict[str, int]:
        return {arc.label: len(arc.rows) for arc in arcs}

    def fed(self, *frames: tuple[float, list[tuple]]) -> TrackArcs:
        arcs = TrackArcs(TrackingDataParameters(least_detections=1))
        for seconds, found in frames:
            arcs.add(START_NS + round(seconds * 1e9), rows(*found))
        return arcs

    def test_short_tracks_are_not_written(self, tmp_path):
        arcs = collected(least_detections=5)
        assert self.labels(arcs.arcs) == {"3": 6}
        assert self.labels(collected(least_detections=2).arcs) == {"3": 6, "17": 4, "5": 2}
        assert collected(least_detections=7).write(tmp_path / "a.tdm", "kvn") == 0
        assert not list(tmp_path.iterdir())

    def test_a_recording_without_tracks_leaves_no_file_of_an_older_one(self, tmp_path):
        path = written(tmp_path, "kvn")
        assert collected(least_detections=7).write(path, "kvn", force=True) == 0
        assert not path.exists()

    def test_an_arc_ends_when_nothing_is_heard_of_it(self):
        frames = [(k, [(1, 10 + k / 100, 0)] * (k < 3) + [(2, 50 + k / 100, 0)]) for k in range(9)]
        arcs = self.fed(*frames)
        assert self.labels(arcs.take_ended(6.5)) == {}
        assert self.labels(arcs.take_ended(5.5)) == {"1": 3}
        arcs.add(START_NS + 30 * 10**9, rows())
        assert self.labels(arcs.take_ended(5.5)) == {"2": 9}
        assert self.labels(arcs.take_all()) == {}

    def test_an_arc_that_is_long_enough_is_cut(self):
        # Least 3, at most 5: the 2 that are left are not a track of 2.
        arcs = TrackArcs(TrackingDataParameters(least_detections=3), longest=5)
        ended = []
        for k in range(12):
            arcs.add(START_NS + k * 10**9, rows((1, 10 + k / 100, 0), (2, 50, 0))[: 1 + (k == 6)])
            ended += [(k, arc) for arc in arcs.take_ended(1000)]
        assert [(k, arc.label, len(arc.rows)) for k, arc in ended] == [(5, "1", 5), (10, "1", 5)]
        (last,) = arcs.take_all()
        assert (last.label, len(last.rows)) == ("1", 2)
        found = np.concatenate([arc.rows["stamp_ns"] for arc in (*dict(ended).values(), last)])
        assert found.tolist() == [START_NS + k * 10**9 for k in range(12)]

    def test_an_arc_is_not_cut_below_what_a_track_must_have(self):
        arcs = TrackArcs(TrackingDataParameters(least_detections=8), longest=5)
        for k in range(12):
            arcs.add(START_NS + k * 10**9, rows((1, 10 + k / 100, 0)))
        assert [len(arc.rows) for arc in arcs.take_all()] == [8, 4]

    def test_a_jump_off_the_path_of_a_full_arc_is_another_object(self):
        arcs = TrackArcs(TrackingDataParameters(least_detections=1), longest=5)
        for k in range(6):
            arcs.add(START_NS + k * 10**9, rows((1, 10 + k / 100 + 5 * (k == 5), 0)))
        assert self.labels(arcs.take_all()) == {"1": 5, "1-2": 1}

    def test_a_number_that_comes_back_is_another_object(self):
        arcs = self.fed((0, [(1, 10, 0)]), (1, [(1, 10.1, 0)]), (20, []))
        assert self.labels(arcs.take_ended(5)) == {"1": 2}
        arcs.add(START_NS + 21 * 10**9, rows((1, 10.2, 0)))
        assert self.labels(arcs.take_all()) == {"1-2": 1}

    def test_time_that_runs_backwards_ends_all(self):
        arcs = self.fed((5, [(1, 10, 0), (2, 20, 0)]), (6, [(1, 10, 0), (2, 20, 0)]), (0, []))
        arcs.add(START_NS + 10**8, rows((2, 20, 0)))
        assert self.labels(arcs.take_ended(1000)) == {"1": 2, "2": 2}
        assert self.labels(arcs.take_all()) == {"2-2": 1}

    def test_a_jump_off_the_path_begins_a_new_arc(self):
        # 0.5 deg/s, seen for 2 s; the number is given again 3 s later, 1 deg off the path.
        path = [(k / 10, [(1, 10 + k / 20, 40)]) for k in range(21)]
        assert self.labels(self.fed(*path, (5, [(1, 12.5, 41)])).arcs) == {"1": 21, "1-2": 1}
        assert self.labels(self.fed(*path, (5, [(1, 12.5, 40.02)])).arcs) == {"1": 22}
        # Faster than anything in orbit, from the first sight on.
        assert self.labels(self.fed((0, [(1, 10, 0)]), (1, [(1, 80, 0)])).arcs) == {
            "1": 1,
            "1-2": 1,
        }

    def test_a_fast_pass_near_the_pole_is_one_arc(self):
        # 2 deg/s on a great circle 0.5 deg from the pole, with a gap of 2 s at its top.
        angles = np.radians([-10 + 0.2 * k for k in range(101) if not 45 <= k < 65])
        times = [k / 10 for k in range(101) if not 45 <= k < 65]
        tilt = math.radians(0.5)
        x, y, z = np.sin(angles), np.cos(angles) * math.sin(tilt), np.cos(angles) * math.cos(tilt)
        ra, dec = np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arcsin(z))
        frames = [(t, [(1, *at)]) for t, at in zip(times, zip(ra, dec, strict=True), strict=True)]
        assert self.labels(self.fed(*frames).arcs) == {"1": 81}

    def test_rows_without_uncertainty_do(self):
        dtype = np.dtype([("track_id", "u4"), ("ra", "f8"), ("dec", "f8")])
        arcs = TrackArcs(TrackingDataParameters(least_detections=1))
        arcs.add(START_NS, rows((9, 1.0, 2.0), dtype=dtype))
        (arc,) = arcs.arcs
        assert np.isnan([arc.rows[0][n] for n in ("sigma_ra", "sigma_dec", "flux", "snr")]).all()


class TestFiles:
    def test_nothing_is_replaced_without_force(self, tmp_path):
        path = tmp_path / "a.tdm"
        path.write_text("precious")
        with pytest.raises(FileExistsError, match=r"a\.tdm exists already and is not replaced"):
            collected().write(path, "kvn")
        assert path.read_text() == "precious"
        assert collected().write(path, "kvn", force=True) == 2
        assert path.read_text().startswith("CCSDS_TDM_VERS")
        assert list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize("links", [True, False])
    def test_nothing_is_replaced_that_comes_in_between(self, tmp_path, monkeypatch, links):
        path = tmp_path / "a.tdm"
        real = files.os.fsync

        def another_writes(number: int) -> None:
            real(number)
            path.write_text("precious")

        def no_links(*_: object) -> None:
            raise OSError(1, "Operation not permitted")

        monkeypatch.setattr(files.os, "fsync", another_writes)
        if not links:
            monkeypatch.setattr(files.os, "link", no_links)
        with pytest.raises(FileExistsError, match=r"a\.tdm exists already and is not replaced"):
            collected().write(path, "kvn")
        assert path.read_text() == "precious"
        assert list(tmp_path.iterdir()) == [path]

    def test_a_file_system_without_links_does(self, tmp_path, monkeypatch):
        def no_links(*_: object) -> None:
            raise OSError(1, "Operation not permitted")

        monkeypatch.setattr(files.os, "link", no_links)
        path = tmp_path / "a.tdm"
        assert collected().write(path, "kvn") == 2
        assert path.read_text().startswith("CCSDS_TDM_VERS")
        assert list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize("step", ["fsync", "replace"])
    @pytest.mark.parametrize("old", [None, "old"])
    def test_what_fails_midway_leaves_things_as_they_were(self, tmp_path, monkeypatch, step, old):
        path = tmp_path / "a.xml"
        if old:
            path.write_text(old)

        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(files.os, step, full)
        with pytest.raises(OSError, match="No space left") as error:
            collected().write(path, "xml", force=True)
        assert error.value.filename == f"{path}"
        assert [p.read_text() for p in tmp_path.iterdir()] == ([old] if old else [])

    def test_a_file_that_may_not_grow_is_not_there(self, tmp_path):
        # As on a full disk: the system itself refuses the write, in the middle of the file.
        script = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_tracking_data import collected
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    collected().write(Path({str(tmp_path)!r}) / "a.tdm", "kvn")
except OSError as error:
    sys.exit(error.strerror)
"""
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, timeout=60
        )
        assert done.stderr.strip() == "File too large"
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("name", SUFFIXES)
    def test_everybody_may_read_the_file(self, tmp_path, name):
        path = tmp_path / "a"
        arcs = collected()
        write_arcs(path, arcs.arcs, name, TrackingDataParameters(station="1234"))
        plain = tmp_path / "plain"
        plain.touch()
        assert path.stat().st_mode == plain.stat().st_mode


@pytest.mark.parametrize(
    "names", ["25544", "3=", "x=25544", "3=a,3=b", "0=a", "3=a;7=b,9", "-3=a", "=a"]
)
def test_object_names_say_how_to_write_them(names):
    with pytest.raises(ParameterError, match=r"written as 3=25544,7=GEO-1, not .*see '"):
        TrackingDataParameters(object_names=names)


def test_names_of_objects_are_taken_apart():
    parameters = TrackingDataParameters(object_names=" 3=25544 , 7-2=A=B c,")
    assert parameters.object_by_track == {"3": "25544", "7-2": "A=B c"}


@pytest.mark.parametrize(
    "given",
    [
        {"station": ""},
        {"station": "  "},
        {"station": "Zürich"},
        {"originator": "two\nlines"},
        {"originator": "x" * 201},
        {"object_names": "3=tab\tbed"},
    ],
    ids=repr,
)
def test_what_a_line_cannot_hold_is_refused(given):
    (name,) = given
    with pytest.raises(ParameterError, match=rf"{name} must be 1 to 200 printable ASCII"):
        TrackingDataParameters(**given)
