"""``geogs ros2``: a node of ROS 2 that tracks a camera."""

from collections.abc import Sequence

from geogs.application.ros.node_settings import NodeSettings
from geogs.cli.options import parse_options


def main(argv: Sequence[str]) -> int:
    """Run the node; returns the exit code."""
    options = parse_options(NodeSettings, argv, "ros2")

    from geogs.application.ros.node import run_node

    run_node(options)
    return 0
