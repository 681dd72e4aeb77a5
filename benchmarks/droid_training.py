"""Trains DROID-SLAM's network through the dense bundle adjustment on one clip of a synthetic room.

    python benchmarks/droid_training.py [--base 16] [--steps 160] [--updates 4] [--views 5]

Poses of the first two views are given (they set the scale), the others start like the second; all
depths start as one. The loss is DROID-SLAM's: relative poses, induced flow and residuals of every
update, of which only what the adjustment makes of flow, weights and damping is ever compared with
the truth. One clip is learned by heart: this shows that gradients pass through the adjustment and
are of use, not that a network trained like this is a good one. Prints the curve.
"""

import argparse
import time

import numpy as np
import torch

from geogs.tracking.flow.droid_network import DroidNetwork, DroidSize
from geogs_synth.export import default_camera
from geogs_synth.raycast import Raycaster
from geogs_synth.room import make_room
from geogs_synth.trajectory import handheld_trajectory
from geogs_train.bundle import ClipState
from geogs_train.clip_state import blind_start, neighbour_edges, true_state
from geogs_train.droid_unroll import (
    UnrollOptions,
    cell_cameras,
    unroll,
)
from geogs_train.pose_loss import Estimate, pose_errors, pose_loss

FRAMES = 120
"""Of the path that the clip is a part of."""


def room_clip(
    seed: int, views: int, step: int, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor, ClipState]:
    """Images (1, v, 3, h, w), intrinsics (1, 4) and truth of a clip of a synthetic room."""
    scene, camera = make_room(seed), default_camera(width, height)
    path = handheld_trajectory(scene, FRAMES, seed)[: views * step : step]
    raycaster = Raycaster(scene, threads=1)
    found = [raycaster.render(camera, T_wc) for T_wc in path]
    images = torch.from_numpy(np.stack([v.image for v in found])).permute(0, 3, 1, 2).float() / 255
    depth = torch.from_numpy(np.stack([v.depth for v in found])).float()
    T_cw = torch.from_numpy(np.linalg.inv(path))
    intrinsics = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]])
    return images[None], intrinsics, true_state(T_cw[None], depth[None])


def main() -> None:
    """Train and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", type=int, default=16, help="width; 32 is DROID-SLAM's")
    parser.add_argument("--steps", type=int, default=160)
    parser.add_argument("--updates", type=int, default=4, help="of the network in a step")
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--stride", type=int, default=8, help="frames from view to view")
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--height", type=int, default=72)
    parser.add_argument("--rate", type=float, default=1e-3, help="largest learning rate")
    parser.add_argument("--clip", type=float, default=1.0, help="largest norm of a gradient")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)

    images, intrinsics, truth = room_clip(
        args.seed, args.views, args.stride, args.width, args.height
    )
    start, edges = blind_start(truth), neighbour_edges(args.views, 2)
    cameras, rows, columns = cell_cameras(intrinsics, args.height, args.width)
    network = DroidNetwork(DroidSize(args.base))
    count = sum(p.numel() for p in network.parameters())
    print(
        f"{args.views} views of {args.width} x {args.height} ({columns} x {rows} cells), "
        f"{len(edges.source)} edges, {count} parameters, {args.updates} updates a step"
    )
    nothing = Estimate(start, torch.zeros(1, len(edges.source), rows * columns, 2))
    before = pose_errors(cameras, nothing, truth, edges)
    print(f"at the start: pose {float(before.pose):.4f}, flow {float(before.flow):.3f} cells")
    print("step     loss     pose  flow (cells)  residual  gradient  seconds")

    optimizer = torch.optim.Adam(network.parameters(), args.rate)
    losses, began = [], time.perf_counter()
    for step in range(args.steps):
        share = min((step + 1) / 5, (1 + np.cos(np.pi * step / args.steps)) / 2)
        for group in optimizer.param_groups:
            group["lr"] = args.rate * share
        options = UnrollOptions(updates=args.updates)
        estimates = unroll(network, images, intrinsics, start, edges, options)
        loss, errors = pose_loss(cameras, estimates, truth, edges)
        optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), args.clip)
        optimizer.step()
        losses.append(float(loss.detach()))
        last = errors[-1]
        if step % 5 and step + 1 < args.steps:
            continue
        print(
            f"{step:4d} {losses[-1]:8.4f} {float(last.pose.detach()):8.4f} "
            f"{float(last.flow.detach()):13.3f} {float(last.residual.detach()):9.4f} "
            f"{float(norm):9.3f} {time.perf_counter() - began:8.1f}",
            flush=True,
        )
    end = float(np.median(losses[-8:]))
    print(f"loss {losses[0]:.3f} -> {end:.3f} (median of the last 8): 1/{losses[0] / end:.1f}")


if __name__ == "__main__":
    main()
