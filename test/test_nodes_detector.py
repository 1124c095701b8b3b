# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The detector over real DDS: one answer per image, and the answers say the same thing."""

import threading

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from ros_graph import (
    PATIENCE_S,
    Graph,
    header,
    image,
    padded_big_endian,
    sky,
    stamps,
    without_rso,
)
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from ofsat_ros import report
from ofsat_ros.detection import CONFIRMED
from ofsat_ros.images import encode_png
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.detector import Detector
from ofsat_ros.nodes.health import Health
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.tracking import COASTING

RELIABLE = ("-p", "reliable_input:=true")
DOUBLE, INTEGER, STRING = 3, 2, 4


def compressed(frame) -> CompressedImage:
    png = encode_png(frame.image)
    return CompressedImage(header=header(frame), format="mono16; png compressed", data=png)


class Station:
    """A detector with a camera before it and a listener behind it."""

    def __init__(self, graph: Graph, kind: type = Image, topic: str = "image") -> None:
        self.graph = graph
        self.detector = graph.add(Detector(context=graph.context))
        self.clouds = graph.listen(PointCloud2, "rso_detections")
        self.tracks = graph.listen(PointCloud2, "rso_tracks")
        self.motions = graph.listen(Vector3Stamped, "star_field_motion")
        self.camera = graph.publisher(kind, topic)
        answers = self.outputs("rso_detections", "rso_tracks", "star_field_motion")
        graph.connect(self.camera, *answers)

    def outputs(self, *topics: str) -> list:
        return [p for p in self.detector.publishers if p.topic_name.strip("/") in topics]

    def send(self, *images) -> None:
        """Send images and wait for their answers."""
        wanted = len(self.clouds) + len(images)
        for one in images:
            self.camera.publish(one)
            self.graph.serve_once()
        answers = (self.clouds, self.tracks, self.motions)
        self.graph.until(lambda: min(map(len, answers)) >= wanted)

    def set(self, **values):
        """Set parameters in one call; return the result."""
        kinds = {
            float: lambda v: ParameterValue(type=DOUBLE, double_value=v),
            int: lambda v: ParameterValue(type=INTEGER, integer_value=v),
            str: lambda v: ParameterValue(type=STRING, string_value=v),
        }
        request = SetParametersAtomically.Request(
            parameters=[Parameter(name=n, value=kinds[type(v)](v)) for n, v in values.items()]
        )
        service = "detector/set_parameters_atomically"
        return self.graph.call(SetParametersAtomically, service, request).result

    def diagnostics_when(self, condition) -> DiagnosticStatus:
        """Return the first status that meets a condition."""
        heard = self.graph.listen(DiagnosticArray, "/diagnostics")
        self.graph.until(lambda: heard and condition(heard[-1].status[0]))
        return heard[-1].status[0]


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


@pytest.mark.parametrize(
    ("kind", "make"),
    [(Image, image), (Image, padded_big_endian), (CompressedImage, compressed)],
    ids=["mono16", "big-endian padded", "png"],
)
def test_every_frame_is_answered_once_in_order(kind, make):
    frames = sky(12)
    transport = "compressed" if kind is CompressedImage else "raw"
    expected = Pipeline()
    detections = [expected.process(f.image, f.stamp_ns).detections for f in frames]
    assert sum(map(len, detections)) >= 8  # else the comparison below says nothing
    with Graph(*RELIABLE, "-p", f"image_transport:={transport}") as graph:
        station = Station(graph, kind, "image/compressed" if kind is CompressedImage else "image")
        station.send(*map(make, frames))
        graph.serve(0.2)
    assert stamps(station.clouds) == [f.stamp_ns for f in frames]
    assert stamps(station.tracks) == [f.stamp_ns for f in frames]
    assert stamps(station.motions) == [f.stamp_ns for f in frames]
    assert {c.header.frame_id for c in station.clouds} == {"camera_optical_frame"}
    for cloud, rows in zip(station.clouds, detections, strict=True):
        heard = messages.cloud_array(cloud)
        np.testing.assert_array_equal(heard["u"], rows["x"])
        np.testing.assert_array_equal(heard["v_rate"], rows["vy"])


