# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The recorder and the demo: the files say what was published."""

import csv
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import Vector3Stamped
from rclpy.serialization import deserialize_message
from ros_graph import START_S, Graph, Process, header, sky, write_bag
from sensor_msgs.msg import Image, PointCloud2, PointField
from visualization_msgs.msg import MarkerArray

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.nodes import demo, messages
from ofsat_ros.nodes.recorder import HEARING, Recorder
from ofsat_ros.nodes.runtime import StartError
from ofsat_ros.recordings import Bag
from ofsat_ros.tracking import TRACK_DTYPE

FRAMES = sky(6)
FOUND = [0, 2, 0, 0, 1, 0]  # detections per frame


def results(number: int) -> dict[str, object]:
    """Return what a detector publishes for a frame, with made-up detections."""
    head = header(FRAMES[number])
    random = np.random.default_rng(number)
    rows = messages.cloud_rows(FOUND[number])
    for name in ("u", "v", "u_rate", "v_rate", "rel_u_rate", "rel_v_rate", "snr", "angle"):
        rows[name] = random.uniform(-1.5, 1.5, len(rows))
    rows["id"], rows["status"] = 7, CONFIRMED
    tracks = np.zeros(number, TRACK_DTYPE)
    tracks["x"], tracks["track_id"], tracks["hits"] = 3.25, 7, number
    picture = np.full((20, 30, 3), (10 * number, 0, 250), np.uint8)
    return {
        "rso_detections": messages.cloud_message(head, rows),
        "rso_tracks": messages.tracks_cloud(head, tracks),
        "star_field_motion": messages.star_field_vector(head, None),
        "flow_markers": messages.no_flow_markers(head),
        "image_annotated": messages.image_message(head, picture),
    }


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "detections.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> tuple[Path, list[dict[str, object]]]:
    """Folder of a recorder that heard six frames, and what was published."""
    folder = tmp_path_factory.mktemp("recorder") / "output"
    kinds = [PointCloud2, PointCloud2, Vector3Stamped, MarkerArray, Image]
    published = [results(number) for number in range(len(FRAMES))]
    stop = threading.Event()
    arguments = ("-p", f"output:={folder}", "-p", "picture_every:=4", "-p", "frames:=6")
    with Graph(*arguments) as graph:
        graph.add(Recorder(stop, context=graph.context))
        publishers = {
            topic: graph.publisher(kind, topic)
            for topic, kind in zip(published[0], kinds, strict=True)
        }
        graph.connect(*publishers.values())
        for frame in published:
            for topic, message in frame.items():
                publishers[topic].publish(message)
                graph.serve_once()
        graph.until(stop.is_set)
    return folder, published


def test_detections_csv_holds_the_clouds(recorded):
    folder, published = recorded
    expected = [
        (FRAMES[number].stamp_ns, number, row)
        for number, frame in enumerate(published)
        for row in messages.cloud_array(frame["rso_detections"])
    ]
    found = rows_of(folder)
    assert len(found) == len(expected) == 3
    for line, (stamp_ns, frame, row) in zip(found, expected, strict=True):
        assert (int(line["stamp_ns"]), int(line["frame"])) == (stamp_ns, frame)
        assert (line["track_id"], line["confirmed"]) == ("7", "1")
        columns = {"x_px": "u", "vy_px_s": "v_rate", "rel_vx_px_s": "rel_u_rate", "snr": "snr"}
        for column, field in columns.items():
            assert float(line[column]) == pytest.approx(row[field], abs=1e-3)
        assert float(line["angle_deg"]) == pytest.approx(np.degrees(row["angle"]), abs=1e-3)
        assert line["ra_deg"] in ("", "nan")


def test_detections_csv_has_the_columns_of_the_design(recorded):
    names = (
        "stamp_ns,frame,track_id,confirmed,x_px,y_px,vx_px_s,vy_px_s,rel_vx_px_s,rel_vy_px_s,"
        "sigma_x_px,sigma_y_px,snr,flux,length_px,angle_deg,ra_deg,dec_deg"
    )
    assert (recorded[0] / "detections.csv").read_text().splitlines()[0] == names


