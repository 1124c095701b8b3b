# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The ``ofsat`` command: files, words, exit codes, and what it finds in simulated recordings."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from command import fails, subprocess_ofsat, succeeds

import ofsat_ros
from ofsat_ros import evaluation
from ofsat_ros.parameters import Parameters, preset_names
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.recordings import IMAGE, Bag, BagWriter, open_recording
from ofsat_ros.results import DETECTION_COLUMNS, STAR_FIELD_COLUMNS, read_run
from ofsat_ros.simulation import SCENARIOS, TRUTH_DTYPE, scenario

TOPIC = "/camera/image_raw"
START = 1_767_225_600_000_000_000


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def truth_of(bag: Path) -> np.ndarray:
    rows = csv.reader(Path(f"{bag}.truth.csv").read_text(encoding="ascii").splitlines()[1:])
    return np.array([tuple(row) for row in rows], TRUTH_DTYPE)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames of `survey`, 160 x 128 px."""
    bag = tmp_path_factory.mktemp("bags") / "small"
    size = ("--size", 160, 128)
    succeeds("simulate", "-o", bag, "--scenario", "survey", "--frames", 6, *size)
    return bag


# Simulate


@pytest.mark.parametrize("name", SCENARIOS)
def test_simulate_makes_the_scenario_and_its_truth(name: str, tmp_path: Path):
    bag = tmp_path / "bag"
    options = ("--seed", 3, "--frames", 3, "--size", 96, 64, "--bit-depth", 12)
    done = succeeds("simulate", "-o", bag, "--scenario", name, *options)
    expected = list(scenario(name, 3, frames=3, width=96, height=64, bit_depth=12))
    with open_recording(bag) as recording:
        frames = list(recording)
        assert (recording.topic, recording.problems) == (TOPIC, [])
    for frame, wanted in zip(frames, expected, strict=True):
        assert np.array_equal(frame.image, wanted.image)
        assert (frame.stamp_ns, frame.frame_id) == (wanted.stamp_ns, "camera_optical_frame")
    truth = truth_of(bag)
    wanted_truth = np.concatenate([frame.truth for frame in expected])
    for column in ("stamp_ns", "frame", "id"):
        assert np.array_equal(truth[column], wanted_truth[column])
    np.testing.assert_allclose(truth["x_px"], wanted_truth["x_px"], atol=1e-4)
    words = f"3 frames on {TOPIC} are in {bag}, their truth in {bag}.truth.csv\n"
    assert (done.stdout, done.stderr) == (words, "")


def test_simulate_takes_eight_bits_sqlite_and_png(tmp_path: Path):
    bag = tmp_path / "bag"
    options = ("--bit-depth", 8, "--storage", "sqlite3", "--compressed")
    succeeds("simulate", "-o", bag, "--frames", 2, "--size", 64, 48, *options)
    assert [path.suffix for path in sorted(bag.iterdir())] == [".db3", ".yaml"]
    with open_recording(bag) as recording:
        assert recording.topics == {f"{TOPIC}/compressed": 2}
        images = [frame.image for frame in recording]
    wanted = scenario("sidereal", 1, frames=2, width=64, height=48, bit_depth=8)
    for image, frame in zip(images, wanted, strict=True):
        assert image.dtype == np.uint8
        assert np.array_equal(image, frame.image)


def test_simulate_does_not_replace_a_bag_unless_told(tmp_path: Path):
    bag = tmp_path / "bag"
    command = ("simulate", "-o", bag, "--frames", 1, "--size", 32, 32)
    succeeds(*command)
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    assert f"ofsat: {bag} exists" in fails(1, *command, "--seed", 2)
    assert before == {path.name: path.read_bytes() for path in bag.iterdir()}
    succeeds(*command, "--seed", 2, "--force")
    assert before != {path.name: path.read_bytes() for path in bag.iterdir()}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--size", 8, 64), "width must be an integer within 16 to 16384, not 8"),
        (("--frames", 0), "frames must be an integer within 1 to 1e+07, not 0"),
        (("--seed", -1), "seed must be an integer within 0 to 2.14748e+09, not -1"),
        (("--bit-depth", 17), "17 is not in the range 8<=x<=16"),
        (
            ("--scenario", "leo"),
            "'leo' is not one of 'geo', 'sidereal', 'survey', 'empty', 'fast'",
        ),
        (("--storage", "ros1"), "'ros1' is not one of 'mcap', 'sqlite3'"),
    ],
)
def test_simulate_refuses_what_it_cannot_do(options: tuple, message: str, tmp_path: Path):
    assert message in fails(2, "simulate", "-o", tmp_path / "bag", *options)
    assert not list(tmp_path.iterdir())


def test_simulate_in_the_current_folder_is_refused_in_words(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "ofsat: . exists" in fails(1, "simulate", "-o", ".", "--frames", 1)


# Process: files and words


def run_pipeline(bag: Path, parameters: Parameters | None = None) -> tuple[list, list]:
    """What the pipeline says at each frame of a bag, and at last."""
    pipeline = Pipeline(parameters)
    with open_recording(bag) as recording:
        results = [pipeline.process(frame.image, frame.stamp_ns) for frame in recording]
    settled = [last for result in results for last in result.settled] + pipeline.finish()
    return results, settled


def test_process_writes_the_pipelines_last_word(small: Path, tmp_path: Path):
    done = succeeds("process", small, "-o", tmp_path / "new" / "results")
    results, settled = run_pipeline(small)
    rows = read(tmp_path / "new/results/detections.csv")
    found = [(last, row) for last in settled for row in last.detections]
    assert len(rows) == len(found) > sum(len(result.detections) for result in results) > 10
    for row, (last, detection) in zip(rows, found, strict=True):
        assert tuple(row) == DETECTION_COLUMNS
        assert (int(row["stamp_ns"]), int(row["frame"])) == (last.stamp_ns, last.frame)
        assert (int(row["track_id"]), row["confirmed"]) == (detection["track_id"], "1")
        assert float(row["x_px"]) == pytest.approx(detection["x"], rel=1e-8)
        assert float(row["rel_vy_px_s"]) == pytest.approx(detection["rel_vy"], rel=1e-8)
    tracks = read(tmp_path / "new/results/tracks.csv")
    assert [int(track["track_id"]) for track in tracks] == sorted(
        {int(r["track_id"]) for r in rows}
    )
    assert sum(int(track["detections"]) for track in tracks) == len(rows)
    rows = read(tmp_path / "new/results/star_field.csv")
    assert tuple(rows[0]) == STAR_FIELD_COLUMNS
    assert [int(row["frame"]) for row in rows] == list(range(6))
    assert rows[0]["note"] == "first frame"
    for row, result in zip(rows[1:], results[1:], strict=True):
        assert float(row["dx_px"]) == pytest.approx(result.star_field.displacement[0], rel=1e-8)
    assert done.stdout == (
        f"{len(found)} RSO detections of {len(tracks)} tracks in 6 frames;"
        f" detections.csv, tracks.csv and star_field.csv are in {tmp_path}/new/results\n"
    )
    assert done.stderr == ""


def test_process_live_writes_what_the_node_would_say(small: Path, tmp_path: Path):
    succeeds("process", small, "-o", tmp_path, "--live")
    results, _ = run_pipeline(small)
    rows = read(tmp_path / "detections.csv")
    said = [(result.frame, row) for result in results for row in result.detections]
    assert [(int(r["frame"]), int(r["track_id"])) for r in rows] == [
        (frame, row["track_id"]) for frame, row in said
    ]
    assert min(int(row["frame"]) for row in rows) == 2  # three frames make a track


def test_process_says_where_the_time_went(small: Path, tmp_path: Path):
    done = succeeds("process", small, "-o", tmp_path, "--profile")
    summary, head, *lines = done.stdout.splitlines()
    assert summary.endswith(f"star_field.csv are in {tmp_path}")
    assert head.split() == ["stage", "ms", "per", "frame", "share"]
    table = {line[:26].strip(): line[26:].split() for line in lines}
    stages = {name.replace("_", " ") for name in run_pipeline(small)[0][-1].seconds}
    around = {"waiting for frames", "other", "writing", "the last frames' last word"}
    assert list(table)[-2:] == ["all", "reading, meanwhile"]
    assert table.keys() == stages | around | {"all", "reading, meanwhile"}
    parts = [float(table[name][0]) for name in stages | around]
    assert sum(parts) == pytest.approx(float(table["all"][0]), abs=0.1)  # each to 0.005
    assert table["all"][1] == "100.0%"
    assert float(table["reading, meanwhile"][0]) > 0


# Evaluate


def test_evaluate_compares_the_results_with_truth(small: Path, tmp_path: Path):
    succeeds("process", small, "-o", tmp_path)
    truth = f"{small}.truth.csv"
    done = succeeds("evaluate", tmp_path, truth, "--json")
    told = json.loads(done.stdout)
    direct = evaluation.evaluate(
        evaluation.read_truth(truth), evaluation.read_detections(tmp_path), frames=6
    )
    assert told == json.loads(json.dumps(direct.as_dict()))
    assert direct.recall(20) > 0.9
    table = succeeds("evaluate", tmp_path, truth).stdout
    assert table == f"{direct}\n"


def test_evaluate_lists_what_was_missed(small: Path, tmp_path: Path):
    succeeds("process", small, "-o", tmp_path, "--spot-sigmas", 100, "--threshold-sigmas", 100)
    done = succeeds("evaluate", tmp_path, f"{small}.truth.csv", "--list")
    assert done.stdout.count("missed") > 10


def test_evaluate_says_what_it_cannot_read(small: Path, tmp_path: Path):
    assert "detections.csv" in fails(1, "evaluate", tmp_path, f"{small}.truth.csv")


def test_process_takes_a_bare_file_and_a_topic(small: Path, tmp_path: Path):
    succeeds("process", small / "small.mcap", "-o", tmp_path / "a", "--topic", TOPIC)
    succeeds("process", small, "-o", tmp_path / "b")
    for name in ("detections.csv", "tracks.csv", "star_field.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize("preset", preset_names())
def test_process_takes_a_preset_and_changes(preset: str, small: Path, tmp_path: Path):
    succeeds("process", small, "-o", tmp_path, "--preset", preset, "--threshold-sigmas", "6")
    pipeline = Pipeline(Parameters.preset(preset, threshold_sigmas=6))
    with open_recording(small) as recording:
        expected = [pipeline.process(frame.image, frame.stamp_ns) for frame in recording]
    rows = read(tmp_path / "star_field.csv")
    assert [int(r["detections"]) for r in rows] == [len(r.detections) for r in expected]
    assert [int(r["objects"]) for r in rows] == [len(r.objects) for r in expected]


def test_process_has_an_option_for_every_parameter():
    done = succeeds("process", "--help-all")
    words = " ".join(done.stdout.split())
    for about in Parameters.describe():
        assert f"--{about.name.replace('_', '-')} " in words
        allowed = f"{about.allowed} {about.unit}".strip()
        assert f"[{about.stage}; {allowed}; default {about.default}]" in words


@pytest.mark.parametrize("about", [*Parameters.describe()], ids=lambda about: about.name)
def test_every_option_reaches_its_parameter(about, small: Path, tmp_path: Path, monkeypatch):
    given = []
    monkeypatch.setattr(
        "ofsat_ros.processing.job.Pipeline", lambda p: given.append(p) or Pipeline(p)
    )
    value = about.choices[-1] if about.choices else about.high
    if about.name == "dense_iterations":
        value = 2  # 20 rounds are not needed to see that it arrives
    option = f"--{about.name.replace('_', '-')}"
    succeeds("process", small, "-o", tmp_path, option, value)
    assert given == [Parameters().replace(**{about.name: value})]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--window-px", 200), "Error: window_px must be within 3 to 101 px, not 200"),
        (("--rso-sigmas", "nan"), "Error: rso_sigmas must be within 0.5 to 100, not nan"),
        (("--window-px", "wide"), "'wide' is not a valid integer"),
        (("--engine", "fast"), "'fast' is not one of 'sparse', 'dense'"),
        (("--preset", "best"), "'best' is not one of 'robust', 'paper_matlab', 'paper_opencv'"),
        (("--windw-px", 9), "No such option"),
    ],
)
def test_bad_options_are_bad_usage(options: tuple, message: str, small: Path, tmp_path: Path):
    output = tmp_path / "results"
    assert message in fails(2, "process", small, "-o", output, *options)
    assert not output.exists()


def test_an_output_is_asked_for(small: Path):
    assert "Missing option '-o' / '--output'" in fails(2, "process", small)


def test_a_recording_that_is_not_there(tmp_path: Path):
    output = tmp_path / "results"
    said = fails(1, "process", tmp_path / "absent", "-o", output)
    assert said == f"ofsat: {tmp_path}/absent does not exist: check the path"
    assert not output.exists()


def test_a_topic_that_is_not_there(small: Path, tmp_path: Path):
    said = fails(1, "process", small, "-o", tmp_path / "results", "--topic", "/other")
    listing = f"image topics are {TOPIC} (6)"
    assert said == f"ofsat: {small}: topic /other is not there; {listing}"
    assert not (tmp_path / "results").exists()


def test_results_are_not_replaced_unless_told(small: Path, tmp_path: Path):
    succeeds("process", small, "-o", tmp_path, "--preset", "paper_opencv")
    before = (tmp_path / "detections.csv").read_bytes()
    said = fails(1, "process", small, "-o", tmp_path)
    assert f"ofsat: {tmp_path} already holds detections.csv, tracks.csv, star_field.csv" in said
    assert "--force" in said
    assert (tmp_path / "detections.csv").read_bytes() == before
    succeeds("process", small, "-o", tmp_path, "--force")
    assert (tmp_path / "detections.csv").read_bytes() != before


def test_other_files_in_the_output_stay(small: Path, tmp_path: Path):
    (tmp_path / "notes.txt").write_text("mine")
    succeeds("process", small, "-o", tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_an_output_that_is_a_file(small: Path, tmp_path: Path):
    (tmp_path / "file").write_text("")
    assert "is a file" in fails(2, "process", small, "-o", tmp_path / "file")
    said = fails(1, "process", small, "-o", tmp_path / "file" / "results")
    assert said == f"ofsat: {tmp_path}/file/results: Not a directory"


def test_an_output_that_cannot_be_made(small: Path):
    # Where nobody may make a folder, root neither.
    said = fails(1, "process", small, "-o", "/proc/ofsat_results")
    assert said == "ofsat: /proc/ofsat_results: No such file or directory"


def test_a_file_that_cannot_be_written(small: Path, tmp_path: Path):
    (tmp_path / "star_field.csv").mkdir()
    said = fails(1, "process", small, "-o", tmp_path, "--force")
    assert said.startswith(
        f"ofsat: {tmp_path}/star_field.csv is not replaced, since it is a folder"
    )


def test_a_disk_that_is_full_ends_with_a_reason(small: Path, tmp_path: Path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ofsat_ros.results.ResultWriter.add_star_field", full)
    said = fails(1, "process", small, "-o", tmp_path / "results")
    assert said == "ofsat: No space left on device"


# Process: recordings with faults


def write(path: Path, images: list[np.ndarray | bytes]) -> None:
    """A bag of one frame a second; bytes are a message that is damaged."""
    with BagWriter(path) as bag:
        for i, image in enumerate(images):
            stamp_ns = START + i * 1_000_000_000
            if isinstance(image, bytes):
                bag.write(TOPIC, IMAGE, image, stamp_ns)
            else:
                bag.write_image(TOPIC, image, stamp_ns, "optical")


def moving(count: int, size: int = 128) -> list[np.ndarray]:
    settings = {"width": size, "height": size, "frames": count, "star_count": 60}
    return [frame.image for frame in scenario("survey", 4, **settings)]


def test_a_frame_that_cannot_be_decoded_is_skipped_and_said(tmp_path: Path):
    images = moving(7)
    write(tmp_path / "bag", [*images[:3], b"\0\1\0\0" + b"\7" * 60, *images[4:]])
    done = succeeds("process", tmp_path / "bag", "-o", tmp_path / "out")
    assert "note: frame 3 of /camera/image_raw skipped: the message is damaged" in done.stderr
    assert "in 6 frames (1 more could not be processed)" in done.stdout
    rows = read(tmp_path / "out/star_field.csv")
    # Numbers are the recording's, as in its truth, and time goes on across the hole.
    assert [int(row["frame"]) for row in rows] == [0, 1, 2, 4, 5, 6]
    assert [int(row["stamp_ns"]) for row in rows] == [
        START + int(row["frame"]) * 1_000_000_000 for row in rows
    ]
    assert [row["dt_s"] for row in rows] == ["nan", "1", "1", "2", "1", "1"]
    assert {int(row["frame"]) for row in read(tmp_path / "out/detections.csv")} == {
        0,
        1,
        2,
        4,
        5,
        6,
    }


def test_a_frame_that_cannot_be_processed_is_left_out_and_said(tmp_path: Path):
    images = moving(5)
    images[1] = images[3] = images[1][:12]
    write(tmp_path / "bag", images)
    done = succeeds("process", tmp_path / "bag", "-o", tmp_path / "out")
    said = "note: frame 1 is left out, and others like it: an image of shape (12, 128) cannot be"
    assert said in " ".join(done.stderr.split())
    assert done.stderr.count("left out") == 1
    assert "in 3 frames (2 more could not be processed)" in done.stdout
    assert [row["frame"] for row in read(tmp_path / "out/star_field.csv")] == ["0", "2", "4"]


def test_a_fresh_start_is_said(tmp_path: Path):
    images = moving(6)
    images[3:] = [image[:100] for image in images[3:]]
    write(tmp_path / "bag", images)
    done = succeeds("process", tmp_path / "bag", "-o", tmp_path / "out")
    said = "the image's size changed from 128x128 to 128x100"
    assert done.stderr == f"note: frame 3 starts afresh: {said}\n"
    notes = [row["note"] for row in read(tmp_path / "out/star_field.csv")]
    assert (notes[0], notes[3]) == ("first frame", said)


def test_a_recording_without_a_usable_frame_is_an_error(tmp_path: Path):
    write(tmp_path / "bag", [np.zeros((8, 8), np.uint16)] * 3)
    said = fails(1, "process", tmp_path / "bag", "-o", tmp_path / "out")
    assert said.endswith(f"ofsat: no frame of {tmp_path}/bag could be processed")


def test_an_empty_sky_says_why_nothing_is_found(tmp_path: Path):
    write(tmp_path / "bag", [np.zeros((64, 64), np.uint16)] * 3)
    done = succeeds("process", tmp_path / "bag", "-o", tmp_path / "out")
    assert "0 RSO detections in 3 frames; the last frame says: the image is empty" in done.stdout


# Process: what is found


def compare(bag: Path, output: Path, reach_px: float = 2.0) -> tuple[list[int], int]:
    """RSOs found in each frame but the first, and detections that are near no RSO."""
    truth, found = truth_of(bag), read(output / "detections.csv")
    counts, false = [], 0
    for frame in range(1, truth["frame"].max() + 1):
        now = truth[truth["frame"] == frame]
        rows = [row for row in found if int(row["frame"]) == frame]
        xy = np.array([(float(r["x_px"]), float(r["y_px"])) for r in rows]).reshape(-1, 2)
        distance = np.hypot(xy[:, :1] - now["x_px"], xy[:, 1:] - now["y_px"])
        counts.append(int(np.count_nonzero((distance < reach_px).any(axis=0))))
        false += int(np.count_nonzero((distance > 5).all(axis=1)))
        assert all(int(r["stamp_ns"]) == now["stamp_ns"][0] for r in rows)
    return counts, false


@pytest.fixture(scope="module")
def sidereal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("bags") / "sidereal"
    succeeds("simulate", "-o", bag, "--scenario", "sidereal", "--frames", 40, "--size", 256, 256)
    return bag


@pytest.mark.parametrize("engine", ["sparse", "dense"])
def test_the_crossing_rso_is_found(engine: str, sidereal: Path, tmp_path: Path):
    succeeds("process", sidereal, "-o", tmp_path, "--engine", engine)
    counts, false = compare(sidereal, tmp_path)
    assert len(counts) == 39
    # At the edge and where it passes a star it is one object with something else.
    assert sum(counts) >= 0.9 * 39
    assert false <= 2


def test_the_crossing_rsos_velocity_is_true(sidereal: Path, tmp_path: Path):
    succeeds("process", sidereal, "-o", tmp_path)
    truth = truth_of(sidereal)
    errors = [
        np.hypot(float(row["vx_px_s"]) - now["vx_px_s"], float(row["vy_px_s"]) - now["vy_px_s"])
        for row in read(tmp_path / "detections.csv")
        for now in truth[truth["frame"] == int(row["frame"])]
    ]
    # 3 px a frame of 1 s; a vector that is wrong by more than 0.5 px is a wrong one.
    assert np.median(errors) < 0.15
    assert np.mean(np.array(errors) < 0.5) > 0.85


def test_the_standing_rsos_are_found_among_streaks(tmp_path: Path):
    bag = tmp_path / "geo"
    succeeds("simulate", "-o", bag, "--scenario", "geo", "--frames", 20, "--size", 320, 320)
    succeeds("process", bag, "-o", tmp_path / "out")
    counts, false = compare(bag, tmp_path / "out")
    # A star's streak that runs over an RSO hides it for a frame or two.
    assert counts.count(5) > len(counts) / 2
    assert np.mean(counts) > 4.3
    assert false <= 0.3 * len(counts)
    rows = read(tmp_path / "out/star_field.csv")[1:]
    # 15.04 arcsec/s for 2.5 s at 5 arcsec per px
    speed = np.hypot(*([float(row[name]) for row in rows] for name in ("dx_px", "dy_px")))
    np.testing.assert_allclose(speed, 15.04 * 2.5 / 5, atol=0.15)


def test_an_empty_scenario_has_next_to_no_false_alarm(tmp_path: Path):
    bag = tmp_path / "empty"
    succeeds("simulate", "-o", bag, "--scenario", "empty", "--frames", 12, "--size", 320, 320)
    succeeds("process", bag, "-o", tmp_path / "out")
    assert len(read(tmp_path / "out/detections.csv")) <= 2


# As a program


def test_the_program_keeps_its_two_streams_apart(small: Path, tmp_path: Path):
    done = subprocess_ofsat("process", small, "-o", tmp_path / "out", "--no-report")
    out, err = done.communicate(timeout=60)
    assert done.returncode == 0, err
    assert re.fullmatch(r"\d+ RSO detections of \d+ tracks in 6 frames; .*\n", out)
    # No progress bar where nobody watches, and no warning.
    assert err == ""
    assert len(read(tmp_path / "out/star_field.csv")) == 6


def test_the_progress_bar_is_on_standard_error(small: Path, tmp_path: Path):
    """A terminal on standard error, a pipe on standard output."""
    master, slave = os.openpty()
    termios.tcsetwinsize(slave, (24, 100))
    command = [sys.executable, "-m", "ofsat_ros.cli", "process", small, "--no-report"]
    command += ["-o", tmp_path / "out"]
    environment = {**os.environ, "PYTHONPATH": str(Path(ofsat_ros.__file__).parent.parent)}
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=slave, env=environment, timeout=60, text=True
    )
    os.close(slave)
    shown = os.read(master, 65536).decode()
    os.close(master)
    assert done.returncode == 0
    assert re.fullmatch(r"\d+ RSO detections of \d+ tracks in 6 frames; .*\n", done.stdout)
    # Time taken, time left, rate.
    assert re.search(r"6/6 \[\d\d:\d\d<\d\d:\d\d, +[\d.]+ ?(frames/s|s/ frames)\]", shown)


def wait_for_lines(path: Path, count: int, program: subprocess.Popen) -> None:
    deadline = time.monotonic() + 60
    while not path.exists() or path.read_text(encoding="utf-8").count("\n") < count:
        assert program.poll() is None, program.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_an_interruption_leaves_whole_files(tmp_path: Path):
    # Hundreds of frames, of which few are done when the signal comes.
    image = moving(2, 512)
    write(tmp_path / "bag", [image[i % 2] for i in range(300)])
    program = subprocess_ofsat("process", tmp_path / "bag", "-o", tmp_path / "out", "--bag")
    wait_for_lines(tmp_path / "out/unfinished/star_field.csv", 4, program)
    program.send_signal(signal.SIGINT)
    out, err = program.communicate(timeout=60)
    assert program.returncode == 130, err
    assert out == ""
    assert "Traceback" not in err
    said = re.search(r"stopped; (\d+) RSO detections in (\d+) frames.* so far, in", err)
    rows = read(tmp_path / "out/star_field.csv")
    # The signal may come between a frame's line and its count.
    assert len(rows) - int(said[2]) in (0, 1)
    assert 3 <= len(rows) < 300
    for name, columns in (("star_field", STAR_FIELD_COLUMNS), ("detections", DETECTION_COLUMNS)):
        text = (tmp_path / f"out/{name}.csv").read_text()
        assert text.endswith("\n")
        lines = list(csv.reader(text.splitlines()))
        assert {len(line) for line in lines} == {len(columns)}
    run = read_run(tmp_path / "out")
    assert (run["stopped"], run["frames"]) == (True, int(said[2]))
    with Bag(tmp_path / "out/results") as bag:
        counts = [about.count for about in bag.topics.values()]
        assert len(list(bag.messages(list(bag.topics)))) == sum(counts)
        assert bag.problems == []
    # The signal may also come between two of a frame's messages.
    assert len(counts) == 4
    assert {len(rows) - count for count in counts} <= {0, 1}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interruption_that_python_drops_is_heard(number, tmp_path: Path, monkeypatch):
    class Last:
        def __del__(self):
            signal.raise_signal(number)  # nothing can be raised here

    usual, hook = Pipeline.process, sys.unraisablehook
    to_drop = [*range(3), Last()]

    def process(*arguments):
        del to_drop[:1]
        time.sleep(0.002)  # or all frames are done first
        return usual(*arguments)

    monkeypatch.setattr(Pipeline, "process", process)
    before = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP)}
    image = moving(2, 64)
    write(tmp_path / "bag", [image[i % 2] for i in range(300)])
    try:
        said = fails(130, "process", tmp_path / "bag", "-o", tmp_path / "out")
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    assert re.search(r"stopped; .* in \d+ frames?.* so far, in", said)
    assert 0 < read_run(tmp_path / "out")["frames"] < 300
    assert sys.unraisablehook is hook


def test_an_interruption_leaves_a_whole_bag(tmp_path: Path):
    bag = tmp_path / "bag"
    program = subprocess_ofsat("simulate", "-o", bag, "--frames", 5000, "--size", 256, 256)
    deadline = time.monotonic() + 60
    made = tmp_path / "bag.unfinished" / "bag"
    while sum(f.stat().st_size for f in made.glob("*.mcap")) < 3 * 256 * 256 * 2:
        assert program.poll() is None, program.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    program.send_signal(signal.SIGINT)
    out, err = program.communicate(timeout=60)
    assert program.returncode == 130, err
    assert (out, "Traceback" in err) == ("", False)
    count = int(re.search(r"stopped; (\d+) frames are in", err)[1])
    with open_recording(bag) as recording:
        frames = list(recording)
        assert recording.problems == []
    assert len(frames) - count in (0, 1)
    assert 3 <= count < 5000
    assert set(truth_of(bag)["frame"]) == set(range(count))


def test_version_and_help():
    assert succeeds("--version").stdout == f"ofsat, version {ofsat_ros.__version__}\n"
    words = succeeds("-h").stdout
    assert "process" in words
    assert "simulate" in words