def test_tracks_keep_their_id_and_coast_while_the_rso_is_not_seen():
    frames = sky(10)
    frames[6:8] = map(without_rso, frames[6:8])
    pipeline = Pipeline()
    expected = [pipeline.process(f.image, f.stamp_ns) for f in frames]
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        station.send(*map(image, frames))
    for cloud, one in zip(station.tracks, expected, strict=True):
        heard = messages.tracks_array(cloud)
        for name in set(heard.dtype.names) - {"log_false"}:
            np.testing.assert_array_equal(heard[name], one.tracks[name])
    first, *seen = [n for n, one in enumerate(expected) if len(one.tracks)]
    assert first <= 3
    assert seen == list(range(first + 1, 10))
    for number in (first, *seen):
        (track,) = messages.tracks_array(station.tracks[number])
        rsos = messages.detections_array(station.clouds[number])
        confirmed = rsos[rsos["status"] == CONFIRMED]
        hidden = number in (6, 7)
        assert track["status"] == (COASTING if hidden else CONFIRMED)
        assert confirmed["track_id"].tolist() == ([] if hidden else [track["track_id"]])
        assert track["track_id"] == 1
        truth = frames[number].truth[0]
        # Two frames ahead, a velocity of some 0.1 px a frame still holds.
        assert np.hypot(track["x"] - truth["x_px"], track["y"] - truth["y_px"]) < 1.5
    assert (track["hits"], track["misses"]) == (8 - first + 2, 2)
    assert track["age"] == pytest.approx(9 * 0.5)


def test_two_frames_alone_make_candidates_and_no_track():
    frames = sky(6)
    with Graph(*RELIABLE, "-p", "rso_test:=vector") as graph:
        station = Station(graph)
        station.send(*map(image, frames))
    rows = np.concatenate([messages.detections_array(cloud) for cloud in station.clouds])
    assert len(rows) >= 4
    assert not rows["track_id"].any()
    assert not rows["status"].any()
    assert [cloud.width for cloud in station.tracks] == [0] * 6
    assert stamps(station.tracks) == [f.stamp_ns for f in frames]


def test_detections_and_markers_say_the_same():
    frames = sky(8)
    with Graph(*RELIABLE, "-p", "marker_scale:=4") as graph:
        station = Station(graph)
        arrays = graph.listen(MarkerArray, "flow_markers")
        graph.connect(*station.outputs("flow_markers"))
        station.send(*map(image, frames))
        graph.until(lambda: len(arrays) == len(frames))
    seen = 0
    for cloud, array in zip(station.clouds, arrays, strict=True):
        rows = messages.cloud_array(cloud)
        assert array.markers[0].action == Marker.DELETEALL
        assert all(m.header == cloud.header for m in array.markers)
        boxes = [m for m in array.markers if m.ns == "rso_boxes"]
        centres = [np.mean([(p.x, p.y, p.z) for p in box.points], axis=0) for box in boxes]
        expected = np.column_stack([rows["u"], rows["v"], np.zeros(len(rows))])
        np.testing.assert_allclose(np.reshape(centres, (-1, 3)), expected, atol=1e-9)
        flow = [m for m in array.markers if m.ns == "rso_flow"]
        points = [(p.x, p.y) for m in flow for p in m.points]
        ends = np.reshape(points, (-1, 2, 2))
        np.testing.assert_allclose(ends[:, 0], expected[:, :2], atol=1e-9)
        step = np.column_stack([rows["u_rate"], rows["v_rate"]]) * 0.5 * 4  # dt, scale
        np.testing.assert_allclose(ends[:, 1] - ends[:, 0], step, atol=1e-9)
        seen += len(rows)
    assert seen >= 5


def test_star_field_motion_is_the_true_one():
    frames = sky(5, camera_rate_arcsec_s=(20.0, -10.0), star_count=100)
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        station.send(*map(image, frames))
    motion = [(m.vector.x, m.vector.y, m.vector.z) for m in station.motions]
    assert np.isnan(motion[0]).all()
    truth = [(*(f.displacement_px / 0.5), 0.0) for f in frames[1:]]
    # The stage's own tests hold it to 0.1 px per frame; here that unit and sign are right.
    np.testing.assert_allclose(motion[1:], truth, atol=0.2)


