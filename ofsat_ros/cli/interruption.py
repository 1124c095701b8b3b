# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM and the end of the terminal: each stops a command, whenever it comes.

Python raises KeyboardInterrupt wherever the main thread is at that moment, and drops it where
nothing can be raised: in destructors, in callbacks of C, and so at the end of every import.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_AGAIN_S = 0.02


@contextmanager
def interruptible() -> Iterator[None]:
    """Have all that ends a program raise KeyboardInterrupt, and again if it was dropped."""
    usual = sys.unraisablehook

    def again(dropped: Any) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            # Later, for nothing can be raised here; by SIGTERM, which few programs ignore.
            threading.Timer(_AGAIN_S, _thread.interrupt_main, [signal.SIGTERM]).start()
        else:
            usual(dropped)

    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            # Not what was told to stay: `nohup` means it.
            if signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, signal.default_int_handler)
    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = usual


@contextmanager
def nothing_to_finish() -> Iterator[None]:
    """Have the same end the program at once, without an exception that imports might swallow."""
    usual = {}
    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            if signal.getsignal(number) is signal.default_int_handler:
                usual[number] = signal.signal(number, _end)
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


def interrupted(error: BaseException | None) -> bool:
    """Return whether it is an interruption at root: modules in C make an ImportError of one."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _end(*_: object) -> None:
    with suppress(OSError):  # nobody may be there to read it
        os.write(2, b"stopped\n")
    os._exit(130)
