# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What is detected, and what is invented: the robust method beside the paper's and peers.

``python -m benchmarks.detection --bench FOLDER`` runs every method over the same sequences and
prints two Markdown tables: all sequences together, and by kind.  FOLDER holds bags with their
truth beside them as ``NAME.truth.csv``.  The first letter of a name is its kind; a name that
begins with ``R_`` is a real recording, which is a kind of its own and in no sum.  Without a
folder, the sequences are the simulator's scenarios, each a kind.  The scoring is that of
`ofsat_ros.evaluation`.

Every method runs in one thread, on frames that are in memory.  Its time is given in units of what
``paper_opencv`` takes for the same frames.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import multiprocessing
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import sep
import yaml
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.peers import sep_linking, sep_two_frames
from ofsat_ros.detection import CONFIRMED
from ofsat_ros.evaluation import (
    OUTCOME_DTYPE,
    SNR_RANGES,
    Evaluation,
    EvaluationError,
    detection_table,
    evaluate,
    merge,
    read_truth,
)
from ofsat_ros.parameters import ParameterError, Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.recordings import Frame, RecordingError, open_recording
from ofsat_ros.simulation import SCENARIOS, scenario

_REFERENCE = "paper_opencv"
_REAL = "R_"
_MANY_FRAMES = 200
_SCENARIO_FRAMES = 30  # of each scenario, if it has so many


Detections = list[NDArray[np.void]]


def run_robust(frames: Sequence[Frame], parameters: Parameters, look_back: bool) -> Detections:
    """Return the detections of each frame; with `look_back`, a track labels its earlier ones."""
    pipeline, live, settled = Pipeline(parameters), [], []
    for frame in frames:
        result = pipeline.process(frame.image, frame.stamp_ns)
        live.append(result.detections)
        settled += result.settled
    settled += pipeline.finish()
    return [last.detections for last in settled] if look_back else live


def _all_confirmed(frames: Sequence[Frame], parameters: Parameters) -> Detections:
    """All that the pipeline detects: the published methods know no tracks."""
    pipeline, found = Pipeline(parameters), []
    for frame in frames:
        detections = pipeline.process(frame.image, frame.stamp_ns).detections.copy()
        detections["status"] = CONFIRMED
        found.append(detections)
    return found


def _peer(
    method: Callable[[Sequence[NDArray[np.generic]], Sequence[int]], Detections],
    frames: Sequence[Frame],
    _: Parameters,
) -> Detections:
    return method([frame.image for frame in frames], [frame.stamp_ns for frame in frames])


@dataclass(frozen=True)
class Method:
    """A method by name: frames and the robust preset's parameters in, detections out."""

    title: str
    run: Callable[[Sequence[Frame], Parameters], Detections]
    live: bool = False


def _paper(preset: str) -> Callable[[Sequence[Frame], Parameters], Detections]:
    return lambda frames, _: _all_confirmed(frames, Parameters.preset(preset))


METHODS = {
    "robust": Method("robust, looking back", partial(run_robust, look_back=True)),
    "robust_live": Method("robust, live", partial(run_robust, look_back=False), live=True),
    "robust_dense": Method(
        "robust, dense engine, looking back",
        lambda frames, p: run_robust(frames, p.replace(engine="dense"), look_back=True),
    ),
    "paper_opencv": Method("paper, OpenCV (sparse)", _paper("paper_opencv")),
    "paper_matlab": Method("paper, MATLAB (dense)", _paper("paper_matlab")),
    "sep": Method("SExtractor (sep), two frames", partial(_peer, sep_two_frames)),
    "sep_linking": Method("SExtractor (sep), linking", partial(_peer, sep_linking)),
}


