# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How nodes start and end: signals, start errors, and the hand-over to their own threads."""

import importlib
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from ros_graph import Process, sky, write_bag

from ofsat_ros.nodes import runtime
from ofsat_ros.nodes.runtime import Inbox
from ofsat_ros.nodes.start import END_SIGNALS

MEGABYTE = 1 << 20


def test_inbox_keeps_the_order():
    inbox = Inbox(depth=3, backlog_s=None)
    for number in range(3):
        assert inbox.put(number, MEGABYTE) == 0
    assert [inbox.get() for _ in range(3)] == [0, 1, 2]


def test_live_inbox_without_backlog_keeps_the_newest_and_counts_the_others():
    inbox = Inbox(depth=3, backlog_s=0.0)
    assert [inbox.put(number, MEGABYTE) for number in range(3)] == [0, 1, 1]
    assert inbox.get() == 2


def test_live_inbox_loses_nothing_in_a_hiccup_and_all_but_the_newest_in_an_overload(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(runtime.time, "monotonic", lambda: now_s)
    inbox = Inbox(depth=3, backlog_s=0.5)
    for number in range(10):  # 0.45 s
        assert inbox.put(number, MEGABYTE) == 0
        now_s += 0.05
    assert inbox.get() == 0
    assert inbox.put(10, MEGABYTE) == 0  # the oldest has waited for 0.45 s
    now_s += 0.1
    assert inbox.put(11, MEGABYTE) == 10
    assert inbox.get() == 11


def test_live_inbox_never_blocks():
    inbox = Inbox(depth=1, backlog_s=60.0)
    half = Inbox.LIMIT_BYTES // 2
    assert [inbox.put(number, half) for number in range(4)] == [0, 0, 2, 1]
    assert inbox.get() == 3


def test_in_an_overload_nothing_waits_behind_another_until_the_worker_keeps_up(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(runtime.time, "monotonic", lambda: now_s)
    inbox = Inbox(depth=3, backlog_s=0.5)
    inbox.put(0, MEGABYTE)
    now_s += 0.6
    assert inbox.put(1, MEGABYTE) == 1
    for number in range(2, 20):  # three come while one is in work
        now_s += 0.1
        assert inbox.put(number, MEGABYTE) == (number % 3 != 1)
        if number % 3 == 0:
            assert inbox.get() == number
    for number in range(20, 26):  # each is taken when it comes
        assert inbox.get() == number - 1
        now_s += 0.1
        assert inbox.put(number, MEGABYTE) == 0
    assert inbox.get() == 25
    threading.Timer(0.1, inbox.put, (26, MEGABYTE)).start()
    assert inbox.get() == 26  # the worker had to wait, long after the last one was replaced
    assert [inbox.put(number, MEGABYTE) for number in (27, 28)] == [0, 0]


def test_a_picture_in_work_and_one_that_waits_are_all_that_is_kept():
    inbox = Inbox(depth=1, backlog_s=None, limit_bytes=0)
    inbox.put(0, 1)
    thread = threading.Thread(target=inbox.put, args=(1, 1))
    thread.start()
    thread.join(0.1)
    assert thread.is_alive()
    assert inbox.get() == 0
    thread.join(5)
    assert inbox.get() == 1


def test_full_inbox_blocks_until_there_is_room():
    inbox = Inbox(depth=2, backlog_s=None)
    half = Inbox.LIMIT_BYTES // 2
    inbox.put(0, half)
    inbox.put(1, half)
    thread = threading.Thread(target=inbox.put, args=(2, half))
    thread.start()
    thread.join(0.1)
    assert thread.is_alive()
    assert inbox.get() == 0
    thread.join(5)
    assert not thread.is_alive()
    assert [inbox.get(), inbox.get()] == [1, 2]


def test_small_frames_may_queue_beyond_the_depth():
    inbox = Inbox(depth=2, backlog_s=None)
    for number in range(100):  # would block, and never end, if the depth were the limit
        inbox.put(number, MEGABYTE)
    assert inbox.get() == 0


def test_closing_releases_both_ends():
    inbox = Inbox(depth=1, backlog_s=None)
    got: list = []
    thread = threading.Thread(target=lambda: got.append(inbox.get()))
    thread.start()
    inbox.close()
    thread.join(5)
    assert got == [None]
    inbox.put(0, 2 * Inbox.LIMIT_BYTES)
    inbox.put(1, 2 * Inbox.LIMIT_BYTES)  # does not block


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_every_node_within_a_second(number, tmp_path):
    bag = write_bag(tmp_path / "bag", sky(2), topic="/nobody")
    arguments = {
        "detector": (),  # it works on the simulator's images when the signal comes
        "simulator": ("--ros-args", "-p", "rate:=20.0"),
        "player": (f"{bag}",),
        "recorder": ("--ros-args", "-p", f"output:={tmp_path / 'output'}"),
        "guide": ("--ros-args", "-p", "engaged:=true"),
        "tdm_writer": ("--ros-args", "-p", f"output:={tmp_path / 'tracks'}"),
    }
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(Process(tmp_path, name, *given))
            for name, given in arguments.items()
        }
        nodes["detector"].wait_for("waiting for images")
        nodes["simulator"].wait_for("px every")
        nodes["player"].wait_for("waiting for 1 subscriber")
        nodes["recorder"].wait_for("hearing a detector")
        nodes["recorder"].wait_for("time (UTC)")
        nodes["guide"].wait_for("waiting for tracks on")
        nodes["tdm_writer"].wait_for("writing the tracks of")
        # Other processes on this machine make and remove segments meanwhile.
        segments = set.union(*(node.shared_memory for node in nodes.values()))
        assert len(segments) >= len(nodes)
        for name, node in nodes.items():
            # A busy machine may take longer than the second: five, and the node's own share of it.
            cpu_s = node.end(number, patience_s=5.0)
            assert cpu_s < 1.0, name
            assert node.wait() == 0, f"{name}: {node.err}"
            assert "Traceback" not in node.err
    assert not segments & set(os.listdir("/dev/shm")), "shared memory was not given back"


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable]:
    """Return a function that runs a node's main here, without the imports of a new process."""
    monkeypatch.setattr(runtime, "prepare_for_large_images", lambda: None)
    before = {number: signal.getsignal(number) for number in END_SIGNALS}

    def main(node: str, *arguments: str) -> int:
        monkeypatch.setattr("sys.argv", [node, *arguments])
        return importlib.import_module(f"ofsat_ros.nodes.{node}").main()

    yield main
    for number, handler in before.items():
        signal.signal(number, handler)


