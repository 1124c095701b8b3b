# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``run.json``: what a folder of results was made of, how, and what it did not tell.

With it a folder explains itself: the report reads it, and opens the recording again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

RUN = "run.json"

_COUNTS = ("frames", "left_out", "width", "height", "first_stamp_ns", "last_stamp_ns", "start_ns")
_WORDS = ("version", "preset", "started_utc", "topic", "camera_info_topic", "attitude_topic")
# What each field holds, if it is not null.
_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(_WORDS, (str,)),
    **dict.fromkeys(_COUNTS, (int,)),
    **dict.fromkeys(("fps", "exposure_s", "seconds"), (int, float)),
    **dict.fromkeys(("parameters", "profile", "unlocated"), (dict,)),
    **dict.fromkeys(("problems", "files"), (list,)),
    **dict.fromkeys(("live", "stopped"), (bool,)),
    "recording": (str, list),
}
# Those that not every run has.
_OTHERS: dict[str, tuple[type, ...]] = {"content": (str,), "key": (str,), "segment": (dict,)}
# And what is in those that hold several.
_PARTS: dict[str, tuple[type, ...]] = {
    "recording": (str,),
    "problems": (str,),
    "profile": (int, float),
    "unlocated": (int,),
}


class ResultError(ValueError):
    """A folder that holds no results; the message says what is missing."""


def write_run(folder: str | Path, run: Mapping[str, Any]) -> None:
    """Write ``run.json``; there is a whole one or none, whatever happens meanwhile.

    Parameters
    ----------
    folder : str or Path
        Existing folder.
    run : mapping of str to what JSON holds
        ``version`` of this package; ``recording`` (absolute path, or a list of several),
        ``topic``, ``camera_info_topic``, ``attitude_topic``, ``fps``, ``exposure_s`` and
        ``start_ns``, with which ``open_recording`` gives the same frames again; ``preset``, and
        ``parameters`` as used, by their names; ``live``; counts ``frames`` and ``left_out``;
        ``first_stamp_ns`` and ``last_stamp_ns`` as in the tables, ``width`` and ``height`` (px),
        all null without a frame; ``started_utc`` (ISO 8601) and ``seconds`` it took; ``profile``,
        seconds by stage; ``problems``, the notes that the user was given; ``unlocated``, counts of
        detections without direction by the reason; ``files`` made; ``stopped``, whether the run
        ended before the recording did.  Of a batch, ``content``, the hash of the recording's
        files, and ``key``, that of all that decides the result; of a segment that is still to be
        joined with others, ``segment``, what that needs.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    text = json.dumps(dict(run), indent=2, ensure_ascii=False, allow_nan=False)
    # Names that are no Unicode become JSON's own escapes.
    write_whole(Path(folder) / RUN, text + "\n", "backslashreplace")


def write_whole(path: Path, text: str, errors: str = "strict") -> None:
    """Write a file that is whole or, whatever happens meanwhile, as it was before.

    Parameters
    ----------
    path : Path
    text : str
        Becomes UTF-8.
    errors : str
        What becomes of characters that have none, as in `str.encode`.

    Raises
    ------
    OSError
        If it cannot be written; it names the file.
    """
    unfinished = path.with_name(f".{path.name}.part")
    try:
        with naming(path):
            unfinished.write_text(text, encoding="utf-8", errors=errors)
            os.replace(unfinished, path)
    finally:
        with suppress(OSError):  # the folder may be gone
            unfinished.unlink()


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have an error of the system name a file, which one of writing doesn't."""
    try:
        yield
    except OSError as error:
        error.filename = f"{path}"
        raise


def read_run(folder: str | Path) -> dict[str, Any]:
    """Return what `write_run` has written; of its fields, those that are missing are None.

    Raises
    ------
    ResultError
        If there is no such file in the folder, or it is damaged.
    OSError
        If it cannot be read.
    """
    path = Path(folder) / RUN
    if not path.is_file():
        raise ResultError(f"{folder} holds no {RUN}: give a folder that ofsat process has made")
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ResultError(f"{path} is damaged: {error}; run ofsat process again") from error
    if not isinstance(run, dict):
        raise ResultError(f"{path} is damaged: it holds no object; run ofsat process again")
    for name, value in run.items():
        if not _fits(name, value):
            raise ResultError(f"{path} is damaged: {name} is {value!r}; run ofsat process again")
    return dict.fromkeys(_KINDS) | run


def _fits(name: str, value: Any) -> bool:
    """Whether a field holds what it should."""
    kinds = _KINDS | _OTHERS
    if value is None or name not in kinds:
        return True
    if not isinstance(value, kinds[name]):
        return False
    parts = value.values() if isinstance(value, dict) else value if type(value) is list else ()
    return name not in _PARTS or all(isinstance(part, _PARTS[name]) for part in parts)
