# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Several recordings of one kind as one: files of a night, one after the other."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from ofsat_ros.recordings.bag import RecordingError, Topic
from ofsat_ros.recordings.recording import Attitude, Frame, Skipped, Source


class TimedSource(Source, Protocol):
    """One that knows when its first frame was taken, ns UTC, or nearly."""

    first_ns: int


class Series:
    """Bags, or SER files, in the order of time, as a `Source`.

    Parameters
    ----------
    sources : list
        At least one; closed with the series.

    Raises
    ------
    RecordingError
        If their image topics differ.
    """

    def __init__(self, sources: list[TimedSource]) -> None:
        self._sources = sorted(sources, key=lambda source: source.first_ns)
        first = self._sources[0]
        self.path = common_folder([source.path for source in sources])
        self.kind, self.topic = first.kind, first.topic
        self.camera_info_topic, self.attitude_topic = first.camera_info_topic, first.attitude_topic
        self.count = sum(source.count for source in sources)
        self.topics: dict[str, int] = {}
        self.contents: dict[str, Topic] = {}
        for source in self._sources:
            for name, count in source.topics.items():
                self.topics[name] = self.topics.get(name, 0) + count
            for name, about in source.contents.items():
                before = self.contents.get(name, Topic(about.msgtype, 0))
                self.contents[name] = Topic(before.msgtype, before.count + about.count)
            if source.topic != self.topic:
                raise RecordingError(
                    f"the images of {first.path} are on {self.topic}, and those of {source.path}"
                    f" on {source.topic}: give one recording, or choose the topic"
                )

    @property
    def problems(self) -> list[str]:
        """See `Source`."""
        told = (problem for source in self._sources for problem in source.problems)
        return list(dict.fromkeys(told))

    @property
    def last_attitudes(self) -> tuple[Attitude, ...]:
        """See `Source`."""
        return self._sources[-1].last_attitudes

    def close(self) -> None:
        """See `Source`."""
        for source in self._sources:
            source.close()

    def frames(
        self, say: Callable[[str], None], first: int = 0
    ) -> Iterator[Frame | Skipped | None]:
        """See `Source`."""
        number = 0
        attitudes: tuple[Attitude, ...] = ()  # after the last frame of the one before
        for source in self._sources:
            try:
                for given in source.frames(say, max(0, first - number)):
                    if given is None:
                        yield None
                    elif isinstance(given, Skipped):
                        yield replace(given, name=f"{given.name} of {source.path.name}")
                    else:
                        both = (*attitudes, *given.attitudes)
                        yield replace(given, number=number, attitudes=both)
                        attitudes = ()
                    number += 1
            except RecordingError as error:  # those after it may be whole
                say(f"{error}")
            attitudes += source.last_attitudes


def common_folder(paths: list[Path]) -> Path:
    """Return the folder that all paths are in; of one, itself."""
    if len(paths) == 1:
        return paths[0]
    return Path(os.path.commonpath([path.absolute() for path in paths]))