PROBLEMS = {
    "bad value": ("detector", ["-p", "smoothing_sigma_px:=50"], "0 to 10 px, not 50"),
    "bad type": ("detector", ["-p", "engine:=3"], "engine must be text .sparse | dense."),
    "misspelt": ("detector", ["-p", "threshold_sigma:=3"], "did you mean threshold_sigmas"),
    "no preset": ("detector", ["-p", "preset:=best"], "no preset 'best'; there are robust"),
    "misspelt qos": (
        "detector",
        ["-p", "qos_overrides./imag.subscription.depth:=3"],
        "did you mean qos_overrides./image.subscription.depth",
    ),
    "bad qos": (
        "detector",
        ["-p", "qos_overrides./image.subscription.reliability:=sure"],
        "reliability.*sure",
    ),
    "no such file": ("detector", ["--params-file", "nowhere.yaml"], "nowhere.yaml"),
    "no bag given": ("player", [], "no bag given: player PATH"),
    "wrong bag": ("player", ["-p", "bag:=nowhere/bag"], "nowhere/bag does not exist"),
    "no scenario": ("simulator", ["-p", "scenario:=rain"], "no scenario 'rain'; there are geo"),
    "not ours": ("recorder", ["-p", "output:=mine"], "is not a recorder's"),
}


@pytest.mark.parametrize("problem", PROBLEMS)
def test_a_wrong_start_is_one_clear_line(problem, in_this_process, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    node, arguments, said = PROBLEMS[problem]
    assert in_this_process(node, "--ros-args", *arguments) == 2
    err = capfd.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith(f"{node}: ")]
    assert len(lines) == 1, err
    assert re.search(said, lines[0])
    assert "Traceback" not in err


def test_a_wrong_start_ends_the_process(tmp_path):
    with Process(tmp_path, "player") as player:
        assert player.wait() == 2
    assert player.err == "player: no bag given: player PATH, or --ros-args -p bag:=PATH\n"


def test_parameters_of_another_node_are_only_warned_of(tmp_path):
    with Process(tmp_path, "detector", "--ros-args", "-p", "bag:=night.mcap") as detector:
        detector.wait_for("parameter bag is read by player")
        detector.wait_for("waiting for images")
