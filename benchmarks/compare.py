# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The present tree beside an earlier version of itself: what is found, and what it costs.

``python -m benchmarks.compare [REVISION]`` runs ``ofsat process`` of both over the same simulated
skies, made by this tree, and prints a Markdown table.  Without a revision, it is the last tag; if
there is none, what was before the last change of ``ofsat_ros/``.  It is a report and no gate: what
a difference means is for the reader to say.

Times are those of the processor, at their best of `_ROUNDS`, in turns: other load hardly moves
their ratio.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from tqdm import tqdm

from ofsat_ros.cli import main as ofsat
from ofsat_ros.evaluation import (
    FALSE_ALARM,
    Evaluation,
    count_frames,
    evaluate,
    merge,
    read_detections,
    read_truth,
)
from ofsat_ros.results import DETECTIONS

ROOT = Path(__file__).parents[1]
# Bright and faint, fast and slow, under a good sky and a bad one.
_SCENES = ("slow", "fast", "clouds", "ugly")
_SEED = 3
_FRAMES = 24
_ROUNDS = 2
_PATIENCE_S = 300.0


class CompareError(RuntimeError):
    """There is nothing to compare with, or it does not run."""


@dataclass(frozen=True)
class Run:
    """What a version made of a scene: its score, its processor time, its rows of detections."""

    score: Evaluation
    cpu_s: float
    rows: list[str]


def git(*arguments: str) -> str:
    """Return what git prints in this repository."""
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)
    except FileNotFoundError:
        raise CompareError("there is no git here") from None
    if done.returncode:
        raise CompareError(f"git {arguments[0]}: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout.strip()


def earlier() -> str:
    """Return the revision to compare with if none is asked for.

    Raises
    ------
    CompareError
        If this is no repository, or has no earlier commit, as a shallow copy.
    """
    if tags := git("tag", "--sort=-creatordate", "--merged"):
        return tags.splitlines()[0]
    if git("status", "--porcelain", "--", "ofsat_ros"):
        return git("rev-parse", "HEAD")
    return git("rev-parse", git("rev-list", "-1", "HEAD", "--", "ofsat_ros") + "^")


def check_out(revision: str, folder: Path) -> None:
    """Write the tree of a revision into a folder, and leave the repository as it is."""
    archive = folder.with_suffix(".tar")
    git("archive", f"--output={archive}", revision, "--", "ofsat_ros")
    folder.mkdir()
    subprocess.run(["tar", "-xf", archive, "-C", folder], check=True)


def process(tree: Path, bag: Path, folder: Path) -> float:
    """Let the version in `tree` process a bag; return its processor time, s."""
    command = [sys.executable, "-m", "ofsat_ros.cli", "process", bag, "-o", folder]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [*map(str, command), "--no-report", "--force"],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": f"{tree}"},
        capture_output=True,
        text=True,
        timeout=_PATIENCE_S,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise CompareError(f"{tree.name} does not run: {done.stderr.strip().splitlines()[-1]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compare(trees: Sequence[Path], scenes: Sequence[str], work: Path) -> dict[str, list[Run]]:
    """Return of each scene what each tree made of it."""
    runs = {}
    for scene in tqdm(scenes, desc="comparing", disable=None):
        bag = work / scene
        options = ["--scenario", scene, "--seed", f"{_SEED}", "--frames", f"{_FRAMES}"]
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            ofsat(["simulate", "-o", f"{bag}", *options], standalone_mode=False)
        truth = read_truth(work / f"{scene}.truth.csv")
        folders = [work / f"{scene}_{number}" for number in range(len(trees))]
        pairs = list(zip(trees, folders, strict=True))
        times = [[process(tree, bag, folder) for tree, folder in pairs] for _ in range(_ROUNDS)]
        runs[scene] = [
            Run(
                evaluate(truth, read_detections(folder), frames=count_frames(folder), name=scene),
                min(cpu_s),
                sorted((folder / DETECTIONS).read_text().splitlines()),
            )
            for folder, cpu_s in zip(folders, zip(*times, strict=True), strict=True)
        ]
    return runs


def table(runs: Mapping[str, Sequence[Run]]) -> str:
    """Return the comparison as a Markdown table; of two values, the earlier tree's and this."""
    lines = [
        "| sky | recall | precision | false alarms | centroid rms, px | processor, s | ratio"
        " | rows |",
        "|---|---|---|---|---|---|---|---|",
        *(_line(scene, *pair) for scene, pair in runs.items()),
    ]
    if len(runs) > 1:
        lines.append(_line("all", *map(_together, zip(*runs.values(), strict=True))))
    return "\n".join(lines)


def _together(runs: Sequence[Run]) -> Run:
    scores, times, rows = zip(*((run.score, run.cpu_s, run.rows) for run in runs), strict=True)
    return Run(merge(scores), sum(times), [row for each in rows for row in each])


def _line(name: str, before: Run, now: Run) -> str:
    both = (before.score, now.score)
    cells = [
        name,
        _pair(".3f", *(score.recall() for score in both)),
        _pair(".3f", *(score.precision for score in both)),
        _pair("d", *(score.count(FALSE_ALARM) for score in both)),
        _pair(".3f", *(score.centroid_rms_px for score in both)),
        _pair(".2f", before.cpu_s, now.cpu_s),
        f"{now.cpu_s / before.cpu_s:.2f}",
        "the same" if before.rows == now.rows else "differs",
    ]
    return f"| {' | '.join(cells)} |"


def _pair(form: str, before: float, now: float) -> str:
    texts = (f"{before:{form}}", f"{now:{form}}")
    return texts[0] if texts[0] == texts[1] else " to ".join(texts)


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("revision", nargs="?", help="commit or tag to compare with")
    parser.add_argument("--scenes", nargs="+", default=_SCENES, metavar="NAME")
    options = parser.parse_args()
    try:
        revision = options.revision or earlier()
        with tempfile.TemporaryDirectory(prefix="ofsat_compare_") as name:
            work = Path(name)
            check_out(revision, work / "earlier")
            print(f"compare: {git('log', '-1', '--format=%h, %cs, %s', revision)}; and this tree")
            print(table(compare([work / "earlier", ROOT], options.scenes, work)))
    except (CompareError, subprocess.TimeoutExpired) as error:
        sys.exit(f"compare: NOT COMPARED: {error}")


if __name__ == "__main__":
    main()
