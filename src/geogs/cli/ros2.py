"""``geogs ros2``: a node of ROS 2 that tracks a camera."""

from collections.abc import Sequence
from dataclasses import dataclass

from geogs.application.ros.settings import NodeSettings
from geogs.cli.options import parse_options


@dataclass(frozen=True)
class NodeOptions(NodeSettings):
    """Track a camera in ROS 2: publishes ~/pose, ~/path, ~/cloud and ~/mesh until Ctrl-C.

    Needs rclpy, which comes with an installation of ROS 2 (source its setup file first).
    """


def main(argv: Sequence[str]) -> int:
    """Run the node; returns the exit code."""
    options = parse_options(NodeOptions, argv, "ros2")

    from geogs.application.ros.node import run_node

    run_node(options)
    return 0
