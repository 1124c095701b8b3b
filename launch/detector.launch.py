# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Start the detector.

For example::

    ros2 launch ofsat_ros detector.launch.py image:=/camera/image_raw params_file:=my.yaml
    ros2 launch ofsat_ros detector.launch.py image:=/camera/image_raw rviz:=true
    ros2 launch ofsat_ros detector.launch.py image:=/camera/image_raw respawn:=true

Sets the Fast DDS profile for large images unless the environment already names one; whoever sends
the images needs it too.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

from ofsat_ros.parameters import preset_names

CONFIG = Path(get_package_share_directory("ofsat_ros"), "config")
PROFILE = (CONFIG / "fastdds_large_images.xml").as_posix()
VIEW = (CONFIG / "ofsat.rviz").as_posix()

ARGUMENTS = [
    DeclareLaunchArgument(
        "namespace", default_value="", description="before the names of the node and its topics"
    ),
    DeclareLaunchArgument(
        "image", default_value="", description="topic to read; empty: image, or image/compressed"
    ),
    DeclareLaunchArgument(
        "camera_info", default_value="", description="topic of the calibration; empty: camera_info"
    ),
    DeclareLaunchArgument(
        "attitude", default_value="", description="topic of the attitude; empty: attitude"
    ),
    DeclareLaunchArgument(
        "image_transport",
        default_value="",
        choices=["", "raw", "compressed"],
        description="how the images come; empty: as the parameters say",
    ),
    DeclareLaunchArgument(
        "preset",
        default_value="",
        choices=["", *preset_names()],
        description="named choices to start from; empty: as the parameters say",
    ),
    DeclareLaunchArgument(
        "reliable_input",
        default_value="",
        choices=["", "true", "false"],
        description="true: lose no frame, for replay; empty: as the parameters say",
    ),
    DeclareLaunchArgument(
        "params_file", default_value="", description="YAML file of parameters; empty: none"
    ),
    DeclareLaunchArgument(
        "respawn",
        default_value="false",
        choices=["true", "false"],
        description="true: start the node again, 2 s after it ended in whatever way",
    ),
    DeclareLaunchArgument(
        "rviz",
        default_value="false",
        choices=["true", "false"],
        description="true: show image and markers in RViz, which must be installed: rviz2",
    ),
]


def detector(context: LaunchContext) -> list[Node]:
    """Return the node; an argument that is not given leaves the parameter as it would be.

    And RViz, if it is wanted.
    """
    given = {
        argument.name: LaunchConfiguration(argument.name).perform(context)
        for argument in ARGUMENTS
    }
    parameters = {name: given[name] for name in ("preset", "image_transport") if given[name]}
    if given["reliable_input"]:
        parameters["reliable_input"] = given["reliable_input"] == "true"
    files = [given["params_file"]] if given["params_file"] else []
    remappings = [(name, given[name]) for name in ("camera_info", "attitude") if given[name]]
    if given["image"]:
        remappings += [(name, given["image"]) for name in ("image", "image/compressed")]
    return [
        Node(
            package="ofsat_ros",
            executable="detector",
            name="detector",
            namespace=given["namespace"],
            output="screen",
            respawn=given["respawn"] == "true",
            respawn_delay=2.0,
            parameters=[*files, parameters],
            remappings=remappings,
        ),
        *([rviz(given["namespace"])] if given["rviz"] == "true" else []),
    ]


def rviz(namespace: str) -> Node:
    """Return RViz, looking at what the detector in a namespace publishes."""
    topics = ("image_annotated", "flow_markers")
    return Node(
        package="rviz2",
        executable="rviz2",
        name="rviz",
        namespace=namespace,
        arguments=["-d", VIEW],
        # The view names topics without a namespace.
        remappings=[(f"/{topic}", topic) for topic in topics],
    )


def generate_launch_description() -> LaunchDescription:
    """Describe what `ros2 launch` starts."""
    profile = EnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", default_value=PROFILE)
    return LaunchDescription(
        [
            *ARGUMENTS,
            SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", profile),
            OpaqueFunction(function=detector),
        ]
    )
