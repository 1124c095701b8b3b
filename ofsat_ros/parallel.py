# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Work in parts: small enough for the processor's cache, on several threads.

Used by the stages that touch most data.  OpenCV and NumPy let other threads run while they work,
so that Python's threads are enough, if the parts are not small.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def in_parallel(task: Callable[[Item], Answer], items: Iterable[Item]) -> list[Answer]:
    """Do a task for each item, on as many threads as OpenCV may use; answers in their order."""
    items, threads = list(items), cv2.getNumThreads()
    if threads < 2 or len(items) < 2:
        return [task(item) for item in items]
    return list(_workers(threads).map(task, items))


def buffer(name: str, shape: tuple[int, ...], dtype: type = np.float32) -> NDArray:
    """An array of this thread's own, which it gets again: fresh memory costs more than the work.

    What the name stood for before is lost.
    """
    size = int(np.prod(shape))
    array = getattr(_own, name, None)
    if array is None or array.size < size:
        array = np.empty(size, dtype)
        setattr(_own, name, array)
    return array[:size].reshape(shape)


_own = threading.local()


@cache
def _workers(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="ofsat_part")
