"""Priors: networks on single images, depth sensors, odometry."""
