"""ROS 2 bags and messages."""
