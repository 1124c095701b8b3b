# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Many recordings by ``ofsat batch``: which, once each, whatever dies meanwhile, as by one run."""

import csv
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import warnings
from pathlib import Path

import psutil
import pytest
from command import environment, fails, ofsat, succeeds

from ofsat_ros.batch import (
    Found,
    Order,
    Outcome,
    Place,
    Settings,
    content_key,
    find_recordings,
    tasks,
)
from ofsat_ros.batch.content import stamp
from ofsat_ros.catalog import Catalog, CatalogError
from ofsat_ros.cli.batch import _Screen as Screen
from ofsat_ros.recordings import BagWriter, RecordingError
from ofsat_ros.simulation import scenario

PATIENCE_S = 240.0
FRAMES, SEGMENT = 56, 28
# With so short a memory, so short segments suffice.
SHORT = ("--history-frames", 5, "--coast-frames", 2)
IMAGE = "/camera/image_raw"
# A worker loads this first: it dies at the third frame of some recordings, of others the first
# time only; and tells what it has begun.
PRELOAD = """
import os, pathlib, signal
from ofsat_ros.processing import Job
run = Job.run

def dies(self, folder, say, watch, run=run):
    path = pathlib.Path(self.paths[0])
    marker = path.parent / "it has killed"
    if self.segment:
        with open(path.with_name("begun"), "a") as begun:
            print(f"{self.segment.first}-{self.segment.end}", file=begun)

    def deadly(done, count):
        watch(done, count)
        if done == 3 and (path.name == "always" or (path.name == "once" and not marker.exists())):
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    return run(self, folder, say, deadly)

if run.__name__ == "run":  # it may be loaded twice
    Job.run = dies
"""


def write_bag(path: Path, seed: int = 1, frames: int = 8) -> Path:
    with BagWriter(path) as bag:
        for frame in scenario("survey", seed, frames=frames, width=96, height=80):
            bag.write_image(IMAGE, frame.image, frame.stamp_ns, "optical_frame")
    return path


def rows(folder: Path, name: str = "detections.csv") -> list[list[str]]:
    with (folder / name).open(encoding="utf-8") as file:
        return list(csv.reader(file))


def told(out: Path) -> dict[str, dict]:
    """What batch.json says, by the recordings' names."""
    about = json.loads((out / "batch.json").read_text(encoding="utf-8"))
    return {Path(each["recording"]).name: each for each in about["recordings"]}


# --- Which recordings


def test_recordings_are_found_in_all_folders(tmp_path):
    bag = write_bag(tmp_path / "night1" / "bag")
    (tmp_path / "night1" / "sky").mkdir()
    for name in ("a.fits", "b.fits", "preview.png", "beside.ser"):
        (tmp_path / "night1" / "sky" / name).touch()
    for name in ("iss.ser", "moon.ser", "notes.txt", ".hidden.ser"):
        (tmp_path / name).touch()
    (tmp_path / ".trash").mkdir()
    (tmp_path / ".trash" / "old.ser").touch()
    (tmp_path / "again").symlink_to(tmp_path / "night1")
    (tmp_path / "night1" / "round").symlink_to(tmp_path)
    loose = tmp_path / "loose"
    loose.mkdir()
    for name in ("one.mcap", "two.mcap"):
        shutil.copy(bag / "bag.mcap", loose / name)
    # Results, and what a batch writes into, hold no recordings.
    for name, sign in (("found", "run.json"), ("other", "batch.json")):
        (tmp_path / name).mkdir()
        (tmp_path / name / sign).touch()
        (tmp_path / name / "film.mp4").touch()
    (tmp_path / "out" / "results").mkdir(parents=True)
    (tmp_path / "out" / "results" / "x.ser").touch()

    found = find_recordings([tmp_path, tmp_path / "iss.ser"], besides=tmp_path / "out")
    assert {(f.path.resolve().relative_to(tmp_path).as_posix(), f.kind) for f in found} == {
        ("night1/bag", "bag"),
        ("night1/sky", "FITS"),
        ("night1/sky/beside.ser", "SER"),
        ("iss.ser", "SER"),
        ("moon.ser", "SER"),
        ("loose/one.mcap", "bag"),
        ("loose/two.mcap", "bag"),
    }
    assert len(found) == 7
    (sky,) = (each for each in found if each.kind == "FITS")
    assert [file.name for file in sky.files] == ["a.fits", "b.fits"]
    assert find_recordings([bag], besides=tmp_path)[0].name == "bag"
    # Workers may be in another folder.
    relative = Path(os.path.relpath(bag / "bag.mcap"))
    assert find_recordings([relative], besides=tmp_path)[0].path.is_absolute()
    with pytest.raises(RecordingError, match=r"nowhere does not exist: check the path"):
        find_recordings([tmp_path / "nowhere"], besides=tmp_path / "out")


