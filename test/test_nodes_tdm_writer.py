# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The tdm_writer node: files of the tracks that were heard of, whatever happens meanwhile."""

import math
import os
import re
import signal
import time
from pathlib import Path

import pytest
from ccsds_ndm.ndm_io import NdmIo
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from ros_graph import Graph, Process
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.runtime import StartError
from ofsat_ros.nodes.tdm_writer import TdmWriter
from ofsat_ros.parameters import ParameterError, TdmWriterParameters

START_S = 1_790_000_000


def cloud(seconds: float, *tracks: int, located: bool = True) -> PointCloud2:
    """Detections of tracks that move at 0.1 deg/s, at a time since the start."""
    rows = messages.cloud_rows(len(tracks))
    for row, track_id in zip(rows, tracks, strict=True):
        row["id"], row["status"], row["u"] = track_id, CONFIRMED, 5.0
        if located:
            row["ra"], row["dec"] = direction(seconds, track_id)
    stamp = messages.time_message(START_S * 10**9 + round(seconds * 1e9))
    return messages.cloud_message(Header(stamp=stamp, frame_id="camera"), rows)


def direction(seconds: float, track_id: int) -> tuple[float, float]:
    return math.radians(10 * track_id + seconds / 10), math.radians(-20 + track_id)


def angles(path: Path) -> list[tuple[str, float]]:
    """Epochs and right ascensions of a message of one track."""
    (segment,) = NdmIo().from_path(path).body.segment
    found = [(o.epoch, o.angle_1.value) for o in segment.data.observation if o.angle_1]
    assert [o.epoch for o in segment.data.observation if o.angle_2] == [at for at, _ in found]
    return found


