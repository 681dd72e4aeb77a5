"""Follow a camera frame by frame: python examples/track_video.py VIDEO.

Prints where the camera is as far as each frame can tell; ``trajectory.tum`` gets the poses as they
are known at the end, when loops and the final adjustment have moved them.
"""

import sys
from pathlib import Path

import geogs
from geogs.config import preset
from geogs.io.writers.trajectories import write_tum_trajectory


def main(video: str, trajectory: Path = Path("trajectory.tum")) -> None:
    """Track a video, a folder of images, a bag, or ``camera:0``."""
    source = geogs.open_source(video)
    slam = geogs.Slam(source.camera, preset("fast"), device="cpu")
    for pose in geogs.track(source, slam=slam):
        if pose.T_wc is None:
            print(f"{pose.timestamp:8.3f} s  {pose.state.value}")
        else:
            x, y, z = pose.T_wc[:3, 3]
            at = f"{x:7.3f} {y:7.3f} {z:7.3f} ± {pose.sigma_position:.4f}"
            print(f"{pose.timestamp:8.3f} s  {at}")
    slam.finish()
    write_tum_trajectory(trajectory, slam.trajectory())


if __name__ == "__main__":
    main(sys.argv[1])
