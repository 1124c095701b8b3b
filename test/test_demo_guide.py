# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The guide's demo from start to end: all nodes as processes, over DDS, in real time."""

import csv
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from ros_graph import Process

from ofsat_ros.nodes.demo_guide import COLUMNS

pytestmark = pytest.mark.alone


def test_rso_is_acquired_and_held(tmp_path):
    output = tmp_path / "out"
    given = ("--scenario", "guide_drift", "--seconds", "15", "--output", f"{output}")
    with Process(tmp_path, "demo_guide", *given) as shown:
        assert shown.wait(90) == 0, shown.out + shown.err
    said = re.search(
        r"guide_drift: held; acquired with frame (\d+); error 8 s later ([\d.]+) px rms,"
        r" ([\d.]+) px at worst; no loss;",
        shown.out,
    )
    assert 3 <= int(said[1]) <= 12
    assert float(said[2]) <= 2.0
    with (output / "guide_drift.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) > 50
    late = [row for row in rows if float(row["time_s"]) > 9]
    off = np.array([[float(row[name]) for name in COLUMNS[2:6]] for row in late])
    assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))) <= 2.0
    # What the guide says of the offset is where the RSO is.
    assert np.nanmedian(np.abs(off[:, 2:] - off[:, :2])) < 0.5
    assert {row["state"] for row in late} == {"following"}
    assert (output / "guide_drift.png").read_bytes().startswith(b"\x89PNG")


def test_ctrl_c_leaves_no_process_behind(tmp_path):
    with Process(tmp_path, "demo_guide", "--output", f"{tmp_path / 'out'}") as shown:
        shown.wait_for("following: track", 60)
        task = Path(f"/proc/{shown.popen.pid}/task/{shown.popen.pid}/children")
        children = task.read_text().split()
        assert len(children) == 3
        shown.popen.send_signal(signal.SIGINT)
        assert shown.wait() == 130
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]
    assert "Traceback" not in shown.err
