# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The long night's benchmark tells growth, false tracks and lost frames from their absence."""

import itertools
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rclpy

from benchmarks.soak import alone, graph, night
from benchmarks.soak.watching import Held, growth, own_segments

SIDE, ROUND = 128, 64


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("night")
    night.render(place, SIDE, ROUND)
    return place


def test_the_sky_comes_round_without_a_jump(folder: Path):
    sky = night.Night.load(folder)
    assert sky.images.shape == (ROUND, SIDE, SIDE)
    # Once around in one round: the frame after the last is the first again.
    assert sky.drift_px * ROUND == SIDE
    assert np.array_equal(sky.image(ROUND), sky.image(0))
    assert not np.array_equal(sky.image(1), sky.image(0))
    # Where an RSO is said to be, something shines; in the cloud there is nothing.
    for number in (3, ROUND - 3):
        xy, sure = sky.rsos(number)
        image = sky.image(number)
        for x, y in np.rint(xy[sure]).astype(int):
            assert image[y - 1 : y + 2, x - 1 : x + 2].mean() > np.median(image) + 500
    _, sure = sky.rsos(186 * ROUND // night.ROUND)
    assert not sure.any()


def test_a_short_night_holds_nothing_more(folder: Path):
    soak = alone.Soak(night.Night.load(folder))
    blocks = list(soak.run(140, 20))
    assert [block.last for block in blocks] == [20, 40, 60, 80, 100, 120, 140]
    assert sum(block.found for block in blocks) >= 0.9 * sum(block.sure for block in blocks) > 0
    assert all(len(block.seconds) == 20 for block in blocks)
    # Every disturbance was there, and left nothing behind: not one object for each frame.
    assert not soak.more
    assert growth([block.resident for block in blocks[1:]]) < 5e6
    assert "more objects alive: nothing" in alone.said(soak)


def test_what_grows_is_named(folder: Path):
    class Kept:
        def __init__(self, result: object) -> None:
            self.result = result

    soak = alone.Soak(night.Night.load(folder))
    process, kept = soak._pipeline.process, []

    def keeping(*arguments):
        kept.extend(Kept(number) for number in range(10))
        return process(*arguments)

    soak._pipeline.process = keeping
    list(soak.run(75, 15))
    # After the second block, 3 of 15 frames and a disturbance or two.
    assert 450 <= soak.more["Kept"] <= 500
    assert "Kept" in alone.said(soak)


def test_false_tracks_are_counted():
    block = alone.Block(10, [0.1], 4, 3, {1: True, 2: False})
    assert block.false_tracks == 1
    assert f"{block}".endswith("| 0.750 | 1 of 2 |")


def test_a_long_bag(folder: Path, tmp_path: Path):
    for name in ("images.npy", "truth.npz"):
        (tmp_path / name).symlink_to(folder / name)
    *_, said = alone.process(tmp_path, 40, samples=2)
    assert said.startswith("\nexit code 0; 40 frames, ")


def test_growth_is_that_of_the_halves():
    assert growth([1.0, 1.0, 9.0, 3.0, 3.0, 3.0]) == 2.0
    assert growth([5.0]) == 0.0


def test_own_segments_are_those_of_the_process():
    code = "import rclpy; rclpy.init(); n = rclpy.create_node('n'); print(1, flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        process.stdout.readline()
        names = own_segments(process.pid)
        assert Held.by(process.pid).threads > 1
    finally:
        graph._bury(process)
        process.stdin.close()
        process.stdout.close()
    assert names
    assert all(name.startswith("fastrtps_") and "port" not in name for name in names)
    assert not any(Path("/dev/shm", name).exists() for name in names)


@pytest.mark.alone
def test_a_night_over_dds(folder: Path, tmp_path: Path):
    for name in ("images.npy", "truth.npz"):
        (tmp_path / name).symlink_to(folder / name)
    rclpy.init()
    try:
        with graph.Observatory(tmp_path, 2.0) as observatory:
            quiet = observatory.watch("quiet", 3.0)
            with graph.viewer(0.0) as viewer:
                viewer.send_signal(signal.SIGSTOP)
                stopped = observatory.watch("a viewer is stopped", 2.0)
            assert observatory.ears.again == 0
    finally:
        rclpy.shutdown()
    for phase in (quiet, stopped):
        assert phase.sent == phase.answered > 0
        assert (phase.lost, phase.dropped) == (0, 0)
    assert set(quiet.held) == {"detector", "guide", "tdm_writer", "recorder"}
    cells = f"{quiet}".strip("| ").split(" | ")
    assert cells[:3] == ["quiet", f"{quiet.sent}", f"{quiet.sent}"]
    assert len(cells) == graph.HEAD.splitlines()[0].count("|") - 1
    # All have ended in order, and the recorder's bag is whole.
    assert "0 lost" not in (tmp_path / "tdm_writer.out").read_text()
    assert "the bag results are in" in (tmp_path / "recorder.out").read_text()
    assert list(itertools.chain((tmp_path / "record").glob("results/*.mcap")))
