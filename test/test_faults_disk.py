# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Runs that are killed, and disks that are full: what was there stays, what is whole is read."""

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from command import environment, fails, succeeds
from recorded import ENDING, FRAME_ID, TOPIC, noise, scene, simple_bag, stamp_of, write_bag

from ofsat_ros.cli.process import UNFINISHED
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.recordings import Bag, BagWriter, RecordingError, check_bag, hold, open_recording
from ofsat_ros.recordings.held import temporary_folder
from ofsat_ros.report import write_video
from ofsat_ros.results import DETECTION_COLUMNS, STAR_FIELD_COLUMNS, read_run
from ofsat_ros.tracking_data import remove_parts

TABLES = {"detections.csv": DETECTION_COLUMNS, "star_field.csv": STAR_FIELD_COLUMNS}
FRAMES, KILLS = 8, 8

# Takes jobs, a line each.  Runs a command once to its end, and then again and again, each time in
# a copy of this process, that has imported all, and kills it after a random part of its time.
_KILLER = """
import json, os, random, signal, sys, time
import cv2
from ofsat_ros.cli import main

cv2.setNumThreads(1)  # threads are not copied with the process

def start(words):
    if not (child := os.fork()):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        try:
            main(words)
        finally:
            os._exit(0)
    return child

for job in sys.stdin:
    seed, kills, folder, words = json.loads(job)
    chance = random.Random(seed)
    out = lambda name: [word.replace("OUT", f"{folder}/{name}") for word in words]
    main(out("whole"), standalone_mode=False)
    begin_s = time.monotonic()
    os.waitpid(start(out("timed")), 0)
    takes_s = time.monotonic() - begin_s
    for number in range(kills):
        child = start(out(number))
        time.sleep(chance.uniform(0, 1.05 * takes_s))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    print("done", flush=True)
"""

Kill = Callable[..., None]


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("bags") / "sky"
    options = ("--scenario", "survey", "--frames", FRAMES, "--size", 160, 120)
    succeeds("simulate", "-o", bag, *options)
    return bag


