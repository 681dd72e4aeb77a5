"""Error of the keyframe depths against ray-cast truth, and how well the confidence knows it.

    python benchmarks/keyframe_depth.py ROOM TRACK.npz [--lag 4] [--width 300] [--every 1]

ROOM has traj.txt, results/frame*.jpg and mesh.ply (camera to world, OpenCV axes, metres). TRACK.npz
holds a tracker's keyframes: T (n,4,4) world to camera, d (n,gh,gw) inverse depth and info (n,gh,gw)
on the stride-8 grid, k frame numbers, cam = f, cx, cy, width, height. Needs trimesh and embreex.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from geogs.depth.completion import complete_inverse_depth, upsample_grid
from geogs.depth.depth_view import DepthView, KeyframeDepth, depth_images
from geogs.depth.estimate import estimate_depth
from geogs.depth.evidence import CONFIDENT_DEVIATION
from geogs.depth.fusion import check_depth
from geogs.depth.sweep_neighbors import select_sweep_neighbours
from geogs.geometry.camera import Camera
from geogs.geometry.umeyama import umeyama
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable


def load_views(
    room: Path, track: Path, width: int
) -> tuple[list[DepthView], Camera, Camera, np.ndarray]:
    """Views in the true frame (one Sim(3) from the keyframe positions), cameras, true poses."""
    data = np.load(track)
    f, cx, cy, w, h = data["cam"]
    working = Camera(f, f, cx, cy, int(w), int(h))
    render = working.with_long_edge(width)
    true = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)[data["k"]]
    poses = np.linalg.inv(data["T"])
    source, target = torch.from_numpy(poses[:, :3, 3]), torch.from_numpy(true[:, :3, 3])
    scale, rotation, translation = (np.asarray(x) for x in umeyama(source, target))
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + translation
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    ate = 100 * np.sqrt(((poses[:, :3, 3] - true[:, :3, 3]) ** 2).sum(1).mean())
    print(f"{room.name}: {len(poses)} keyframes, ATE {ate:.2f} cm")
    files = sorted((room / "results").glob("frame*.jpg"))
    views, segment = [], KeyframeTable.on(SampleGrid(working)).new_set()
    for i, k in enumerate(data["k"]):
        image = cv2.cvtColor(cv2.imread(str(files[k])), cv2.COLOR_BGR2RGB)
        image = cv2.resize(image, (working.width, working.height), interpolation=cv2.INTER_AREA)
        keyframe = segment.add(int(k), 0.0, image, None, torch.from_numpy(np.linalg.inv(poses[i])))
        keyframe.inverse_depth = torch.from_numpy((data["d"][i] / scale).astype(np.float32)).ravel()
        information = (data["info"][i] * scale**2).astype(np.float32)
        keyframe.information = torch.from_numpy(information).ravel()
        images = (*depth_images(keyframe.image, render), keyframe.image)
        views.append(DepthView(i, keyframe.T_cw.numpy(), *images, *keyframe.depth_field()))
    return views, working, render, true


def ray_cast(room: Path, poses: np.ndarray, camera: Camera) -> np.ndarray:
    """True depth (n, h, w); 0 where nothing is hit."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    mesh = trimesh.load(room / "mesh.ply", process=False)
    caster, triangles = RayMeshIntersector(mesh), np.asarray(mesh.triangles)
    rays = camera.rays(torch.float64).numpy().reshape(-1, 3)
    depths = []
    for pose in poses:
        direction = rays @ pose[:3, :3].T
        origin = np.broadcast_to(pose[:3, 3], direction.shape)
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        hit = caster.intersects_first(origin, unit)
        corner = triangles[hit]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        slope = (normal * direction).sum(1)
        slope[np.abs(slope) < 1e-12] = 1e-12
        depth = (normal * (corner[:, 0] - origin)).sum(1) / slope
        depth[(hit < 0) | (depth < 0) | (depth > 20)] = 0
        depths.append(depth.reshape(camera.height, camera.width))
    return np.array(depths, np.float32)