def test_an_image_that_cannot_be_decoded_is_answered_empty_and_the_node_lives_on():
    frames = sky(4)
    broken, cut = image(frames[1]), image(frames[2])
    broken.encoding = "yuv422"
    cut.data = cut.data[:-5000]
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        arrays = graph.listen(MarkerArray, "flow_markers")
        graph.connect(*station.outputs("flow_markers"))
        station.send(image(frames[0]), broken, cut)
        status = station.diagnostics_when(lambda s: values(s)["frames_failed"] == "2")
        assert status.level == DiagnosticStatus.WARN
        assert "too short" in status.message
        station.send(image(frames[3]))
        status = station.diagnostics_when(lambda s: values(s)["frames_processed"] == "2")
        assert status.level == DiagnosticStatus.OK
        graph.until(lambda: len(arrays) == 4)
    assert stamps(station.clouds) == [f.stamp_ns for f in frames]
    assert stamps(station.tracks) == [f.stamp_ns for f in frames]
    assert [c.width for c in station.clouds[1:3] + station.tracks[1:3]] == [0] * 4
    assert [m.action for m in arrays[1].markers] == [Marker.DELETEALL]
    assert np.isnan(station.motions[1].vector.x)


def test_a_frame_without_stamp_is_answered_and_named():
    frames = sky(2)
    unstamped = [image(f) for f in frames]
    for one in unstamped:
        one.header.stamp.sec = one.header.stamp.nanosec = 0
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        station.send(*unstamped)
        status = station.diagnostics_when(lambda s: "no stamp" in s.message)
    assert status.level == DiagnosticStatus.ERROR
    assert stamps(station.clouds) == [0, 0]


def test_best_effort_camera_is_answered_in_order():
    frames = sky(5)
    with Graph() as graph:
        station = Station(graph)
        for frame in frames:
            station.send(image(frame))  # one at a time: nothing to drop
    assert stamps(station.clouds) == [f.stamp_ns for f in frames]


def test_live_input_drops_all_but_the_newest(monkeypatch):
    frames = sky(6)
    entered, proceed = threading.Event(), threading.Event()

    def slow(self, image, stamp_ns, process=Pipeline.process):
        entered.set()
        assert proceed.wait(PATIENCE_S)
        return process(self, image, stamp_ns)

    monkeypatch.setattr(Pipeline, "process", slow)
    with Graph("-p", "backlog_s:=0.0") as graph:
        station = Station(graph)
        station.camera.publish(image(frames[0]))
        graph.until(entered.is_set)
        for frame in frames[1:]:
            station.camera.publish(image(frame))
        status = station.diagnostics_when(lambda s: values(s)["frames_dropped"] == "4")
        assert "slower than the camera" in status.message
        proceed.set()
        graph.until(lambda: len(station.clouds) == 2)
    assert stamps(station.clouds) == [frames[0].stamp_ns, frames[-1].stamp_ns]


def test_picture_is_drawn_only_while_somebody_listens(monkeypatch):
    drawn = []
    annotate = report.annotate

    def counted(image, result, **options):
        drawn.append(result.frame)
        return annotate(image, result, **options)

    monkeypatch.setattr(report, "annotate", counted)
    frames = sky(4)
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        station.send(image(frames[0]), image(frames[1]))
        assert drawn == []
        pictures = graph.listen(Image, "image_annotated")
        graph.connect(*station.outputs("image_annotated"))
        station.send(image(frames[2]), image(frames[3]))
        graph.until(lambda: len(pictures) == 2)
    assert drawn == [2, 3]
    assert stamps(pictures) == [f.stamp_ns for f in frames[2:]]
    assert {p.encoding for p in pictures} == {"bgr8"}
    height, width = frames[0].image.shape  # a small image is enlarged
    assert pictures[0].width / width == pictures[0].height / height >= 1


@pytest.mark.parametrize("reliable", [True, False])
def test_a_slow_picture_delays_no_answer(reliable, monkeypatch):
    """Live, the frames in between are not drawn; with reliable input all are."""
    begun, proceed = [], threading.Event()

    def slow(picture, result, annotate=report.annotate, **options):
        begun.append(result.frame)
        assert proceed.wait(PATIENCE_S)
        return annotate(picture, result, **options)

    monkeypatch.setattr(report, "annotate", slow)
    frames = sky(6)
    with Graph("-p", f"reliable_input:={reliable}".lower()) as graph:
        station = Station(graph)
        pictures = graph.listen(Image, "image_annotated")
        graph.connect(*station.outputs("image_annotated"))
        # One is being drawn, one waits; a third would have to wait with reliable input.
        answered = frames[:3] if reliable else frames
        for frame in answered:
            station.send(image(frame))
            graph.until(lambda: begun)
        assert begun == [0]
        proceed.set()
        for frame in frames[len(answered) :]:
            station.send(image(frame))
        wanted = range(6) if reliable else (0, 5)
        graph.until(lambda: len(pictures) == len(wanted))
        graph.serve(0.2)
    assert stamps(station.clouds) == [f.stamp_ns for f in frames]
    assert stamps(pictures) == [frames[number].stamp_ns for number in wanted]


