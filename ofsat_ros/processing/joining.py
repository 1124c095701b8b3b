# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Segments joined: result folders of overlapping segments become one, as of one run.

One run hands over to the next where both tell the same, the same RSOs at the same places, for so
many frames that neither knows of a track that the other doesn't.  Where they never do (the first
follows a faint RSO that the second cannot find anew), the first is run again, and on, until they
do, or the recording ends.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.processing.job import SOURCE, Job, write_arcs
from ofsat_ros.processing.output import Output
from ofsat_ros.processing.run import Watch
from ofsat_ros.processing.segments import RunOfSegment, Segment, by_frame
from ofsat_ros.results import STAR_FIELD, ResultError, ResultWriter, read_run, write_run

# What two runs find within this of each other is the same, px: the noise of what is faintest is
# more, and what rounding makes of it less.
_SAME_PX = 0.1
_SKIPPED, _MOST_SKIPPED = " skipped: ", 10
_ALIKE = ("others like it", "others may be alike")

Rows = NDArray[np.void]


@dataclass(frozen=True)
class _Seam:
    """Where a segment is handed over to another, and which of their tracks are the same.

    `same` is the number of a track in the second run to that in the first.
    """

    frame: int
    same: dict[int, int]


def join(
    folders: Sequence[Path],
    segments: Sequence[Segment],
    into: Path,
    say: Callable[[str], None] = lambda line: None,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Join the results of a recording's segments.

    Parameters
    ----------
    folders : sequence of Path
        Where `Job.run` has written each segment's.
    segments : sequence of Segment
        In their order.
    into : Path
        An existing folder, for the tables and ``run.json``.
    say : callable, optional
        Takes lines for the user.
    watch : callable, optional
        If a segment is run again: see `Job.run`.

    Returns
    -------
    dict
        What ``run.json`` says.

    Raises
    ------
    ResultError
        If a folder does not hold the whole of its segment.
    RecordingError, OSError
        If a file cannot be read, or written.
    """
    runs = [_read_run(folder) for folder in folders]
    job = _job_of(runs[0])
    arcs = job.make_arcs()
    output = Output(arcs, say)
    with ExitStack() as stack:
        output.writer = stack.enter_context(ResultWriter(into))
        again = _Again(job, into / "again", watch)
        stack.callback(again.remove)
        said, problems = set(), []
        for part, track_ids in _parts(folders, segments, runs, job.settling, again):
            for note in part.about["notes"]:
                if (what := _without_numbers(note)) not in said:
                    said.add(what)
                    output.note(note)
            _copy(part, track_ids, output)
            problems += part.about["problems"]
            output.totals.add_profile(_read_run(part.folder)["profile"])
        output.totals.left_out = part.about["reached"] - output.totals.frames
        output.end(_distinct(problems))
        output.tell_unlocated(part.about["calibrated"], part.about["missing"])
        about = {name: value for name, value in runs[0].items() if name != "segment"}
        about["files"] = [*runs[0]["files"], *write_arcs(arcs, into, job.formats, output.note)]
        about |= output.totals.as_dict()
        about["seconds"] = sum(run["seconds"] for run in runs)
        write_run(into, about)
    return about


def _read_run(folder: Path) -> dict[str, Any]:
    run = read_run(folder)
    if run.get("segment") is None or run["stopped"]:
        raise ResultError(f"{folder} does not hold the whole of a segment: process it again")
    return run


def _job_of(run: dict[str, Any]) -> Job:
    """The job of the whole recording."""
    paths = run["recording"]
    return Job(
        paths=(paths,) if isinstance(paths, str) else tuple(paths),
        source={name: run[name] for name in SOURCE},
        preset=run["preset"],
        parameters=run["parameters"],
        formats=tuple(run["segment"]["formats"]),
        live=run["live"],
    )


class _Again:
    """Runs segments again, and on."""

    def __init__(self, job: Job, folder: Path, watch: Watch | None) -> None:
        self._job, self._folder, self._watch = job, folder, watch
        self._count = 0

    def run(self, segment: Segment) -> RunOfSegment:
        folder = self._folder / f"{self._count}"
        self._count += 1
        folder.mkdir(parents=True)
        replace(self._job, segment=segment).run(folder, lambda line: None, self._watch)
        return RunOfSegment.read(folder, segment, _read_run(folder)["segment"])

    def remove(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


def _parts(
    folders: Sequence[Path],
    segments: Sequence[Segment],
    runs: Sequence[dict[str, Any]],
    settling: int,
    again: _Again,
) -> Iterator[tuple[RunOfSegment, _TrackIds]]:
    """Yield what of each segment counts, and what turns its numbers of tracks into the whole's."""

    def read(index: int) -> RunOfSegment:
        return RunOfSegment.read(folders[index], segments[index], runs[index]["segment"])

    here, ids, first, index = read(0), _TrackIds({}, 0), 0, 0
    while index < len(folders) - 1:
        found = None
        for other in range(index + 1, len(folders)):
            if segments[other].first >= here.segment.stop:
                break
            there = read(other)
            if found := _seam(here, there, settling):
                break
        if found is not None:
            yield here.part(first, found.frame), ids
            ids = ids.after(found, here, there)
            here, first, index = there, found.frame, other
        elif here.has_ended:
            break
        else:
            here = again.run(here.segment.longer())
    yield here.part(first, here.segment.stop), ids


def _seam(here: RunOfSegment, there: RunOfSegment, settling: int) -> _Seam | None:
    """Find where two runs tell the same for long enough; None if they don't."""
    told = [run.settled(settling) for run in (here, there)]
    if not all(map(len, told)):
        return None
    last = min(numbers[-1] for numbers in told)
    numbers = np.union1d(*told)
    numbers = numbers[(numbers >= there.segment.start) & (numbers <= last)]
    pairs = [
        _same_rows(*rows)
        for rows in zip(by_frame(here.rows, numbers), by_frame(there.rows, numbers), strict=True)
    ]
    agree = np.isin(numbers, told[0]) & np.isin(numbers, told[1])
    agree &= np.array([pair is not None for pair in pairs], bool)
    since = len(agree) - int(np.argmin(agree[::-1])) if not agree.all() else 0
    places = range(since, len(numbers) - settling + 1)
    # Nearest to the cut: there both know most.
    for i in sorted(places, key=lambda i: abs(int(numbers[i]) - there.segment.first)):
        same = _one_to_one([pair for pair in pairs[i:] if pair is not None])
        if same is not None and _all_known(there, int(numbers[i]), same):
            return _Seam(int(numbers[i]), same)
    return None


def _same_rows(here: Rows, there: Rows) -> list[tuple[int, int]] | None:
    """Pairs of tracks, here and there, of a frame's rows; None if these are not the same."""
    if len(here) != len(there):
        return None
    a, b = (rows["detection"] for rows in (here, there))
    if not len(a):
        return []
    off = np.maximum(abs(a["x"][:, None] - b["x"]), abs(a["y"][:, None] - b["y"]))
    nearest = off.argmin(axis=1)
    if len(set(nearest.tolist())) < len(nearest) or off.min(axis=1).max() > _SAME_PX:
        return None
    pairs = list(zip(a["track_id"].tolist(), b["track_id"][nearest].tolist(), strict=True))
    return pairs if all((one == 0) == (other == 0) for one, other in pairs) else None


def _one_to_one(pairs: Sequence[list[tuple[int, int]]]) -> dict[int, int] | None:
    """Which track there is which here; None if one is two."""
    both = {pair for frame in pairs for pair in frame if pair[0]}
    same = {there: here for here, there in both}
    return same if len(same) == len(both) == len(set(same.values())) else None


def _all_known(there: RunOfSegment, frame: int, same: dict[int, int]) -> bool:
    """Whether all tracks that were born before a frame, and are seen from it on, are known."""
    seen = np.unique(there.rows["detection"]["track_id"][there.rows["frame"] >= frame])
    born_before = seen[(seen > 0) & (seen <= there.last_id_before(frame))]
    return set(born_before.tolist()) <= same.keys()


@dataclass(frozen=True)
class _TrackIds:
    """What numbers of a segment's tracks are in the whole.

    `same` is the number of those that the segment before had, too; others are `shift` more.
    """

    same: dict[int, int]
    shift: int

    def __call__(self, track_id: int) -> int:
        return self.same.get(track_id, track_id + self.shift) if track_id else 0

    def after(self, seam: _Seam, here: RunOfSegment, there: RunOfSegment) -> _TrackIds:
        """Numbers of the next segment's tracks: the births after the seam go on counting."""
        same = {other: self(one) for other, one in seam.same.items()}
        born = self._last_before(here, seam.frame)
        known = there.last_id_before(seam.frame)
        late = [other for other in same if other > known]
        # What there is born only after the seam may have been known here.
        shift = born - known - sum(same[other] <= born for other in late)
        return _TrackIds(same, max([shift, *(same[o] - o for o in late if same[o] > born)]))

    def _last_before(self, run: RunOfSegment, frame: int) -> int:
        last = run.last_id_before(frame)
        shared = (here for there, here in self.same.items() if there <= last)
        return max(last + self.shift, *shared, 0)


def _copy(part: RunOfSegment, track_id: _TrackIds, output: Output) -> None:
    """Write what of a segment counts."""
    resets = dict(map(tuple, part.about["resets"]))
    reasons = part.about["reasons"]
    numbers = part.frames["frame"].tolist()
    lines = _star_field_lines(part.folder, set(numbers))
    detections = by_frame(part.rows, numbers)
    for frame, line, rows in zip(part.frames.tolist(), lines, detections, strict=True):
        number, stamp_ns, height, width, _ = frame
        output.add_frame(number, stamp_ns, (height, width), resets.get(number, ""), "")
        output.writer.copy_star_field(line)
        found = rows["detection"].copy()
        found["track_id"] = [track_id(each) for each in found["track_id"].tolist()]
        why = reasons[rows["why"][0]] if len(rows) else ""
        output.add_detections(number, stamp_ns, _by_birth(found), why)


def _by_birth(detections: NDArray[np.void]) -> NDArray[np.void]:
    """Return a frame's detections in the order of their tracks' births, candidates last."""
    track_id = detections["track_id"].astype(np.int64)
    order = np.where(track_id > 0, track_id, np.iinfo(np.int64).max)
    return detections[np.argsort(order, kind="stable")]


def _star_field_lines(folder: Path, numbers: set[int]) -> Iterator[str]:
    """Yield the lines of the star field of some frames."""
    with (folder / STAR_FIELD).open(encoding="utf-8", newline="\n") as file:
        next(file)
        for line in file:
            if int(line.split(",", 2)[1]) in numbers:
                yield line


def _without_numbers(note: str) -> str:
    """A note, or if it stands for others like it, what these have in common."""
    return re.sub(r"\d+", "#", note) if any(words in note for words in _ALIKE) else note


def _distinct(problems: Sequence[str]) -> list[str]:
    """Problems of the recording, each once, as one run would have told them."""
    first: dict[str, str] = {}
    for problem in problems:
        first.setdefault(_without_numbers(problem), problem)
    told = list(first.values())
    skipped = [problem for problem in told if _SKIPPED in problem][_MOST_SKIPPED:]
    return [problem for problem in told if problem not in skipped]
