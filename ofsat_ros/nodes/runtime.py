# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What all nodes share: how a process becomes a node, and how it ends.

`run` is the whole of a node's ``main``: it readies allocator and middleware for large images,
starts the node, serves its callbacks in one thread, and ends it in order on SIGINT, SIGTERM,
SIGHUP or when the node itself sets its stop event.  `Inbox` hands messages from the callbacks to a
node's own worker thread, so that a slow frame delays no service or parameter.
"""

from __future__ import annotations

import _thread
import argparse
import ctypes
import os
import platform
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import resources
from typing import Any, NoReturn, TextIO

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ofsat_ros.nodes import shared_memory
from ofsat_ros.nodes.ros_parameters import refuse_unknown
from ofsat_ros.nodes.start import on_end_signals
from ofsat_ros.parameters import ParameterError
from ofsat_ros.printing import printable

STARTED_WRONGLY = 2  # exit code; the same as argparse's

_PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
# How often the main thread looks whether a signal has come.
_LOOK_S = 0.2
# How long a node's own threads, or the middleware, may take to end, or a node to be made: signals
# must end it within a second.
_PATIENCE_S = 0.5


class StartError(Exception):
    """A node cannot start; the message is one line that says what to do."""


class Inbox:
    """Messages on their way from a callback to a worker thread, in order.

    Parameters
    ----------
    depth : int
        Messages that may wait whatever their size; more may wait while they are small.
    backlog_s : float or None
        None: none is lost; `put` blocks only when `depth` messages wait and one more would exceed
        `LIMIT_BYTES`.  So up to 1 GiB is held whatever the depth, and more than that only for the
        first `depth` messages.  A number: when one has waited for longer, or there is no room,
        the next replaces all that wait, and so does each from then on, until the worker keeps up
        for as long: a hiccup loses none, and in an overload nothing waits behind another.
    """

    # The middleware overwrites what is not taken from it in time, without a word; so memory, not
    # a count of frames, bounds how far a reliable sender may run ahead of the worker.
    LIMIT_BYTES = 1 << 30

    def __init__(
        self, depth: int, backlog_s: float | None, limit_bytes: int = LIMIT_BYTES
    ) -> None:
        self._depth, self._limit_bytes = depth, limit_bytes
        self._backlog_s = backlog_s
        self._items: deque[tuple[Any, int, float]] = deque()  # message, size, when it came
        self._bytes = 0
        self._taken_s: float | None = None  # when the message in work was taken
        self.closed = False
        self._overloaded, self._replaced_s = False, 0.0
        self._changed = threading.Condition()

    def put(self, item: Any, size: int) -> int:
        """Add a message of `size` bytes; return how many waiting ones it replaced."""
        with self._changed:
            replaced = 0
            now_s = time.monotonic()
            if self._backlog_s is None:
                self._changed.wait_for(lambda: self.closed or self._has_room(size))
            elif self._items and (
                self._overloaded
                or now_s - self._items[0][2] >= self._backlog_s
                or not self._has_room(size)
            ):
                self._overloaded, self._replaced_s = True, now_s
                replaced = len(self._items)
                self._items.clear()
                self._bytes = 0
            self._items.append((item, size, now_s))
            self._bytes += size
            self._changed.notify_all()
            return replaced

    def get(self) -> Any | None:
        """Wait for the next message and return it; None once closed."""
        with self._changed:
            self._taken_s = None
            if self._overloaded and not self._items:
                self._overloaded = time.monotonic() - self._replaced_s <= (self._backlog_s or 0)
            self._changed.wait_for(lambda: self.closed or self._items)
            if self.closed:
                return None
            item, size, _ = self._items.popleft()
            self._bytes -= size
            self._taken_s = time.monotonic()
            self._changed.notify_all()
            return item

    def in_work_s(self) -> float:
        """Return how long the worker has been at its last message, s; 0 if it waits for one."""
        taken_s = self._taken_s
        return 0.0 if taken_s is None else time.monotonic() - taken_s

    def close(self) -> None:
        """Release whoever waits; what is inside is dropped."""
        with self._changed:
            self.closed = True
            self._items.clear()
            self._changed.notify_all()

    def _has_room(self, size: int) -> bool:
        return len(self._items) < self._depth or self._bytes + size <= self._limit_bytes


@contextmanager
def lifetime(node: Node, stop: threading.Event) -> Iterator[None]:
    """Wrap all that a node's own thread does: with it the node ends, with 1 after an error.

    Parameters
    ----------
    node : Node
        Its attribute ``exit_code`` becomes 1 after an error, which is logged.
    stop : threading.Event
        Set at the end.  An error after it was set is none: the node is being taken apart.
    """
    try:
        yield
    # Otherwise the thread would end, and the node would seem to have done its work.
    except Exception:  # noqa: BLE001
        if not stop.is_set():
            node.get_logger().error(traceback.format_exc())
            node.exit_code = 1
    finally:
        stop.set()


def parser_of(node: str, description: str) -> argparse.ArgumentParser:
    """Return a parser for a node's arguments that are not ROS's; the node may add some."""
    return argparse.ArgumentParser(
        node,
        description=description,
        epilog="Parameters: --ros-args -p NAME:=VALUE; the README has a table of them.",
    )


def run(
    make_node: Callable[[threading.Event, argparse.Namespace], Node],
    parser: argparse.ArgumentParser,
) -> int:
    """Run a node until a signal or the node itself ends it.

    Parameters
    ----------
    make_node : callable
        Called with the stop event, which the node may set, and the parsed arguments.  The node
        has a ``close()`` that ends its own threads and flushes its files within half a second.
    parser : argparse.ArgumentParser
        As `parser_of` makes it.

    Returns
    -------
    int
        Exit code of a node that could not start: 2.  Of others the process ends here: with 0 after
        an orderly end, 1 after a failure.
    """
    stop, made = threading.Event(), threading.Event()
    _end_on_signals(stop, made)
    shortage = prepare_for_large_images()
    node = None
    try:
        options = parser.parse_args(remove_ros_args(sys.argv)[1:])
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = make_node(stop, options)
        refuse_unknown(node)
    # rclpy's own: use_sim_time or a QoS of the wrong type; a recorded topic that is no name.
    except (
        ParameterError,
        ParameterException,
        NameValidationException,
        StartError,
        RuntimeError,
    ) as error:
        say(f"{parser.prog}: {_one_line(error)}", sys.stderr)
        if node is not None:
            node.close()
        rclpy.try_shutdown()
        return STARTED_WRONGLY
    made.set()
    if shortage:
        node.get_logger().warning(shortage)
    return _serve(node, stop)


def say(line: str, where: TextIO | None = None) -> None:
    """Print a line; without a reader (``| head``, a closed terminal) the node works on.

    Parameters
    ----------
    line : str
    where : TextIO, optional
        Default: standard output.
    """
    where = where or sys.stdout
    try:
        where.write(line + "\n")
        where.flush()
    except OSError:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), where.fileno())


def prepare_for_large_images() -> str:
    """Ready allocator and middleware for images of megabytes; call before ``rclpy.init``.

    Returns
    -------
    str
        What is wrong with the machine's shared memory; empty if nothing is.
    """
    _keep_large_buffers()
    if os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") != "rmw_fastrtps_cpp":
        return ""
    shared_memory.remove_abandoned()
    # Unless the user chose for himself.
    if not any(os.environ.get(name) for name in _PROFILE_VARIABLES):
        os.environ[_PROFILE_VARIABLES[0]] = profile_path()
    chosen = next(os.environ[name] for name in _PROFILE_VARIABLES if os.environ.get(name))
    return shared_memory.shortage(chosen)


def _end_on_signals(stop: threading.Event, made: threading.Event) -> None:
    """Have signals set the stop event, or end the process if it takes long to make the node."""

    def end() -> None:
        stop.set()
        if not made.wait(_PATIENCE_S):  # a large bag that is opened, say: nothing is written yet
            _leave(0)

    # Ours instead of rclpy's or Python's: no exception then breaks into whatever runs.  Not at
    # once: this may have interrupted the main thread while it holds the event's own lock.
    on_end_signals(lambda *_: _thread.start_new_thread(end, ()))


def _leave(code: int) -> NoReturn:
    """End the process at once; the middleware's shared memory does not outlive it."""
    shared_memory.remove_own()
    os._exit(code)


