"""Metres from another tracker: python examples/metric_from_poses.py VIDEO POSES.

POSES has rows ``t tx ty tz qx qy qz qw`` at the video's times, camera to world, metres: of ARKit,
of a robot's odometry, of a motion capture. They are priors: where the images contradict them, the
images win.
"""

import sys
from dataclasses import replace

import geogs
from geogs.config import preset


def main(video: str, poses: str) -> float | None:
    """Prints how far poses and images agree; returns metres to the unit of the images alone."""
    config = preset("fast")
    config = replace(config, input=replace(config.input, poses=poses))
    source = geogs.open_source(video, config.input)
    slam = geogs.Slam(source.camera, config, device="cpu")
    for frame in source:
        slam.process(frame)
    slam.finish()
    said = slam.statistics()
    print("poses:", said["poses"])
    print("scale:", said["metric_scale"])
    return None if slam.metric_scale is None else slam.metric_scale.factor


if __name__ == "__main__":
    main(*sys.argv[1:3])
