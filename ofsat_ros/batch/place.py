# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The folder that a batch writes into: whose it is, what is whole in it, what is told of it."""

from __future__ import annotations

import json
import shutil
import uuid
from collections import defaultdict
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Self

from ofsat_ros.batch.content import SHORT
from ofsat_ros.batch.finding import BATCH
from ofsat_ros.batch.tasks import RESULTS, RUNNING, SEGMENTS, UNFINISHED, whole
from ofsat_ros.recordings import HeldError, RecordingError, hold
from ofsat_ros.results import write_whole

_NAME_BYTES = 200  # of the 255 that file systems allow


class Place:
    """A batch's folder, held for one process at a time; a context manager.

    Parameters
    ----------
    folder : Path
        New or empty, or a batch's.

    Attributes
    ----------
    folder : Path
    run : str
        Names this time that it is held.

    Raises
    ------
    RecordingError
        If it holds what no batch has made, or another batch is at work in it.
    OSError
        If it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.run = folder, uuid.uuid4().hex
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()) and not (folder / BATCH).is_file():
            raise RecordingError(
                f"{folder} holds files that no batch has made: choose another folder"
            )
        with ExitStack() as held:
            try:
                held.enter_context(hold(folder))
            except HeldError as error:
                raise RecordingError(
                    f"another batch is writing into {folder}: wait for its end, or choose another"
                    " folder"
                ) from error
            self._told = self._read()
            if not self._told:
                self.tell({})
            write_whole(folder / RUNNING, self.run)
            held.callback(self._clear)
            held.callback(self.stop)
            self._clear()
            self._held = held.pop_all()
        self._named: dict[str, list[str]] = defaultdict(list)  # by the short key
        for each in folder.glob(f"{RESULTS}/*"):
            self._named[each.name[-SHORT:]].append(each.name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def stop(self) -> None:
        """Have workers that are at work here end by themselves."""
        (self.folder / RUNNING).unlink(missing_ok=True)

    def whole(self, key: str) -> str:
        """Return the folder of the result of a key, relative to this; empty if there is none."""
        names = (f"{RESULTS}/{name}" for name in self._named[key[:SHORT]])
        return next((name for name in names if whole(self.folder / name, key)), "")

    def name(self, recording: str, key: str) -> str:
        """Return where the result of a recording of this name belongs, relative to this."""
        short = recording.encode(errors="surrogateescape")[:_NAME_BYTES].decode(errors="ignore")
        return f"{RESULTS}/{short}-{key[:SHORT]}"

    def segments(self, key: str) -> str:
        """Return where segments are until they are joined, relative to this."""
        return f"{SEGMENTS}/{key}"

    def known(self, recording: str) -> dict[str, Any]:
        """Return stamp, content and frames of a recording as a batch here has last told them."""
        return self._told.get(recording, {})

    def tell(self, about: dict[str, Any]) -> None:
        """Write ``batch.json``."""
        text = json.dumps(about, indent=2, ensure_ascii=False)
        write_whole(self.folder / BATCH, text + "\n", "backslashreplace")

    def _read(self) -> dict[str, dict[str, Any]]:
        """Return what ``batch.json`` tells of each recording; nothing if it is damaged."""
        try:
            told = json.loads((self.folder / BATCH).read_text(encoding="utf-8"))
            return {
                each["recording"]: {name: each[name] for name in ("stamp", "content", "frames")}
                for each in told["recordings"]
            }
        except (FileNotFoundError, ValueError, LookupError, TypeError):
            return {}

    def _clear(self) -> None:
        """Remove what those have left who were killed, or whose batch has ended."""
        for left in (self.folder / UNFINISHED).glob("*"):
            with suppress(OSError), hold(left):
                shutil.rmtree(left)
        with suppress(OSError):  # there may be none, or one in which somebody is at work
            (self.folder / UNFINISHED).rmdir()
