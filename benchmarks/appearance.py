"""The appearance-coupled baseline (2DGS with colour) on images with known poses, to a mesh.

    python benchmarks/appearance.py SOURCE --points-only --points FILE.ply [--long-edge 800]
    python benchmarks/appearance.py SOURCE --points FILE.ply --budget 60 --voxel 0.001 -o OUT

The first finds SIFT points on the CPU; the second trains on an NVIDIA GPU with gsplat and writes
mesh.ply and summary.json. Without --points the points are found first, outside the budget.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

import torch

from geogs.config import InputConfig, MeshConfig
from geogs.errors import GeogsError
from geogs.io.sources.sniff import open_posed_source
from geogs.io.writers.atomic import prepare_output_folder, write_text
from geogs.io.writers.ply_writer import write_mesh
from geogs.mesh.triangle_mesh import Mesh
from geogs_bench.appearance.baseline import appearance_mesh, train_appearance
from geogs_bench.appearance.config import AppearanceConfig
from geogs_bench.appearance.disks import AppearanceDisks
from geogs_bench.appearance.points_file import read_points, write_points
from geogs_bench.appearance.start_points import StartPoints, find_start_points
from geogs_bench.appearance.trainer import AppearanceResult
from geogs_bench.appearance.views import TrainingView, training_views


def main() -> int:
    """Run; returns the exit code."""
    args = arguments()
    try:
        run(args)
    except GeogsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="images with known poses")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of training")
    parser.add_argument("--at", type=float, nargs="*", default=[], help="seconds of snapshots")
    parser.add_argument("--long-edge", type=int, default=800)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--points", type=Path, help="PLY file of start points")
    parser.add_argument("--points-only", action="store_true", help="find them, write them, stop")
    parser.add_argument("--grow-gradient", type=float, default=AppearanceConfig.grow_gradient)
    parser.add_argument("--voxel", type=float, help="of the mesh, units of the poses")
    parser.add_argument("--truncation", type=float, default=5.0, help="voxels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/appearance"))
    return parser.parse_args()


def run(args: argparse.Namespace) -> None:
    """Points, or the whole baseline."""
    source = open_posed_source(
        args.source, InputConfig(long_edge=args.long_edge, stride=args.stride)
    )
    views = training_views(source)
    if args.points_only:
        path = args.points or Path(f"{source.name}-points.ply")
        points = find_start_points(views)
        write_points(path, points)
        print(f"{len(points)} points of {len(views)} views in {path}")
        return
    points = read_points(args.points) if args.points else find_start_points(views)
    config = AppearanceConfig(grow_gradient=args.grow_gradient)
    mesh_config = MeshConfig(voxel=args.voxel, truncation=args.truncation)
    output = prepare_output_folder(args.output)

    def snapshot(seconds: float, disks: AppearanceDisks) -> None:
        mesh = appearance_mesh(disks, views, mesh_config, config)
        save(output / f"mesh-{seconds:.0f}s.ply", mesh)
        print(f"{seconds:6.1f} s  {len(disks)} disks  {len(mesh.faces)} faces", flush=True)

    result = train_appearance(
        views, points, args.budget, config, args.seed, args.device, args.at, snapshot
    )
    mesh = appearance_mesh(result.disks, views, mesh_config, config)
    save(output / "mesh.ply", mesh)
    write_text(
        output / "summary.json",
        json.dumps(summary(result, mesh, views, points, config, mesh_config), indent=2),
    )
    print(
        f"{source.name}: {result.seconds:.1f} s, {result.iterations} iterations, "
        f"{len(result.disks)} disks ({result.disks.bytes / 1e6:.0f} MB), "
        f"PSNR {result.psnr:.2f} dB, {len(mesh.faces)} faces"
    )


def save(path: Path, mesh: Mesh) -> None:
    """Write a mesh."""
    write_mesh(path, mesh.vertices, mesh.faces, mesh.colours, mesh.normals)


def summary(
    result: AppearanceResult,
    mesh: Mesh,
    views: list[TrainingView],
    points: StartPoints,
    config: AppearanceConfig,
    mesh_config: MeshConfig,
) -> dict[str, object]:
    """What happened, in numbers."""
    return {
        "views": len(views),
        "start_points": len(points),
        "iterations": result.iterations,
        "seconds": round(result.seconds, 3),
        "disks": len(result.disks),
        "bytes": result.disks.bytes,
        "psnr": round(result.psnr, 3),
        "mesh_faces": len(mesh.faces),
        "peak_gpu_memory_bytes": torch.cuda.max_memory_allocated(),
        "config": asdict(config),
        "mesh": asdict(mesh_config),
    }


if __name__ == "__main__":
    sys.exit(main())
