# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Workers that do tasks: Dask's, on this machine or behind a scheduler elsewhere.

The only part of ``batch`` that knows Dask.  It hands out a few tasks at a time, so that a worker
that dies takes with it, and is blamed on, no others than those it was at.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import queue
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, Self

from ofsat_ros.batch.tasks import PROGRESS, Answer, Order, probe

# How often a task is begun whose worker dies each time.
TRIES = 3
_CONNECT_S, _CLOSE_S = 30, 5
# Workers that died come back, or others do.
_ASK_EVERY_S, _UNMANNED_S = 1.0, 300.0
_LOCAL = {
    "distributed.scheduler.allowed-failures": TRIES - 1,
    "distributed.scheduler.worker-saturation": 1.0,
    # Results are small: what a worker holds is the task's, which neither spilling nor waiting
    # makes less; but one that outgrows its share is ended before the machine is out of memory.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.worker.profile.enabled": False,
    "distributed.worker.daemon": True,
    # A busy machine takes its time to start one again.
    "distributed.deploy.lost-worker-timeout": "60s",
    # Nothing is served but what the workers need.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}


class ClusterError(Exception):
    """There is no cluster to work on, or no longer; the message says why and what to do."""


@dataclass(frozen=True)
class Progress:
    """How many frames a task has done."""

    token: str
    frames: int


class Cluster:
    """A cluster to give tasks to; a context manager, which ends what is still at work.

    Parameters
    ----------
    order : Order
        As the tasks have it.
    scheduler : str or None
        Address of a scheduler, as ``tcp://host:8786``; None for workers of our own.
    workers : int or None
        How many of our own; None for one a core.

    Raises
    ------
    ModuleNotFoundError
        If Dask is not installed; the message names the extra that brings it.
    ClusterError
        If there is no such scheduler, or it has no workers, or they are not fit.
    """

    def __init__(self, order: Order, scheduler: str | None, workers: int | None) -> None:
        # The latter, for what goes between our own processes.
        for module in ("distributed", "cryptography"):
            if importlib.util.find_spec(module) is None:
                raise ModuleNotFoundError(
                    f"batch needs {module}: pip install 'ofsat_ros[cluster]'", name=module
                )
        import distributed

        self._distributed = distributed
        self._order = order
        # Filled by threads of Dask's.
        self._inbox: queue.SimpleQueue[tuple[str, Any] | Progress] = queue.SimpleQueue()
        self._futures: dict[str, Any] = {}
        self._unfit: set[str] = set()
        self._restore: Callable[[], object] = lambda: None  # others' workers are not ours to start
        self._slots, self._asked_s, self._manned_s = 0, -_ASK_EVERY_S, time.monotonic()
        with ExitStack() as stack:
            if scheduler is None:
                own = stack.enter_context(_own(distributed, workers))
                self._client = stack.enter_context(_client(distributed, own, "ourselves"))
                # Of workers that died, those that could not be started again.
                self._restore = partial(own.scale, len(own.workers))
            else:
                self._client = stack.enter_context(_client(distributed, scheduler, scheduler))
                self._check(scheduler)
            self._client.subscribe_topic(PROGRESS, self._hear)
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # the scheduler may be gone, or slow
            self._client.cancel(list(self._futures.values()))
        self._open.close()

    @property
    def slots(self) -> int:
        """How many tasks can be at work at once.

        Raises
        ------
        ClusterError
            If there has been no worker for a long time.
        """
        now_s = time.monotonic()
        if now_s - self._asked_s > _ASK_EVERY_S:
            self._asked_s, self._slots = now_s, sum(self._client.nthreads().values())
            self._restore()
        if self._slots:
            self._manned_s = now_s
        elif now_s - self._manned_s > _UNMANNED_S:
            raise ClusterError(
                "no worker is left: start some, and run the same command again to go on"
            )
        return self._slots

    @property
    def busy(self) -> int:
        """How many are."""
        return len(self._futures)

    def submit(self, token: str, task: Callable[..., Answer], *arguments: Any) -> None:
        """Have a task done by a worker that is fit, as far as is known."""
        fit = set(self._client.nthreads()) - self._unfit if self._unfit else None
        future = self._client.submit(
            task,
            *arguments,
            key=f"{token}-{os.urandom(4).hex()}",
            pure=False,
            workers=fit or None,
            # Others may come, and these may go.
            allow_other_workers=bool(fit),
        )
        self._futures[token] = future
        future.add_done_callback(lambda done: self._inbox.put((token, done)))

    def news(self, timeout_s: float) -> tuple[str, Answer] | Progress | None:
        """Return what comes next: a task's token with its answer, or progress; None for nothing.

        Raises
        ------
        ClusterError
            If the scheduler is gone.
        """
        try:
            news = self._inbox.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(news, Progress):
            return news
        token, future = news
        del self._futures[token]
        return token, self._answer(future)

    def _answer(self, future: Any) -> Answer:
        if future.status == "cancelled":
            raise ClusterError("the scheduler is gone: run the same command again to go on")
        try:
            answer = future.result()
        except self._distributed.KilledWorker as error:
            tries = error.allowed_failures + 1
            return Answer(
                failed=f"its worker died {tries} times, killed or out of memory: it is given up"
            )
        # Of Dask itself, or of a worker that lacks a module.
        except Exception as error:  # noqa: BLE001
            return Answer(unfit=f"{type(error).__name__}: {error}")
        if answer.unfit:
            self._unfit.add(answer.worker)
        assert isinstance(answer, Answer)
        return answer

    def _hear(self, event: tuple[float, dict[str, Any]]) -> None:
        _, told = event
        if told["run"] == self._order.run:
            self._inbox.put(Progress(told["token"], told["frames"]))

    def _check(self, scheduler: str) -> None:
        """Refuse a cluster whose workers could not do the work."""
        found = self._client.run(probe, self._order, on_error="return")
        if not found:
            raise ClusterError(f"the scheduler at {scheduler} has no worker: start some first")
        unfit = [f"{where}: {why}" for where, why in sorted(found.items()) if why]
        if unfit:
            raise ClusterError("not all workers are fit for this:\n  " + "\n  ".join(unfit))


@contextmanager
def _own(distributed: Any, workers: int | None) -> Iterator[Any]:
    """Start workers on this machine, whom nobody else can reach, and end them."""
    import dask
    from dask.system import CPU_COUNT

    dask.config.set(_LOCAL)
    with _signals_for_us():
        # Encrypted with keys of its own, for other users of this machine reach its ports, too.
        cluster = distributed.LocalCluster(
            n_workers=workers or CPU_COUNT,
            threads_per_worker=1,
            host="127.0.0.1",
            security=True,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0", "dashboard": False},
            silence_logs=logging.CRITICAL,
        )
    try:
        yield cluster
    finally:
        # Workers that take longer end with us.
        with suppress(TimeoutError):
            cluster.close(_CLOSE_S)


@contextmanager
def _signals_for_us() -> Iterator[None]:
    """Have the threads and processes that are begun meanwhile ignore the terminal.

    Ctrl-C goes to all processes there; workers end when they are told to, or when we are gone.
    """
    if sys.platform == "win32":
        yield
        return
    # Who begins this process of Python's own lets the thread hear SIGINT again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _client(distributed: Any, cluster: Any, name: str) -> Iterator[Any]:
    """Connect with a cluster, or with what has this address."""
    # What goes wrong with it is told in our words.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(cluster, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise ClusterError(f"no scheduler answers at {name}: {error}") from error
    try:
        yield client
    finally:
        with suppress(TimeoutError):
            client.close(_CLOSE_S)