@dataclass(frozen=True)
class Source:
    """Where a sequence comes from: a bag, or a scenario if there is no folder."""

    name: str
    folder: Path | None = None

    @property
    def kind(self) -> str:
        """Its row in the table by kind."""
        return self.name if self.folder is None or self.is_real else self.name[:1]

    @property
    def is_real(self) -> bool:
        """Whether it was recorded, not rendered."""
        return self.folder is not None and self.name.startswith(_REAL)

    def load(self) -> tuple[list[Frame], NDArray[np.void]]:
        """Return the frames and their truth."""
        if self.folder is None:
            frames = min(scenario(self.name).settings.frames, _SCENARIO_FRAMES)
            simulated = list(scenario(self.name, frames=frames))
            truth = np.concatenate([frame.truth for frame in simulated])
            return [Frame(f.image, f.stamp_ns, "") for f in simulated], truth
        with open_recording(self.folder / self.name) as recording:
            return list(recording), read_truth(self.folder / f"{self.name}.truth.csv")


@dataclass(frozen=True)
class Result:
    """What one method made of one sequence."""

    source: Source
    method: str
    evaluation: Evaluation
    seconds: float


def find_sources(bench: Path | None, pattern: str, long: bool) -> list[Source]:
    """Return the sequences whose names fit, without the long ones unless asked for."""
    if bench is None:
        return [Source(name) for name in SCENARIOS if fnmatch.fnmatch(name, pattern)]
    names = [path.name.removesuffix(".truth.csv") for path in sorted(bench.glob("*.truth.csv"))]
    sources = [Source(name, bench) for name in names if fnmatch.fnmatch(name, pattern)]
    return [source for source in sources if long or _frame_count(source) <= _MANY_FRAMES]


def _frame_count(source: Source) -> int:
    assert source.folder is not None
    with open_recording(source.folder / source.name) as recording:
        return len(recording)


def run(source: Source, methods: Sequence[str], parameters: Parameters) -> list[Result]:
    """Run the methods over one sequence."""
    cv2.setNumThreads(1)
    frames, truth = source.load()
    stamps_ns = [frame.stamp_ns for frame in frames]
    results = []
    for name in methods:
        method = METHODS[name]
        start = time.perf_counter()
        found = method.run(frames, parameters)
        seconds = time.perf_counter() - start
        evaluation = evaluate(
            truth,
            detection_table(found, stamps_ns),
            frames=len(frames),
            shape=frames[0].image.shape,
            live=method.live,
            name=source.name,
        )
        results.append(Result(source, name, evaluation, seconds))
    return results


def _run_all(
    sources: Sequence[Source], methods: Sequence[str], parameters: Parameters, jobs: int
) -> list[Result]:
    work = partial(run, methods=methods, parameters=parameters)
    results: list[Result] = []
    with ExitStack() as stack:
        progress = stack.enter_context(tqdm(total=len(sources), unit=" sequences", disable=None))
        # Spawned: OpenCV's threads do not survive a fork.
        done: Iterable[list[Result]] = map(work, sources)
        if jobs > 1:
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(jobs))
            done = pool.imap(work, sources)
        for some in done:
            results += some
            progress.update()
    return results


def total_table(results: Sequence[Result]) -> str:
    """Return the Markdown table of all sequences that are not real, a row for each method."""
    results = [result for result in results if not result.source.is_real]
    kinds = [kind for kind in ("D", "E") if any(r.source.kind == kind for r in results)]
    extra = [f"in {kind}" for kind in kinds] + ["time"]
    lines = _header(["method"], extra)
    reference = _seconds(results, _REFERENCE)
    for name in _methods(results):
        own = [result for result in results if result.method == name]
        cells = [
            _number(_merged(r for r in own if r.source.kind == kind).false_alarms_per_frame)
            for kind in kinds
        ]
        ratio = _seconds(results, name) / reference if reference else float("nan")
        lines.append(_row([METHODS[name].title], _merged(own), [*cells, _number(ratio, 1)]))
    return "\n".join(lines)


def kind_table(results: Sequence[Result]) -> str:
    """Return the Markdown table with a row for each kind and method."""
    lines = _header(["kind", "method"], [])
    for kind in dict.fromkeys(result.source.kind for result in results):
        for name in _methods(results):
            own = (r for r in results if r.source.kind == kind and r.method == name)
            lines.append(_row([kind, METHODS[name].title], _merged(own), []))
    return "\n".join(lines)


