# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Start the simulator and a detector that looks at its images.

For example::

    ros2 launch ofsat_ros simulation.launch.py scenario:=geo
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from ofsat_ros.simulation import SCENARIOS


def simulator(context: LaunchContext) -> list:
    """Return the simulator, which publishes where the detector listens."""
    scenario, seed, rate, namespace, image = (
        LaunchConfiguration(name).perform(context)
        for name in ("scenario", "seed", "rate", "namespace", "image")
    )
    node = Node(
        package="ofsat_ros",
        executable="simulator",
        name="simulator",
        namespace=namespace,
        output="screen",
        parameters=[{"scenario": scenario, "seed": int(seed), "rate": float(rate)}],
        remappings=[("image", image)] if image else [],
    )
    # A detector alone would wait for ever.
    end = OnProcessExit(target_action=node, on_exit=[Shutdown(reason="the simulator has ended")])
    return [node, RegisterEventHandler(end)]


def generate_launch_description() -> LaunchDescription:
    """Describe what `ros2 launch` starts; the detector's own arguments are taken too."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "scenario",
                default_value="sidereal",
                choices=list(SCENARIOS),
                description="sky to show",
            ),
            DeclareLaunchArgument("seed", default_value="1", description="of the sky, its noise"),
            DeclareLaunchArgument("rate", default_value="1.0", description="1: in real time"),
            DeclareLaunchArgument(
                "namespace", default_value="", description="before the names of nodes and topics"
            ),
            DeclareLaunchArgument(
                "image", default_value="", description="topic of the images; empty: image"
            ),
            IncludeLaunchDescription(Path(__file__).with_name("detector.launch.py").as_posix()),
            OpaqueFunction(function=simulator),
        ]
    )
