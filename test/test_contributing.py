# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What contributors are given works: reference, comparison, pre-commit, container."""

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from command import environment

from benchmarks import compare
from ofsat_ros.evaluation import FALSE_ALARM, FOUND, MISSED, OUTCOME_DTYPE, Evaluation

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def declared() -> dict[str, list[str]]:
    """What docs/api.md declares public."""
    reference = runpy.run_path(f"{ROOT / 'docs' / 'reference.py'}")
    return reference["declared"]((ROOT / "docs" / "api.md").read_text())


def test_reference_has_each_public_name(declared: dict[str, list[str]], tmp_path: Path) -> None:
    # In a process of its own: it narrows the modules to what is public.
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "reference.py", tmp_path],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert len(declared) > 10
    for module, names in declared.items():
        page = (tmp_path / "ofsat_ros" / f"{module}.html").read_text()
        shown = re.findall(r'<section id="(\w+)">', page)
        assert sorted(shown) == sorted(names)
    pages = {path.stem for path in (tmp_path / "ofsat_ros").iterdir()}
    assert pages == set(declared)


def test_examples_use_public_names_only(declared: dict[str, list[str]]) -> None:
    used = re.findall(
        r"^from ofsat_ros\.(\w+) import (.+)$", (ROOT / "docs/integration.md").read_text(), re.M
    )
    assert len(used) > 0
    for module, names in used:
        assert set(names.split(", ")) <= set(declared[module])


def git(folder: Path, *arguments: str) -> str:
    person = ("-c", "user.name=somebody", "-c", "user.email=somebody@example.org")
    done = subprocess.run(
        ["git", *person, *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository of three commits, the last of which leaves the package alone."""
    # git in a hook of another repository is told of that one.
    for name in [name for name in os.environ if name.startswith("GIT_")]:
        monkeypatch.delenv(name)
    folder = tmp_path / "repository"
    (folder / "ofsat_ros").mkdir(parents=True)
    git(folder, "init", "--quiet")
    for number, file in enumerate(("ofsat_ros/a.py", "ofsat_ros/a.py", "README.md")):
        (folder / file).write_text(f"{number}\n")
        git(folder, "add", ".")
        git(folder, "commit", "--quiet", "--message", f"{number}")
    monkeypatch.setattr(compare, "ROOT", folder)
    return folder


def test_comparison_is_with_what_was_before_the_last_change(repository: Path) -> None:
    assert compare.earlier() == git(repository, "rev-parse", "HEAD~2")
    (repository / "ofsat_ros" / "a.py").write_text("changed\n")
    assert compare.earlier() == git(repository, "rev-parse", "HEAD")
    git(repository, "tag", "0.1.0", "HEAD~1")
    assert compare.earlier() == "0.1.0"


def test_comparison_checks_out_beside_the_repository(repository: Path, tmp_path: Path) -> None:
    compare.check_out("HEAD~2", tmp_path / "earlier")
    assert (tmp_path / "earlier" / "ofsat_ros" / "a.py").read_text() == "0\n"
    assert git(repository, "status", "--porcelain") == ""


def test_comparison_says_why_there_is_none(repository: Path, tmp_path: Path) -> None:
    with pytest.raises(compare.CompareError, match="git archive"):
        compare.check_out("no_such_revision", tmp_path / "earlier")
    compare.check_out("HEAD", tmp_path / "earlier")
    with pytest.raises(compare.CompareError, match="earlier does not run: "):
        compare.process(tmp_path / "earlier", tmp_path / "bag", tmp_path / "out")


def test_comparison_of_a_tree_with_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare, "_FRAMES", 8)
    monkeypatch.setattr(compare, "_ROUNDS", 1)
    (before, now) = compare.compare([ROOT, ROOT], ["slow"], tmp_path)["slow"]
    assert before.rows == now.rows
    assert before.score.count(FOUND) == now.score.count(FOUND) > 10
    assert before.cpu_s > 0.2  # what Python and its libraries take to start


def test_comparison_as_a_table() -> None:
    rows = np.zeros(4, OUTCOME_DTYPE)
    rows["outcome"] = [FOUND, FOUND, FOUND, MISSED]
    before = compare.Run(Evaluation(rows, 8, ("slow",)), 2.0, ["row"])
    worse = rows.copy()
    worse["outcome"][2] = FALSE_ALARM
    now = compare.Run(Evaluation(worse, 8, ("slow",)), 3.0, ["another"])
    told = compare.table({"slow": [before, now], "fast": [before, before]}).splitlines()
    cells = {line.split(" | ")[0].strip("| "): line.split(" | ")[1:] for line in told}
    assert cells["slow"][:3] == ["0.750 to 0.667", "1.000 to 0.667", "0 to 1"]
    assert cells["slow"][4:] == ["2.00 to 3.00", "1.50", "differs |"]
    assert cells["fast"][4:] == ["2.00", "1.00", "the same |"]
    assert cells["all"][:1] + cells["all"][4:6] == ["0.750 to 0.714", "4.00 to 5.00", "1.25"]


def test_before_a_commit_runs_what_lint_runs() -> None:
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    (local,) = config["repos"]
    assert local["repo"] == "local"
    assert {hook["language"] for hook in local["hooks"]} == {"system"}  # nothing to download
    entries = [shlex.split(hook["entry"]) for hook in local["hooks"]]
    lint = (ROOT / "Makefile").read_text().partition("\nlint: ")[2].partition("\n\n")[0]
    commands = [shlex.split(line) for line in re.findall(r"\$\(BIN\)/(.+)", lint)]
    assert [entry[0] for entry in entries] == [f".venv/bin/{command[0]}" for command in commands]
    assert [entry[1:2] for entry in entries] == [command[1:2] for command in commands]


def test_container_is_made_of_what_is_here() -> None:
    settings = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    recipe = ROOT / ".devcontainer" / settings["build"]["dockerfile"]
    context = recipe.parent / settings["build"]["context"]
    assert context.resolve() == ROOT
    lines = recipe.read_text().splitlines()
    assert "FROM ros:jazzy" in lines
    copied = [line.split()[1] for line in lines if line.startswith("COPY ")]
    assert copied == ["package.xml"]
    assert settings["workspaceFolder"] in settings["workspaceMount"]