def test_a_frame_that_fails_clears_the_markers_of_the_one_before():
    frames = sky(2)
    broken = image(frames[1])
    broken.encoding = "yuv422"
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        arrays = graph.listen(MarkerArray, "flow_markers")
        graph.connect(*station.outputs("flow_markers"))
        station.send(image(frames[0]), broken)
        graph.until(lambda: len(arrays) == 2)
    assert stamps([a.markers[0] for a in arrays]) == [f.stamp_ns for f in frames]
    assert [m.action for m in arrays[1].markers] == [Marker.DELETEALL]


def test_diagnostics_say_where_the_time_goes():
    frames = sky(4)
    pipeline = Pipeline()
    stages = [pipeline.process(f.image, f.stamp_ns).seconds for f in frames][-1]
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        station.send(*map(image, frames))
        told = values(station.diagnostics_when(lambda s: values(s)["frames_processed"] == "4"))
    profile = {k[8:-3]: float(v) for k, v in told.items() if k.startswith("profile_")}
    steps = {"receive", "wait", "convert", "process", "locate", "publish", "draw"}
    assert profile.keys() == steps | stages.keys()
    assert 0 < sum(profile[stage] for stage in stages) <= profile["process"] * 1.001  # 4 digits
    assert np.isnan(profile["draw"])
    assert profile["receive"] > 0


def test_a_picture_that_cannot_be_drawn_costs_no_answer(monkeypatch):
    def broken(image, result, **options):
        raise IndexError("no such colour")

    monkeypatch.setattr(report, "annotate", broken)
    frames = sky(4)
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        graph.listen(Image, "image_annotated")
        graph.connect(*station.outputs("image_annotated"))
        station.send(*map(image, frames))
    assert stamps(station.clouds) == [f.stamp_ns for f in frames]


def test_reset_and_enable():
    frames = sky(8)
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        station.send(*map(image, frames[:3]))
        assert graph.call(Trigger, "detector/reset", Trigger.Request()).success
        station.send(image(frames[3]), image(frames[4]))
        known = [np.isfinite(m.vector.x) for m in station.motions]
        assert known == [False, True, True, False, True]

        assert graph.call(SetBool, "detector/enable", SetBool.Request(data=False)).success
        station.camera.publish(image(frames[5]))
        status = station.diagnostics_when(lambda s: values(s)["frames_received"] == "6")
        assert "disabled" in status.message
        assert len(station.clouds) == len(station.tracks) == 5
        graph.call(SetBool, "detector/enable", SetBool.Request(data=True))
        station.send(image(frames[6]), image(frames[7]))
        known = [np.isfinite(m.vector.x) for m in station.motions]
        assert known[5:] == [False, True]
    assert frames[5].stamp_ns not in stamps(station.clouds)


def test_a_bad_value_is_refused_with_a_reason_and_several_change_at_once():
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        for change, reason in [
            ({"smoothing_sigma_px": 50.0}, "10"),
            ({"smoothing_sigma_px": "wide"}, "smoothing_sigma_px"),
            ({"engine": "magic"}, "sparse | dense"),
            ({"smoothing_sigma": 2.0}, "did you mean smoothing_sigma_px"),
            ({"reliable_input": "false"}, "reliable_input"),
            ({"threshold_sigmas": 5.0, "engine": "magic"}, "engine"),
        ]:
            result = station.set(**change)
            assert not result.successful
            assert reason in result.reason
        assert station.detector.get_parameter("threshold_sigmas").value == 4.0

        result = station.set(smoothing_sigma_px=2, threshold_sigmas=5.0, engine="dense")
        assert result.successful, result.reason
        request = GetParameters.Request(names=["smoothing_sigma_px", "threshold_sigmas", "engine"])
        got = graph.call(GetParameters, "detector/get_parameters", request).values
    assert (got[0].double_value, got[1].double_value, got[2].string_value) == (2.0, 5.0, "dense")


