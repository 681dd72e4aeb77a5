"""A node of ROS 2 that tracks a camera."""
