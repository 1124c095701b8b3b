# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Where a command makes its files, until they are whole and take their place.

So a run that fails, or is killed, harms nothing that was there.  What it has made so far can be
read where it was made; the next run for the same place clears it away.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Self

from ofsat_ros.recordings import HeldError, RecordingError, check_bag, hold, remove_bag

_REPLACED = "replaced"


class Unfinished:
    """A folder in which files are made for another one; a context manager.

    At the end of the ``with`` they take their place, and nothing of these names that was there
    before stays beside them.  If an exception ends it, they stay where they were made; Ctrl-C
    does not make them replace others.

    Parameters
    ----------
    folder : Path
        Where to make them: on the file system of `place`.
    place : Path
        Where they belong.
    names : sequence of str
        Files, and bags (which end in /), that are or might be made.
    force : bool
        Replace those of them that are there.

    Attributes
    ----------
    folder : Path
        Where they are made; later, where they are.
    kept : bool
        Whether others of these names are still there.
    filled : bool
        Whether what was made is worth keeping, which its maker says.

    Raises
    ------
    RecordingError
        If some are there and may not be replaced, or something else is there by such a name; or if
        another process is at work in the folder, or it holds what is not of these names.
    OSError
        If the folder cannot be made.
    """

    def __init__(self, folder: Path, place: Path, names: Sequence[str], force: bool) -> None:
        self.folder, self._place, self._names = folder, place, names
        self.filled = False
        old = [name for name in names if os.path.lexists(place / name)]
        self.kept = bool(old)
        if old and not force:
            words = ", ".join(name.rstrip("/") for name in old)
            raise RecordingError(
                f"{place} already holds {words}; choose another folder, or --force to replace them"
            )
        for name in old:
            _check(place / name, name)
        place.mkdir(parents=True, exist_ok=True)
        folder.mkdir(exist_ok=True)
        with ExitStack() as held:
            try:
                held.enter_context(hold(folder))
            except HeldError as error:
                raise RecordingError(
                    f"another run is writing into {folder}: wait for its end, or choose another"
                    " output"
                ) from error
            self._clear()
            held.callback(self._remove_folder)
            self._held = held.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        stopped = kind is not None and issubclass(kind, KeyboardInterrupt)
        with self._held:
            if not self.filled:
                self._clear()
            elif kind is None or (stopped and not self.kept):
                self._finish()

    def _finish(self) -> None:
        # Aside first: to remove a large bag takes a while, to rename it doesn't.
        aside = self.folder / _REPLACED
        aside.mkdir()
        # Also what a process that was killed has left half-written beside them.
        parts = [f".{name}.part" for name in self._names if not name.endswith("/")]
        for name in [*self._names, *parts]:
            if os.path.lexists(self._place / name):
                os.replace(self._place / name, aside / name)
        for name in self._names:
            if (self.folder / name).exists():
                os.replace(self.folder / name, self._place / name)
        self._clear()
        self._remove_folder()
        self.folder, self.kept = self._place, False

    def _remove_folder(self) -> None:
        with suppress(OSError):  # what was not finished stays
            self.folder.rmdir()

    def _clear(self) -> None:
        """Remove what was made, or replaced."""
        for folder in (self.folder / _REPLACED, self.folder):
            inside = sorted(folder.iterdir()) if folder.is_dir() else []
            if foreign := [path.name for path in inside if not self._is_ours(path)]:
                raise RecordingError(
                    f"{folder} holds {', '.join(foreign)}, which was not made here: move it away"
                )
            for path in inside:
                remove_bag(path) if _is_folder(path) else path.unlink()

    def _is_ours(self, path: Path) -> bool:
        """Whether a command has made this; of folders, `remove_bag` sees to that."""
        known = [name for name in self._names if not name.endswith("/")]
        return _is_folder(path) or any(
            path.name == name or (path.name.startswith(f".{name}.") and path.suffix == ".part")
            for name in known
        )


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _check(path: Path, name: str) -> None:
    """Refuse to replace what is something else than its name says."""
    if name.endswith("/"):
        check_bag(path)
    elif _is_folder(path):
        raise RecordingError(f"{path} is not replaced, since it is a folder: remove it yourself")
