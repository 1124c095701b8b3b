# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Install ofsat_ros, for pip and for colcon alike."""

import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "ofsat_ros"
VERSION = re.search(r'^__version__ = "(.+)"$', Path(NAME, "__init__.py").read_text(), re.M)[1]

# ROS and OpenCV are extras, never requirements: a ROS machine has both from apt, where pip does
# not see them and would put others in front of them.
OPENCV = ["opencv-python-headless>=4.6"]
ROS = [
    "ros-jazzy-rclpy",
    "ros-jazzy-rmw-fastrtps-cpp",
    "ros-jazzy-diagnostic-msgs",
    "ros-jazzy-geometry-msgs",
    "ros-jazzy-rosgraph-msgs",
    "ros-jazzy-sensor-msgs",
    "ros-jazzy-std-srvs",
    "ros-jazzy-visualization-msgs",
    *OPENCV,
]
LINT = ["mypy>=2.4,<3", "pip-audit", "ruff>=0.17,<0.18", "types-PyYAML", "types-tqdm"]
SKY = ["astropy>=5.3"]  # the first that reads parts of compressed images
PLOT = ["matplotlib"]
REPORT = ["av", "jinja2", "pillow"]
CLUSTER = ["cryptography", "distributed>=2025.1"]  # the first for encryption on one machine, too
BENCH = ["sgp4", *PLOT, *SKY]
DOCS = ["pdoc>=16"]
TEST = [
    "catkin_pkg",  # reads package.xml and the changelog as bloom does
    "colcon-core",
    "colcon-ros",
    "hypothesis",
    "mcap",  # writes what we read
    "pytest>=7.4",  # Ubuntu 24.04's
    "pytest-xdist",
    "sep",
    *(*SKY, *PLOT, *REPORT, *CLUSTER, *DOCS, "sgp4"),
    *("ccsds-ndm", "lxml"),  # reads back what we write; GPL, so for tests only
    "setuptools>=70.1,<80",  # the range in which colcon and pip can both build with it
]

SAMPLE_BAG = "bags/survey_png"  # the smallest
NODES = (
    *("detector", "player", "simulator", "recorder", "guide", "tdm_writer", "watch"),
    *("demo", "demo_guide"),
)

setup(
    name=NAME,
    version=VERSION,
    description="Detects satellites and debris in a telescope camera's stream by optical flow",
    maintainer="ofsat_ros maintainers",
    maintainer_email="maintainers@ofsat-ros.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["presets/*.yaml", "data/*", "report/page/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        # What the demo plays where there is no source tree.
        (f"share/{NAME}/{SAMPLE_BAG}", sorted(glob(f"{SAMPLE_BAG}/*"))),
        # For people to copy from; the code reads the package's own, which pip installs too.
        (f"share/{NAME}/config", sorted(glob(f"{NAME}/presets/*.yaml") + glob(f"{NAME}/data/*"))),
    ],
    zip_safe=False,
    install_requires=[
        *("click", "numpy>=1.26", "PyYAML", "rosbags>=0.11.9", "scipy>=1.11", "tqdm"),
        'backports.zstd; python_version < "3.14"',  # as rosbags has it
    ],
    extras_require={
        "ros": ROS,
        "opencv": OPENCV,
        "sky": SKY,
        "plot": PLOT,
        "fits": SKY,
        "exif": ["pillow"],
        "report": REPORT,
        "cluster": CLUSTER,
        "lint": LINT,
        "test": TEST,
        "bench": BENCH,
        "docs": DOCS,
        "all": [*ROS, *SKY, *PLOT, *REPORT, *LINT, *TEST, *BENCH],
    },
    entry_points={
        "console_scripts": [
            f"ofsat = {NAME}.cli:main",
            *(f"{node} = {NAME}.nodes.start:{node}" for node in NODES),
        ]
    },
)
