"""Start the simulator and a detector that looks at its images.

For example::

    ros2 launch ofsat_ros simulation.launch.py scenario:=geo
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Describe what `ros2 launch` starts; the detector's own arguments are taken too."""
    simulator = Node(
        package="ofsat_ros",
        executable="simulator",
        name="simulator",
        output="screen",
        parameters=[
            {
                "scenario": LaunchConfiguration("scenario"),
                "seed": ParameterValue(LaunchConfiguration("seed"), value_type=int),
                "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
            }
        ],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("scenario", default_value="sidereal", description="sky to show"),
            DeclareLaunchArgument("seed", default_value="1", description="of the sky, its noise"),
            DeclareLaunchArgument("rate", default_value="1.0", description="1: in real time"),
            IncludeLaunchDescription(Path(__file__).with_name("detector.launch.py").as_posix()),
            simulator,
        ]
    )
