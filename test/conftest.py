"""What all tests share: a ROS graph of their own, set before anything imports rclpy."""

import os
from pathlib import Path

import ofsat_ros

# Two test runs at once, or a ROS graph on this machine, must not hear each other.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(ofsat_ros.__file__).parent / "data" / "fastdds_large_images.xml"
)
