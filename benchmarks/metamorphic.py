"""Metamorphic relations of the whole system: the same world must give the same map.

    python benchmarks/metamorphic.py SEQUENCE [--frames 60] [--long-edge 160] [--preset fast]

The sequence is reconstructed unchanged and as from other cameras: mirrored, at half the frame rate,
with intrinsics for images of another size, darker with another gamma, backwards. Printed are the
distances of path and disks from those of the unchanged sequence, after the best similarity, as
fractions of their extents, with the allowed ones. Ends with 1 if a relation does not hold.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from geogs.config import Config, InputConfig, preset
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from geogs.types import Frame

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Shape:
    """Reconstruction of a sequence, in its own world."""

    poses: dict[int, np.ndarray]
    """Camera to world of the tracked frames, by their index in the unchanged sequence."""
    disks: np.ndarray
    """Centres (n, 3)."""

    def mirrored(self) -> "Shape":
        """Exchange left and right."""
        poses = {k: MIRROR @ T @ MIRROR for k, T in self.poses.items()}
        return Shape(poses, self.disks @ MIRROR[:3, :3])


@dataclass(frozen=True)
class Relation:
    """Another input of the same world."""

    name: str
    change: Callable[[Sequence[Frame], Camera], tuple[list[Frame], Camera]]
    """Makes the frames, which keep the index of the unchanged sequence, and their camera."""
    path: float
    """Largest RMS distance of the positions, as a fraction of the path's extent."""
    map: float
    """Largest median distance of the disks, as a fraction of the map's extent."""
    is_mirrored: bool = False


def mirrored(frames: Sequence[Frame], camera: Camera) -> tuple[list[Frame], Camera]:
    """Exchange left and right."""
    flipped = [replace(f, image=np.ascontiguousarray(f.image[:, ::-1])) for f in frames]
    return flipped, replace(camera, cx=camera.width - 1 - camera.cx)


def half_the_rate(frames: Sequence[Frame], camera: Camera) -> tuple[list[Frame], Camera]:
    """Keep every other frame."""
    return list(frames[::2]), camera


def slower(frames: Sequence[Frame], camera: Camera) -> tuple[list[Frame], Camera]:
    """The same images, seconds apart."""
    return [replace(f, timestamp=100 * f.timestamp) for f in frames], camera


def other_unit(frames: Sequence[Frame], camera: Camera) -> tuple[list[Frame], Camera]:
    """Give intrinsics for images of three times the size."""
    large = camera.resized(3 * camera.width, 3 * camera.height)
    known = Calibration(large.fx, large.fy, large.cx, large.cy, (), large.width, large.height)
    return list(frames), known.fit(camera.width, camera.height).camera()


def darker(frames: Sequence[Frame], camera: Camera) -> tuple[list[Frame], Camera]:
    """Change exposure and gamma."""
    table = (255 * 0.85 * (np.arange(256) / 255) ** 1.15).round().astype(np.uint8)
    return [replace(f, image=table[f.image]) for f in frames], camera


def backwards(frames: Sequence[Frame], camera: Camera) -> tuple[list[Frame], Camera]:
    """Reverse the frames."""
    end = frames[-1].timestamp
    return [replace(f, timestamp=end - f.timestamp) for f in reversed(frames)], camera


RELATIONS = (
    Relation("mirrored", mirrored, 0.03, 0.05, is_mirrored=True),
    Relation("half the frame rate", half_the_rate, 0.03, 0.04),
    Relation("another clock", slower, 0.001, 0.001),
    Relation("another unit of intrinsics", other_unit, 0.005, 0.01),
    Relation("gain 0.85, gamma 1.15", darker, 0.03, 0.04),
    Relation("backwards", backwards, 0.04, 0.05),
)


def shape_of(frames: Sequence[Frame], camera: Camera, config: Config) -> Shape:
    """Run the system on frames; their own indices are only used for the result."""
    slam = Slam(camera, config, device="cpu")
    for index, frame in enumerate(frames):
        slam.process(replace(frame, index=index))
    slam.finish()
    trajectory = slam.trajectory()
    tracked = zip(frames, trajectory.T_wc, trajectory.tracked, strict=True)
    poses = {frame.index: T for frame, T, is_tracked in tracked if is_tracked}
    return Shape(poses, slam.snapshot().position.double().numpy())


def distances(shape: Shape, as_it_is: Shape) -> tuple[float, float]:
    """Distances of path (RMS) and disks (median) after a similarity, as fractions of their extents.

    Disks are measured to the nearest of the other map; infinite if there are too few.
    """
    both = sorted(shape.poses.keys() & as_it_is.poses.keys())
    if len(both) < max(3, len(shape.poses) // 2) or not len(shape.disks):
        return float("inf"), float("inf")
    here, there = (np.array([some.poses[k] for k in both]) for some in (shape, as_it_is))
    # The path may be nearly straight, so the cameras' axes determine the rotation.
    u, _, vt = np.linalg.svd((there[:, :3, :3] @ here[:, :3, :3].transpose(0, 2, 1)).sum(0))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    centre, target = here[:, :3, 3].mean(0), there[:, :3, 3].mean(0)
    turned, goal = (here[:, :3, 3] - centre) @ R.T, there[:, :3, 3] - target
    scale = (turned * goal).sum() / np.square(turned).sum()
    extent = np.sqrt(np.square(goal).sum(1).mean())
    path = np.sqrt(np.square(scale * turned - goal).sum(1).mean())
    moved = scale * (shape.disks - centre) @ R.T + target
    apart, _ = cKDTree(as_it_is.disks).query(moved)
    spread = np.sqrt(np.square(as_it_is.disks - as_it_is.disks.mean(0)).sum(1).mean())
    return float(path / extent), float(np.median(apart) / spread)


def held(
    relation: Relation, frames: Sequence[Frame], camera: Camera, config: Config, as_it_is: Shape
) -> tuple[float, float, bool]:
    """Distances of path and map under a relation, and whether they are allowed."""
    shape = shape_of(*relation.change(frames, camera), config)
    path, disks = distances(shape.mirrored() if relation.is_mirrored else shape, as_it_is)
    return path, disks, path <= relation.path and disks <= relation.map


def main() -> None:
    """Test all relations on a sequence."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--long-edge", type=int, default=160)
    parser.add_argument("--preset", default="fast")
    options = parser.parse_args()
    torch.set_num_threads(1)
    source = open_source(
        options.sequence, InputConfig(long_edge=options.long_edge, stop=options.frames)
    )
    frames, config = list(source), preset(options.preset)
    as_it_is = shape_of(frames, source.camera, config)
    wrong = 0
    for relation in RELATIONS:
        path, disks, is_held = held(relation, frames, source.camera, config, as_it_is)
        wrong += not is_held
        print(
            f"{relation.name:<28} path {path:8.4f} (at most {relation.path:g})  disks {disks:8.4f} "
            f"(at most {relation.map:g})  {'held' if is_held else 'NOT HELD'}",
            flush=True,
        )
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