def test_content_counts_and_neither_names_nor_times(tmp_path):
    def files(folder: str, **contents: str) -> list[Path]:
        (tmp_path / folder).mkdir()
        for name, text in contents.items():
            (tmp_path / folder / name).write_text(text)
        return sorted((tmp_path / folder).iterdir())

    first = files("first", a="12", b="3")
    key, at = content_key(first), stamp(first)
    assert content_key(files("moved", x="12", y="3")) == key
    assert content_key(files("cut_elsewhere", a="1", b="23")) != key
    assert content_key(files("other_order", a="3", b="12")) != key
    os.utime(first[0], (0, 0))
    assert content_key(first) == key
    assert stamp(first) != at


def test_each_kind_gets_the_options_that_it_has_a_use_for():
    source = dict(topic="t", camera_info_topic="c", attitude_topic="a", fps=2, exposure_s=1)
    settings = Settings({**source, "start_ns": 5}, "robust", {}, (), False, False, 0)
    kept = {
        kind: set(settings.job(Found(Path("x"), kind)).source) for kind in ("bag", "FITS", "video")
    }
    assert kept == {
        "bag": {"topic", "camera_info_topic", "attitude_topic", "exposure_s"},
        "FITS": {"topic", "fps", "exposure_s", "start_ns"},
        "video": {"fps", "exposure_s", "start_ns"},
    }


