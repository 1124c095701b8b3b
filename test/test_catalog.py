# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The catalogue of tracks: what goes in comes out, by time, place, rate and brightness."""

import csv
import io
import json
import math
import shutil
import sqlite3
import time
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from archived import EVENING_NS, HOUR_NS, NAN, Seen, archived
from command import fails, ofsat, subprocess_ofsat, succeeds
from hypothesis import given, settings
from hypothesis import strategies as st

from ofsat_ros.catalog import Catalog, CatalogError, Cone, Night, Selection
from ofsat_ros.catalog.sphere import angles, cap_of, distance_to_arcs, unit_vectors
from ofsat_ros.results import ResultError, read_run, write_run

INF = math.inf
# Across 0h; over the pole; fast, past 83.6 +22 between two frames; without directions; south.
ACROSS = Seen(1, [(359.9 + 0.02 * i, 10.0) for i in range(11)], snr=20, flux=5000)
POLAR = Seen(2, [(30, 89.5), (30, 89.9), (210, 89.7)], snr=8, flux=300, rel=(0.3, 0.4))
FAST = Seen(7, [(80.0, 22.0), (87.0, 22.0)], snr=30, flux=100_000, rel=(60, 80))
NOWHERE = Seen(3, [(NAN, NAN)] * 5, snr=6, flux=90, rel=(NAN, NAN))
SOUTH = Seen(1, [(120, -45 - 0.001 * i) for i in range(60)], snr=12)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A catalogue of two recordings, an hour apart, and their folders."""
    first = archived(tmp_path / "results" / "first", [ACROSS, POLAR, NOWHERE])
    later = EVENING_NS + HOUR_NS
    second = archived(tmp_path / "results" / "Second", [SOUTH, FAST], start_ns=later)
    with Catalog(tmp_path, write=True) as catalog:
        assert catalog.add(first)
        assert catalog.add(second)
    return tmp_path


def found(out: Path, **wanted: object) -> set[tuple[str, int]]:
    with Catalog(out) as catalog:
        tracks = catalog.query(Selection(**wanted))
        assert catalog.count(Selection(**wanted)) == len(tracks)
    return set(zip(tracks["recording"].tolist(), tracks["track_id"].tolist(), strict=True))


def test_a_track_comes_out_as_it_went_in(out: Path):
    with Catalog(out) as catalog:
        (track,) = catalog.query(Selection(snr=(20, 20)))
        (result, _) = catalog.results()
    assert track["result"] == result.id
    assert (track["track_id"], track["detections"]) == (1, 11)
    assert (track["first_frame"], track["last_frame"]) == (2, 12)
    assert track["first_stamp_ns"] == EVENING_NS + 2 * 10**9
    assert track["last_stamp_ns"] == EVENING_NS + 12 * 10**9
    assert [track[f"last_{axis}_px"] for axis in "xy"] == [130, 160]
    assert (track["rel_vx_px_s"], track["rel_vy_px_s"], track["rate_px_s"]) == (3, -4, 5)
    # 0.02 degrees of right ascension a second, at declination 10.
    assert track["rate_arcsec_s"] == pytest.approx(72 * math.cos(math.radians(10)), rel=1e-4)
    assert track["magnitude"] == pytest.approx(-2.5 * math.log10(5000))
    places = [track[f"{end}_{axis}_deg"] for end in ("first", "last") for axis in ("ra", "dec")]
    assert places == pytest.approx([359.9, 10, 360.1, 10])
    assert (track["recording"], track["folder"]) == ("first.bag", "results/first")


def test_a_result_comes_out_with_where_it_is_from(out: Path):
    with Catalog(out) as catalog:
        first, second = catalog.results()
    assert first.folder == out / "results" / "first"
    assert first.recording == ("/data/first.bag",)
    assert (first.version, first.preset, first.parameters) == (
        *("0.1.0", "robust"),
        {"spot_sigmas": 4.5},
    )
    assert (first.frames, first.width_px, first.tracks, second.tracks) == (150, 640, 3, 2)
    assert first.unlocated == {"no attitude": 5}
    assert (first.live, first.stopped, first.key) == (False, False, None)


def test_unknown_is_nan(out: Path):
    with Catalog(out) as catalog:
        (track,) = catalog.query(Selection(snr=(6, 6)))
    names = ("first_ra_deg", "last_dec_deg", "rate_arcsec_s", "rate_px_s")
    assert np.isnan([track[name] for name in names]).all()


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ({}, {*(("first.bag", i) for i in (1, 2, 3)), ("Second.bag", 1), ("Second.bag", 7)}),
        ({"from_ns": EVENING_NS + HOUR_NS}, {("Second.bag", 1), ("Second.bag", 7)}),
        ({"to_ns": EVENING_NS + HOUR_NS}, {("first.bag", 1), ("first.bag", 2), ("first.bag", 3)}),
        # Seen at that moment: the fast one is gone by then.
        ({"from_ns": EVENING_NS + HOUR_NS + 9 * 10**9}, {("Second.bag", 1)}),
        ({"rate_px_s": (6, INF)}, {("Second.bag", 7)}),
        ({"rate_px_s": (-INF, 1)}, {("first.bag", 2)}),
        ({"rate_arcsec_s": (20_000, INF)}, {("Second.bag", 7)}),
        ({"snr": (6, 8)}, {("first.bag", 2), ("first.bag", 3)}),
        ({"magnitude": (-INF, -9)}, {("first.bag", 1), ("Second.bag", 7)}),
        ({"magnitude": (-5, INF)}, {("first.bag", 3)}),
        ({"recording": "SECOND"}, {("Second.bag", 1), ("Second.bag", 7)}),
        ({"recording": "data/f", "snr": (7, 9)}, {("first.bag", 2)}),
        ({"snr": (100, 200)}, set()),
    ],
)  # fmt: skip
def test_selections(out: Path, wanted: dict[str, object], expected: set[tuple[str, int]]):
    assert found(out, **wanted) == expected


@pytest.mark.parametrize(
    ("cone", "expected"),
    [
        ((0, 10, 0.05), {("first.bag", 1)}),
        ((360.08, 10, 0.01), {("first.bag", 1)}),
        ((-0.08, 10, 0.01), {("first.bag", 1)}),
        ((0, 10.05, 0.04), set()),
        ((77, 90, 0.12), {("first.bag", 2)}),  # it goes from 89.9 to 89.7 beyond the pole
        ((77, 90, 1e-6), {("first.bag", 2)}),  # right over it
        ((300, 89.8, 0.05), set()),
        ((83.5, 22.045, 0.03), {("Second.bag", 7)}),  # the great circle goes north of +22
        ((83.5, 22, 0.001), set()),
        ((120, -45.03, 0.0001), {("Second.bag", 1)}),
        ((0, 90, 180), {("first.bag", 1), ("first.bag", 2), ("Second.bag", 1), ("Second.bag", 7)}),
        ((0, -90, 90), {("Second.bag", 1)}),
    ],
)  # fmt: skip
def test_cones(out: Path, cone: tuple[float, float, float], expected: set[tuple[str, int]]):
    """Their radii are such that each track is in or out by 10 % at least, or 0.001 degrees."""
    assert found(out, cone=Cone(*cone)) == expected


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0, 360), st.floats(-90, 90)), min_size=3, max_size=3, unique=True)
)
def test_distance_to_arcs_is_that_of_the_nearest_of_many_places(places):
    place, start, end = unit_vectors(*np.transpose(places))
    share = np.linspace(0, 1, 2001)[:, None]
    between = start * (1 - share) + end * share
    size = np.linalg.norm(between, axis=1, keepdims=True)
    if size.min() < 1e-3:  # opposite ends: any way is the short one
        return
    nearest = angles(between / size, place).min()
    exact = distance_to_arcs(place, start[None], end[None])[0]
    # Neighbours are far apart if the ends are nearly opposite; none is nearer than the nearest,
    # which is known to 0.02": of ends 1e-9 rad apart, rounding turns the circle.
    spacing = angles(between[:-1] / size[:-1], between[1:] / size[1:]).max()
    assert nearest - spacing <= exact <= nearest + 1e-7
    middle, radius = cap_of(np.stack([start, end]))
    assert angles(between / size, middle).max() <= radius + 1e-7


def test_sorted_limited_and_unknown_last(out: Path):
    with Catalog(out) as catalog:
        by_rate = catalog.query(sort="rate_px_s", descending=True)
        assert by_rate["track_id"].tolist() == [7, 1, 1, 2, 3]
        assert catalog.query(sort="rate_px_s")["track_id"].tolist()[-1] == 3
        assert catalog.query(sort="magnitude", limit=2)["track_id"].tolist() == [7, 1]
        near = catalog.query(Selection(cone=Cone(0, 90, 180)), sort="snr", limit=1)
        assert near["snr"].tolist() == [8]
        with pytest.raises(ValueError, match=r"tracks are sorted by track_id, .*, not by 1; DROP"):
            catalog.query(sort="1; DROP TABLE tracks")


def test_the_same_again_changes_nothing(out: Path):
    before = (out / "catalog.sqlite").read_bytes()
    with Catalog(out, write=True) as catalog:
        assert not catalog.add(out / "results" / "first")
        assert not catalog.add(out / "results" / ".." / "results" / "first")
    assert (out / "catalog.sqlite").read_bytes() == before


def test_another_result_of_the_recording_takes_its_place(out: Path):
    again = archived(out / "again", [SOUTH], recording="/data/first.bag")
    with Catalog(out, write=True) as catalog:
        assert catalog.add(again)
    assert found(out) == {("first.bag", 1), ("Second.bag", 1), ("Second.bag", 7)}
    # Moved and copied files are the same recording; another camera's topic in them is not.
    for name, changes in (("a", {}), ("b", {"topic": "/other"}), ("c", {"content": "ff"})):
        about = {"content": "ee", "recording": f"/{name}"} | changes
        folder = archived(out / name, [SOUTH], **about)
        with Catalog(out, write=True) as catalog:
            catalog.add(folder)
    moved = archived(out / "moved", [SOUTH], content="ee", recording="/elsewhere")
    with Catalog(out, write=True) as catalog:
        catalog.add(moved)
        names = [one.name for one in catalog.results()]
    assert names == ["first.bag", "b", "c", "elsewhere", "Second.bag"]


def test_a_path_used_again_on_another_night_is_another_recording(out: Path):
    again = archived(
        out / "again", [], recording="/data/first.bag", start_ns=EVENING_NS + 24 * HOUR_NS
    )
    with Catalog(out, write=True) as catalog:
        catalog.add(again)
        assert len(catalog.results()) == 3


def test_a_folder_made_anew_is_read_anew(out: Path):
    shutil.rmtree(out / "results" / "first")
    archived(out / "results" / "first", [SOUTH], seconds=3.0)
    with Catalog(out, write=True) as catalog:
        assert catalog.add(out / "results" / "first")
    assert found(out, recording="first") == {("first.bag", 1)}


def test_a_catalogue_moves_along_with_its_folders(out: Path):
    moved = Path(shutil.move(out / "results", out / "new" / "results")).parent
    shutil.move(out / "catalog.sqlite", moved)
    with Catalog(moved / "catalog.sqlite") as catalog:
        assert [one.folder.is_dir() for one in catalog.results()] == [True, True]


def test_results_that_are_gone_are_forgotten_on_demand(out: Path):
    shutil.rmtree(out / "results" / "first")
    with Catalog(out, write=True) as catalog:
        assert catalog.remove_missing(out / "elsewhere") == 0
        assert catalog.remove_missing(out / "results") == 1
        assert catalog.remove_missing() == 0
        (row,) = catalog.results()
        assert row.name == "Second.bag"
        assert set(catalog.query()["result"]) == set(catalog.paths(catalog.query())["result"])
    raw = sqlite3.connect(out / "catalog.sqlite")
    for table in ("tracks", "path", "minutes"):  # nothing is left of it
        assert raw.execute(f"SELECT DISTINCT result FROM {table}").fetchall() == [(row.id,)]
    raw.close()


def test_damaged_folders_leave_the_catalogue_as_it_was(out: Path):
    bad = archived(out / "bad", [ACROSS, ACROSS])  # the same number twice
    empty = archived(out / "empty", frames=3)
    write_run(empty, read_run(empty) | {"frames": 0})
    part = archived(out / "part", segment={"first": 0})
    huge = archived(out / "huge", left_out=1 << 70)
    with Catalog(out, write=True) as catalog:
        before = repr(catalog.query().tolist())  # NaN is not itself
        for folder, says in (
            (bad, "bad is damaged: UNIQUE constraint failed"),
            (empty, r"is not taken in: run\.json tells of no frame"),
            (part, "is a part that ofsat batch will join"),
            (huge, "is damaged: Python int too large"),
            (out / "results", r"holds no run\.json"),
        ):
            with pytest.raises(ResultError, match=says):
                catalog.add(folder)
        (bad / "tracks.csv").unlink()
        with pytest.raises(ResultError, match=r"holds no tracks\.csv"):
            catalog.add(bad)
        assert repr(catalog.query().tolist()) == before


def test_minutes_tell_of_clouds(tmp_path: Path):
    folder = archived(tmp_path / "cloudy", blind=range(70, 100))
    with Catalog(tmp_path, write=True) as catalog:
        catalog.add(folder)
        minutes = catalog.minutes(catalog.results())
    assert minutes["start_ns"].tolist() == [EVENING_NS + i * 60 * 10**9 for i in range(3)]
    assert minutes["frames"].tolist() == [60, 60, 30]
    assert minutes["blind"].tolist() == [0, 30, 0]
    assert minutes["stars"].tolist() == [300, 150, 300]
    assert minutes["noise"].tolist() == [4, 4, 4]
    assert minutes["resets"].tolist() == [0, 0, 0]


def test_names_of_any_kind(tmp_path: Path):
    folder = archived(tmp_path / "Ünïcode 'quoted'", [SOUTH], recording="/x/\udcff'.bag")
    with Catalog(tmp_path, write=True) as catalog:
        assert catalog.add(folder)
        (one,) = catalog.results()
        assert one.folder == folder
        assert one.name == r"\udcff'.bag"
        assert len(catalog.query(Selection(recording=r"\UDCFF'"))) == 1
        odd = archived(tmp_path / "\udcff", [SOUTH])
        with pytest.raises(ResultError, match="its name is no Unicode; rename it"):
            catalog.add(odd)


class TestNights:
    def test_from_noon_to_noon(self):
        night = Night.of(EVENING_NS)
        assert night == Night(date(2026, 3, 1)) == Night.parse("2026-03-01")
        assert night.first_ns == EVENING_NS - 8 * HOUR_NS
        assert Night.of(night.first_ns) == Night.of(night.end_ns - 1) == night
        assert f"{Night.of(night.end_ns)}" == "2026-03-02"

    @pytest.mark.parametrize(
        ("longitude", "noon_utc_h"), [(15, 11), (-155, 12 + 155 / 15), (205, 12 + 155 / 15)]
    )
    def test_by_the_sun_of_the_site(self, longitude: float, noon_utc_h: float):
        night = Night.parse("2026-03-01", longitude)
        noon = EVENING_NS - 8 * HOUR_NS
        assert (night.first_ns - noon) / HOUR_NS == pytest.approx(noon_utc_h - 12, abs=1e-3)
        assert Night.of(night.first_ns, longitude) == night

    def test_of_a_catalogue(self, out: Path):
        with Catalog(out, write=True) as catalog:
            assert [f"{night}" for night in catalog.nights()] == ["2026-03-01"]
            catalog.longitude_deg = 120.0
            catalog.longitude_deg = -120.0  # noon is at 20:00 UTC
            (night,) = catalog.nights()
            assert night.first_ns == EVENING_NS
            assert len(catalog.results(night)) == 2
        with Catalog(out) as catalog:
            assert catalog.longitude_deg == -120.0


class TestFiles:
    def test_none_there(self, tmp_path: Path):
        with pytest.raises(CatalogError, match=r"there is no catalogue at .*catalog\.sqlite: `of"):
            Catalog(tmp_path)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("content", [b"", b"SQLite format 3\0", b"not a catalogue" * 100])
    def test_what_is_none(self, tmp_path: Path, content: bytes):
        (tmp_path / "catalog.sqlite").write_bytes(content)
        with pytest.raises(CatalogError, match=r"is no catalogue of ofsat|is damaged .*: delete"):
            Catalog(tmp_path)

    def test_of_another_program(self, tmp_path: Path):
        other = sqlite3.connect(tmp_path / "catalog.sqlite")
        other.execute("CREATE TABLE tracks (x)")
        other.close()
        for write in (False, True):
            with pytest.raises(CatalogError, match="is no catalogue of ofsat: give another file"):
                Catalog(tmp_path, write=write)

    @pytest.mark.parametrize(("version", "says"), [(99, "a newer"), (0, "an older")])
    def test_of_another_version(self, out: Path, version: int, says: str):
        raw = sqlite3.connect(out / "catalog.sqlite")
        raw.execute(f"PRAGMA user_version = {version}")
        raw.close()
        with pytest.raises(CatalogError, match=f"made by {says} version of ofsat .* --add FOLDER"):
            Catalog(out)

    def test_damaged_in_the_middle(self, out: Path):
        path = out / "catalog.sqlite"
        data = bytearray(path.read_bytes())
        data[4096:] = b"\xa5" * (len(data) - 4096)
        path.write_bytes(data)
        with (
            pytest.raises(CatalogError, match=r"is damaged \(.*\): delete it, and make it anew"),
            Catalog(out) as catalog,
        ):
            catalog.query()

    def test_locked(self, out: Path, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr("ofsat_ros.catalog.storage._PATIENCE_S", 0.05)
        other = sqlite3.connect(out / "catalog.sqlite", isolation_level=None)
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(CatalogError, match="is being written by another process: try again"):
            Catalog(out)
        other.execute("ROLLBACK")
        other.execute("BEGIN IMMEDIATE")  # one writes: others may read, and not write
        assert len(found(out)) == 5
        with (
            Catalog(out, write=True) as catalog,
            pytest.raises(CatalogError, match="is being written by another process"),
        ):
            catalog.remove_missing()
        other.close()

    def test_not_to_be_written(self, out: Path):
        shutil.rmtree(out / "results" / "first")
        with (
            Catalog(out) as catalog,
            pytest.raises(CatalogError, match="cannot be written: see to its permissions"),
        ):
            catalog.remove_missing()

    def test_what_was_begun_is_undone(self, out: Path, monkeypatch: pytest.MonkeyPatch):
        def stops(*_: object) -> None:
            raise KeyboardInterrupt

        again = archived(out / "again", [SOUTH], recording="/data/first.bag")
        before = found(out)
        with Catalog(out, write=True) as catalog:
            monkeypatch.setattr("ofsat_ros.catalog.catalog._put", stops)
            with pytest.raises(KeyboardInterrupt):
                catalog.add(again)
        assert found(out) == before


def test_a_hundred_thousand_tracks_answer_within_a_second(tmp_path: Path):
    """Put in as rows: making so many folders takes longer than all questions."""
    with Catalog(tmp_path, write=True) as catalog:
        catalog.add(archived(tmp_path / "one", [ACROSS]))
    raw = sqlite3.connect(tmp_path / "catalog.sqlite")
    raw.execute(
        "WITH RECURSIVE n(i) AS (SELECT 2 UNION ALL SELECT i + 1 FROM n WHERE i < 100000)"
        " INSERT INTO tracks SELECT result, i, first_stamp_ns + i * 1000000, last_stamp_ns, 0, 1,"
        " i, 1, 1, 1, 1, 1, 1, 1, 1, i, i, i % 97, i, 1, 10, 10, 10, 10,"
        " cap_x, cap_y, cap_z, cap_cos, cap_sin FROM n, tracks WHERE track_id = 1"
    )
    raw.execute(
        "INSERT INTO path SELECT result, track_id, 0, (track_id * 7919) % 360, -30 FROM tracks"
        " WHERE track_id > 1"
    )
    raw.execute("UPDATE tracks SET cap_x = -cap_x WHERE track_id > 1 AND track_id % 100")
    raw.commit()
    raw.close()
    with Catalog(tmp_path) as catalog:
        for selection in (
            Selection(snr=(95, INF)),
            Selection(from_ns=EVENING_NS + 10**9, to_ns=EVENING_NS + 3 * 10**9),
            Selection(cone=Cone(0, 10, 1)),
        ):
            start_s = time.process_time()  # of this process: the machine may be busy
            tracks = catalog.query(selection, sort="flux", descending=True)
            assert time.process_time() - start_s < 1
            assert 0 < len(tracks) < 5000


class TestCommand:
    def test_table(self, out: Path):
        lines = succeeds("catalog", out).output.splitlines()
        assert len(lines) == 6
        assert lines[0].split()[:3] == ["first", "seen,", "UTC"]
        assert lines[1].split() == [
            *("2026-03-01T20:00:02", "1", "11", "20.0", "-9.25", "5", "70.91"),
            *("359.9000", "+10.0000", "first.bag"),
        ]
        (unknown,) = (line for line in lines if " 6.0 " in line)
        assert unknown.split()[-5:] == ["-", "-", "-", "-", "first.bag"]
        few = succeeds("catalog", out, "--limit", "2", "--sort", "snr").output.splitlines()
        assert [line.split()[3] for line in few[1:3]] == ["30.0", "20.0"]
        assert few[3] == "2 of 5 tracks: --limit, --csv or --json show more"

    def test_csv_and_json_are_the_same(self, out: Path):
        where = ("--cone", "0", "10", "0.5")
        (row,) = csv.DictReader(io.StringIO(succeeds("catalog", out, *where, "--csv").output))
        (told,) = json.loads(succeeds("catalog", out, *where, "--json").output)
        assert list(row) == list(told)
        assert row == {name: f"{value}" for name, value in told.items()}
        (nowhere,) = json.loads(succeeds("catalog", out, "--snr", "6..6", "--json").output)
        assert nowhere["first_ra_deg"] is None

    @pytest.mark.parametrize(
        ("options", "ids"),
        [
            (("--from", "2026-03-01T21:00:00Z"), [1, 7]),
            (("--to", "2026-03-01T20:30:00Z", "--snr", "..8"), [2, 3]),
            (("--night", "2026-03-01", "--px-s", "5.."), [1, 1, 7]),
            (("--magnitude", "-20..-12"), [7]),
            (("--arcsec-s", "20000..", "--recording", "second"), [7]),
        ],
    )
    def test_options(self, out: Path, options: tuple[str, ...], ids: list[int]):
        told = json.loads(succeeds("catalog", out, *options, "--json").output)
        assert sorted(row["track_id"] for row in told) == ids

    def test_nothing_says_why(self, out: Path):
        done = ofsat("catalog", out, "--cone", "200", "0", "1", "--snr", "25..")
        assert (done.exit_code, done.stdout) == (0, "")
        assert " ".join(done.stderr.split()) == (
            "none of 5 tracks is so; each condition alone: 0 within 1 deg about 200 0, 1 with snr"
            " from 25; directions are known of 4 (no attitude)"
        )
        with Catalog(out / "empty", write=True):
            pass
        assert "holds 0 results, and no track" in ofsat("catalog", out / "empty").stderr

    def test_folders_of_process_are_taken_in(self, tmp_path: Path):
        archived(tmp_path / "a" / "one", [SOUTH])
        inside = archived(tmp_path / "a" / "one" / "unfinished", [SOUTH])
        archived(tmp_path / "b" / "two", [FAST])
        (tmp_path / "b" / "bad").mkdir()
        (tmp_path / "b" / "bad" / "run.json").write_text("{")
        place = tmp_path / "new.sqlite"
        done = ofsat("catalog", place, "--add", tmp_path / "a", "--add", tmp_path / "b")
        assert done.exit_code == 1
        assert done.stdout == "2 results are taken in, 0 were there, 1 are left out\n"
        assert "run.json is damaged" in done.stderr
        assert len(found(place)) == 2
        assert inside.is_dir()
        done = succeeds("catalog", place, "--add", tmp_path / "a")
        assert done.stdout == "0 results are taken in, 1 were there, 0 are left out\n"
        none = tmp_path / "none"
        none.mkdir()
        done = ofsat("catalog", place, "--add", none)
        assert done.exit_code == 1
        assert "there is no run.json in" in done.stderr

    def test_the_result_that_was_made_last_counts(self, tmp_path: Path):
        made = {"z": "2026-01-01", "a": "2026-05-05", "m": "2026-03-03"}
        for name, day in made.items():
            archived(tmp_path / name, [SOUTH], recording="/same", started_utc=f"{day}T00:00:00Z")
        succeeds("catalog", tmp_path, "--add", tmp_path)
        with Catalog(tmp_path) as catalog:
            assert [one.folder.name for one in catalog.results()] == ["a"]

    def test_prune_and_longitude(self, out: Path):
        shutil.rmtree(out / "results" / "first")
        assert "1 results are forgotten" in succeeds("catalog", out, "--prune").output
        assert (
            "by the noon of longitude -150" in succeeds("catalog", out, "--longitude", -150).output
        )
        done = succeeds("catalog", out, "--night", "2026-02-28", "--json")  # to 22:00 UTC
        assert len(json.loads(done.output)) == 2

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            (("--snr", "5"), "'5' is no range: give it as 5..20, 5.. or ..20"),
            (("--snr", "9..5"), "is no range"),
            (("--snr", "nan.."), "is no range"),
            (("--cone", "0", "91", "1"), "the middle of a cone is RA and DEC in degrees"),
            (("--cone", "0", "0", "-1"), "a cone's radius is 0 to 180 degrees, not -1"),
            (("--night", "today"), "a night is the date of its evening, as 2026-03-01, not"),
            (("--sort", "id"), "is not one of"),
        ],
    )
    def test_bad_usage(self, out: Path, options: tuple[str, ...], says: str):
        assert says in fails(2, "catalog", out, *options)

    def test_a_reader_who_has_seen_enough_is_no_error(self, out: Path):
        with subprocess_ofsat("catalog", out, "--csv") as process:
            process.stdout.close()  # before anything is written
            assert process.stderr.read() == ""

    def test_what_cannot_be_used(self, tmp_path: Path):
        assert "there is no catalogue at" in fails(1, "catalog", tmp_path)
