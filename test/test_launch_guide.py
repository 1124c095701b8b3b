# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The guide's launch file starts an executable that exists, with parameters that exist."""

from typing import Any

import pytest
from test_launch import launch, of_kind, only  # noqa: F401  a fixture, and what reads it

from ofsat_ros.parameters import GuideParameters


def test_guide_is_left_as_it_is_without_arguments(launch: Any):  # noqa: F811
    node = only("Node", launch("guide.launch.py"))
    assert (node.kwargs["package"], node.kwargs["executable"]) == ("ofsat_ros", "guide")
    assert node.kwargs["parameters"] == [{}]
    assert node.kwargs["remappings"] == []


@pytest.mark.parametrize("engaged", ["true", "false"])
def test_guide_takes_its_arguments(launch: Any, engaged: str):  # noqa: F811
    node = only(
        "Node",
        launch(
            "guide.launch.py",
            namespace="east",
            camera_info="/cam/camera_info",
            mount_rate="/mount/rate",
            target="nearest",
            engaged=engaged,
            params_file="my.yaml",
        ),
    )
    assert node.kwargs["namespace"] == "east"
    # The later wins: what is said on the command line is said on purpose.
    file, parameters = node.kwargs["parameters"]
    assert file == "my.yaml"
    assert parameters == {"target": "nearest", "engaged": engaged == "true"}
    GuideParameters.of(parameters)
    assert node.kwargs["remappings"] == [
        ("camera_info", "/cam/camera_info"),
        ("mount_rate", "/mount/rate"),
    ]


def test_launch_offers_the_targets_there_are(launch: Any):  # noqa: F811
    arguments = {one.name: one for one in of_kind("Argument", launch("guide.launch.py"))}
    (target,) = (about for about in GuideParameters.describe() if about.name == "target")
    assert arguments["target"].kwargs["choices"] == ["", *target.choices]
