# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The files that ``ofsat process`` makes: tables, bag, run, report, video; and what stays."""

import csv
import errno
import html
import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result
from command import fails, invoke, ofsat
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.parameters import CameraParameters, Parameters, TrackingDataParameters
from ofsat_ros.recordings import Bag, BagWriter, open_recording
from ofsat_ros.results import read_run
from ofsat_ros.results.messages import detections_array, tracks_array
from ofsat_ros.simulation import scenario

WIDTH, HEIGHT, FRAMES = 160, 120, 8
FRAME_ID = "camera_optical_frame"
IMAGE, INFO, ATTITUDE = "/camera/image_raw", "/camera/camera_info", "/camera/attitude"


def write_bag(path: Path, attitudes: bool = True) -> Path:
    camera = Camera.ideal(WIDTH, HEIGHT, np.radians(5 / 3600))
    with BagWriter(path) as bag:
        for frame in scenario("survey", 1, frames=FRAMES, width=WIDTH, height=HEIGHT):
            stamp_ns = frame.stamp_ns
            bag.write_camera_info(INFO, camera, stamp_ns, FRAME_ID)
            for at_ns in (stamp_ns, stamp_ns + 300_000_000) if attitudes else ():
                bag.write_attitude(ATTITUDE, Rotation.from_euler("x", 0.3), at_ns, FRAME_ID)
            bag.write_image(IMAGE, frame.image, stamp_ns, FRAME_ID)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp("bags") / "bag")


def process(bag: Path, output: Path, *options: object) -> tuple[Result, list[dict]]:
    done = ofsat("process", bag, "-o", output, *options)
    assert done.exit_code == 0, done.output
    with (output / "detections.csv").open(encoding="utf-8") as file:
        return done, list(csv.DictReader(file))


def test_results_of_an_earlier_run_neither_get_lost_nor_stay_beside_new_ones(bag, tmp_path):
    (tmp_path / "tracks.tdm").write_text("precious")
    command = ("process", bag, "-o", tmp_path, "--tdm", "kvn", "--bag")
    assert "already holds tracks.tdm; choose another folder, or --force" in fails(1, *command)
    assert (tmp_path / "tracks.tdm").read_text() == "precious"
    assert ofsat(*command, "--force").exit_code == 0
    assert (tmp_path / "tracks.tdm").read_text().startswith("CCSDS_TDM_VERS")
    files = ("detections.csv", "tracks.csv", "star_field.csv", "run.json", "tracks.tdm", "results")
    assert {path.name for path in tmp_path.iterdir()} == set(files)
    (tmp_path / "report.html").write_text("of an earlier run")
    said = fails(1, *command)
    assert all(name in said for name in (*files, "report.html"))
    # Without tracking data, none of another run's stays beside the new results; nor the rest.
    assert ofsat(*command[:4], "--force").exit_code == 0
    assert {path.name for path in tmp_path.iterdir()} == set(files[:4])


