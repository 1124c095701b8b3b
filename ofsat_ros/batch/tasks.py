# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a worker does: it looks at a recording, processes it or a part of it, joins the parts.

Plain values go in and come out.  What cannot be done comes out as words, so that nothing but the
end of a worker's process is a failure to the cluster.  A result takes its place when it is whole;
who finds it there does not make it again.  All processes see the same file system.
"""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from ofsat_ros import __version__
from ofsat_ros.batch.content import content_key, stamp
from ofsat_ros.batch.finding import Found
from ofsat_ros.processing import Job, Segment, join
from ofsat_ros.recordings import RecordingError, hold, open_recording
from ofsat_ros.report import write_report
from ofsat_ros.results import ResultError, read_run, write_run

# In the folder that a batch writes into.
RESULTS, SEGMENTS, UNFINISHED, RUNNING = "results", "segments", "unfinished", "running"
PROGRESS = "ofsat_batch"  # topic of the cluster's events
_TELL_EVERY_S = 0.5


class StoppedError(Exception):
    """The batch that ordered a task has ended."""


class UnfitError(Exception):
    """A worker cannot do what others might; the message says why."""


@dataclass(frozen=True)
class Order:
    """What all tasks of a batch have in common.

    Attributes
    ----------
    out : str
        The folder that the batch writes into.
    run : str
        Names this run of the batch: what stands in OUT/running while it goes on.
    threads : int
        Threads for one task.
    report : bool or None
        Whether results get a page; None: where the extra for it is there.
    version : str
        Of this package, where the order comes from.
    """

    out: str
    run: str
    threads: int
    report: bool | None
    version: str = __version__

    def check(self, *needed: str) -> None:
        """Raise `UnfitError` if this worker is not as the one who ordered, or lacks a path."""
        if self.version != __version__:
            raise UnfitError(f"it has ofsat_ros {__version__}, not {self.version}")
        for path in (self.out, *needed):
            if not os.path.exists(path):
                raise UnfitError(f"it sees no {path}: all machines have to mount the same files")

    def check_running(self) -> None:
        """Raise `StoppedError` if the batch has ended, or was started anew."""
        try:
            running = Path(self.out, RUNNING).read_text()
        except FileNotFoundError:
            running = ""
        if running != self.run:
            raise StoppedError


@dataclass(frozen=True)
class Answer:
    """What became of a task: `value` if it was done, else one of the others.

    Attributes
    ----------
    value : dict or None
    failed : str
        Why it cannot be done.
    unfit : str
        Why this worker cannot do it; `worker` is its address.
    stopped : bool
        Whether the batch has ended.
    """

    value: dict[str, Any] | None = None
    failed: str = ""
    unfit: str = ""
    worker: str = ""
    stopped: bool = False


def probe(order: Order) -> str:
    """Return why this worker is not fit for the batch; empty if it is."""
    try:
        order.check()
        order.check_running()
    except StoppedError:
        return f"its {order.out} is another folder: all machines have to mount the same files"
    except UnfitError as error:
        return f"{error}"
    return ""


def look(order: Order, found: Found, job: Job, known: dict[str, Any]) -> Answer:
    """Return what a recording holds: ``stamp``, ``content`` and ``frames`` (0: not known).

    What is `known` of it from another time holds if its files were not touched since.
    """

    def work() -> dict[str, Any]:
        files = found.files
        at = stamp(files)
        if known.get("stamp") == at:
            return known
        content = content_key(files)
        with open_recording(job.paths, **job.source) as recording:
            return {"stamp": at, "content": content, "frames": len(recording)}

    return _answer(order, job, work)


def process(order: Order, token: str, job: Job, place: str, mark: dict[str, str]) -> Answer:
    """Process a recording, or the segment that the job names, into the folder `place` of OUT.

    Parameters
    ----------
    order : Order
    token : str
        Names the task where its progress is told.
    job : Job
    place : str
    mark : dict
        What ``run.json`` gets besides: ``content`` and ``key``.

    Returns
    -------
    Answer
        Its value is what ``run.json`` says.
    """

    def make(folder: Path) -> dict[str, Any]:
        run = job.run(folder, _silent, _watch(order, token))
        if not run["frames"] and job.segment is None:
            raise RecordingError("no frame of it could be processed")
        return run

    report = job.segment is None
    return _answer(order, job, lambda: _settled(order, Path(order.out, place), mark, make, report))


def join_segments(
    order: Order,
    token: str,
    job: Job,
    segments: list[Segment],
    places: list[str],
    place: str,
    mark: dict[str, str],
) -> Answer:
    """Join the folders of all segments of a recording into the folder `place` of OUT.

    Parameters and answer are those of `process`; `places` has the folder of each segment.
    """
    folders = [Path(order.out, each) for each in places]

    def work() -> dict[str, Any]:
        def make(folder: Path) -> dict[str, Any]:
            return join(folders, segments, folder, _silent, _watch(order, token))

        run = _settled(order, Path(order.out, place), mark, make, True)
        shutil.rmtree(folders[0].parent, ignore_errors=True)
        return run

    return _answer(order, job, work)


def whole(folder: Path, key: str) -> dict[str, Any] | None:
    """Return what ``run.json`` says, if the folder holds the whole result of this key."""
    try:
        run = read_run(folder)
    except (ResultError, OSError):
        return None
    return run if run.get("key") == key and not run["stopped"] else None


def _answer(order: Order, job: Job, work: Callable[[], dict[str, Any]]) -> Answer:
    try:
        order.check(*job.paths)
        order.check_running()
        cv2.setNumThreads(order.threads)
        return Answer(work())
    except StoppedError:
        return Answer(stopped=True)
    except UnfitError as error:
        return Answer(unfit=f"{error}", worker=_worker().address)
    except (RecordingError, ResultError) as error:
        return Answer(failed=f"{error}")
    except OSError as error:
        words = error.strerror or f"{error}"
        return Answer(failed=f"{error.filename}: {words}" if error.filename else words)
    except Exception as error:  # noqa: BLE001 - a mistake of ours must not end the others' work
        return Answer(failed=f"a mistake in ofsat: {type(error).__name__}: {error}")


def _settled(
    order: Order,
    target: Path,
    mark: dict[str, str],
    make: Callable[[Path], dict[str, Any]],
    report: bool,
) -> dict[str, Any]:
    """Return the run of a folder of results, which is made first if it is not whole."""
    if run := whole(target, mark["key"]):
        return run
    with _workplace(order) as folder:
        run = make(folder) | mark
        write_run(folder, run)
        if report and order.report is not False:
            run["files"] = [*run["files"], *_reported(folder, bool(order.report))]
            write_run(folder, run)
        order.check_running()
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = folder.with_name(f"{folder.name}_replaced")
        with suppress(FileNotFoundError):
            target.rename(aside)
        try:
            folder.rename(target)
        except OSError:
            # Another has made the same meanwhile: a worker that was taken for lost.
            if whole(target, mark["key"]) is None:
                raise
        shutil.rmtree(aside, ignore_errors=True)
    return run


@contextmanager
def _workplace(order: Order) -> Iterator[Path]:
    """Make a folder of OUT that is removed if it was not moved to its place."""
    folder = Path(order.out, UNFINISHED, uuid.uuid4().hex)
    folder.mkdir(parents=True)
    try:
        with hold(folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _reported(folder: Path, wanted: bool) -> list[str]:
    try:
        return [write_report(folder).name]
    except ModuleNotFoundError:
        if wanted:
            raise
        return []


def _watch(order: Order, token: str) -> Callable[[int, int], None]:
    """Return what tells how far a task is, and ends it when the batch has ended."""
    told_s = 0.0

    def watch(done: int, _: int | None) -> None:
        nonlocal told_s
        if time.monotonic() - told_s >= _TELL_EVERY_S:
            told_s = time.monotonic()
            order.check_running()
            _worker().log_event(PROGRESS, {"run": order.run, "token": token, "frames": done})

    return watch


def _worker() -> Any:
    from distributed import get_worker

    return get_worker()


def _silent(_: str) -> None:
    """Notes stand in ``run.json``."""
