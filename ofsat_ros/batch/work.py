# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A batch: which tasks there are, in which order, and what became of each recording.

Runs in the process that the user has started.  What is done is known by folders of results and
their keys alone, so that a batch that was ended in any way goes on where it was.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ofsat_ros import __version__
from ofsat_ros.batch import tasks
from ofsat_ros.batch.cluster import TRIES, Cluster, Progress
from ofsat_ros.batch.content import result_key
from ofsat_ros.batch.finding import Found
from ofsat_ros.batch.place import Place
from ofsat_ros.batch.tasks import Answer, Order
from ofsat_ros.processing import Job, Segment, cut
from ofsat_ros.recordings import RecordingError

_TURN_S, _SAVE_EVERY_S = 0.2, 10.0
# Of the options of `open_recording`, those that other files than of their kind have no use for.
_OF_BAGS = ("camera_info_topic", "attitude_topic")
_OF_OTHERS = ("fps", "start_ns")


@dataclass
class Outcome:
    """What became of a recording.

    Attributes
    ----------
    recording : str
        Its absolute path.
    state : str
        ``waiting``, ``done``, ``skipped`` (it was done before) or ``failed``.
    reason : str
        Why it failed; of one that is skipped, which other recording has the same content.
    folder : str
        Its results, relative to the batch's folder.
    stamp, content, key : str
        What its files looked like, what they contain, what its result is known by.
    frames : int
        How many it has; 0 if that is not known.
    """

    recording: str
    state: str = "waiting"
    reason: str = ""
    folder: str = ""
    stamp: str = ""
    content: str = ""
    key: str = ""
    frames: int = 0


@dataclass(frozen=True)
class Settings:
    """What is done with each recording; `source`, `preset` to `live` as in `Job`.

    Attributes
    ----------
    segment_frames : int
        While there are more workers than recordings, these are cut into segments of at least so
        many frames, if no bags are wanted; 0: they are not.
    """

    source: dict[str, Any]
    preset: str
    parameters: dict[str, Any]
    formats: tuple[str, ...]
    bag: bool
    live: bool
    segment_frames: int

    def check(self) -> None:
        """Raise ParameterError if a parameter's value is none."""
        self.job(Found(Path(), ""))

    def job(self, found: Found) -> Job:
        """Return what is to be done with a recording, with the options that it has a use for."""
        useless = set(_OF_OTHERS if found.kind == "bag" else _OF_BAGS)
        if found.kind not in ("bag", "FITS"):
            useless.add("topic")
        source = {name: value for name, value in self.source.items() if name not in useless}
        return Job(
            paths=(f"{found.path.resolve()}",),
            source=source,
            preset=self.preset,
            parameters=self.parameters,
            formats=self.formats,
            bag=self.bag,
            live=self.live,
        )


@dataclass
class _Task:
    """A task of the recording of a number."""

    of: int
    call: Callable[..., Answer]
    arguments: tuple[Any, ...]
    frames: int = 0  # that it gives
    tries: int = 0


@dataclass
class _Cut:
    """A recording in segments: which, in which folders, and how many are not done."""

    segments: list[Segment]
    places: list[str]
    left: int