def test_what_is_no_bag_is_never_removed(bag, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/thesis.tex").write_text("years of work")
    assert ofsat("process", bag, "-o", tmp_path, "--force").exit_code == 0
    said = fails(1, "process", bag, "-o", tmp_path, "--force", "--bag")
    assert "results is not replaced, since it is no bag: remove it yourself" in said
    assert (tmp_path / "results/thesis.tex").read_text() == "years of work"


def test_the_bag_of_results_plays_beside_the_recording(bag, tmp_path):
    """Its stamps are the images', also where these are not the middles of the exposures."""
    done, rows = process(bag, tmp_path, "--bag", "--stamp-offset-s", 0.2)
    assert "star_field.csv and results/ are in" in " ".join(done.stdout.split())
    with open_recording(bag) as recording:
        stamps = [frame.stamp_ns for frame in recording]
    written: dict[str, list] = {}
    with Bag(tmp_path / "results") as results:
        for topic, msgtype, at_ns, data in results.messages(list(results.topics)):
            written.setdefault(topic, []).append((at_ns, results.deserialize(data, msgtype)))
    assert {topic: [at_ns for at_ns, _ in kept] for topic, kept in written.items()} == (
        dict.fromkeys(
            ("/rso_detections", "/rso_tracks", "/star_field_motion", "/flow_markers"), stamps
        )
    )
    for topic, kept in written.items():
        headers = [m.markers[0].header if "markers" in topic else m.header for _, m in kept]
        assert {header.frame_id for header in headers} == {FRAME_ID}
        assert [h.stamp.sec * 10**9 + h.stamp.nanosec for h in headers] == stamps

    # What it says is what the files say, directions too.
    for frame, (_, cloud) in enumerate(written["/rso_detections"]):
        found = detections_array(cloud)
        said = [row for row in rows if int(row["frame"]) == frame]
        for name, scale in [("x", 1), ("vy", 1), ("track_id", 1), ("ra", 180 / math.pi)]:
            column = {"x": "x_px", "vy": "vy_px_s", "ra": "ra_deg"}.get(name, name)
            expected = [float(row[column]) for row in said]
            assert found[name].astype(float) * scale == pytest.approx(expected, rel=1e-8)
    last = tracks_array(written["/rso_tracks"][-1][1])
    assert len(last)
    assert np.isfinite(last["dec"]).all()


def test_the_bag_says_live_what_the_node_would(bag, tmp_path):
    _, rows = process(bag, tmp_path, "--bag", "--live")
    with Bag(tmp_path / "results") as results:
        clouds = [
            results.deserialize(data, msgtype)
            for _, msgtype, _, data in results.messages(["/rso_detections"])
        ]
    counts = [sum(int(row["frame"]) == frame for row in rows) for frame in range(FRAMES)]
    assert [cloud.width for cloud in clouds] == counts
    assert counts[0] == 0 < counts[-1]


def test_a_run_says_what_was_made_of_what_and_how(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(bag.parent)
    options = ("--preset", "paper_opencv", "--threshold-sigmas", 3, "--station", "X")
    done, rows = process(Path(bag.name), tmp_path, *options, "--json", "--tdm", "kvn", "--bag")
    run = read_run(tmp_path)
    assert json.loads(done.stdout) == run
    assert run["parameters"] == {
        **Parameters.preset("paper_opencv", threshold_sigmas=3.0).as_dict(),
        **CameraParameters().as_dict(),
        **TrackingDataParameters(station="X").as_dict(),
    }
    stamps = sorted({int(row["stamp_ns"]) for row in rows})
    assert (run["preset"], run["live"], run["stopped"]) == ("paper_opencv", False, False)
    assert (run["frames"], run["left_out"]) == (FRAMES, 0)
    assert (run["width"], run["height"]) == (WIDTH, HEIGHT)
    assert run["first_stamp_ns"] <= stamps[0] < stamps[-1] <= run["last_stamp_ns"]
    assert run["last_stamp_ns"] - run["first_stamp_ns"] == (FRAMES - 1) * 10**9
    assert run["detections"] + run["candidates"] == len(rows)
    made = {path.name for path in tmp_path.iterdir()} - {"run.json"}
    assert {name.rstrip("/") for name in run["files"]} == made
    assert 0 < sum(run["profile"].values()) - run["profile"]["reading, meanwhile"] < run["seconds"]
    # With what it says, the same frames are opened again, from anywhere.
    monkeypatch.chdir(tmp_path)
    names = ("topic", "camera_info_topic", "attitude_topic", "fps", "exposure_s")
    with open_recording(run["recording"], **{name: run[name] for name in names}) as recording:
        assert recording.path == bag
        assert (recording.topic, recording.camera_info_topic) == (IMAGE, INFO)
        assert len(list(recording)) == FRAMES


def test_a_run_says_what_the_user_was_told(tmp_path):
    write_bag(tmp_path / "bag", attitudes=False)
    done, rows = process(tmp_path / "bag", tmp_path / "out", "--tdm", "kvn")
    run = read_run(tmp_path / "out")
    assert run["unlocated"] == {"no attitude has come": len(rows)}
    assert [f"note: {problem}" for problem in run["problems"]] == done.stderr.splitlines()
    assert len(run["problems"]) == 2
    assert run["attitude_topic"] is None


def test_a_full_disk_is_told_in_words_and_a_video_needs_no_report(bag, tmp_path, monkeypatch):
    def refuse(folder: Path, say: object) -> Path:
        raise OSError(errno.ENOSPC, "No space left on device")

    def write_video(folder: Path, path: Path) -> Path:
        path.write_text("a film")
        return path

    monkeypatch.setattr("ofsat_ros.cli.process.write_report", refuse)
    monkeypatch.setattr("ofsat_ros.cli.process.write_video", write_video)
    film = tmp_path / "film.mp4"
    words = ("process", bag, "-o", tmp_path / "out", "--video", film)
    done = invoke(*words)
    assert done.exit_code == 0
    assert done.stderr == "note: no report is written: No space left on device\n"
    assert film.exists()


@pytest.mark.parametrize("error", [ModuleNotFoundError, OSError])
def test_a_report_that_cannot_be_made_costs_nothing_but_itself(error, bag, tmp_path, monkeypatch):
    def refuse(folder: Path, say: object) -> Path:
        assert read_run(folder)["frames"] == FRAMES
        raise error("the extra ofsat_ros[report] is missing")

    monkeypatch.setattr("ofsat_ros.cli.process.write_report", refuse)
    said = "the extra ofsat_ros[report] is missing"
    command = ("process", bag, "-o", tmp_path)
    # As nobody has said a word of it; the tests' own default is none.
    done = invoke(*command)
    assert (done.exit_code, done.stderr) == (0, f"note: no report is written: {said}\n")
    assert fails(1, *command, "--force", "--report") == f"ofsat: {said}"
    assert "report.html" not in read_run(tmp_path)["files"]
    assert ofsat(*command, "--force", "--no-report").stderr == ""


def test_report_and_video_are_made_of_the_results(bag, tmp_path, monkeypatch):
    def write_report(folder: Path, say: object) -> Path:
        assert (folder / "tracks.csv").read_text().count("\n") > 1  # whole
        (folder / "report.html").write_text("a page")
        return folder / "report.html"

    def write_video(folder: Path, path: Path) -> Path:
        path.write_text(f"a film of {folder}")
        return path

    monkeypatch.setattr("ofsat_ros.cli.process.write_report", write_report)
    monkeypatch.setattr("ofsat_ros.cli.process.write_video", write_video)
    film = tmp_path / "film.mp4"
    command = ("process", bag, "-o", tmp_path / "out", "--report", "--video", film)
    done = ofsat(*command)
    words = " ".join(done.stdout.split())
    assert f"star_field.csv and report.html are in {tmp_path}/out, the video is {film}" in words
    assert film.read_text() == f"a film of {tmp_path / 'out'}"
    assert read_run(tmp_path / "out")["files"][-2:] == ["report.html", f"{film}"]
    for path in (tmp_path / "out").iterdir():
        path.unlink()
    said = fails(1, *command)
    assert said == f"ofsat: {film} exists: choose another name, or --force to replace it"
    said = fails(2, *command[:-1], tmp_path / "film.avi")
    assert "film.avi ends neither in .mp4 nor in .gif" in said
    assert ofsat(*command, "--force").exit_code == 0


def test_a_stop_in_the_report_leaves_the_results_whole(bag, tmp_path, monkeypatch):
    def stopped(folder: Path, say: object) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr("ofsat_ros.cli.process.write_report", stopped)
    done = ofsat("process", bag, "-o", tmp_path, "--report")
    assert (done.exit_code, done.stdout) == (130, "")
    said = " ".join(done.stderr.split())
    assert f"in {tmp_path}; `ofsat report {tmp_path}` makes a page of it" in said
    assert "so far" not in said
    run = read_run(tmp_path)
    assert (run["stopped"], run["frames"]) == (False, FRAMES)


def test_several_files_and_their_begin_are_in_the_run_and_on_the_page(bag, tmp_path):
    with open_recording(bag) as recording:
        for frame in recording:
            cv2.imwrite(f"{tmp_path}/frame{frame.number}.png", frame.image)
    files = [tmp_path / f"frame{number}.png" for number in range(FRAMES)]
    times = ("--fps", 1, "--start", "2026-01-01T02:00+01:00")
    done = ofsat("process", *reversed(files), "-o", tmp_path / "found", *times, "--report")
    assert done.exit_code == 0, done.output
    run = read_run(tmp_path / "found")
    start_ns = 1_767_229_200_000_000_000
    assert run["recording"] == [f"{file}" for file in reversed(files)]
    assert (run["fps"], run["start_ns"], run["first_stamp_ns"]) == (1, start_ns, start_ns)
    page = html.unescape((tmp_path / "found" / "report.html").read_text(encoding="utf-8"))
    command = re.search(r"ofsat (process .*?)</code>", page)[1].split()
    assert command[1 : FRAMES + 1] == run["recording"]
    assert command[-4:] == ["--fps", "1.0", "--start", "2026-01-01T01:00:00Z"]
    assert "No pictures" not in page
    folder, found = tmp_path / "found", tmp_path / "again"
    assert ofsat("process", tmp_path, "-o", found, *times).exit_code == 0
    rows = [np.genfromtxt(f / "star_field.csv", delimiter=",")[1:, :2] for f in (folder, found)]
    np.testing.assert_array_equal(*rows)
