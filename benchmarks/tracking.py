"""Track a folder with known poses and print errors and speed.

    python benchmarks/tracking.py SOURCE_DIR [--long-edge 512] [--frames 150] [--depth-every 12]

SOURCE_DIR is in Replica layout (results/frame*.jpg, traj.txt, cam_params.json, mesh.ply) or in
7-Scenes layout (seq-01/frame-*.color.jpg and .pose.txt). Ground truth is read for the printed
errors only.
"""

import argparse
import dataclasses
import json
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from geogs.config import Config, TrackingConfig
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.evaluation.surfaces.surface import read_surface
from geogs.geometry.camera import Camera
from geogs.geometry.umeyama import umeyama
from geogs.loop.global_bundle import global_bundle
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import Frame
from geogs.world.grid import OFFSET, STRIDE, SampleGrid


@dataclasses.dataclass(frozen=True)
class Sequence:
    """Image files with their true poses."""

    files: list[Path]
    camera: Camera
    T_wc: np.ndarray
    mesh: Path | None

    def frames(self) -> Iterator[Frame]:
        """Images at the camera's size."""
        size = (self.camera.width, self.camera.height)
        for n, path in enumerate(self.files):
            image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
            if image.shape[1::-1] != size:
                image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            yield Frame(n, n / 30, image)


def load(folder: Path, long_edge: int, count: int | None) -> Sequence:
    """Find out the layout and read poses and camera."""
    if (folder / "results").is_dir():
        files = sorted((folder / "results").glob("frame*.*"))[:count]
        T_wc = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)[: len(files)]
        c = json.loads((folder / "cam_params.json").read_text())["camera"]
        camera = Camera(c["fx"], c["fy"], c["cx"], c["cy"], c["w"], c["h"])
    else:
        files = sorted((folder / "seq-01").glob("*.color.jpg"))[:count]
        poses = [str(f).replace("color.jpg", "pose.txt") for f in files]
        # The poses are of the depth camera; the colour centre lies 25 mm to its side.
        offset = np.eye(4)
        offset[0, 3] = 0.025
        T_wc = np.stack([np.loadtxt(p) @ offset for p in poses])
        height, width = cv2.imread(str(files[0])).shape[:2]
        camera = Camera(525.0, 525.0, 320.0, 240.0, width, height)
    mesh = folder / "mesh.ply"
    return Sequence(files, camera.with_long_edge(long_edge), T_wc, mesh if mesh.exists() else None)