def tracks_of(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


class Writer:
    """A writer in a graph with a probe that plays the detector."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.node = graph.add(TdmWriter(context=graph.context))
        self._clouds = graph.publisher(PointCloud2, "rso_detections")
        graph.connect(self._clouds)
        self._sent = 0

    def hear(self, *frames: PointCloud2) -> None:
        """Send frames, and wait until they are taken, and what has ended is written."""
        for frame in frames:
            self._clouds.publish(frame)
            self.graph.serve_once()
        self._sent += len(frames)
        self.graph.until(lambda: self.node._counts["frames"] == self._sent)
        self.wait_until_written()

    def wait_until_written(self) -> None:
        self.graph.until(lambda: not self.node._waiting or self.node._why_waiting)

    def time_passes(self) -> None:
        self.node._on_timer()
        self.wait_until_written()


@pytest.fixture
def writer(tmp_path, request):
    given = [f for name in getattr(request, "param", ()) for f in ("-p", name)]
    with Graph("-p", f"output:={tmp_path / 'out'}", *given) as graph:
        yield Writer(graph)


def test_a_track_is_written_when_it_has_ended(writer, tmp_path, capfd):
    writer.hear(*(cloud(k, 1, 2) for k in range(5)))
    writer.hear(*(cloud(k, 2) for k in range(5, 15)))
    assert tracks_of(tmp_path / "out") == []
    writer.hear(cloud(15, 2))  # track 1 was seen 11 s ago
    path = tmp_path / "out" / "20260921T141320_1.tdm"
    assert tracks_of(tmp_path / "out") == [path.name]
    found = angles(path)
    assert [at for at, _ in found] == [f"2026-09-21T14:13:2{k}.000000" for k in range(5)]
    expected = [math.degrees(direction(k, 1)[0]) for k in range(5)]
    assert [ra for _, ra in found] == pytest.approx(expected, abs=6e-9)
    assert f"{path}: 5 directions of track 1\n" in capfd.readouterr().out
    writer.node.close()
    assert tracks_of(tmp_path / "out") == [path.name, "20260921T141320_2.tdm"]
    assert len(angles(tmp_path / "out" / "20260921T141320_2.tdm")) == 16
    assert f"2 tracks written into {tmp_path / 'out'}" in capfd.readouterr().out
    assert writer.node.exit_code == 0


@pytest.mark.parametrize(
    "writer",
    [("stamp_reference:=start", "exposure_time_s:=0.5", "stamp_offset_s:=-2.0", "format:=xml")],
    indirect=True,
)
def test_times_are_the_middle_of_the_exposure(writer, tmp_path):
    writer.hear(*(cloud(k, 1) for k in range(3)))
    writer.node.close()
    (path,) = (tmp_path / "out").iterdir()
    assert path.suffix == ".xml"
    assert [at[17:] for at, _ in angles(path)] == ["18.250000", "19.250000", "20.250000"]


@pytest.mark.parametrize("writer", [("format:=iod", "station:='4171'")], indirect=True)
def test_iod_lines(writer, tmp_path):
    writer.hear(*(cloud(k, 1) for k in range(3)))
    writer.node.close()
    (path,) = (tmp_path / "out").iterdir()
    lines = path.read_text().splitlines()
    assert [line[16:40] for line in lines] == [f"4171   2026092114132{k}000" for k in range(3)]


def test_names_may_be_given_while_the_track_lasts(writer, tmp_path):
    writer.hear(*(cloud(k, 1) for k in range(3)))

    def set_names(names: str) -> object:
        value = ParameterValue(type=4, string_value=names)
        request = SetParameters.Request(parameters=[Parameter(name="object_names", value=value)])
        response = writer.graph.call(SetParameters, "/tdm_writer/set_parameters", request)
        return response.results[0]

    refused = set_names("ISS")
    assert not refused.successful
    assert "written as 3=25544,7=GEO-1" in refused.reason
    assert set_names("1=25544").successful
    writer.node.close()
    (path,) = (tmp_path / "out").iterdir()
    assert "PARTICIPANT_2   = 25544\n" in path.read_text()


def test_a_bag_that_begins_anew_gives_files_of_its_own(writer, tmp_path):
    # The detector never gives a number twice, but one that was started anew does.
    writer.hear(*(cloud(k, 1) for k in range(5)))
    writer.hear(cloud(-1), cloud(0))
    assert tracks_of(tmp_path / "out") == ["20260921T141320_1.tdm"]
    writer.hear(*(cloud(k, 1, 2) for k in range(1, 5)))
    writer.node.close()
    names = ["20260921T141320_1.tdm", "20260921T141321_1-2.tdm", "20260921T141321_2.tdm"]
    assert tracks_of(tmp_path / "out") == names
    text = (tmp_path / "out" / names[1]).read_text()
    assert "PARTICIPANT_2   = UNKNOWN-1-2\n" in text


def test_files_of_an_earlier_run_stay(writer, tmp_path):
    old = tmp_path / "out" / "20260921T141320_1.tdm"
    old.write_text("old")
    writer.hear(*(cloud(k, 1) for k in range(5)))
    writer.node.close()
    assert old.read_text() == "old"
    assert tracks_of(tmp_path / "out") == [old.name, "20260921T141320_1_2.tdm"]


def test_a_name_that_another_writer_takes_meanwhile_is_not_used(writer, tmp_path, monkeypatch):
    real, first = os.fsync, tmp_path / "out" / "20260921T141320_1.tdm"

    def another_writes(number: int) -> None:
        real(number)
        first.write_text("another's")

    monkeypatch.setattr("os.fsync", another_writes)
    writer.hear(*(cloud(k, 1) for k in range(5)))
    writer.node.close()
    assert first.read_text() == "another's"
    assert tracks_of(tmp_path / "out") == [first.name, "20260921T141320_1_2.tdm"]
    assert writer.node.exit_code == 0


@pytest.mark.parametrize(
    "writer", [("longest_directions:=10", "object_names:=1=25544")], indirect=True
)
def test_a_long_track_makes_several_files(writer, tmp_path):
    writer.hear(*(cloud(k, 1) for k in range(21)))
    names = ["20260921T141320_1.tdm", "20260921T141330_1.tdm"]
    assert tracks_of(tmp_path / "out") == names
    writer.node.close()
    paths = [tmp_path / "out" / name for name in (*names, "20260921T141340_1.tdm")]
    assert tracks_of(tmp_path / "out") == [path.name for path in paths]
    found = [at[17:19] for path in paths for at, _ in angles(path)]
    assert found == [f"{(20 + k) % 60:02d}" for k in range(21)]
    assert all("PARTICIPANT_2   = 25544\n" in path.read_text() for path in paths)


class Steady:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.mark.parametrize(("interval_s", "silent_s"), [(0.1, 10), (1, 10), (6, 30)])
def test_tracks_end_when_no_more_images_come(writer, tmp_path, monkeypatch, interval_s, silent_s):
    clock = Steady()
    monkeypatch.setattr("ofsat_ros.nodes.tdm_writer.time", clock)
    writer.time_passes()  # nothing was heard yet
    for k in range(5):
        writer.hear(cloud(k, 1, 2))
        clock.now_s += interval_s
    clock.now_s += silent_s - interval_s - 0.01
    writer.time_passes()
    assert tracks_of(tmp_path / "out") == []
    clock.now_s += 0.02
    writer.time_passes()
    names = ["20260921T141320_1.tdm", "20260921T141320_2.tdm"]
    assert tracks_of(tmp_path / "out") == names
    writer.time_passes()
    writer.hear(*(cloud(k, 1) for k in range(6, 9)))
    writer.node.close()
    assert tracks_of(tmp_path / "out") == [*names, "20260921T141326_1-2.tdm"]


@pytest.mark.parametrize("name", ["kvn", "xml"])
def test_what_is_open_after_a_night_is_written_at_once(tmp_path, name):
    # Half a second is what a node has to close; the worst is when every file is full.
    with Graph("-p", f"output:={tmp_path / 'out'}", "-p", f"format:={name}") as graph:
        node = graph.add(TdmWriter(context=graph.context))
        longest = TdmWriterParameters().longest_directions
        rows = messages.detections_array(cloud(0, 1, 2, 3, 4, 5))
        rows["sigma_ra"] = rows["sigma_dec"] = 1e-6
        for k in range(2 * longest):
            node._arcs.add(START_S * 10**9 + k * 10**9, rows)
        assert len(node._arcs.take_ended(1e9)) == 5
        began = time.thread_time()
        node.close()
        # Only this thread's own work: others may keep the disk and the processor busy.
        assert time.thread_time() - began < 0.5
    assert len(tracks_of(tmp_path / "out")) == 5


def test_without_directions_it_says_why_nothing_is_written(writer, tmp_path, capfd):
    heard = writer.graph.listen(DiagnosticArray, "/diagnostics")
    writer.hear(*(cloud(k, 1, 0, located=False) for k in range(5)))
    writer.graph.until(lambda: heard and "camera_info" in heard[-1].status[0].message)
    status = heard[-1].status[0]
    assert (status.name, status.level) == ("/tdm_writer: tracking data", DiagnosticStatus.WARN)
    values = {v.key: v.value for v in status.values}
    assert (values["detections"], values["detections_without_direction"]) == ("5", "5")
    assert values["tracks_written"] == "0"
    writer.node.close()
    said = capfd.readouterr().err
    # Once while it runs, once at the end.
    assert len(re.findall("need.* calibration on camera_info and a fresh attitude", said)) == 2
    assert tracks_of(tmp_path / "out") == []


def test_what_cannot_be_written_is_kept_and_tried_again(writer, tmp_path, monkeypatch, capfd):
    real = os.fsync

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    heard = writer.graph.listen(DiagnosticArray, "/diagnostics")
    writer.hear(*(cloud(k, 1, 2) for k in range(5)), *(cloud(k, 3) for k in range(20, 24)))
    assert tracks_of(tmp_path / "out") == []
    problem = "2 tracks waiting: .*_1.tdm cannot be written: No space left on device"
    writer.graph.until(lambda: heard and re.search(problem, heard[-1].status[0].message))
    writer.hear(cloud(40), cloud(41))
    assert capfd.readouterr().err.count("No space left") == 1
    monkeypatch.setattr("os.fsync", real)
    writer.node._on_timer()
    writer.graph.until(lambda: not writer.node._waiting)
    assert len(tracks_of(tmp_path / "out")) == 3
    writer.node.close()
    assert writer.node.exit_code == 0


def test_what_cannot_be_written_to_the_end_is_said(writer, tmp_path, monkeypatch, capfd):
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    writer.hear(*(cloud(k, 1) for k in range(5)))
    monkeypatch.setattr("os.fsync", full)
    writer.node.close()
    assert writer.node.exit_code == 1
    said = capfd.readouterr().err
    path = tmp_path / "out" / "20260921T141320_1.tdm"
    assert f"1 track lost: {path} cannot be written: No space left on device" in said


def test_what_is_not_a_detectors_is_left_out(writer, tmp_path):
    field = PointField(name="x", datatype=PointField.FLOAT32, count=1)
    foreign = PointCloud2(fields=[field], point_step=4, width=2, data=bytes(8))
    writer._clouds.publish(foreign)
    writer.hear(*(cloud(k, 1) for k in range(3)))
    writer.node.close()
    assert len(tracks_of(tmp_path / "out")) == 1


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ("output:=/proc/nowhere", StartError, "/proc/nowhere cannot be made: .*-p output:="),
        ("object_names:=ISS", ParameterError, "written as 3=25544,7=GEO-1"),
        ("format:=iod", ParameterError, "station must be four digits"),
        ("format:=csv", ParameterError, "format must be one of kvn | xml | iod"),
    ],
)
def test_it_does_not_start_with(tmp_path, given, error, words, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (
        Graph("-p", given) as graph,
        pytest.raises(error, match=words.replace("|", r"\|")),
    ):
        TdmWriter(context=graph.context)
    assert not list(tmp_path.iterdir())


def test_without_a_name_the_folder_is_named_by_the_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Graph() as graph:
        graph.add(TdmWriter(context=graph.context))
    (folder,) = tmp_path.iterdir()
    assert re.fullmatch(r"tracks_\d{8}_\d{6}", folder.name)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_writes_what_is_open(tmp_path, number):
    folder = tmp_path / "out"
    with (
        Process(tmp_path, "tdm_writer", "--ros-args", "-p", f"output:={folder}") as process,
        Graph() as graph,
    ):
        clouds = graph.publisher(PointCloud2, "rso_detections")
        heard = graph.listen(DiagnosticArray, "/diagnostics")
        graph.connect(clouds)
        for k in range(5):
            clouds.publish(cloud(k, 7, 8))

        def detections() -> str:
            values = heard[-1].status[0].values if heard else []
            return {v.key: v.value for v in values}.get("detections", "")

        graph.until(lambda: detections() == "10")
        assert tracks_of(folder) == []
        process.end(number)
        assert process.wait() == 0, process.err
    assert tracks_of(folder) == ["20260921T141320_7.tdm", "20260921T141320_8.tdm"]
    assert all(len(angles(path)) == 5 for path in folder.iterdir())
    assert f"2 tracks written into {folder}" in process.out
