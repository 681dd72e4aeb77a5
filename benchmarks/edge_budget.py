"""Error budget of depth at edges, of thin things and behind them, from the search to the mesh.

    python benchmarks/edge_budget.py SEQUENCE [--every 3] [--long-edge 320] [--steps 600] [OPTIONS]

SEQUENCE is a folder in Replica layout with exact depth images (geogs synth; best with
--flaws.readout 0, as the rows of a rolling shutter have other poses). Every third frame is a
keyframe with its true pose. Their depths are searched, checked, made disks, trained and fused as
in a run, and after each step scored from the keyframes like the mesh in geogs bench edges. For
comparison exact depths are fused, and disks trained on them. OPTIONS are those of geogs run
(--mapping.loss.edge-factor 40). Percent of the pixels of a kind: right within 2 / 5 %, in front by
more than 5 %, missing.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from geogs.config import Config, InputConfig
from geogs.depth.depth_view import DenseDepth
from geogs.errors import InputError
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.geometry.camera import Camera
from geogs.io.pose_files import read_replica_trajectory
from geogs.io.sources.sniff import open_source
from geogs.mapping.known_poses import expect_depths
from geogs.mapping.map_frame import MapFrame
from geogs.mapping.mapper import Mapper
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import DepthMapView
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs_bench.scoring.depth_scores import ComparedView, compare_view, place_scores
from geogs_bench.scoring.true_depths import TrueView

KINDS = ("all", "open", "edge", "thin", "behind thin")
WINDOW, TOLERANCE = 7, 0.003
"""Window and tolerance of the planes of true depths, as in ``geogs bench edges``."""
RASTER = 8
"""Pixels between the true points that set the range of the depth search."""

Maps = Sequence[tuple[Tensor, Tensor]]
"""Depth in map units and weight of each keyframe."""


@dataclass(frozen=True)
class Keyframes:
    """The keyframes of a sequence at their true poses, with the scoring of their depths."""

    camera: Camera
    judged: list[ComparedView]
    poses: list[Tensor]
    """World to camera, metres."""
    points: Float64[np.ndarray, "n 3"]
    """Some of the points that they see, metres."""
    frame: MapFrame

    @staticmethod
    def read(sequence: Path, every: int, long_edge: int) -> "Keyframes":
        """Read every ``every``-th frame, at this size."""
        source = open_source(sequence, InputConfig(long_edge=long_edge, depth="auto"))
        truth, judged, poses, points = read_replica_trajectory(sequence / "traj.txt"), [], [], []
        camera = source.camera
        rays = camera.rays(torch.float64).numpy()[::RASTER, ::RASTER]
        for f in source:
            if f.index % every:
                continue
            depth = None if f.depth is None else f.depth.metres()
            if depth is None:
                raise InputError(f"{sequence} has no depth images.")
            view, T_wc = TrueView(f.index, f.timestamp, f.image, depth), truth.T_wc[f.index]
            judged.append(compare_view(view, depth, (camera, camera), WINDOW, TOLERANCE))
            poses.append(torch.from_numpy(np.linalg.inv(T_wc)))
            there = (rays * depth[::RASTER, ::RASTER, None])[depth[::RASTER, ::RASTER] > 0]
            points.append(there @ T_wc[:3, :3].T + T_wc[:3, 3])
        seen = np.concatenate(points)
        return Keyframes(camera, judged, poses, seen, MapFrame.around(seen, poses))

    @property
    def exact(self) -> list[Tensor]:
        """The true depths in map units."""
        depths = (torch.from_numpy(v.view.depth) for v in self.judged)
        return [(depth / self.frame.unit).float() for depth in depths]

    def mapper(self, config: Config) -> Mapper:
        """Make a mapper without disks yet, with the range of the depth search."""
        keyframes = KeyframeTable.on(SampleGrid(self.camera)).new_set()
        mapper = Mapper(keyframes.table, config.mapping, config.seed)
        if mapper.cameras.render.width != self.camera.width:
            raise InputError("Depths are judged at the size of the render: --long-edge is another.")
        for view, T_cw in zip(self.judged, self.poses, strict=True):
            image, time = view.view.image, view.view.timestamp
            pose = self.frame.pose(T_cw)
            mapper.observe(keyframes.add(view.view.index, time, image, None, pose).id)
        points = self.frame.points(self.points)
        expect_depths(mapper.views.values(), points, self.camera)
        return mapper

    def report(self, name: str, found: Sequence[Float32[np.ndarray, "h w"]]) -> None:
        """Print the scores of depths in map units, 0 or infinite where there is none."""
        views = []
        for view, depth in zip(self.judged, found, strict=True):
            metres = np.where(depth > 0, depth * self.frame.unit, np.inf).astype(np.float32)
            views.append(replace(view, found=metres))
        scores = {score.place: score for score in place_scores(views)}
        cells = [
            f"{s.within_2:5.1f} /{s.within_5:5.1f}, {s.in_front:4.1f}, {100 - s.covered:4.1f}"
            for s in (scores[kind] for kind in KINDS if kind in scores)
        ]
        print(f"{name:24s}| " + " | ".join(cells), flush=True)

    def fuse(self, name: str, maps: Maps, mapper: Mapper, config: Config) -> None:
        """Print the scores of the mesh of depth maps, from the keyframes."""
        poses = [view.T_cw for view in mapper.views.values()]
        views = [
            DepthMapView(depth, weight, self.camera, T_cw, None)
            for (depth, weight), T_cw in zip(maps, poses, strict=True)
        ]
        mesh = extract_mesh(views, replace(config.mesh, colour=False))
        shown = [render_mesh(mesh.vertices, mesh.faces, self.camera, T.numpy())[0] for T in poses]
        self.report(name, [np.where(np.isfinite(depth), depth, 0) for depth in shown])


def train(keyframes: Keyframes, name: str, mapper: Mapper, config: Config, steps: int) -> None:
    """Make and train disks of the mapper's depths, and print the scores of them and their mesh."""
    mapper.grow()
    keyframes.report(f"{name}: new disks", [r.depth.numpy() for r in mapper.renders()])
    mapper.train(steps)
    renders = mapper.renders()
    keyframes.report(f"{name}: trained disks", [r.depth.numpy() for r in renders])
    keyframes.fuse(f"{name}: mesh", [(r.depth, r.weight) for r in renders], mapper, config)


