# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Start the guide beside a detector that runs already.

For example::

    ros2 launch ofsat_ros guide.launch.py camera_info:=/camera/camera_info params_file:=my.yaml

It commands nothing before it is engaged: ``ros2 service call /guide/engage std_srvs/srv/SetBool
"{data: true}"``, or the argument ``engaged:=true``.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = [
    DeclareLaunchArgument(
        "namespace",
        default_value="",
        description="before the names of the node and its topics; as the detector's",
    ),
    DeclareLaunchArgument(
        "camera_info", default_value="", description="topic of the calibration; empty: camera_info"
    ),
    DeclareLaunchArgument(
        "mount_rate", default_value="", description="topic of the commands; empty: mount_rate"
    ),
    DeclareLaunchArgument(
        "target",
        default_value="",
        choices=["", "first", "brightest", "nearest", "id"],
        description="which track is followed; empty: as the parameters say",
    ),
    DeclareLaunchArgument(
        "engaged",
        default_value="",
        choices=["", "true", "false"],
        description="true: command the mount from the start; empty: as the parameters say",
    ),
    DeclareLaunchArgument(
        "respawn",
        default_value="false",
        choices=["true", "false"],
        description="true: start the node again, 2 s after it ended in whatever way",
    ),
    DeclareLaunchArgument(
        "params_file", default_value="", description="YAML file of parameters; empty: none"
    ),
]


def guide(context: LaunchContext) -> list[Node]:
    """Return the guide with what was given."""
    given = {
        argument.name: LaunchConfiguration(argument.name).perform(context)
        for argument in ARGUMENTS
    }
    parameters: dict[str, str | bool] = {}
    if given["target"]:
        parameters["target"] = given["target"]
    if given["engaged"]:
        parameters["engaged"] = given["engaged"] == "true"
    return [
        Node(
            package="ofsat_ros",
            executable="guide",
            name="guide",
            namespace=given["namespace"],
            output="screen",
            respawn=given["respawn"] == "true",
            respawn_delay=2.0,
            parameters=[*([given["params_file"]] if given["params_file"] else []), parameters],
            remappings=[
                (name, given[name]) for name in ("camera_info", "mount_rate") if given[name]
            ],
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe what `ros2 launch` starts."""
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=guide)])
