# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Folders that belong to a process for as long as it lives.

The system drops the lock of a process that ends, be it killed: what such a one has left behind is
so told from what another is at work on.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import rmtree
from tempfile import gettempdir, mkdtemp

# Nobody names his own folder so: whatever begins with it, and is left behind, is removed.
_PREFIX = ".ofsat_unpacked_"


class HeldError(OSError):
    """A folder belongs to another process that lives."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Hold an existing folder, as long as the ``with`` lasts.

    Where a file system has no locks, nobody is kept from anything.

    Raises
    ------
    HeldError
        If another process holds it, or another ``with`` of this one.
    OSError
        If it is no folder, or may not be read.
    """
    if sys.platform == "win32":  # it has no such locks
        yield
        return
    import fcntl

    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise HeldError(f"{folder} is in use by another process") from error
        except OSError:
            pass
        yield
    finally:
        os.close(opened)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder for as long as the ``with`` lasts; first remove those of killed processes."""
    for left in Path(gettempdir()).glob(f"{_PREFIX}*"):
        if sys.platform != "win32":  # where nobody can tell who is killed
            with suppress(OSError):
                if left.lstat().st_uid == os.getuid() and not left.is_symlink():
                    with hold(left):
                        rmtree(left)
    folder = Path(mkdtemp(prefix=_PREFIX))
    try:
        with hold(folder):
            yield folder
    finally:
        rmtree(folder, ignore_errors=True)