def test_results_bag_holds_what_was_published(recorded):
    folder, published = recorded
    topics = ["/rso_detections", "/rso_tracks", "/star_field_motion", "/flow_markers"]
    with Bag(folder / "results") as bag:
        assert {name: about.count for name, about in bag.topics.items()} == dict.fromkeys(
            topics, 6
        )
        heard = list(bag.messages(topics))
    for topic in topics:
        times = [time_ns for name, _, time_ns, _ in heard if name == topic]
        assert times == [f.stamp_ns for f in FRAMES]
        sent = [frame[topic.strip("/")] for frame in published]
        kept = [
            deserialize_message(bytes(d), type(sent[0]))
            for name, _, _, d in heard
            if name == topic
        ]
        # By their text: NaN is not equal to itself.
        assert list(map(str, kept)) == list(map(str, sent))


def test_every_nth_picture_is_kept(recorded):
    folder, _ = recorded
    assert sorted(p.name for p in folder.glob("*.png")) == ["frame_000000.png", "frame_000004.png"]
    picture = cv2.imread(f"{folder / 'frame_000004.png'}")
    assert picture.shape == (20, 30, 3)
    assert (picture == (40, 0, 250)).all()


def test_results_are_replaced_only_when_asked_for(recorded):
    folder, _ = recorded
    before = rows_of(folder)
    with (
        Graph("-p", f"output:={folder}") as graph,
        pytest.raises(StartError, match=r"already holds results.*overwrite:=true"),
    ):
        Recorder(threading.Event(), context=graph.context)
    assert before
    assert rows_of(folder) == before


def test_without_a_name_the_folder_is_named_by_the_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Graph() as graph:
        graph.add(Recorder(threading.Event(), context=graph.context))
    (folder,) = tmp_path.iterdir()
    assert re.fullmatch(r"ofsat_\d{8}_\d{6}", folder.name)
    assert rows_of(folder) == []


