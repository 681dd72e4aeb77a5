"""Cost of single steps of a keyframe with many keyframes before it.

    python benchmarks/growth.py [--keyframes 100 400 1600] [--size 320 192]

Keyframes of noise along a long winding path, with depth, are given to the mapper and to the loop
search without any tracking, so that growth shows within a minute. Printed are CPU milliseconds
of each step for every number of keyframes, then the ratio of the last to the first. A constant cost
is near 1; a loop over all keyframes grows with their number.
"""

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
import torch

from geogs.config import LoopConfig, preset
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.lie import se3_inverse, sim3_exp, so3_exp
from geogs.loop.closure import consistent_loops
from geogs.loop.detect import LoopDetector
from geogs.loop.pose_graph import PoseGraph, solve
from geogs.loop.retrieval import AppearanceIndex
from geogs.mapping.mapper import Mapper
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.loops import ImageFeatures, RelativePoses
from geogs_synth.sequence.location import centred_camera

STEP = 0.15
LOOPS = 100


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--keyframes", type=int, nargs="+", default=(100, 400, 1600))
    parser.add_argument("--size", type=int, nargs=2, default=(320, 192))
    options = parser.parse_args()
    torch.set_num_threads(1)
    table: dict[str, list[float]] = {}
    for count in options.keyframes:
        steps = {**mapping(count, options.size), **looks(count), **closing(count)}
        for name, milliseconds in steps.items():
            table.setdefault(name, []).append(round(milliseconds, 2))
        print(json.dumps({"keyframes": count, **{k: v[-1] for k, v in table.items()}}), flush=True)
    ratios = {k: round(v[-1] / max(v[0], 1e-3), 1) for k, v in table.items()}
    print(json.dumps({"last / first": ratios}))


def cost(step: Callable[[], object], times: int = 5) -> float:
    """CPU milliseconds of this thread, the least of ``times`` calls."""
    found = []
    for _ in range(times):
        start = time.thread_time()
        step()
        found.append(time.thread_time() - start)
    return 1e3 * min(found)


def way(count: int) -> torch.Tensor:
    """World to camera along a winding path that never comes back."""
    t = torch.arange(count, dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, :3, :3] = so3_exp(torch.stack([0 * t, 0.6 * torch.sin(t / 7), 0 * t], 1))
    T[:, 0, 3] = STEP * t
    return se3_inverse(T)


def mapping(count: int, size: tuple[int, int]) -> dict[str, float]:
    """Cost of the mapper's steps, and of the main thread's part of the loop search."""
    camera, random = centred_camera(*size), np.random.default_rng(0)
    grid = SampleGrid(camera)
    store = KeyframeTable.on(grid, ClassicalFlow(grid).encode, 128)
    segment, mapper = store.new_set(), Mapper(store, preset("fast").mapping)
    detector = LoopDetector(store, ClassicalFlow(grid), LoopConfig())
    image = random.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
    render = mapper.cameras.render
    for n, T in enumerate(way(count)):
        keyframe = segment.add(n, n / 30, image, None, T.clone())
        keyframe.inverse_depth = torch.full((grid.size,), 0.4)
        keyframe.information = torch.full((grid.size,), 1e4)
        mapper.observe(n)
        depth = torch.full((render.height, render.width), 2.5)
        mapper.views[n].set_depth(DenseDepth(depth, torch.ones_like(depth), torch.tensor(2.5)))
        mapper.table.mapped.append(n)
        detector._enter(n)
    view = mapper.views[count - 1]
    return {
        "views whose depths check one": cost(lambda: mapper.depths.near(view)),
        "views that vote on disks": cost(lambda: mapper.growth.voters(view)),
        "photometric partners": cost(lambda: mapper.partners.choose([view])),
        "loop candidates by pose": cost(lambda: detector.candidates(count - 1)),
        "depths for the search of loops": cost(detector._depths),
        "poses of all keyframes": cost(lambda: segment.poses(segment.ids)),
    }


def looks(count: int) -> dict[str, float]:
    """Cost of a query for similar keyframes, when all words are known."""
    random, index = np.random.default_rng(0), AppearanceIndex()
    words = random.integers(0, 256, (2000, 32), dtype=np.uint8)

    def features() -> ImageFeatures:
        chosen = random.choice(len(words), 300, replace=False)
        return ImageFeatures(np.zeros((300, 2), np.float32), words[chosen])

    for n in range(count):
        index.add(n, features())
    return {
        "keyframes that look alike": cost(lambda: index.query(features(), range(count - 15, count)))
    }


def closing(count: int) -> dict[str, float]:
    """Cost of voting on loops and of the pose graph, for a ring walked twice."""
    start, relative = ring(count)
    kept = consistent_loops(start, relative)
    graph = PoseGraph(start, relative.select(kept), torch.arange(count) < 1)
    return {
        "vote on loops": cost(lambda: consistent_loops(start, relative), 1),
        "pose graph": cost(lambda: solve(graph), 1),
    }


def ring(count: int) -> tuple[torch.Tensor, RelativePoses]:
    """Poses by odometry, and all relative poses."""
    random, lap = torch.Generator().manual_seed(0), count // 2
    angle = 2 * np.pi * torch.arange(count, dtype=torch.float64) / lap
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, :3, :3] = so3_exp(torch.stack([0 * angle, -angle, 0 * angle], 1))
    centre = torch.stack([angle.cos(), 0 * angle, angle.sin()], 1) * lap * STEP / (2 * np.pi)
    T[:, :3, 3] = -(T[:, :3, :3] @ centre[..., None])[..., 0]
    pairs = [(i, i + k) for k in (1, 2, 3) for i in range(count - k)]
    edges = len(pairs)
    again = torch.randperm(count - lap, generator=random)[:LOOPS].sort().values.tolist()
    pairs += [(i, i + lap) for i in again]
    source, target = (torch.tensor([p[k] for p in pairs]) for k in (0, 1))
    deviation = torch.tensor([2e-3] * 3 + [1e-3] * 3 + [2e-3], dtype=torch.float64)
    noise = deviation * torch.randn(len(pairs), 7, generator=random, dtype=torch.float64)
    G = sim3_exp(noise) @ T[target] @ se3_inverse(T[source])
    start = [T[0]]
    for step in G[: count - 1]:
        pose = step @ start[-1]
        pose[:3, :3] /= torch.linalg.det(pose[:3, :3]).pow(1 / 3)
        start.append(pose)
    is_loop = torch.arange(len(pairs)) >= edges
    information = (1 / deviation.square()).repeat(len(pairs), 1)
    return torch.stack(start), RelativePoses(source, target, G, information, is_loop)


if __name__ == "__main__":
    main()
