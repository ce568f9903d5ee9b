"""The ROS 2 bridge."""
