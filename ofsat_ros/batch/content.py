# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a result depends on, as short strings that are equal if it is: what is done, and stays so.

A recording is known by its content: it may be moved, renamed or copied.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# Of a key, what a folder's name bears.
SHORT = 8


def content_key(paths: Sequence[Path]) -> str:
    """Return the SHA-256 of what files contain, whatever they are called and wherever they are.

    Parameters
    ----------
    paths : sequence of Path
        Files of a recording.  Their order counts: that of pictures is the order of time.

    Raises
    ------
    OSError
        If one cannot be read.
    """
    whole = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            whole.update(hashlib.file_digest(file, "sha256").digest())
    return whole.hexdigest()


def stamp(paths: Sequence[Path]) -> str:
    """Return what changes whenever files do: a hash of their paths, sizes and times.

    By it content that was read once need not be read again.
    """
    about = [(f"{path.resolve()}", (at := path.stat()).st_size, at.st_mtime_ns) for path in paths]
    return _hash(about)


def result_key(content: str, made_by: dict[str, Any]) -> str:
    """Return what a result is known by: content, and all that decides what is made of it."""
    return _hash([content, made_by])


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