def test_changes_take_effect_at_the_next_frame():
    frames = sky(4)
    by_hand = Pipeline(Parameters.preset())
    with Graph(*RELIABLE) as graph:
        station = Station(graph)

        def noise_and_threshold(**change):
            assert station.set(**change).successful
            frame = frames.pop(0)
            by_hand.parameters = by_hand.parameters.replace(**change)
            expected = by_hand.process(frame.image, frame.stamp_ns)
            station.send(image(frame))
            count = str(len(station.clouds))
            found = values(
                station.diagnostics_when(lambda s: values(s).get("frames_processed") == count)
            )
            assert float(found["noise_dn"]) == pytest.approx(expected.noise, rel=1e-3)
            assert float(found["threshold_dn"]) == pytest.approx(expected.threshold, rel=1e-3)
            return expected.noise, expected.threshold

        first = noise_and_threshold(smoothing_sigma_px=1.0)
        smoother = noise_and_threshold(smoothing_sigma_px=2.0)
        higher = noise_and_threshold(threshold_sigmas=8.0)
        noise_and_threshold(engine="dense")
    assert smoother[0] < 0.7 * first[0]  # twice the sigma halves white noise
    assert higher[1] > 1.5 * smoother[1]


def test_tracking_changes_while_it_runs():
    frames = sky(12)
    by_hand = Pipeline()
    confirmed = []
    changes = {
        0: {"max_speed_px": 1.0},  # a frame: slower than the RSO
        4: {"max_speed_px": 100.0, "false_tracks": 0.01},
        6: {"history_frames": 4, "coast_frames": 0},
        9: {"history_frames": 20},
    }
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        for number, frame in enumerate(frames):
            if number in changes:
                result = station.set(**changes[number])
                assert result.successful, result.reason
                by_hand.parameters = by_hand.parameters.replace(**changes[number])
            expected = by_hand.process(frame.image, frame.stamp_ns).tracks
            station.send(image(frame))
            heard = messages.tracks_array(station.tracks[-1])
            np.testing.assert_array_equal(heard["x"], expected["x"])
            np.testing.assert_array_equal(heard["track_id"], expected["track_id"])
            confirmed.append(len(heard))
        assert not station.set(history_frames=2).successful
        assert not station.set(false_tracks=0.0).successful
    assert confirmed[:4] == [0] * 4
    assert confirmed[4:] == [1] * 8


def test_descriptors_come_from_the_table():
    with Graph() as graph:
        graph.add(Detector(context=graph.context))
        names = ["smoothing_sigma_px", "engine", "preset", "window_px", "history_frames"]
        request = DescribeParameters.Request(names=names)
        service = "detector/describe_parameters"
        sigma, engine, preset, window, history = graph.call(
            DescribeParameters, service, request
        ).descriptors
    assert "[px]" in sigma.description
    limits = sigma.floating_point_range[0]
    assert (limits.from_value, limits.to_value) == (0.0, 10.0)
    assert engine.additional_constraints == "sparse | dense"
    assert (preset.read_only, engine.read_only) == (True, False)
    assert window.integer_range[0].to_value == 101
    assert (history.integer_range[0].from_value, history.read_only) == (3, False)


def test_start_values_yaml_preset_and_command_line(tmp_path):
    yaml = tmp_path / "mine.yaml"
    yaml.write_text("/**:\n  ros__parameters:\n    window_px: 31\n    rso_sigmas: 3\n")
    with Graph(
        *("--params-file", f"{yaml}"),
        *("-p", "preset:=paper_opencv", "-p", "smoothing_sigma_px:=2", "-p", "rso_sigmas:=4"),
    ) as graph:
        detector = graph.add(Detector(context=graph.context))
        got = {name: detector.get_parameter(name).value for name in Parameters().as_dict()}
    expected = Parameters.preset(
        "paper_opencv", window_px=31, rso_sigmas=4.0, smoothing_sigma_px=2.0
    )
    assert got == expected.as_dict()


def test_diagnostics_say_what_is_found():
    frames = sky(6)
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        waiting = station.diagnostics_when(lambda s: True)
        assert waiting.name == "/detector: detection"
        assert waiting.message == "waiting for images"
        station.send(*map(image, frames))
        status = station.diagnostics_when(lambda s: values(s)["frames_processed"] == "6")
    assert status.level == DiagnosticStatus.OK
    found = values(status)
    assert found["frames_received"] == "6"
    assert found["frames_lost"] == found["frames_dropped"] == "0"
    assert int(found["objects"]) >= int(found["stars"]) > 10
    assert float(found["rate_hz"]) > 0
    assert 0 < float(found["latency_s"]) < 10
    assert abs(float(found["star_motion_x_px_s"])) < 0.5
    assert float(found["threshold_dn"]) > float(found["noise_dn"]) > 0
    assert (found["rso_confirmed"], found["tracks"], found["tracks_coasting"]) == ("1", "1", "0")
    assert float(found["star_residual_px"]) < 0.5
    assert status.message.startswith("1 RSO")


