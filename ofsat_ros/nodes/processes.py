"""Nodes as processes of their own: what the demos start and, whatever happens, end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_PATIENCE_S = {signal.SIGINT: 5.0, signal.SIGTERM: 2.0, signal.SIGKILL: 2.0}


def own_graph() -> dict[str, str]:
    """Return what an environment sets so that its nodes neither hear nor disturb other graphs."""
    return {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


@contextmanager
def children() -> Iterator[Callable[..., subprocess.Popen]]:
    """Give a function that starts a node; all that were started are ended in any case.

    The function takes the node's name and what follows ``--ros-args``; with ``piped=True``, what
    the node prints is to be read from the process's `stdout`.  The nodes are in the graph of the
    environment, or else in one of their own.
    """
    running: list[subprocess.Popen] = []
    environment = {**own_graph(), **os.environ}

    def start(node: str, *ros_arguments: str, piped: bool = False) -> subprocess.Popen:
        output = subprocess.PIPE if piped else None
        command = [sys.executable, "-m", f"ofsat_ros.nodes.{node}", "--ros-args", *ros_arguments]
        with _signals_held_back():
            # An own session: Ctrl-C reaches this process, which then ends them in order.
            process = subprocess.Popen(
                command, stdout=output, text=True, env=environment, start_new_session=True
            )
            running.append(process)
        return process

    try:
        yield start
    finally:
        with _signals_held_back():
            for process in reversed(running):
                _end(process)


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Let SIGINT and SIGTERM wait: a process that starts just now must be known, to be ended."""
    came: list[int] = []
    before = {
        number: signal.signal(number, lambda *_: came.append(1))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        raise KeyboardInterrupt


def _end(process: subprocess.Popen) -> None:
    for number, patience_s in _PATIENCE_S.items():
        if process.poll() is not None:
            return
        process.send_signal(number)
        try:
            process.wait(patience_s)
        except subprocess.TimeoutExpired:
            continue
