# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a process holds, as the system tells: memory, open files, threads, shared memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MB = 1e6
_SHARED = Path("/dev/shm")


@dataclass(frozen=True)
class Held:
    """What a process holds.

    Attributes
    ----------
    resident : float
        Memory that is its own, bytes: without files and what it shares with others, which the
        middleware maps as it meets them.
    files, threads : int
    """

    resident: float
    files: int
    threads: int

    @classmethod
    def by(cls, pid: int) -> Held:
        """Ask the system about a process."""
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        told = dict(line.split(":", 1) for line in lines)
        resident = 1024.0 * int(told["RssAnon"].split()[0])
        return cls(resident, len(os.listdir(f"/proc/{pid}/fd")), int(told["Threads"]))


def shared_bytes() -> float:
    """Return how much of the machine's shared memory is taken, bytes."""
    told = os.statvfs(_SHARED)
    return float((told.f_blocks - told.f_bfree) * told.f_frsize)


def own_segments(pid: int) -> set[str]:
    """Return the names of the shared memory that is a process's own.

    Each segment has a file beside it that its owner holds open, to be told from others.
    """
    held = (os.readlink(entry) for entry in Path(f"/proc/{pid}/fd").iterdir())
    locks = {Path(name).name for name in held if name.startswith(f"{_SHARED}/")}
    names = locks | {name.removesuffix("_el") for name in locks}
    # Ports are shared by all.
    return {name for name in names if "port" not in name}


def growth(values: Sequence[float]) -> float:
    """Return how much the second half of what was sampled is above the first, by medians."""
    half = len(values) // 2
    if not half:
        return 0.0
    return float(np.median(values[-half:]) - np.median(values[:half]))