def main() -> None:
    """Run the benchmark."""
    from geogs.cli.run import parse

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--long-edge", type=int, default=320)
    parser.add_argument("--steps", type=int, default=600)
    arguments, rest = parser.parse_known_args()
    config = parse(["none", "--mapping.render-long-edge", str(arguments.long_edge), *rest]).config
    torch.set_num_threads(1)  # as in a run
    keyframes = Keyframes.read(arguments.sequence, arguments.every, arguments.long_edge)
    print(f"{'':24s}| " + " | ".join(f"{kind:25s}" for kind in KINDS))
    exact = [DenseDepth(d, torch.ones_like(d), d.median()) for d in keyframes.exact]

    mapper = keyframes.mapper(config)
    ids = [*mapper.views]
    keyframes.fuse("exact: fused", [(d.depth, d.confidence) for d in exact], mapper, config)
    for view, depth in zip(mapper.views.values(), exact, strict=True):
        view.set_depth(depth)
    mapper.table.mapped = ids
    train(keyframes, "exact", mapper, config, arguments.steps)

    mapper = keyframes.mapper(config)
    mapper.search_depths(ids)
    keyframes.report("searched", [v.dense.depth.numpy() for v in mapper.views.values()])
    mapper.check_depths()
    checked = [v.dense for v in mapper.views.values()]
    keyframes.report("checked", [d.depth.numpy() for d in checked])
    keyframes.fuse("checked: fused", [(d.depth, d.confidence) for d in checked], mapper, config)
    train(keyframes, "checked", mapper, config, arguments.steps)


if __name__ == "__main__":
    main()
