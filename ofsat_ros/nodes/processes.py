# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of their own: what the demos start and, whatever happens, end."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import resources

from ofsat_ros.nodes.start import END_SIGNALS, on_end_signals

_START = (sys.executable, "-m", "ofsat_ros.nodes.start")
_PROFILE = resources.files("ofsat_ros").joinpath("data/fastdds_this_machine.xml")
_PATIENCE_S = {signal.SIGINT: 5.0, signal.SIGTERM: 2.0, signal.SIGKILL: 2.0}


@functools.cache
def own_graph() -> Mapping[str, str]:
    """Return what an environment sets so that its nodes neither hear nor disturb other graphs.

    Whatever the user's environment says: a mount that listens there must not obey a demo.
    """
    domain = 51 + os.getpid() % 50
    if os.environ.get("ROS_DOMAIN_ID") == f"{domain}":
        domain += 1
    return {
        "ROS_DOMAIN_ID": f"{domain}",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_STATIC_PEERS": "",
        "FASTRTPS_DEFAULT_PROFILES_FILE": f"{_PROFILE}",
    }


def stop_on_signals() -> None:
    """Have the signals that end a process raise KeyboardInterrupt."""
    on_end_signals(signal.default_int_handler)


@contextmanager
def children() -> Iterator[Callable[..., subprocess.Popen]]:
    """Give a function that starts a node; all that were started are ended in any case.

    The function takes the node's name and what follows ``--ros-args``; with ``piped=True``, what
    the node prints is to be read from the process's `stdout`.  The nodes are in a graph of their
    own.
    """
    running: list[subprocess.Popen] = []
    environment = {**os.environ, **own_graph()}

    def start(node: str, *ros_arguments: str, piped: bool = False) -> subprocess.Popen:
        output = subprocess.PIPE if piped else None
        command = [*_START, node, "--ros-args", *ros_arguments]
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
    """Let signals wait: a process that starts just now must be known, to be ended."""
    came: list[int] = []
    before = {
        number: signal.signal(number, lambda *_: came.append(1))
        for number in END_SIGNALS
        if signal.getsignal(number) != signal.SIG_IGN
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
