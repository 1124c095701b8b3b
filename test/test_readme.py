"""What README and docs say is so: every command runs, tables and pictures are the present ones.

A command of a kind that another test runs, or CI itself, is only checked for what it names.
"""

import os
import re
import runpy
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from ros_graph import Process

from ofsat_ros.parameters import Parameters
from ofsat_ros.results import DETECTION_COLUMNS, STAR_FIELD_COLUMNS, TRACK_COLUMNS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
INTEGRATION = (ROOT / "docs" / "integration.md").read_text()
# Ready when it has said this.
READY = {
    "detector": "waiting for images on",
    "player": "waiting for 1 subscriber",
    "recorder": "recording into",
    "simulator": "px every",
    "guide": "waiting for tracks on",
    "tdm_writer": "writing the tracks of",
}
# What only a machine with ROS from apt can do, and what the tests of colcon and launch do.
ELSEWHERE = ("rosdep install", "pip install", "colcon build", "source install", "ros2 launch")


def commands(text: str) -> list[str]:
    """Every line of the shell blocks."""
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    return [line for block in blocks for line in block.strip().splitlines()]


def starting(prefix: str) -> list[str]:
    found = [line for line in commands(README) if line.startswith(prefix)]
    assert found, prefix
    return found


def installed(text: str) -> str:
    """The command with paths of this tree for those of a workspace."""
    text = text.replace("install/ofsat_ros/share/ofsat_ros/config", f"{ROOT}/ofsat_ros/presets")
    return text.replace("src/ofsat_ros/", f"{ROOT}/")


def test_every_command_is_of_a_kind_that_is_run() -> None:
    kinds = ("make ", ".venv/bin/ofsat ", "ros2 run ofsat_ros ", "ros2 param set", *ELSEWHERE)
    assert [line for line in commands(README) if not line.startswith(kinds)] == []


def test_make_targets_are_what_ci_runs() -> None:
    ci = (ROOT / ".ci" / "run").read_text()
    assert [line for line in starting("make ") if line not in ci] == []


def test_ofsat_commands_run(tmp_path: Path) -> None:
    (tmp_path / "bags").symlink_to(ROOT / "bags")
    for line in starting(".venv/bin/ofsat "):
        arguments = shlex.split(line)[1:]
        done = subprocess.run(
            [sys.executable, "-m", "ofsat_ros.cli", *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=100,
        )
        assert done.returncode == 0, (line, done.stderr)
    assert (tmp_path / "night1" / "detections.csv").stat().st_size > 1000
    assert (tmp_path / "my_sky.truth.csv").exists()


@pytest.mark.parametrize("line", starting("ros2 run ofsat_ros "))
def test_ros2_run_commands_start_and_stop(line: str, tmp_path: Path) -> None:
    node, *arguments = shlex.split(installed(line))[3:]
    # What it writes shall not land in the tree.
    arguments = [a.replace("output:=", f"output:={tmp_path}/") for a in arguments]
    with Process(tmp_path, node, *arguments) as process:
        process.wait_for(READY[node])
        process.popen.send_signal(signal.SIGINT)
        assert process.wait() == 0, process.err
        assert "Traceback" not in process.err


@pytest.mark.parametrize("line", starting("ros2 param set"))
def test_ros2_param_commands_name_live_parameters(line: str) -> None:
    name, value = shlex.split(line)[4:]
    (about,) = (p for p in Parameters.describe() if p.name == name)
    assert about.live
    assert about.check(float(value) if isinstance(about.default, float) else value)


@pytest.mark.parametrize("line", starting("ros2 launch"))
def test_launch_commands_name_files_and_arguments(line: str) -> None:
    file, *arguments = shlex.split(line)[3:]
    text = (ROOT / "launch" / file).read_text()
    for argument in arguments:
        assert f'"{argument.split(":=")[0]}"' in text


def test_python_example_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    (code,) = re.findall(r"```python\n(.*?)```", INTEGRATION, re.S)
    exec(compile(code, "docs/integration.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) > 20


def test_table_of_parameters_is_the_present_one() -> None:
    generate = runpy.run_path(f"{ROOT}/docs/generate.py")
    assert generate["with_table"](README) == README, "run python docs/generate.py"


def test_columns_of_files_are_the_present_ones() -> None:
    text = " ".join(INTEGRATION.split())
    assert ", ".join(DETECTION_COLUMNS) in text
    assert ", ".join(STAR_FIELD_COLUMNS) in text
    assert ", ".join(TRACK_COLUMNS) in text


def test_pictures_are_the_present_ones() -> None:
    generate = runpy.run_path(f"{ROOT}/docs/generate.py")
    for file, *what in generate["PICTURES"]:
        kept = cv2.imread(str(ROOT / "docs" / "images" / file))
        made = generate["picture"](*what)
        # Other versions of OpenCV draw and filter a little otherwise.
        different = np.mean(np.abs(kept.astype(int) - made).max(axis=2) > 60)
        assert different < 0.01, f"{file}: run python docs/generate.py"


def test_links_lead_somewhere() -> None:
    pages = [path.relative_to(ROOT) for path in (ROOT / "docs").glob("*.md")]
    for page in ("README.md", "bags/README.md", *pages):
        text = (ROOT / page).read_text()
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
            assert (ROOT / page).parent.joinpath(target).exists(), (page, target)
