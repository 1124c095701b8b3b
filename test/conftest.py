# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What all tests share: a ROS graph of their own, set before anything imports rclpy."""

import os
import re
from pathlib import Path

import pytest

import ofsat_ros

# In the text of tests that run nodes, or what nodes are made of.
_OF_GRAPH = re.compile(r"\b(rclpy|ros_graph|ofsat_ros\.nodes)\b")

# Two test runs at once, the workers of one, or a demo (51 and above) must not hear each other.
_WORKER = os.environ.get("PYTEST_XDIST_WORKER", "").removeprefix("gw")
_RUN = os.getppid() if _WORKER else os.getpid()
os.environ["ROS_DOMAIN_ID"] = str(1 + (_RUN + int(_WORKER or 0)) % 50)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(ofsat_ros.__file__).parent / "data" / "fastdds_large_images.xml"
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the pytest of Ubuntu 24.04 ignore the one setting that came after it."""
    if pytest.version_tuple < (9,):
        parser.addini("faulthandler_exit_on_timeout", "a test that hangs goes on", type="bool")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what has nodes, and so processes and deadlines of its own."""
    files = {item.path for item in items}
    of_graph = {path for path in files if _OF_GRAPH.search(path.read_text())}
    for item in items:
        if item.path in of_graph:
            item.add_marker("graph")