def _methods(results: Sequence[Result]) -> Iterable[str]:
    return dict.fromkeys(result.method for result in results)


def _merged(results: Iterable[Result]) -> Evaluation:
    return merge(result.evaluation for result in results)


def _seconds(results: Iterable[Result], method: str) -> float:
    return sum(result.seconds for result in results if result.method == method)


def _header(first: list[str], extra: list[str]) -> list[str]:
    ranges = [f">= {low:g}" if np.isinf(high) else f"{low:g}-{high:g}" for low, high in SNR_RANGES]
    ranges[0] = f"SNR {ranges[0]}"
    alarms = [name for name in extra if name.startswith("in ")]
    rest = [name for name in extra if not name.startswith("in ")]
    names = [*first, *ranges, "precision", "false alarms/frame", *alarms, "centroid rms, px"]
    names += ["velocity, median px/frame", "objects", *rest]
    return ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]


def _row(first: list[str], evaluation: Evaluation, extra: list[str]) -> str:
    """One line; of the extra cells, the last is the time and the others are false alarms."""
    cells = [*first, *(_number(evaluation.recall(*limits)) for limits in SNR_RANGES)]
    cells += [_number(evaluation.precision), _number(evaluation.false_alarms_per_frame)]
    cells += [*extra[:-1], _number(evaluation.centroid_rms_px)]
    cells += [_number(evaluation.velocity_error_px())]
    cells += ["{} of {}".format(*evaluation.objects), *extra[-1:]]
    return "| " + " | ".join(cells) + " |"


def _number(value: float, digits: int = 2) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def write_outcomes(path: Path, results: Iterable[Result]) -> None:
    """Write what became of every truth and detection as CSV, to be looked at."""
    names = [name for name in OUTCOME_DTYPE.names or () if name != "sequence"]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "sequence", *names])
        for result in results:
            rows = result.evaluation.outcomes[names].tolist()
            writer.writerows([result.method, result.source.name, *row] for row in rows)


def _settings(pairs: Iterable[str]) -> Iterator[tuple[str, Any]]:
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise ParameterError(f"--set takes NAME=VALUE, not {pair!r}")
        yield name, yaml.safe_load(value)


def _options() -> tuple[argparse.ArgumentParser, argparse.Namespace]:
    parser = argparse.ArgumentParser(description="Compare what methods detect and invent.")
    parser.add_argument("--bench", type=Path, metavar="FOLDER", help="bags with truth")
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="METHOD",
        help="of %(choices)s; default: all",
    )  # fmt: skip
    parser.add_argument("--sequences", default="*", metavar="GLOB", help="those of these names")
    parser.add_argument(
        "--long", action="store_true", help=f"those of more than {_MANY_FRAMES} frames as well"
    )
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="NAME=VALUE", help="parameters of robust to change"
    )
    parser.add_argument("--jobs", type=int, default=1, help="sequences at a time")
    parser.add_argument("--outcomes", type=Path, help="CSV file for every miss, false alarm, ...")
    return parser, parser.parse_args()


def main() -> None:
    """Print the tables."""
    parser, options = _options()
    try:
        parameters = Parameters.preset("robust", **dict(_settings(options.set)))
        sources = find_sources(options.bench, options.sequences, options.long)
        if not sources:
            parser.error(
                f"no sequence {options.sequences!r} in {options.bench or 'the simulator'}"
            )
        results = _run_all(sources, options.methods, parameters, options.jobs)
    except (ParameterError, RecordingError, EvaluationError, OSError) as error:
        parser.error(str(error))
    if options.outcomes:
        write_outcomes(options.outcomes, results)
    real = sum(source.is_real for source in sources)
    print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, OpenCV {cv2.__version__},"
        f" sep {sep.__version__}; {len(sources) - real} simulated sequences and {real} real ones\n"
    )
    if real < len(sources):
        print(total_table(results), end="\n\n")
    print(kind_table(results))


if __name__ == "__main__":
    main()
