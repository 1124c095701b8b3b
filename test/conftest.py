"""What all tests share: a ROS graph of their own, set before anything imports rclpy."""

import os
import re
from pathlib import Path

import pytest

import ofsat_ros

# In the text of tests that run nodes, or what nodes are made of.
_OF_GRAPH = re.compile(r"\b(rclpy|ros_graph|ofsat_ros\.nodes)\b")

# Two test runs at once, or a ROS graph on this machine, must not hear each other.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(ofsat_ros.__file__).parent / "data" / "fastdds_large_images.xml"
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what must run one after the other: DDS and its deadlines want the machine alone."""
    files = {item.path for item in items}
    of_graph = {path for path in files if _OF_GRAPH.search(path.read_text())}
    for item in items:
        if item.path in of_graph:
            item.add_marker("graph")
