"""The benchmarks run, and say what their tables claim."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_the_papers_scenes():
    told = run("paper", "--frames", "8", "--brightness", "1")
    assert cells(told, "robust, sparse")[1:4] == ["5 of 5", "35 of 35", "0.00"]
