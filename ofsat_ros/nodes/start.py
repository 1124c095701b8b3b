# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Where a node's process begins: ``ros2 run ofsat_ros NODE``, or this module with a node's name.

Signals come first, and then the node's module, whose imports take a second or two: a node that is
told to end while it starts ends, without a traceback and with the exit code of an orderly end.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

# SIGHUP is what a terminal sends when it is closed, or its ssh connection is lost.
END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STOPPED = 130  # exit code of what had something to finish and was stopped

_DEMOS = ("demo", "demo_guide")


def start(node: str) -> int:
    """Run a node; return its exit code."""
    code = STOPPED if node in _DEMOS else 0
    # There is nothing yet that would have to be closed.
    on_end_signals(lambda *_: os._exit(code))
    main = importlib.import_module(f"ofsat_ros.nodes.{node}").main
    return int(main())


def on_end_signals(handler: Callable[..., Any]) -> None:
    """Have a handler called by whatever ends the process from outside."""
    for number in END_SIGNALS:
        # Whoever started it with `nohup` wants it to stay when the terminal goes.
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


detector = partial(start, "detector")
guide = partial(start, "guide")
player = partial(start, "player")
recorder = partial(start, "recorder")
simulator = partial(start, "simulator")
tdm_writer = partial(start, "tdm_writer")
watch = partial(start, "watch")
demo = partial(start, "demo")
demo_guide = partial(start, "demo_guide")

if __name__ == "__main__":
    node = sys.argv.pop(1)
    sys.exit(start(node))