def typical_depth(view: DepthView) -> float:
    """Median depth where the tracker is fairly sure."""
    deviation = 1.0 / np.maximum(view.inverse_depth * np.sqrt(view.information), 1e-6)
    sure = deviation < 0.2
    return float(np.median(1.0 / view.inverse_depth[sure])) if sure.any() else 2.0


def report(name: str, depths: list[KeyframeDepth], truth: np.ndarray, seconds: float) -> None:
    """One row: all pixels, the sure ones (confidence above 1/2), the best 60 %, calibration."""
    depth = np.stack([d.depth for d in depths])
    confidence = np.stack([d.confidence for d in depths])
    known = truth > 0
    error = 100 * np.abs(depth - truth)[known]
    right = np.abs(depth[known] / truth[known] - 1) < 0.02
    confidence = confidence[known]
    sure = confidence > 0.5
    best = np.argsort(-confidence, kind="stable")[: int(0.6 * len(error))]
    bands = [(confidence >= c) & (confidence < c + 0.2 + (c > 0.7)) for c in np.arange(5) / 5]
    chance = " ".join(f"{100 * right[b].mean():.0f}" if b.any() else "-" for b in bands)
    cells = [
        name,
        f"{np.median(error):.2f} / {error.mean():.2f}",
        f"{100 * sure.mean():.0f} %",
        f"{np.median(error[sure]):.2f} / {error[sure].mean():.2f}" if sure.any() else "-",
        f"{np.median(error[best]):.2f} / {error[best].mean():.2f}",
        chance,
        f"{seconds:.2f}",
    ]
    print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("room", type=Path)
    parser.add_argument("track", type=Path)
    parser.add_argument("--lag", type=int, default=4, help="keyframes waited for")
    parser.add_argument("--width", type=int, default=300, help="pixels")
    parser.add_argument("--every", type=int, default=1, help="use every n-th keyframe")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    views, working, render, poses = load_views(arguments.room, arguments.track, arguments.width)
    chosen = range(0, len(views), arguments.every)
    truth = ray_cast(arguments.room, poses[chosen], render)
    raw, estimated, seconds = [], [], []
    for i in chosen:
        view = views[i]
        completed = complete_inverse_depth(view.inverse_depth, view.information, view.image)
        sure = 1.0 / (1.0 + (completed.deviation / CONFIDENT_DEVIATION) ** 2)
        raw.append(
            KeyframeDepth(
                1.0 / upsample_grid(completed.inverse_depth, working, render),
                upsample_grid(sure.astype(np.float32), working, render),
            )
        )
        start = time.thread_time()
        candidates = views[: i + arguments.lag + 1]
        picked = select_sweep_neighbours(view, candidates, typical_depth(view), render)
        neighbours = [candidates[j] for j in picked]
        estimated.append(estimate_depth(view, neighbours, render, working))
        seconds.append(time.thread_time() - start)
    start, checked, kept = time.thread_time(), [], [views[i] for i in chosen]
    for n, (i, depth) in enumerate(zip(chosen, estimated, strict=True)):
        known = [v for v in kept if v.id <= i + arguments.lag]
        typical = float(np.median(depth.depth))
        picked = select_sweep_neighbours(kept[n], known, typical, render)
        others = [estimated[j] for j in picked]
        other_poses = [known[j].T_cw for j in picked]
        checked.append(check_depth(depth, kept[n].T_cw, others, other_poses, render))
    check_seconds = (time.thread_time() - start) / len(checked)
    print(
        "| depth | all, cm (median / mean) | sure | sure, cm | best 60 %, cm | right to 2 %, per"
        " fifth of confidence | s |"
    )
    print("|---|---|---|---|---|---|---|")
    report("tracker, completed", raw, truth, 0.0)
    report("estimated", estimated, truth, float(np.median(seconds)))
    report("estimated and checked", checked, truth, check_seconds)


if __name__ == "__main__":
    main()
