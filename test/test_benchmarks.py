# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The benchmarks run, and say what their tables claim."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rclpy

from benchmarks import engines, speed, throughput

ROOT = Path(__file__).parents[1]


def run(module: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{module}", *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def cells(text: str, name: str) -> list[str]:
    """The cells of the first row that begins with a name."""
    (line, *_) = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_engines_beside_the_bound():
    for name, method in engines.METHODS.items():
        stars, whole = engines.compare(method, 50.0, np.array([0.37, -0.61]), 1)
        # Two frames allow 0.04 px per axis; 8 bits over the whole range cost `paper_opencv` most.
        assert len(stars) > 100, name
        assert 0.04 < np.sqrt(np.mean(stars**2)) < 0.2
        assert np.linalg.norm(whole) < 0.1
    far = np.array([40.0, 30.0])
    assert (
        np.linalg.norm(engines.compare(engines.METHODS["`robust`, sparse"], 50.0, far, 1)[1]) < 0.1
    )


def test_detection_beside_its_peers():
    methods = ("--methods", "robust", "robust_live", "paper_opencv", "sep", "sep_linking")
    told = run("detection", "--sequences", "slow", "--jobs", "1", *methods)
    # Of the scenario's brightest, all; of the published method, an RSO here and there.
    assert float(cells(told, "robust, looking back")[1]) >= 0.95
    assert float(cells(told, "robust, looking back")[5]) >= 0.95  # precision
    assert float(cells(told, "paper, OpenCV (sparse)")[5]) < 0.5
    assert "SExtractor (sep), two frames" in told
    assert "SExtractor (sep), linking" in told


def test_detection_takes_only_what_there_is(tmp_path: Path):
    with pytest.raises(AssertionError, match="no sequence"):
        run("detection", "--bench", f"{tmp_path}")


def test_sensitivity_at_the_ends_of_its_curve():
    told = run("sensitivity", "--seeds", "1", "--snr", "2", "20", "--jobs", "1")
    assert float(cells(told, "2")[1]) < 0.3
    assert float(cells(told, "20")[1]) > 0.8


def test_few_stars_of_one_kind():
    told = run("few_stars", "--seeds", "2", "--stars", "64", "--jobs", "1")
    for pointing in ("stands still", "drifts"):
        _, stars, found, live, false, false_live = cells(told, pointing)
        assert stars == "64"
        assert min(float(found), float(live)) > 0.9
        assert max(float(false), float(false_live)) < 0.05


def test_optics_of_one_row():
    told = run("optics", "--seeds", "1", "--rows", "3", "--jobs", "1")
    _, name, value, before, after, _ = cells(told, "FWHM 1.0 px, RSOs at rest")
    assert (name, value) == ("`hot_pixels`", "keep")
    # Stars that look like defects: a third of the RSOs is found, and nine tenths.
    assert float(after) > float(before) + 0.3


def test_the_papers_scenes():
    told = run("paper", "--frames", "8", "--brightness", "1")
    assert cells(told, "robust, sparse")[1:4] == ["5 of 5", "35 of 35", "0.00"]


SKY = speed.Sky(256, 192, 40)


@pytest.fixture
def rendered(tmp_path: Path) -> Path:
    speed.render(tmp_path, SKY, speed._FRAMES)
    return tmp_path


def test_speed_of_one_row(rendered: Path):
    row = speed.alone(speed.measure, rendered, SKY, "robust")
    assert len(row.ours) == speed._MEASURED
    assert row.ratio == pytest.approx(sorted(row.ours)[1:3][0] / row.sep, rel=1)
    assert 0 < row.copy < row.sep
    assert sum(row.stages.values()) < 1.5 * max(row.ours)
    # NumPy, OpenCV and SciPy alone take more than 50 MB; frames of this size, next to nothing.
    assert 50e6 < row.peak < 400e6
    assert 20 < row.objects < 80
    (cells_of_row,) = speed._speed_table({"sky": row}).splitlines()[2:]
    assert cells_of_row.startswith("| sky | ")
    head, _, stages = speed._stage_table({"sky": row}).splitlines()
    assert head.count("|") == stages.count("|") == 2 + len(row.stages)


def test_four_skies_move_alike(rendered: Path):
    from ofsat_ros.pipeline import Pipeline

    fourfold = speed.Sky(512, 384, 160, fourfold=True)
    assert fourfold.rendered == SKY
    one, four = Pipeline(), Pipeline()
    for number in range(4):
        small, large = (speed.load(rendered, sky, number) for sky in (SKY, fourfold))
        assert large.shape == (384, 512)
        single = one.process(small, speed.stamp_ns(number))
        both = four.process(large, speed.stamp_ns(number))
    assert single.star_field.star_count > 20
    assert both.star_field.star_count > 3 * single.star_field.star_count
    # Along x; the mirrored parts would otherwise be no stars of this field.
    assert both.star_field.displacement == pytest.approx(single.star_field.displacement, abs=0.05)


def test_memory_and_command(rendered: Path):
    after, peak = speed.alone(speed.memory, rendered, SKY, 55, 6)
    assert set(after) == {50, 51, 52, 53, 55}
    assert all(50e6 < size <= 1.01 * peak for size in after.values())
    read_s, process_s, command_s = speed.alone(speed.process_bag, rendered, SKY)
    assert 0 < read_s < process_s
    assert command_s > 0


@pytest.mark.alone
def test_frames_over_dds(tmp_path: Path):
    speed.render(tmp_path, SKY, 6, (0.0, 0.0))
    rclpy.init()
    try:
        said, sent, frame_s = throughput.overhead(tmp_path, SKY)
        assert "beside `process`" in said
        assert "nan" not in said
        assert "`rso_detections`" in sent
        assert 0 < frame_s < 1
        told = throughput.replay(tmp_path, SKY, 20)
        assert told.startswith("0 lost, 0 repeated, in order; ")
    finally:
        rclpy.shutdown()