def test_diagnostics_come_with_every_frame():
    frames = sky(6)
    frames[5] = without_rso(frames[5])
    pipeline = Pipeline()
    expected = [pipeline.process(f.image, f.stamp_ns) for f in frames]
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        heard = graph.listen(DiagnosticArray, "/diagnostics")
        graph.connect(*station.outputs("diagnostics"))
        station.send(*map(image, frames))

        def by_frame() -> dict[str, DiagnosticStatus]:
            every = [array.status[0] for array in heard]
            return {values(s)["stamp_ns"]: s for s in every if "stamp_ns" in values(s)}

        graph.until(lambda: len(by_frame()) == len(frames))
    for frame, one in zip(frames, expected, strict=True):
        status = by_frame()[str(frame.stamp_ns)]
        found = values(status)
        confirmed = int(np.count_nonzero(one.detections["status"] == CONFIRMED))
        assert found["frame"] == str(one.frame)
        assert found["objects"] == str(len(one.objects))
        assert found["spots"] == str(one.spot_count)
        assert found["rso_confirmed"] == str(confirmed)
        assert found["rso_candidates"] == str(len(one.detections) - confirmed)
        assert found["tracks"] == str(len(one.tracks))
        assert found["nothing_detected_because"] == one.reason
        assert status.message == report.summary(one)
    assert found["tracks_coasting"] == "1"
    assert found["nothing_detected_because"]


def test_no_image_is_said_and_forgotten_when_one_comes():
    with Graph(*RELIABLE, "-p", "no_image_timeout_s:=0.5") as graph:
        station = Station(graph)
        status = station.diagnostics_when(lambda s: "no image on /image for" in s.message)
        assert status.level == DiagnosticStatus.ERROR
        graph.probe.destroy_publisher(station.camera)
        station.diagnostics_when(lambda s: "nobody publishes it" in s.message)


def test_diagnostics_that_fail_do_not_end_the_node(monkeypatch):
    failed = []

    def broken(self):
        failed.append(True)
        raise RuntimeError("deque mutated during iteration")

    monkeypatch.setattr(Health, "values", broken)
    frames = sky(2)
    with Graph(*RELIABLE) as graph:
        station = Station(graph)
        station.send(image(frames[0]))
        graph.until(lambda: failed)
        station.send(image(frames[1]))
    assert stamps(station.clouds) == [f.stamp_ns for f in frames]


def test_markers_are_cleared_once_when_images_stop():
    frames = sky(3)
    with Graph(*RELIABLE, "-p", "no_image_timeout_s:=1.0") as graph:
        station = Station(graph)
        arrays = graph.listen(MarkerArray, "flow_markers")
        graph.connect(*station.outputs("flow_markers"))
        station.send(*map(image, frames))
        last = header(frames[-1])

        def of_last() -> list[int]:
            return [len(a.markers) for a in arrays if a.markers[0].header == last]

        graph.until(lambda: len(of_last()) == 2)
        graph.serve(2.2)  # two more seconds of diagnostics
    drawn, cleared = of_last()
    assert drawn > 1
    assert cleared == 1
    assert arrays[-1].markers[0].action == Marker.DELETEALL


def test_incompatible_qos_is_said_with_the_remedy():
    with Graph(*RELIABLE) as graph:
        detector = graph.add(Detector(context=graph.context))
        heard = graph.listen(DiagnosticArray, "/diagnostics")
        graph.publisher(Image, "image", best_effort=True)
        graph.until(lambda: heard and "reliable_input:=false" in heard[-1].status[0].message)
        assert detector.count_publishers("/image") == 1
    assert heard[-1].status[0].level == DiagnosticStatus.ERROR


def test_qos_can_be_overridden():
    with Graph("-p", "qos_overrides./image.subscription.reliability:=reliable") as graph:
        graph.add(Detector(context=graph.context))
        graph.until(lambda: graph.probe.get_subscriptions_info_by_topic("/image"))
        (about,) = graph.probe.get_subscriptions_info_by_topic("/image")
    assert about.qos_profile.reliability.name == "RELIABLE"
