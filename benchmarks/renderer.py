"""Times the CPU renderer, forward and backward, against its specification.

    python benchmarks/renderer.py [--threads 2] [--repeats 15]

Contestants alternate within one process; medians are printed. The specification is timed on a few
image rows and scaled to the image: its time is proportional to the pixels.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.splat.cpu.rasterize import rasterize_backward, rasterize_forward
from geogs.splat.render import render
from geogs.world.disks import DiskParameters

CASES = [(20_000, 320, 240), (20_000, 640, 480), (50_000, 640, 480)]
REFERENCE_ROWS = 2


def room(n: int, camera: Camera) -> tuple[DiskParameters, np.ndarray]:
    """Disks on a wavy wall that fills the view, overlapping like those of a trained map."""
    g = torch.Generator().manual_seed(0)
    u = torch.rand(n, generator=g) * camera.width
    v = torch.rand(n, generator=g) * camera.height
    z = 3 + 0.5 * torch.sin(u / 40) + 0.5 * torch.sin(v / 55) + 0.01 * torch.randn(n, generator=g)
    ray = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], 1)
    position = torch.cat([ray * z[:, None], z[:, None]], 1)
    quaternion = torch.tensor([1.0, 0, 0, 0]) + 0.25 * torch.randn(n, 4, generator=g)
    spacing = (camera.width * camera.height / n) ** 0.5 / camera.fx
    scale = (0.75 * spacing * z).log()[:, None] + 0.25 * torch.randn(n, 2, generator=g)
    logit = torch.rand(n, generator=g) * 3 - 0.4
    return DiskParameters(position, quaternion, scale, logit), np.eye(4)


def milliseconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return 1e3 * (time.perf_counter() - start)


def reference_milliseconds(disks: DiskParameters, pose: torch.Tensor, camera: Camera) -> float:
    """Time of the specification, forward and backward, from a strip across the image's middle."""
    top = camera.height // 2
    strip = Camera(camera.fx, camera.fy, camera.cx, camera.cy - top, camera.width, REFERENCE_ROWS)
    leaves = DiskParameters(*(p.clone().requires_grad_() for p in disks))

    def both() -> None:
        out = render(leaves, strip, pose, backend="reference")
        (out.depth.sum() + out.normal.sum() + out.alpha.sum() + out.distortion.sum()).backward()

    return milliseconds(both) * camera.height / REFERENCE_ROWS


def autograd_pass(disks: DiskParameters, pose: torch.Tensor, camera: Camera) -> None:
    """A pass as in training: render, a loss, backward."""
    leaves = DiskParameters(*(p.detach().requires_grad_() for p in disks))
    out = render(leaves, camera, pose, backend="cpu")
    (out.depth.sum() + out.normal.sum() + out.alpha.sum() + out.distortion.sum()).backward()


def measure(case: tuple[int, int, int], threads: int, repeats: int) -> None:
    """Print one case's row."""
    n, width, height = case
    camera = Camera(0.65 * width, 0.65 * width, width / 2, height / 2, width, height)
    disks, pose = room(n, camera)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(6, height, width)).astype(np.float32)
    normal = np.ascontiguousarray(weights[1:4].transpose(1, 2, 0))
    gradients = (weights[0], normal, weights[4], weights[5])
    arrays = tuple(p.numpy() for p in disks)
    T_cw, torch_pose = np.ascontiguousarray(pose[:3]), torch.from_numpy(pose)
    trace = None

    def forward() -> None:
        nonlocal trace
        trace = rasterize_forward(arrays, camera, T_cw, 0.05, threads)[1]

    def backward() -> None:
        rasterize_backward(trace, *gradients, threads)

    rows = []
    for k in range(repeats + 2):
        row = milliseconds(forward), milliseconds(backward)
        whole = milliseconds(lambda: autograd_pass(disks, torch_pose, camera))
        if k >= 2:
            rows.append((*row, whole))
    ahead, back, whole = np.array(rows).T
    line = f"{n:6d} disks {width}x{height}: forward {np.median(ahead):6.1f} ms, "
    line += f"backward {np.median(back):6.1f} ms, through autograd {np.median(whole):6.1f} ms"
    if width * height <= 320 * 240:
        slow = reference_milliseconds(disks, torch_pose, camera)
        line += f"; reference {slow / 1e3:.0f} s, {slow / np.median(ahead + back):.0f} times slower"
    print(line, flush=True)


def main() -> None:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    for case in CASES:
        measure(case, args.threads, args.repeats)


if __name__ == "__main__":
    main()
