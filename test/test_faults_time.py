# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Time that goes wrong in the night: stamps doubled, late, bogus; clocks that are set."""

import json
import os
import re
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from command import succeeds
from diagnostic_msgs.msg import DiagnosticArray
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_graph import Graph, image, sky, stamps, write_bag
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from test_guidance import CAMERA, NS, Plant, engaged, ns, rows, track
from test_nodes_guide import camera_info
from test_nodes_tdm_writer import cloud, tracks_of

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.guidance import Guide
from ofsat_ros.nodes import messages
from ofsat_ros.nodes.detector import Detector
from ofsat_ros.nodes.guide import GuideNode
from ofsat_ros.nodes.recorder import Recorder
from ofsat_ros.nodes.tdm_writer import TdmWriter
from ofsat_ros.parameters import GuideParameters, ParameterError
from ofsat_ros.pipeline import FrameResult, ImageError, Pipeline
from ofsat_ros.results import DETECTIONS, read_run
from ofsat_ros.timeline import AstrayError, Timeline

PATIENCE_S = 60.0
FRAMES = sky(14)  # two a second, one RSO at 16 px/s
BAD = 9  # what happens, happens here
SAME = "the same stamp as the frame before"

# A single stamp that is not what it should be, ns, from what it should be; and what is said.
ONE_STAMP: dict[str, tuple[Callable[[int], int], str]] = {
    "late": (lambda at: at - 7 * NS // 10, r"its stamp is 0\.2 s before that of the frame before"),
    "an hour ahead": (lambda at: at + 3600 * NS, "3600.5 s after that of the frame before"),
    "five minutes ahead": (lambda at: at + 300 * NS, "is not believed until the next"),
    "an hour behind": (lambda at: at - 3600 * NS, "3599.5 s before"),
    "none": (lambda at: 0, "before that of the frame before"),
    "before 1970": (lambda at: -5 * NS, "before that of the frame before"),
    "the year 2262": (lambda at: 2**63 - 1, "after that of the frame before"),
    "that of the frame before": (lambda at: at - NS // 2, SAME),
}


def run(pairs) -> tuple[list[FrameResult | str], list]:
    """Process images and stamps; return each result or why there is none, and the look back."""
    pipeline, results, settled = Pipeline(), [], []
    for pixels, stamp_ns in pairs:
        try:
            results.append(pipeline.process(pixels, stamp_ns))
        except ImageError as error:
            results.append(str(error))
        else:
            if results[-1].held_back is not None:
                results[-2] = results[-1].held_back
            settled += results[-1].settled
    return results, settled + pipeline.finish()


def check_sound(results, settled, truth: dict[int, np.ndarray]) -> None:
    """Nothing is confirmed that is not there, no age is negative, each frame settled once."""
    done = [one for one in results if not isinstance(one, str)]
    assert [one.frame for one in settled] == [one.frame for one in done]
    for one in done:
        assert (one.tracks["age"] >= 0).all()
        assert not one.dt_s <= 0
    live = [(one.stamp_ns, one.detections) for one in done]
    for stamp_ns, found in live + [(one.stamp_ns, one.detections) for one in settled]:
        for row in found[found["status"] == CONFIRMED]:
            (x, y), velocity = truth[stamp_ns][:2], truth[stamp_ns][2:]
            assert np.hypot(row["x"] - x, row["y"] - y) < 2
            # Two frames tell 16 px/s to one or so.
            assert np.hypot(*(velocity - (row["vx"], row["vy"]))) < 3


def truth_of(frames, stamps_ns) -> dict[int, np.ndarray]:
    names = ("x_px", "y_px", "vx_px_s", "vy_px_s")
    return {
        stamp_ns: np.array([frame.truth[0][name] for name in names])
        for frame, stamp_ns in zip(frames, stamps_ns, strict=True)
    }


def confirmed(result: FrameResult | str) -> list[int]:
    if isinstance(result, str):
        return []
    found = result.detections
    return found["track_id"][found["status"] == CONFIRMED].tolist()


@pytest.mark.parametrize("fault", ONE_STAMP)
def test_one_bad_stamp_costs_its_frame_and_nothing_else(fault: str):
    change, words = ONE_STAMP[fault]
    at = [frame.stamp_ns for frame in FRAMES]
    at[BAD] = change(at[BAD])
    results, settled = run(zip((f.image for f in FRAMES), at, strict=True))
    assert isinstance(results[BAD], str)
    assert re.search(words, results[BAD])
    assert [confirmed(one) for one in results[5:]] == [
        [] if number == BAD else [1] for number in range(5, len(FRAMES))
    ]
    assert [one.reset for n, one in enumerate(results) if n not in (0, BAD)] == [""] * (
        len(FRAMES) - 2
    )
    del at[BAD]
    check_sound(results, settled, truth_of(FRAMES[:BAD] + FRAMES[BAD + 1 :], at))


@pytest.mark.parametrize(
    ("jump_s", "reset"),
    [
        (90.0, "time jumped ahead by 90.5 s"),
        (3600.0, "time jumped ahead by 3600.5 s"),
        (-3600.0, "time ran backwards by 3599.5 s"),
    ],
)
def test_a_clock_that_is_set_starts_afresh_once(jump_s: float, reset: str):
    at = [f.stamp_ns + round(jump_s * NS) * (n >= BAD) for n, f in enumerate(FRAMES)]
    results, settled = run(zip((f.image for f in FRAMES), at, strict=True))
    # The first frame of the new time is believed with the second.
    assert [one.reset for one in results] == [
        *("first frame", *[""] * (BAD - 1)),
        *(reset, *[""] * (len(FRAMES) - BAD - 1)),
    ]
    # Within three frames of the new time, under a number that was not used before.
    assert all(confirmed(one) == [1] for one in results[5:BAD])
    assert all(confirmed(one) == [2] for one in results[BAD + 4 :])
    # The look back has the first frame of the new time, too.
    assert 2 in settled[BAD].detections["track_id"]
    check_sound(results, settled, truth_of(FRAMES, at))


@pytest.mark.parametrize("missing", [2, 8])
def test_a_camera_that_pauses_loses_no_frame(missing: int):
    """A pause of some seconds is nothing unusual: the track goes on behind it."""
    frames = sky(24, width=384)
    frames = frames[:12] + frames[12 + missing :]
    results, settled = run((frame.image, frame.stamp_ns) for frame in frames)
    assert [one.reset for one in results] == ["first frame"] + [""] * (len(frames) - 1)
    ids = {number for one in results for number in confirmed(one)}
    assert ids == {1}
    assert np.mean([confirmed(one) == [1] for one in results[5:]]) > 0.8
    check_sound(results, settled, truth_of(frames, [frame.stamp_ns for frame in frames]))


def test_a_bag_in_a_loop_is_found_again_each_time():
    frames = FRAMES[:8] * 3
    results, _ = run((f.image, f.stamp_ns) for f in frames)
    for turn in range(3):
        ids = {number for one in results[8 * turn : 8 * turn + 8] for number in confirmed(one)}
        assert ids == {turn + 1}


@pytest.mark.parametrize("fault", ["each frame twice", "two swapped", "whole seconds"])
def test_what_comes_again_or_late_or_with_coarse_stamps_is_still_detected(fault: str):
    order, unit = list(range(len(FRAMES))), 1
    if fault == "each frame twice":
        order = [number for number in order for _ in (0, 1)]
    elif fault == "two swapped":
        order[BAD], order[BAD + 1] = BAD + 1, BAD
    else:
        unit = NS
    frames = [FRAMES[number] for number in order]
    at = [frame.stamp_ns // unit * unit for frame in frames]
    results, settled = run(zip((f.image for f in frames), at, strict=True))
    left_out = [one for one in results if isinstance(one, str)]
    assert len(left_out) == (1 if fault == "two swapped" else len(frames) // 2)
    ids = {number for one in results for number in confirmed(one)}
    assert ids == {1}
    check_sound(results, settled, truth_of(frames[::-1], at[::-1]))


def test_without_stamps_nothing_is_found_and_the_reason_said():
    results, settled = run((frame.image, 0) for frame in FRAMES[:6])
    assert [confirmed(one) for one in results] == [[]] * 6
    assert all(SAME in one for one in results[1:])
    assert sum(len(one.detections) for one in settled) == 0


@pytest.mark.parametrize("ahead_s", [0.25, -0.25, 3600.0])
def test_two_cameras_on_one_topic_make_no_false_track(ahead_s: float):
    """The second one's clock is ahead: of two skies, one is followed, or none."""
    other = sky(len(FRAMES), star_count=61)
    pairs, truth = [], {}
    for one, two in zip(FRAMES, other, strict=True):
        later_ns = two.stamp_ns + round(ahead_s * NS)
        pairs += [(one.image, one.stamp_ns), (two.image, later_ns)]
        truth |= truth_of([one, two], [one.stamp_ns, later_ns])
    results, settled = run(pairs)
    check_sound(results, settled, truth)
    found = [number for one in results for number in confirmed(one)]
    assert bool(found) == (abs(ahead_s) > 1 or ahead_s < 0)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(st.integers(-(2**63), 2**63 - 1) | st.integers(0, 5 * NS), max_size=40))
def test_whatever_the_stamps_those_believed_ascend_or_a_jump_is_told(stamps_ns: list[int]):
    timeline, before_ns, missed = Timeline(), None, 0
    for stamp_ns in stamps_ns:
        try:
            jump_s = timeline.follow(stamp_ns)
        except AstrayError:
            missed += 1
            continue
        if before_ns is not None:
            assert stamp_ns != before_ns
            assert (stamp_ns > before_ns) or jump_s < 0
            # Nobody jumps on the word of a single frame.
            assert missed or not jump_s
        before_ns, missed = stamp_ns, 0
    assert before_ns is not None or not stamps_ns


def test_a_camera_that_pauses_again_and_again_loses_one_frame_in_all():
    timeline, lost = Timeline(), 0
    for burst in range(6):
        for shot in range(3):
            try:
                timeline.follow((120 * burst + shot) * NS)
            except AstrayError:
                lost += 1
    assert lost == 1


# The guide


class Faulty:
    """A guide that gets two frames with another stamp, one as the detector answers it: empty."""

    def __init__(self, guide: Guide, change: Callable[[int], int]) -> None:
        self._guide, self._change = guide, change
        self._count = 0
        self.command = guide.command

    def update(self, stamp_ns, tracks, camera) -> None:
        self._count += 1
        if self._count in (45, 66):
            stamp_ns, tracks = self._change(stamp_ns), tracks[:0] if self._count == 45 else tracks
        self._guide.update(stamp_ns, tracks, camera)


@pytest.mark.parametrize("fault", ONE_STAMP)
def test_a_mount_feels_nothing_of_one_bad_stamp(fault: str):
    change, _ = ONE_STAMP[fault]
    plant = Plant(lambda t: 0.2 * t, Faulty(engaged(), change), start_px=(0.0, 0.0))
    for t, off_px, command in plant.run(8.6):
        if t >= 4:
            assert command.state == "following"
            assert np.degrees(np.hypot(*command.mount_rate[:2])) == pytest.approx(0.2, rel=0.03)
            assert np.hypot(*off_px) < 2


@pytest.mark.parametrize("jump_s", [3600.0, 60.0, -60.0, -3600.0])
def test_a_clock_that_is_set_brings_the_mount_to_rest_and_it_follows_again(jump_s: float):
    """Of camera and guide together, as NTP does it on one machine."""
    guide = engaged()
    speeds, states = [], []
    for tick in range(240):
        at_s = tick / 20 + jump_s * (tick >= 120)
        if tick % 2 == 0:
            guide.update(ns(at_s - 0.05), rows(track(rel=(72, 0), v=(0, 0))), CAMERA)
        command = guide.command(ns(at_s))
        speeds.append(float(np.degrees(np.linalg.norm(command.mount_rate))))
        states.append(command.state)
    # Never faster than the target, and no faster to change than is allowed, 1 deg/s^2.
    assert max(speeds) < 0.21
    assert max(abs(b - a) for a, b in pairwise(speeds)) <= 0.5 + 1e-9
    assert states[-100:] == ["following"] * 100
    assert speeds[-1] == pytest.approx(0.2, rel=0.01)


def test_after_an_hour_no_other_object_is_taken_for_the_target():
    """Its own way since then leads anywhere, and so anything would lie on it."""
    guide = Guide(GuideParameters(target="id", target_id=1))
    for tick in range(41):
        guide.update(ns(tick / 10), rows(track(1, (100, 300), (50, 0), (0, 0))), CAMERA)
    for tick in range(5):
        elsewhere = rows(track(7, (400, 100), (52, 3), (0, 0)))
        guide.update(ns(3600 + tick / 10), elsewhere, CAMERA)
    command = guide.command(ns(3600.5))
    assert command.target_id == 0
    assert "track 1 is not there" in command.reason


def test_an_integral_that_would_swing_is_refused():
    with pytest.raises(ParameterError, match=r"integral_s = 5 s .* at least 8 s, or 0"):
        GuideParameters(settling_s=2.0)
    assert GuideParameters(settling_s=2.0, integral_s=0.0).integral_s == 0
    assert GuideParameters(settling_s=0.3, integral_s=1.2).integral_s == 1.2


# The nodes


def test_the_detector_leaves_out_what_is_astray_and_says_so_once(capfd):
    changes = {8: ONE_STAMP["an hour ahead"][0], 11: ONE_STAMP["none"][0]}
    sent = []
    for number, frame in enumerate(FRAMES):
        message = image(frame)
        if number in changes:
            message.header.stamp = messages.time_message(changes[number](frame.stamp_ns))
        sent += [message] * (2 if number == 6 else 1)
    with Graph("-p", "reliable_input:=true") as graph:
        graph.add(Detector(context=graph.context))
        clouds = graph.listen(PointCloud2, "rso_detections")
        tracks = graph.listen(PointCloud2, "rso_tracks")
        told = graph.listen(DiagnosticArray, "/diagnostics")
        camera = graph.publisher(Image, "image")
        graph.connect(camera)
        for message in sent:
            camera.publish(message)
            graph.serve_once()
        graph.until(lambda: len(clouds) == len(tracks) == len(sent), PATIENCE_S)
        graph.until(lambda: told and "frames_failed=3" in str(values(told[-1])), PATIENCE_S)
    # Each frame is answered, under its own stamp.
    assert stamps(clouds) == stamps(sent)
    seen = [messages.detections_array(one)["track_id"].tolist() for one in clouds]
    assert [ids for n, ids in enumerate(seen) if n > 4] == [
        [] if n in (7, 9, 12) else [1] for n in range(5, len(sent))
    ]
    ages = [messages.tracks_array(one)["age"] for one in tracks]
    assert all((age >= 0).all() for age in ages)
    said = capfd.readouterr().err
    assert said.count(f"image not processed: it has {SAME}") == 1
    assert said.count("is not believed until the next frame goes on from there") == 1


def values(array: DiagnosticArray) -> list[str]:
    return [f"{value.key}={value.value}" for value in array.status[0].values]


class Hearing:
    """A node with a talker that counts what it has taken."""

    def __init__(self, graph: Graph, node: Node) -> None:
        self.graph, self.node = graph, graph.add(node)
        self._clouds = graph.publisher(PointCloud2, "rso_detections")
        graph.connect(self._clouds)

    def send(self, *clouds: PointCloud2) -> None:
        for one in clouds:
            self._clouds.publish(one)
            self.graph.serve_once()


def test_one_bad_stamp_splits_no_file_of_tracking_data(tmp_path):
    with Graph("-p", f"output:={tmp_path / 'out'}") as graph:
        writer = Hearing(graph, TdmWriter(context=graph.context))
        bad = {5: cloud(3600), 9: cloud(-1_790_000_000), 13: cloud(11.5), 17: cloud(3600, 1)}
        sent = [
            c for k in range(25) for c in ([cloud(k, 1), bad[k]] if k in bad else [cloud(k, 1)])
        ]
        writer.send(*sent)
        graph.until(lambda: writer.node._counts["frames"] == len(sent))
        assert writer.node._counts["frames_left_out"] == len(bad)
        writer.node.close()
    (path,) = (tmp_path / "out").iterdir()
    assert path.read_text().count("ANGLE_1 =") == 25


def test_a_disk_that_hangs_holds_up_no_detection(tmp_path, monkeypatch):
    hangs = threading.Event()
    real = os.fsync
    monkeypatch.setattr("os.fsync", lambda number: (hangs.wait(2 * PATIENCE_S), real(number)))
    with Graph("-p", f"output:={tmp_path / 'out'}") as graph:
        writer = Hearing(graph, TdmWriter(context=graph.context))
        told = graph.listen(DiagnosticArray, "/diagnostics")
        writer.send(*(cloud(k, 1) for k in range(5)), *(cloud(k, 2) for k in range(5, 25)))
        graph.until(lambda: writer.node._counts["frames"] == 25, PATIENCE_S)
        graph.until(lambda: any("tracks_waiting=1" in values(one) for one in told), PATIENCE_S)
        count = len(told)
        graph.until(lambda: len(told) > count)  # the heart beats on
        assert not [name for name in tracks_of(tmp_path / "out") if name[0] != "."]
        hangs.set()
        graph.until(lambda: tracks_of(tmp_path / "out") == ["20260921T141320_1.tdm"])


def test_a_detector_that_is_started_anew_uses_no_number_twice(tmp_path, capfd):
    """Its tracks begin with 1 again; not so in the file."""
    with Graph("-p", f"output:={tmp_path / 'out'}") as graph:
        recorder = graph.add(Recorder(threading.Event(), context=graph.context))
        reliable = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        for turn in range(3):
            # Its predecessor was killed, and is missed by nobody for some time.
            detector = graph.add(Node(f"detector_{turn}", context=graph.context))
            publisher = detector.create_publisher(PointCloud2, "rso_detections", reliable)
            graph.connect(publisher)
            for k in range(5):
                publisher.publish(cloud(10 * turn + k, 1, 2))
            graph.until(lambda turn=turn: recorder._frames == 5 * (turn + 1))
        recorder.close()
    lines = (tmp_path / "out" / DETECTIONS).read_text().splitlines()[1:]
    ids = [int(line.split(",")[2]) for line in lines]
    assert ids == [1, 2] * 5 + [3, 4] * 5 + [5, 6] * 5
    said = capfd.readouterr().err
    assert said.count("another detector sends, or the same was started anew") == 2
    assert "its track 1 is 5, and so on" in said


# The command


def test_a_recording_with_bad_stamps_is_processed_and_says_what_is_left_out(tmp_path: Path):
    """The same frames as the detector leaves out, and one number for the RSO."""
    order = [*range(6), 5, *range(6, len(FRAMES))]
    bag = write_bag(tmp_path / "night", [FRAMES[n] for n in order])
    done = succeeds("process", bag, "-o", tmp_path / "out")
    words = f"frame 6 is left out, and others like it: it has {SAME}"
    assert words in " ".join(done.stderr.split())
    run_of = read_run(tmp_path / "out")
    assert (run_of["frames"], run_of["left_out"], run_of["tracks"]) == (len(FRAMES), 1, 1)
    assert any(words in problem for problem in run_of["problems"])
    assert json.dumps(run_of["problems"]).count("starts afresh") == 0


@pytest.mark.parametrize("asked_for", [True, False])
def test_a_calibration_said_once_is_heard_later_if_it_is_asked_for(asked_for: bool):
    """As docs/integration.md says; asking for it always would make all other senders warn."""
    prefix = "qos_overrides./camera_info.subscription"
    overrides = (f"{prefix}.durability:=transient_local", f"{prefix}.reliability:=reliable")
    arguments = [part for given in overrides for part in ("-p", given)] if asked_for else []
    with Graph(*arguments) as graph:
        kept = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        publisher = graph.probe.create_publisher(CameraInfo, "camera_info", kept)
        publisher.publish(camera_info())
        guide = graph.add(GuideNode(context=graph.context))
        graph.connect(publisher)
        if asked_for:
            graph.until(lambda: guide._info is not None)
        else:
            graph.serve(0.5)
            assert guide._info is None