def test_a_folder_is_one_batchs_at_a_time_and_no_others(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").touch()
    with pytest.raises(RecordingError, match="holds files that no batch has made"):
        Place(tmp_path / "thesis")
    with Place(tmp_path / "out") as place:
        (tmp_path / "out" / "unfinished" / "of the dead").mkdir(parents=True)
        order = Order(f"{tmp_path / 'out'}", place.run, 1, None)
        assert tasks.probe(order) == ""
        with pytest.raises(RecordingError, match="another batch is writing into"):
            Place(tmp_path / "out")
        assert (tmp_path / "out" / "unfinished" / "of the dead").exists()
    # Workers of a batch that has ended end, too.
    with pytest.raises(tasks.StoppedError):
        order.check_running()
    with Place(tmp_path / "out"):
        assert not (tmp_path / "out" / "unfinished").exists()
        assert "is another folder: all machines have to mount the same" in tasks.probe(order)


# --- The command


def start(tmp_path: Path, *arguments: object) -> subprocess.Popen:
    preload = tmp_path / "preload.py"
    preload.write_text(PRELOAD)
    return subprocess.Popen(
        [sys.executable, "-m", "ofsat_ros.cli", "batch", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        start_new_session=True,  # as a terminal has it
        env=environment() | {"DASK_DISTRIBUTED__WORKER__PRELOAD": f"{preload}"},
    )


def test_neither_bad_recordings_nor_dying_workers_stop_the_rest(tmp_path):
    """A bad one, one that kills its worker each time, one that does once, and a copy of it."""
    night = tmp_path / "night"
    for seed, name in enumerate(("good", "once", "always")):
        write_bag(night / name, seed)
    shutil.copytree(night / "once", night / "twice")
    (night / "bad.ser").write_text("no such thing")
    out = tmp_path / "out"
    batch = start(tmp_path, night, "-o", out, "--workers", 2, "--no-report")
    summary, said = batch.communicate(timeout=PATIENCE_S)
    assert batch.returncode == 3, said
    assert summary.startswith("5 of 5 recordings: 2 done, 1 skipped, done before, 2 failed")
    always, bad = sorted(said.splitlines()[-2:])
    assert always.startswith(f"failed: {night}/always: its worker died 3 times")
    assert bad == f"failed: {night}/bad.ser is no SER file, or cut within its header"
    assert "Traceback" not in said
    states = {name: about["state"] for name, about in told(out).items()}
    assert [states[name] for name in ("good", "always", "bad.ser")] == ["done", *["failed"] * 2]
    assert {states["once"], states["twice"]} == {"done", "skipped"}
    assert (night / "it has killed").exists()
    for name in ("good", "once"):
        succeeds("process", night / name, "-o", tmp_path / name)
        assert rows(out / told(out)[name]["folder"]) == rows(tmp_path / name)
    with sqlite3.connect(out / "catalog.sqlite") as catalog:
        assert catalog.execute("SELECT count(*) FROM results").fetchone() == (2,)
    catalog.close()
    assert f"{night}/always" in (out / "report.html").read_text(encoding="utf-8")
    assert not (out / "unfinished").exists()


def test_a_batch_that_is_ended_goes_on_where_it_was(tmp_path):
    """In segments, of which none that is done is done twice; the result is that of one run."""
    write_bag(tmp_path / "night" / "long", frames=FRAMES)
    out = tmp_path / "out"
    words = ("night", "-o", out, "--workers", 2, "--segment-frames", SEGMENT, *SHORT)
    batch = start(tmp_path, *words)
    wait_for(lambda: list(out.glob("unfinished/*")), batch)
    os.killpg(batch.pid, signal.SIGINT)  # Ctrl-C, which the workers hear, too
    summary, said = batch.communicate(timeout=PATIENCE_S)
    assert (batch.returncode, summary) == (130, "")
    assert said == "stopped; 0 of 1 recordings: 0 done; run the same command again to go on\n"
    assert json.loads((out / "batch.json").read_text())["stopped"]

    batch = start(tmp_path, *words)
    family = psutil.Process(batch.pid)
    wait_for(lambda: list(out.glob("segments/*/*-*")), batch)
    workers = family.children(recursive=True)
    ports = [each for one in (family, *workers) for each in one.net_connections("inet")]
    assert ports
    assert {each.laddr.ip for each in ports} == {"127.0.0.1"}
    batch.kill()
    batch.communicate()
    assert psutil.wait_procs(workers, timeout=PATIENCE_S)[1] == []
    done = {segment.name for segment in out.glob("segments/*/*-*")}
    assert done
    begun = tmp_path / "night" / "begun"
    begun.write_text("")

    summary, said = start(tmp_path, *words).communicate(timeout=PATIENCE_S)
    assert not done & set(begun.read_text().split())
    assert summary.startswith("1 of 1 recordings: 1 done; "), said
    assert not any((out / "segments").iterdir())
    (found,) = (out / "results").iterdir()
    succeeds("process", tmp_path / "night" / "long", "-o", tmp_path / "whole", *SHORT)
    for name in ("detections.csv", "tracks.csv", "star_field.csv"):
        assert rows(found, name) == rows(tmp_path / "whole", name)


def test_work_goes_on_while_the_catalogue_is_locked(tmp_path, monkeypatch, capsys):
    asked = []

    def add(folder):
        asked.append(folder)
        if len(asked) == 1:
            raise CatalogError("is being written by another process")

    with Catalog(tmp_path, write=True) as catalog:
        monkeypatch.setattr(catalog, "add", add)
        with Screen(catalog, tmp_path, 2, report=True) as screen:
            screen.finished(Outcome("one", "done", folder="results/one"))
            screen.finished(Outcome("two", "skipped", folder="results/two"))
            assert f"{screen}" == "2 of 2 recordings: 1 done, 1 skipped, done before"
            screen.catch_up()
    assert [folder.name for folder in asked] == ["one", "two", "one"]
    # Neither has a page, which was asked for.
    said = capsys.readouterr().err
    assert f"note: {tmp_path}/results/two was done before, without a page: `ofsat report" in said


def wait_for(condition, batch: subprocess.Popen) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert batch.poll() is None, batch.communicate()[1]
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


@pytest.fixture
def scheduler():
    """The address of a cluster that is somebody else's; its worker is in this process."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp://",
        host="127.0.0.1",
        dashboard_address=":0",
    ) as cluster:
        yield cluster.scheduler_address


def test_work_is_done_once_on_a_cluster_of_others(tmp_path, scheduler, monkeypatch):
    night, out = tmp_path / "night", tmp_path / "night" / "out"
    write_bag(night / "first")
    words = ("batch", night, "-o", out, "--scheduler", scheduler, "--no-report")
    monkeypatch.setattr(tasks, "__version__", "0.0.9")
    said = fails(1, *words)
    assert "not all workers are fit for this: " in said
    assert ": it has ofsat_ros 0.0.9, not " in said
    monkeypatch.undo()

    assert succeeds(*words).stdout.startswith("1 of 1 recordings: 1 done; ")
    (first,) = out.glob("results/first-*/run.json")
    made = first.stat().st_mtime_ns
    run = json.loads(first.read_text())
    assert first.parent.name == f"first-{run['key'][:8]}"
    # Moved, it is the same; a second one is new, and so is the same with another parameter.
    (night / "first").rename(night / "moved")
    write_bag(night / "second", seed=2)
    done = succeeds(*words)
    assert done.stdout.startswith(
        "2 of 2 recordings: 1 done, 1 skipped, done before; results, catalog.sqlite,"
        f" report.html, nights and batch.json are in {out}"
    )
    assert told(out)["moved"]["folder"] == f"results/{first.parent.name}"
    assert first.stat().st_mtime_ns == made
    done = succeeds(*words, "--threshold-sigmas", 6)
    assert done.stdout.startswith("2 of 2 recordings: 2 done; ")
    assert first.stat().st_mtime_ns == made
    assert len(list((out / "results").iterdir())) == 4


def test_what_is_wrong_is_said_before_anything_is_begun(tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    words = ("batch", tmp_path / "empty", "-o", tmp_path / "out")
    assert "there is no recording in" in fails(1, *words)
    (tmp_path / "empty" / "x.ser").touch()
    said = fails(2, *words, "--threshold-sigmas", -1)
    assert "threshold_sigmas must be within" in said
    assert "--workers is for this machine" in fails(2, *words, "--workers", 1, "--scheduler", "x")
    monkeypatch.setattr("importlib.util.find_spec", {"distributed": "there"}.get)
    said = fails(1, *words)
    assert "batch needs cryptography: pip install 'ofsat_ros[cluster]'" in said


def test_nobody_answers(tmp_path, monkeypatch):
    from ofsat_ros.batch import cluster

    monkeypatch.setattr(cluster, "_CONNECT_S", 0.3)
    (tmp_path / "x.ser").touch()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        done = ofsat("batch", tmp_path, "-o", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9")
    assert done.exit_code == 1
    assert "no scheduler answers at tcp://127.0.0.1:9" in done.stderr