def test_a_folder_of_results_is_used_again_but_no_other(recorded, tmp_path):
    folder, _ = recorded
    with Graph("-p", f"output:={folder}", "-p", "overwrite:=true") as graph:
        graph.add(Recorder(threading.Event(), context=graph.context))
        assert rows_of(folder) == []
        assert not list(folder.glob("*.png"))
    (tmp_path / "thesis.tex").write_text("years of work")
    with (
        Graph("-p", f"output:={tmp_path}") as graph,
        pytest.raises(StartError, match=r"thesis\.tex, which is not a recorder's"),
    ):
        Recorder(threading.Event(), context=graph.context)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_table_and_files_are_whole_after_a_signal(tmp_path):
    folder = tmp_path / "output"
    with (
        Process(tmp_path, "recorder", "--ros-args", "-p", f"output:={folder}") as recorder,
        Graph() as graph,
    ):
        clouds = graph.publisher(PointCloud2, "rso_detections")
        graph.connect(clouds)
        for number in range(5):
            clouds.publish(results(number)["rso_detections"])
        recorder.wait_for("frames 2 to 3: no RSO")
        recorder.popen.send_signal(signal.SIGINT)
        assert recorder.wait() == 0
    lines = [line for line in recorder.out.splitlines() if line != HEARING]
    first = next(i for i, line in enumerate(lines) if "time (UTC)" in line)
    assert "frame 0: no RSO" in lines[first + 1]
    assert [line.split()[2] for line in lines[first + 2 : first + 4]] == ["1", "1"]
    when = time.gmtime(FRAMES[1].stamp_ns // 10**9)
    assert lines[first + 2].startswith(time.strftime("%Y-%m-%d %H:%M:%S", when))
    assert "5 frames, 3 RSO detections of 1 track;" in lines[-1]
    assert len(rows_of(folder)) == 3
    with Bag(folder / "results") as bag:
        assert bag.topics["/rso_detections"].count == 5


def test_what_is_not_a_detectors_is_left_out(tmp_path):
    folder = tmp_path / "output"
    arguments = ("-p", f"output:={folder}", "-p", "picture_every:=1", "-p", "frames:=2")
    first, second = results(0), results(1)
    early = header(FRAMES[0])
    early.stamp.sec = -5
    field = PointField(name="x", datatype=PointField.FLOAT32, count=1)
    foreign = [
        ("rso_detections", PointCloud2(fields=[field], point_step=4, width=2, data=bytes(8))),
        ("rso_detections", messages.cloud_message(early, messages.cloud_rows(1))),
        ("rso_tracks", messages.tracks_cloud(early, np.zeros(1, TRACK_DTYPE))),
        ("star_field_motion", messages.star_field_vector(early, None)),
        ("flow_markers", MarkerArray()),
        ("image_annotated", messages.image_message(header(FRAMES[0]), FRAMES[0].image)),
        ("image_annotated", Image(header=header(FRAMES[0]), encoding="bgr8", width=9, height=9)),
    ]
    kinds = {topic: type(message) for topic, message in first.items()}
    stop = threading.Event()
    with Graph(*arguments) as graph:
        recorder = graph.add(Recorder(stop, context=graph.context))
        publishers = {topic: graph.publisher(kind, topic) for topic, kind in kinds.items()}
        graph.connect(*publishers.values())
        publishers["rso_detections"].publish(first["rso_detections"])
        for topic, message in [*foreign, *second.items()]:
            publishers[topic].publish(message)
            graph.serve_once()
        graph.until(stop.is_set)
        recorder.close()
        assert recorder.exit_code == 0
    assert [int(row["frame"]) for row in rows_of(folder)] == [1, 1]
    assert [p.name for p in folder.glob("*.png")] == ["frame_000001.png"]
    with Bag(folder / "results") as bag:
        counts = {name: about.count for name, about in bag.topics.items()}
    others = dict.fromkeys(("/rso_tracks", "/star_field_motion", "/flow_markers"), 1)
    assert counts == {"/rso_detections": 2, **others}


def test_pictures_that_come_at_once_are_all_kept(tmp_path):
    count = 12  # while one is written, others come; a detector's publisher keeps as many
    folder = tmp_path / "output"
    frames = sky(count)
    with Graph("-p", f"output:={folder}", "-p", "picture_every:=1") as graph:
        graph.add(Recorder(threading.Event(), context=graph.context))
        clouds = graph.publisher(PointCloud2, "rso_detections")
        pictures = graph.publisher(Image, "image_annotated")
        graph.connect(clouds, pictures)
        for frame in frames:
            clouds.publish(messages.cloud_message(header(frame), messages.cloud_rows(0)))
        picture = np.zeros((600, 800, 3), np.uint8)
        for frame in frames:
            pictures.publish(messages.image_message(header(frame), picture))
        graph.until(lambda: len(list(folder.glob("*.png"))) == count)


def test_a_full_disk_is_one_clear_line(tmp_path):
    folder = tmp_path / "output"
    with (
        Process(tmp_path, "recorder", "--ros-args", "-p", f"output:={folder}") as recorder,
        Graph() as graph,
    ):
        clouds = graph.publisher(PointCloud2, "rso_detections")
        graph.connect(clouds)
        clouds.publish(results(1)["rso_detections"])
        recorder.wait_for("time (UTC)")
        # Files that may not grow fail as on a full disk.
        limit = 16_384
        resource.prlimit(recorder.popen.pid, resource.RLIMIT_FSIZE, (limit, limit))
        for frame in FRAMES:
            rows = messages.cloud_rows(1000)
            clouds.publish(messages.cloud_message(header(frame), rows))
        assert recorder.wait() == 1
    said = [line for line in recorder.err.splitlines() if "[INFO]" not in line]
    assert len(said) == 1, recorder.err
    assert said[0].startswith(f"recorder: the recording in {folder} ends: ")
    assert "File too large" in said[0]
    assert len(rows_of(folder)) >= 2  # what was written stays


def test_demo_from_start_to_end(tmp_path):
    frames = sky(12)
    bag, output = write_bag(tmp_path / "bag", frames), tmp_path / "demo_output"
    given = ("--bag", f"{bag}", "--output", f"{output}", "--rate", "0")
    with Process(tmp_path, "demo", *given) as shown:
        assert shown.wait(60) == 0, shown.err
    said = re.search(
        r"12 frames played, 12 answered, (\d+) RSO detections of 1 track;",
        shown.out,
    )
    found = rows_of(output)
    assert len(found) == int(said[1]) >= 5
    assert all(row["confirmed"] == "1" for row in found)
    assert {int(row["stamp_ns"]) for row in found} <= {f.stamp_ns for f in frames}
    near = 0
    for row in found:
        frame = frames[int(row["frame"])]
        assert int(row["stamp_ns"]) == frame.stamp_ns
        if len(frame.truth):
            distance = np.hypot(
                float(row["x_px"]) - frame.truth["x_px"][0],
                float(row["y_px"]) - frame.truth["y_px"][0],
            )
            near += distance < 2
    assert near >= 5  # most of what is said is the one that is there
    assert (output / "frame_000010.png").exists()
    with Bag(output / "results") as results_bag:
        assert results_bag.topics["/flow_markers"].count == 12
        clouds = results_bag.messages(["/rso_tracks"])
        kept = [deserialize_message(bytes(data), PointCloud2) for *_, data in clouds]
    assert [cloud.header.stamp for cloud in kept] == [header(f).stamp for f in frames]
    assert {int(i) for cloud in kept for i in messages.tracks_array(cloud)["track_id"]} == {1}


def test_demo_leaves_no_process_behind(tmp_path):
    bag = write_bag(tmp_path / "bag", sky(12))
    given = ("--bag", f"{bag}", "--output", f"{tmp_path / 'output'}", "--rate", "0.1")
    with Process(tmp_path, "demo", *given) as shown:
        shown.wait_for("time (UTC)")
        children = Path(f"/proc/{shown.popen.pid}/task/{shown.popen.pid}/children").read_text()
        assert len(children.split()) == 3
        shown.popen.send_signal(signal.SIGINT)
        assert shown.wait(START_S) == 130
    assert not [pid for pid in children.split() if Path(f"/proc/{pid}").exists()]
    assert "Traceback" not in shown.err


def test_ctrl_c_while_a_process_starts_leaves_none_behind(monkeypatch):
    started = []
    popen = subprocess.Popen

    def interrupted(command: list[str], **options) -> subprocess.Popen:
        process = popen([sys.executable, "-c", "import time; time.sleep(60)"], **options)
        started.append(process)
        signal.raise_signal(signal.SIGINT)
        return process

    monkeypatch.setattr(subprocess, "Popen", interrupted)
    with pytest.raises(KeyboardInterrupt), demo.children() as start:
        start("player")
    (process,) = started
    assert process.returncode is not None


def test_demo_whose_recorder_gives_up_says_so_once(tmp_path, monkeypatch, capsys):
    full = f"print('{HEARING}', flush=True); raise SystemExit(1)"  # it has said that the disk is
    stand_ins = {"recorder": full, "detector": "import sys; sys.stdin.read()", "player": ""}

    @contextmanager
    def children() -> Iterator[Callable[..., subprocess.Popen]]:
        with ExitStack() as running:

            def start(node: str, *_: str, piped: bool = False) -> subprocess.Popen:
                command = [sys.executable, "-S", "-c", stand_ins[node]]
                pipe = subprocess.PIPE
                process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
                return running.enter_context(process)

            yield start

    monkeypatch.setattr(demo, "children", children)
    monkeypatch.setattr(demo, "stop_on_signals", lambda: None)
    bag, output = write_bag(tmp_path / "bag", sky(2)), tmp_path / "output"
    monkeypatch.setattr("sys.argv", ["demo", "--bag", f"{bag}", "--output", f"{output}"])
    assert demo.main() == 1
    said = capsys.readouterr()
    assert said.err == f"demo: the recorder has given up; {output} is not whole\n"
    assert "played" not in said.out


def test_demo_without_a_bag_says_so(tmp_path):
    with Process(tmp_path, "demo", "--bag", f"{tmp_path / 'nothing'}") as shown:
        assert shown.wait() == 2
    assert "nothing does not exist" in shown.err
