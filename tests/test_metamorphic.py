"""A relation that the whole must keep; benchmarks/metamorphic.py has all of them."""

import numpy as np
import pytest

from geogs.cli.run import parse
from geogs.config import InputConfig
from geogs.io.sources.sniff import open_source
from metamorphic import RELATIONS, Shape, distances, held, shape_of

# All stages on, and no more than a start.
CONFIG = parse([
    "v.mp4", "--mapping.render-long-edge", "96", "--mapping.iterations", "2",
    "--mapping.pose-iterations", "1", "--mapping.final-iterations", "10",
    "--tracking.init-keyframes", "6", "--mapping.depth.planes", "48",
]).config  # fmt: skip


@pytest.mark.system
@pytest.mark.long
def test_a_mirrored_video_gives_the_mirrored_map(small_room):
    source = open_source(small_room, InputConfig(stop=22))
    frames = list(source)
    as_it_is = shape_of(frames, source.camera, CONFIG)
    path, disks, is_held = held(RELATIONS[0], frames, source.camera, CONFIG, as_it_is)
    assert is_held, (path, disks)


def test_distances_are_those_after_a_similarity():
    random = np.random.default_rng(0)
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    poses, moved = {}, {}
    for k in range(5):
        pose = np.eye(4)
        pose[:3, 3] = [0.1 * k, 0.01 * k * k, 0.0]
        poses[k] = pose
        moved[k] = T @ pose
        moved[k][:3, 3] = 3 * moved[k][:3, 3] + [1, 2, 3]
    disks = random.normal(size=(200, 3))
    shape = Shape(moved, 3 * disks @ T[:3, :3].T + [1, 2, 3])
    assert distances(shape, Shape(poses, disks)) == pytest.approx((0, 0), abs=1e-9)
    assert distances(shape.mirrored().mirrored(), Shape(poses, disks))[1] < 1e-9
    assert distances(shape.mirrored(), Shape(poses, disks))[1] > 0.05
    shape.poses[4][:3, 3] += [0.0, 0.0, 0.3]
    path, _ = distances(shape, Shape(poses, disks))
    assert 0.05 < path < 1
