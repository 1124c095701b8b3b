# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""ROS 2 nodes: thin shells around the package, and the only importers of rclpy and messages."""