def _serve(node: Node, stop: threading.Event) -> NoReturn:
    failures: list[BaseException] = []
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        try:
            while not stop.is_set():
                executor.spin_once()
        except ExternalShutdownException:
            pass
        # Handed to the main thread, which raises it.
        except Exception as error:  # noqa: BLE001
            if not stop.is_set():
                failures.append(error)
        finally:
            stop.set()

    thread = threading.Thread(target=spin, name="executor", daemon=True)
    thread.start()
    # Python acts on a signal when this thread goes on, and one that comes just before it waits, or
    # to another thread, does not wake it.
    while not stop.wait(_LOOK_S):
        pass
    node.close()
    code = getattr(node, "exit_code", 0)
    # What follows is the middleware's: it is not waited for longer than is usual.
    last = threading.Timer(2 * _PATIENCE_S, _leave, (code,))
    last.daemon = True
    last.start()
    executor.create_task(lambda: None)  # the only thing that makes spin_once return
    thread.join(_PATIENCE_S)
    executor.shutdown()
    # Without this the middleware leaves its shared memory behind.
    node.destroy_node()
    rclpy.try_shutdown()
    if failures:
        last.cancel()
        raise failures[0]
    # All that is ours is closed.  Python's own end would take longer than that, and would pull the
    # ground from under a thread that is still inside a long native call.
    _leave(code)


def _one_line(error: Exception) -> str:
    return printable(" ".join(str(error).split()))


def _keep_large_buffers() -> None:
    """Have glibc keep freed megabytes instead of mapping them afresh for every image."""
    if platform.libc_ver()[0] != "glibc":
        return
    mallopt = ctypes.CDLL(None).mallopt
    trim_threshold, mmap_max, arena_max = -1, -4, -8  # malloc.h
    mallopt(mmap_max, 0)
    mallopt(trim_threshold, 2_000_000_000)
    mallopt(arena_max, 1)


def profile_path() -> str:
    """Return where the Fast DDS profile for large images lies."""
    return str(resources.files("ofsat_ros").joinpath("data/fastdds_large_images.xml"))
