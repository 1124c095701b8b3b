# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Play a bag to a detector, losing no frame, and stop when the bag ends.

For example::

    ros2 launch ofsat_ros replay.launch.py bag:=night.mcap rate:=2.0 record:=night1
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
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from ofsat_ros.nodes.recorder import HEARING
from ofsat_ros.recordings import COMPRESSED_IMAGE, Bag, open_recording


def replay(context: LaunchContext) -> list:
    """Return player and detector, joined at the image topic that the bag holds."""
    bag, topic, rate, record = (
        LaunchConfiguration(name).perform(context) for name in ("bag", "topic", "rate", "record")
    )
    with open_recording(bag, topic or None) as recording:
        topic = recording.topic
        beside = {
            "camera_info": recording.camera_info_topic,
            "attitude": recording.attitude_topic,
        }
    with Bag(bag) as messages:
        compressed = messages.topics[topic].msgtype == COMPRESSED_IMAGE
    detector = IncludeLaunchDescription(
        Path(__file__).with_name("detector.launch.py").as_posix(),
        launch_arguments={
            "image": topic,
            "image_transport": "compressed" if compressed else "raw",
            "reliable_input": "true",
            **{name: found for name, found in beside.items() if found},
        }.items(),
    )
    player = Node(
        package="ofsat_ros",
        executable="player",
        name="player",
        namespace=LaunchConfiguration("namespace"),
        output="screen",
        # A bag may be called 20260401, and is no number for that.
        parameters=[
            {"bag": ParameterValue(bag, value_type=str), "topic": topic, "rate": float(rate)}
        ],
    )
    # The player ends when the detector has answered the last frame.
    end = OnProcessExit(target_action=player, on_exit=[Shutdown(reason="the bag has ended")])
    if not record:
        return [detector, player, RegisterEventHandler(end)]
    recorder = Node(
        package="ofsat_ros",
        executable="recorder",
        name="recorder",
        namespace=LaunchConfiguration("namespace"),
        output="screen",
        parameters=[{"output": ParameterValue(record, value_type=str)}],
    )
    # Not before the recorder hears the detector: it is to have the first result, too.
    start = OnProcessIO(
        target_action=recorder,
        on_stdout=lambda said: [player] if HEARING.encode() in said.text else None,
    )
    return [recorder, detector, RegisterEventHandler(start), RegisterEventHandler(end)]


def generate_launch_description() -> LaunchDescription:
    """Describe what `ros2 launch` starts; the detector's own arguments are taken too."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="folder, or .mcap, .db3 or .bag file"),
            DeclareLaunchArgument(
                "topic", default_value="", description="image topic, if the bag has several"
            ),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="1: as recorded; 0: as fast as possible"
            ),
            DeclareLaunchArgument(
                "record",
                default_value="",
                description="folder for the results, which are printed too; empty: neither",
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="before the names of nodes and topics"
            ),
            OpaqueFunction(function=replay),
        ]
    )