class Batch:
    """Many recordings, each to a folder of results.

    Parameters
    ----------
    place : Place
        Where they go.
    recordings : sequence of Found
    settings : Settings
    order : Order
        As the cluster has it.
    finished : callable
        Takes each `Outcome` when nothing more will become of it.

    Attributes
    ----------
    outcomes : list of Outcome
        Of all recordings, as far as they have come.
    """

    def __init__(
        self,
        place: Place,
        recordings: Sequence[Found],
        settings: Settings,
        order: Order,
        finished: Callable[[Outcome], None],
    ) -> None:
        self._place, self._found, self._order = place, recordings, order
        self._settings, self._finished = settings, finished
        self._jobs = [settings.job(found) for found in recordings]
        self.outcomes = [Outcome(job.paths[0], **place.known(job.paths[0])) for job in self._jobs]
        self._ahead = deque(self._look(number) for number in range(len(recordings)))
        self._at_work: dict[str, _Task] = {}
        self._slots = 0  # tasks that can be at work at once
        self._done = 0  # frames, of tasks that are
        self._under_way: dict[str, int] = {}  # frames, by task
        self._cut: dict[int, _Cut] = {}
        self._of_key: dict[str, int] = {}  # who has a content first
        self._copies: dict[int, list[int]] = {}
        self._started, self._started_s = datetime.now(UTC), time.monotonic()

    def run(self, cluster: Cluster, show: Callable[[int, float], None]) -> None:
        """Do all, and save what became of it now and then.

        Parameters
        ----------
        cluster : Cluster
        show : callable
            Takes, several times a second, how many frames this run has done, and of how many;
            the second is an estimate until all recordings were looked at.

        Raises
        ------
        ClusterError
            If there is nobody left to do the work.
        RecordingError
            If another batch has taken the folder.
        OSError
            If it cannot be written.
        """
        shown_s = saved_s = -_SAVE_EVERY_S
        try:
            while self._ahead or cluster.busy:
                self._slots = cluster.slots
                while self._ahead and cluster.busy < self._slots:
                    self._submit(cluster, self._ahead.popleft())
                news = cluster.news(_TURN_S)
                if isinstance(news, Progress):
                    if task := self._at_work.get(news.token):
                        self._under_way[news.token] = min(news.frames, task.frames)
                elif news:
                    self._take(*news)
                now_s = time.monotonic()
                if now_s - shown_s > _TURN_S:
                    shown_s = now_s
                    show(self._done + sum(self._under_way.values()), self._all())
                if now_s - saved_s > _SAVE_EVERY_S:
                    saved_s = now_s
                    self.save(stopped=True)
        finally:
            self.save(stopped=bool(self._ahead or cluster.busy))
            self._place.stop()

    def save(self, stopped: bool) -> None:
        """Write ``batch.json``: what was asked, and what became of each recording."""
        self._place.tell(
            {
                "version": __version__,
                "started_utc": self._started.isoformat(timespec="seconds"),
                "seconds": time.monotonic() - self._started_s,
                "stopped": stopped,
                "asked": asdict(self._settings),
                "recordings": [asdict(outcome) for outcome in self.outcomes],
            }
        )

    def _look(self, number: int) -> _Task:
        about = self.outcomes[number]
        known = {"stamp": about.stamp, "content": about.content, "frames": about.frames}
        return _Task(number, tasks.look, (self._found[number], self._jobs[number], known))

    def _submit(self, cluster: Cluster, task: _Task) -> None:
        token = f"{task.call.__name__}-{task.of}-{id(task)}"
        self._at_work[token] = task
        arguments = task.arguments
        if task.call is not tasks.look:
            arguments = (token, *arguments)
        cluster.submit(token, task.call, self._order, *arguments)

    def _take(self, token: str, answer: Answer) -> None:
        """Go on with a recording after one of its tasks."""
        task = self._at_work.pop(token)
        self._under_way.pop(token, None)
        if answer.stopped:
            raise RecordingError(
                f"another batch has taken {self._place.folder}: it goes on with the work"
            )
        if self.outcomes[task.of].state == "failed":
            return  # another segment of it
        if answer.unfit and task.tries < TRIES - 1:
            task.tries += 1
            self._ahead.append(task)
        elif answer.value is None:
            self._end(task.of, "failed", answer.failed or f"{answer.worker}: {answer.unfit}")
        elif task.call is tasks.look:
            self._plan(task.of, **answer.value)
        elif (parts := self._cut.get(task.of)) and task.call is tasks.process:
            self._done += task.frames
            parts.left -= 1
            if not parts.left:
                self._ahead.appendleft(self._join(task.of, parts))
        else:
            self._done += task.frames
            self._end(task.of, "done")

    def _plan(self, number: int, stamp: str, content: str, frames: int) -> None:
        """Decide what is to be done with a recording whose content is known."""
        outcome, job = self.outcomes[number], self._jobs[number]
        key = result_key(content, self._made_by(job))
        outcome.stamp, outcome.content, outcome.key, outcome.frames = stamp, content, key, frames
        first = self._of_key.setdefault(key, number)
        if first != number and self.outcomes[first].state == "waiting":
            self._copies.setdefault(first, []).append(number)
        elif folder := self._place.whole(key) or self.outcomes[first].folder:
            outcome.folder = folder
            self._end(number, "skipped")
        elif self.outcomes[first].state == "failed":
            self._end(number, "failed", self.outcomes[first].reason)
        else:
            outcome.folder = self._place.name(self._found[number].name, key)
            self._ahead.extendleft(reversed(self._parts(number)))

    def _parts(self, number: int) -> list[_Task]:
        """Return the tasks that a recording is done in."""
        outcome, job = self.outcomes[number], self._jobs[number]
        mark = {"content": outcome.content, "key": outcome.key}
        segments = self._segments(job, outcome.frames)
        if len(segments) < 2:
            about = (job, outcome.folder, mark)
            return [_Task(number, tasks.process, about, outcome.frames)]
        folder = self._place.segments(outcome.key)
        places = [f"{folder}/{each.first}-{each.end}" for each in segments]
        self._cut[number] = _Cut(segments, places, len(segments))
        return [
            _Task(
                number,
                tasks.process,
                (replace(job, segment=segment), at, mark),
                segment.end - segment.first,
            )
            for segment, at in zip(segments, places, strict=True)
        ]

    def _segments(self, job: Job, frames: int) -> list[Segment]:
        """Return the segments of a recording: no more than there are workers for.

        Each costs more than its share, since it learns the sensor from all that is before it.
        """
        least = self._settings.segment_frames
        if job.bag or not least or frames < 2 * least:
            return []
        waiting = sum(outcome.state == "waiting" for outcome in self.outcomes)
        parts = max(1, math.ceil(self._slots / waiting))
        return cut(frames, max(least, frames // parts), job.overlap)

    def _made_by(self, job: Job) -> dict[str, Any]:
        """Return what decides on a result, besides the content of the recording."""
        tables = [table.as_dict() for table in job.make_parameters()]
        about = {"version": __version__, "parameters": tables, "source": job.source}
        return about | {"formats": sorted(job.formats), "bag": job.bag, "live": job.live}

    def _join(self, number: int, parts: _Cut) -> _Task:
        outcome = self.outcomes[number]
        mark = {"content": outcome.content, "key": outcome.key}
        about = (self._jobs[number], parts.segments, parts.places, outcome.folder, mark)
        return _Task(number, tasks.join_segments, about)

    def _all(self) -> float:
        """Return how many frames this run will have done: an estimate until all are looked at."""
        unseen = sum(task.call is tasks.look for task in (*self._ahead, *self._at_work.values()))
        known = [each.frames for each in self.outcomes if each.state in ("waiting", "done")]
        seen = len(known) - unseen
        whole = sum(known)
        return whole * (1 + unseen / seen) if seen > 0 else 0.0

    def _end(self, number: int, state: str, reason: str = "") -> None:
        outcome = self.outcomes[number]
        outcome.state, outcome.reason = state, reason
        if state == "failed":
            outcome.folder = ""
            self._ahead = deque(task for task in self._ahead if task.of != number)
        self._finished(outcome)
        for copy in self._copies.pop(number, ()):
            same = self.outcomes[copy]
            same.folder = outcome.folder
            if state == "failed":
                self._end(copy, "failed", reason)
            else:
                self._end(copy, "skipped", f"its content is that of {outcome.recording}")