@pytest.fixture(scope="module")
def kill() -> Iterator[Kill]:
    """Kill a command at random moments, its output being OUT; and run it once to its end."""
    with subprocess.Popen(
        [sys.executable, "-c", _KILLER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment(),
    ) as killer:
        assert killer.stdin is not None
        assert killer.stdout is not None

        def kill(folder: Path, *words: object, kills: int = KILLS, seed: int = 1) -> None:
            job = [seed, kills, f"{folder}", [f"{word}" for word in words]]
            print(json.dumps(job), file=killer.stdin, flush=True)
            assert "done\n" in iter(killer.stdout.readline, "")

        yield kill
        killer.stdin.close()


def contents(folder: Path, made_now: bool = False) -> dict[str, bytes]:
    """All files; made now, they need not be the same in what depends on time."""
    return {
        f"{path.relative_to(folder)}": b""
        if made_now and path.suffix in (".json", ".mcap")
        else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def count_of(bag: Path) -> int:
    """How many messages can be read of a bag, whatever became of its writer."""
    try:
        with Bag(bag) as opened:
            return len(list(opened.messages(list(opened.topics))))
    except RecordingError:  # it was killed before it wrote any
        return 0


def assert_tables_are_readable(folder: Path) -> None:
    for name, columns in TABLES.items():
        lines = (folder / name).read_text().splitlines() if (folder / name).exists() else []
        # Only the last line may be cut.
        assert {line.count(",") for line in lines[1:-1]} <= {len(columns) - 1}


def test_process_that_is_killed_leaves_what_can_be_read_and_can_be_run_again(sky, kill, tmp_path):
    command = ("process", sky, "--bag", "--no-report")
    kill(tmp_path, *command, "-o", "OUT")
    whole = contents(tmp_path / "whole", made_now=True)
    half = 0
    for number in range(KILLS):
        output = tmp_path / f"{number}"
        if output.exists() and contents(output, made_now=True) == whole:
            continue
        if (work := output / UNFINISHED).exists():
            half += 1
            assert_tables_are_readable(work)
            if (work / "results").exists():
                count_of(work / "results")
        # Nothing that looks like results, and so no --force is needed.
        assert [path.name for path in output.glob("*")] in ([], [UNFINISHED])
        if half < 3:
            succeeds(*command, "-o", output)
            assert contents(output, made_now=True) == whole
            assert count_of(output / "results") == 4 * FRAMES
    assert half


def test_process_that_is_killed_leaves_the_earlier_results(sky, kill, tmp_path):
    earlier = tmp_path / "earlier"
    succeeds("process", sky, "-o", earlier, "--preset", "paper_opencv")
    before = contents(earlier)
    for number in range(KILLS):
        shutil.copytree(earlier, tmp_path / f"{number}")
    kill(tmp_path, "process", sky, "-o", "OUT", "--no-report", "--force", seed=2)
    whole = contents(tmp_path / "whole", made_now=True)
    for number in range(KILLS):
        shutil.rmtree(tmp_path / f"{number}" / UNFINISHED, ignore_errors=True)
        found = tmp_path / f"{number}"
        assert contents(found) == before or contents(found, made_now=True) == whole


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_import_that_is_killed_leaves_what_can_be_read_and_can_be_run_again(
    storage, sky, kill, tmp_path
):
    command = ("import", sky, "--storage", storage)
    kill(tmp_path, *command, "-o", "OUT", kills=KILLS // 2)
    count = count_of(tmp_path / "whole")
    assert count == 3 * FRAMES
    for number in range(KILLS // 2):
        output, made = tmp_path / f"{number}", tmp_path / f"{number}.unfinished"
        assert not output.exists() or count_of(output) == count
        if not output.exists():
            assert count_of(made / f"{number}") <= count
            succeeds(*command, "-o", output)
            assert count_of(output) == count
            assert not made.exists()
        # It may have been killed when the bag was in its place, and the folder not yet removed.
        assert not any(path.is_file() for path in made.rglob("*"))


@contextmanager
def files_of_at_most(size: int):
    """As a disk that is full once a file has so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("room", [0, 10, 1500, 6000])
def test_a_full_disk_costs_process_nothing_that_was_there(sky, tmp_path, room):
    output = tmp_path / "out"
    succeeds("process", sky, "-o", output, "--preset", "paper_opencv", "--bag")
    before = contents(output)
    with files_of_at_most(room):
        said = fails(1, "process", sky, "-o", output, "--bag", "--force")
    assert said.startswith("ofsat: ")
    assert ": File too large" in said
    assert "No such file" not in said
    if "so far" in said:
        assert said.endswith(
            f"so far, in {output}/unfinished; the earlier results are as they were"
        )
        assert_tables_are_readable(output / UNFINISHED)
    found = contents(output)
    assert {name: found[name] for name in found if UNFINISHED not in name} == before
    # With room, the same command makes all anew, and clears away what was left.
    succeeds("process", sky, "-o", output, "--force")
    assert sorted(path.name for path in output.iterdir()) == sorted(
        ["detections.csv", "tracks.csv", "star_field.csv", "run.json"]
    )


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_full_disk_costs_import_nothing_that_was_there(sky, tmp_path, storage):
    output = tmp_path / "bag"
    simple_bag(output)
    command = ("import", sky, "-o", output, "--storage", storage)
    with files_of_at_most(200_000):
        said = fails(1, *command, "--force")
    full = "File too large|disk I/O error|database or disk is full"
    assert any(f"bag.unfinished/bag: {words}" in said for words in full.split("|")), said
    assert said.endswith(f"in {output}.unfinished/bag, and the earlier bag is as it was")
    assert count_of(output) == 3
    count_of(tmp_path / "bag.unfinished" / "bag")
    succeeds(*command, "--force")
    assert count_of(output) == 3 * FRAMES
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag"]


def test_a_disk_without_any_room_begins_no_bag(sky, tmp_path):
    with files_of_at_most(0):
        said = fails(1, "import", sky, "-o", tmp_path / "bag", "--storage", "sqlite3")
    assert said.startswith(f"ofsat: cannot write {tmp_path}/bag.unfinished/bag: ")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_under_a_video_is_said_with_its_name(sky, tmp_path):
    succeeds("process", sky, "-o", tmp_path / "out")
    video = tmp_path / "night.mp4"
    video.write_text("earlier")
    with files_of_at_most(2000), pytest.raises(OSError, match="File too large") as error:
        write_video(tmp_path / "out", video)
    assert error.value.filename == f"{video}"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["night.mp4", "out"]
    assert video.read_text() == "earlier"


def test_ctrl_c_replaces_nothing(sky, tmp_path, monkeypatch):
    succeeds("process", sky, "-o", tmp_path / "out")
    simple_bag(tmp_path / "bag")
    before = contents(tmp_path)
    usual, count = Pipeline.process, iter(range(FRAMES))

    def process(*arguments):
        if next(count) == 5:
            raise KeyboardInterrupt
        return usual(*arguments)

    monkeypatch.setattr(Pipeline, "process", process)
    said = fails(130, "process", sky, "-o", tmp_path / "out", "--force")
    assert "so far" in said
    assert f"in {tmp_path}/out/unfinished; the earlier results are as they were" in said
    assert read_run(tmp_path / "out" / UNFINISHED)["frames"] == 5
    succeeds("report", tmp_path / "out" / UNFINISHED)
    found = contents(tmp_path)
    assert {name: found[name] for name in before} == before


def test_two_runs_do_not_write_into_the_same_place(sky, tmp_path):
    for place, command in (
        (tmp_path / "out" / UNFINISHED, ("process", sky, "-o", tmp_path / "out")),
        (tmp_path / "bag.unfinished", ("import", sky, "-o", tmp_path / "bag")),
    ):
        place.mkdir(parents=True)
        with hold(place):
            said = fails(1, *command)
        assert f"another run is writing into {place}: wait for its end, or" in said
        (place / "thesis.tex").write_text("years of work")
        said = fails(1, *command)
        assert f"{place} holds thesis.tex, which was not made here: move it away" in said
        assert (place / "thesis.tex").read_text() == "years of work"


def test_a_recording_is_not_replaced_by_its_results(sky, tmp_path):
    shutil.copytree(sky, tmp_path / "results")
    for words in ((), ("--bag",)):
        said = fails(1, "process", tmp_path / "results", "-o", tmp_path, "--force", *words)
        assert f"{tmp_path}/results is read, so it cannot be the output" in said
    film = tmp_path / "night.mp4"
    film.write_bytes(b"of last night")
    said = fails(1, "process", film, "-o", tmp_path / "out", "--video", film, "--force")
    assert film.read_bytes() == b"of last night"
    assert count_of(tmp_path / "results") == 3 * FRAMES


def test_output_in_the_recordings_folder_is_not_read_as_a_part_of_it(sky, tmp_path):
    shutil.copytree(sky, tmp_path / "night")
    for words in ((), ("--force",)):
        succeeds("process", tmp_path / "night", "-o", tmp_path / "night", "--bag", *words)
        assert read_run(tmp_path / "night")["frames"] == FRAMES


@pytest.mark.parametrize("storage", ENDING)
def test_what_a_writer_has_flushed_can_be_read_while_it_goes_on(tmp_path, monkeypatch, storage):
    monkeypatch.setattr("ofsat_ros.recordings.bag_writer._FLUSH_EVERY_S", 0.0)
    with BagWriter(tmp_path / "bag", storage=storage) as bag:
        for number in range(1, 6):
            bag.write_image(TOPIC, scene(number), stamp_of(number), FRAME_ID)
            # As if its process had been killed now.
            shutil.copytree(tmp_path / "bag", tmp_path / f"{number}")
            with open_recording(tmp_path / f"{number}") as recording:
                images = [frame.image for frame in recording]
            assert len(images) == number
            np.testing.assert_array_equal(images[-1], scene(number))
    with Bag(tmp_path / "bag") as whole:
        assert whole.topics[TOPIC].count == 5
        assert whole.problems == []


@pytest.mark.parametrize("storage", ENDING)
def test_a_recording_that_grows_gives_what_was_there(tmp_path, monkeypatch, storage):
    monkeypatch.setattr("ofsat_ros.recordings.bag_writer._FLUSH_EVERY_S", 0.0)
    with BagWriter(tmp_path / "bag", storage=storage) as bag:
        for number in range(40):
            bag.write_image(TOPIC, noise(number), stamp_of(number), FRAME_ID)
        with open_recording(tmp_path / "bag") as recording:
            frames = iter(recording)
            images = [next(frames).image]
            for number in range(40, 80):
                bag.write_image(TOPIC, noise(number), stamp_of(number), FRAME_ID)
            images += [frame.image for frame in frames]
    assert len(images) >= 40
    for number, image in enumerate(images):
        np.testing.assert_array_equal(image, noise(number))


@pytest.mark.parametrize("storage", ENDING)
def test_a_bag_that_was_not_finished_is_a_bag_and_others_folders_are_not(tmp_path, storage):
    path = tmp_path / "bag"
    file = write_bag(path, range(3), storage=storage)
    (path / "metadata.yaml").unlink()
    file.with_name(f"{file.name}-journal").write_bytes(b"")
    assert len(check_bag(path)) == 2
    path.rename(tmp_path / "cherished")
    with pytest.raises(RecordingError, match="cherished is not replaced, since it is no bag"):
        check_bag(tmp_path / "cherished")


def test_what_a_killed_process_has_unpacked_does_not_stay_for_ever(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", f"{tmp_path}")
    script = (
        "import os, signal, sys\nfrom ofsat_ros.recordings import open_recording\n"
        "with open_recording(sys.argv[1]):\n    os.kill(os.getpid(), signal.SIGKILL)"
    )
    file = write_bag(tmp_path / "bag", range(3), compression="file")
    done = subprocess.run(
        [sys.executable, "-c", script, file], env={**environment(), "TMPDIR": f"{tmp_path}"}
    )
    assert done.returncode == -9
    (left,) = tmp_path.glob(".ofsat_unpacked_*")
    with temporary_folder() as mine:
        assert not left.exists()
        with temporary_folder() as other:
            assert mine.exists()
            assert mine != other
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


def test_a_disk_that_is_full_of_what_is_unpacked_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", f"{tmp_path}")
    file = write_bag(tmp_path / "bag", range(30), compression="file")
    with (
        files_of_at_most(20_000),
        pytest.raises(RecordingError, match=r"no room in .* to unpack it: set TMPDIR to a folder"),
    ):
        open_recording(file)
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


def test_a_killed_writer_of_tracking_data_leaves_whole_files_and_nothing_for_ever(tmp_path):
    script = """
import sys
from pathlib import Path
import numpy as np
from ofsat_ros.parameters import TrackingDataParameters
from ofsat_ros.tracking_data import TrackArcs
DTYPE = [("track_id", "u4"), ("ra", "f8"), ("dec", "f8")]
arcs = TrackArcs(TrackingDataParameters(), ["kvn"])
for i in range(500):
    arcs.add(1_767_225_600_000_000_000 + i * 10**8, np.array([(1, 1 + i * 1e-5, 0.5)], DTYPE))
print("ready", flush=True)
for number in range(10**6):
    arcs.write(Path(sys.argv[1], f"{number}.tdm"), "kvn")
"""
    rng = np.random.default_rng(5)
    for number in range(4):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        writer = subprocess.Popen(
            [sys.executable, "-c", script, folder], env=environment(), stdout=subprocess.PIPE
        )
        with writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"ready\n"
            with pytest.raises(subprocess.TimeoutExpired):
                writer.wait(timeout=rng.uniform(0.05, 0.2))
            writer.kill()
        for file in folder.glob("*.tdm"):
            assert file.read_text().count("\nANGLE_1 = ") == 500
            assert file.read_text().endswith("DATA_STOP\n")
        parts = list(folder.glob(".*"))
        assert len(parts) <= 1
        remove_parts(folder)
        assert list(folder.glob(".*")) == parts, "it may be another writer's"
        for part in parts:
            os.utime(part, (0, 0))
        remove_parts(folder)
        assert list(folder.glob(".*")) == []


def test_a_folder_that_is_removed_is_an_error_in_words(sky, tmp_path, monkeypatch):
    usual = Pipeline.process

    def process(*arguments):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        return usual(*arguments)

    monkeypatch.setattr(Pipeline, "process", process)
    said = fails(1, "process", sky, "-o", tmp_path / "out")
    assert said == f"ofsat: {tmp_path}/out/unfinished/run.json: No such file or directory"
