"""ROS 2 nodes: thin shells around the package, and the only importers of rclpy and messages."""
