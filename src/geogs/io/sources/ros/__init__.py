"""Recordings of the Robot Operating System (ROS)."""
