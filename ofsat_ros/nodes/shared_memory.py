# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The memory through which Fast DDS hands images on: what the dead left in it, and its room.

A process that is killed (-9, or for want of memory) leaves its segment behind, 134 MB that no
process uses; a node that is started again and again all night would fill ``/dev/shm``, and then no
image arrives anywhere.  So nodes look at it before they join the graph.  It imports no ROS.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from pathlib import Path

_FOLDER = Path("/dev/shm")
# Each segment has a file beside it that its owner keeps locked while he lives.
_LOCK = re.compile(r"((?:fastrtps|fastdds)_[0-9a-f]{16})_el")
# s; a lock this young may belong to somebody who is about to take it.
_YOUNG_S = 5.0
# What Fast DDS takes beyond the size that the profile names.
_OVERHEAD = 1.06


def remove_abandoned() -> int:
    """Remove the segments whose owners have died; return how many these were."""
    return sum(_remove_if_abandoned(lock) for lock in _FOLDER.glob("fast*_el"))


def remove_own() -> None:
    """Remove this process's segments, just before it ends without the middleware's own end."""
    for link in Path("/proc/self/fd").iterdir():
        try:
            path = Path(os.readlink(link))
        except OSError:  # closed meanwhile
            continue
        if path.parent == _FOLDER:
            _remove(path)


def shortage(profile: str) -> str:
    """Return what is wrong if the segment of a profile finds no room; empty if it does.

    Without room Fast DDS goes on without a word that a user would understand, and loses images.

    Parameters
    ----------
    profile : str
        Path of the Fast DDS profile; the size is taken from it.
    """
    try:
        text = Path(profile).read_text(encoding="utf-8", errors="replace")
        state = os.statvfs(_FOLDER)
    except OSError:  # the middleware itself says that there is no such profile
        return ""
    size = re.search(r"<segment_size>\s*(\d+)\s*<", text)
    wanted, free = float(size[1]) * _OVERHEAD if size else 0.0, state.f_bavail * state.f_frsize
    if free >= wanted:
        return ""
    return (
        f"{_FOLDER} has {free / 1e6:.0f} MB free, and each process that sends images needs"
        f" {wanted / 1e6:.0f} MB of it: large images will be lost. Give it more"
        f" (docker run --shm-size=1g; mount -o remount,size=1G {_FOLDER}), or see what fills it"
    )


def _remove_if_abandoned(lock: Path) -> bool:
    try:
        descriptor = os.open(lock, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:  # gone, or another user's
        return False
    try:
        if time.time() - os.fstat(descriptor).st_mtime < _YOUNG_S:
            return False
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return _remove(lock)
    except OSError:  # its owner lives
        return False
    finally:
        os.close(descriptor)


def _remove(lock: Path) -> bool:
    """Remove a segment and its lock, if that is what the name says."""
    name = _LOCK.fullmatch(lock.name)
    if name is None:
        return False
    try:
        lock.with_name(name[1]).unlink(missing_ok=True)
        lock.unlink(missing_ok=True)
    except OSError:  # another user's
        return False
    return True