def align(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """ATE RMSE in cm after Sim(3) alignment of camera centres, and the scale of the alignment."""
    good = np.isfinite(estimate).all(1) & np.isfinite(truth).all(1)
    x, y = torch.from_numpy(estimate[good]), torch.from_numpy(truth[good])
    scale, R, t = umeyama(x, y)
    error = (scale * x @ R.T + t - y).norm(dim=1)
    return 100 * float(error.square().mean().sqrt()), float(scale)


def keyframe_error(tracker: Tracker, sequence: Sequence) -> tuple[float, float]:
    """ATE of the keyframes in cm and the scale to metres."""
    states = [tracker.keyframes[k] for k in tracker.segment.ids]
    centres = np.stack([torch.linalg.inv(s.T_cw)[:3, 3].numpy() for s in states])
    return align(centres, sequence.T_wc[[s.frame_index for s in states], :3, 3])


def true_depth(path: Path, camera: Camera, T_wc: np.ndarray) -> Iterator[np.ndarray]:
    """Depth of a mesh on the tracker's grid from each pose, by ray casting; inf where empty."""
    mesh = read_surface(path)
    grid = SampleGrid(camera)
    cells = Camera(
        camera.fx / STRIDE, camera.fy / STRIDE, (camera.cx - OFFSET) / STRIDE,
        (camera.cy - OFFSET) / STRIDE, grid.width, grid.height,
    )  # fmt: skip
    for T in T_wc:
        yield render_mesh(mesh.vertices, mesh.faces, cells, np.linalg.inv(T))[0].ravel()


def depth_report(tracker: Tracker, sequence: Sequence, scale: float, every: int) -> None:
    """Relative depth error of the keyframes by bins of the predicted relative deviation."""
    ids = tracker.segment.ids[::every]
    states = [tracker.keyframes[k] for k in ids]
    truth = true_depth(
        sequence.mesh, sequence.camera, sequence.T_wc[[s.frame_index for s in states]]
    )
    error, sigma, metres = [], [], []
    for s, z in zip(states, truth, strict=True):
        d, info = s.inverse_depth.numpy(), s.information.numpy()
        ok = (info > 0) & np.isfinite(z)
        error.append((scale / d - z)[ok] / z[ok])
        sigma.append(1 / (d[ok] * np.sqrt(info[ok])))
        metres.append(z[ok])
    error, sigma, metres = np.concatenate(error), np.concatenate(sigma), np.concatenate(metres)
    order = np.array_split(np.argsort(sigma), 8)
    cells = len(ids) * tracker.keyframes.grid.size
    print(f"depth on the grid: {len(error) / cells:.0%} of the cells measured")
    print("  sigma     |error|   |error|/sigma   median |error| cm   > 5 %")
    for part in order:
        e = np.abs(error[part])
        print(
            f"  {np.median(sigma[part]):7.4f}  {np.median(e):7.4f}"
            f"   {np.median(e / sigma[part]):7.2f}"
            f"        {100 * np.median(e * metres[part]):9.2f}          {(e > 0.05).mean():6.1%}"
        )
    ratio = np.abs(error) / sigma
    print(
        f"  all: |error|/sigma median {np.median(ratio):.2f} (normal: 0.67), "
        f"68 % {np.quantile(ratio, 0.683):.2f} (1.00), "
        f"95 % {np.quantile(ratio, 0.954):.2f} (2.00), "
        f"median |error| {100 * np.median(np.abs(error) * metres):.2f} cm"
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("--long-edge", type=int, default=512)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--no-global", action="store_true")
    parser.add_argument(
        "--depth-every", type=int, default=0, help="check every n-th keyframe's depth"
    )
    parser.add_argument("--set", nargs="*", default=[], help="name=value of TrackingConfig")
    args = parser.parse_args()
    torch.set_num_threads(1)  # as the system works; our own threads use the cores
    changes = {k: json.loads(v) for k, v in (item.split("=") for item in args.set)}
    config = dataclasses.replace(TrackingConfig(), **changes)
    sequence = load(args.source, args.long_edge, args.frames)
    tracker = lone_tracker(sequence.camera, Config(tracking=config))
    print(f"{args.source.name}: {len(sequence.files)} frames, {sequence.camera}", flush=True)

    start, spent, lost, cpu = time.perf_counter(), 0.0, 0, time.process_time()
    for frame in sequence.frames():
        tick = time.perf_counter()
        result = tracker.track(frame)
        spent += time.perf_counter() - tick
        lost += result.state.value == "lost"
    tick = time.perf_counter()
    tracker.finish()
    spent += time.perf_counter() - tick
    online, scale = keyframe_error(tracker, sequence)
    rate = len(sequence.files) / spent
    centres = tracker.trajectory().T_wc[:, :3, 3]
    print(
        f"online: {len(tracker.keyframes)} keyframes, keyframe ATE {online:.3f} cm, all frames "
        f"{align(centres, sequence.T_wc[:, :3, 3])[0]:.3f} cm, lost {lost}, {rate:.1f} frames/s "
        f"({spent:.1f} s tracking, {time.perf_counter() - start:.1f} s with reading, "
        f"{time.process_time() - cpu:.1f} s CPU)",
        flush=True,
    )
    if args.depth_every and sequence.mesh:
        depth_report(tracker, sequence, scale, args.depth_every)
    if not args.no_global:
        tick, cpu = time.perf_counter(), time.process_time()
        global_bundle(tracker)
        final, scale = keyframe_error(tracker, sequence)
        print(
            f"global: keyframe ATE {final:.3f} cm, {len(tracker.map.graph.pairs)} pairs, "
            f"{time.perf_counter() - tick:.1f} s, {time.process_time() - cpu:.1f} s CPU",
            flush=True,
        )
        if args.depth_every and sequence.mesh:
            depth_report(tracker, sequence, scale, args.depth_every)
    tick = time.perf_counter()
    trajectory = tracker.trajectory()
    full, _ = align(trajectory.T_wc[:, :3, 3], sequence.T_wc[:, :3, 3])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"all frames: ATE {full:.3f} cm ({time.perf_counter() - tick:.1f} s to solve), "
        f"{(~trajectory.tracked).sum()} untracked, peak memory {peak:.0f} MiB"
    )


if __name__ == "__main__":
    main()
