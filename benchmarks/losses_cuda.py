"""Speed of the fused losses of a window of views beside the plain PyTorch ones, on one GPU.

    python benchmarks/losses_cuda.py [--repeat 50]

Ten views at 616x344 with two partners each at 1232x688: value and all gradients, as in one
training iteration. Prints a Markdown table of medians in milliseconds: the plain losses by
autograd, the fused launch as called and replayed from a CUDA graph; then the time of each kernel.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import cv2
import numpy as np
import torch

from geogs.config import LossConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.losses.cuda import ViewTable, WindowLosses
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import MIN_ALPHA, ViewConstants
from gpu_times import kernel_milliseconds, median_milliseconds
from oracles.multi_view_reference import multi_view_loss
from oracles.single_view_reference import single_view_loss

RENDER = Camera(308.0, 308.0, 307.5, 171.5, 616, 344)
PHOTO = RENDER.resized(1232, 688)
VIEWS, PARTNERS, UNIT = 10, 2, 2.0
Step = Callable[[], object]


@dataclass
class Window:
    """A wavy surface seen from ten close poses, rendered a little beside the truth."""

    views: list[ViewConstants]
    photos: list[PhotoView]
    maps: list[torch.Tensor]
    rendered: torch.Tensor
    partners: list[list[int]]
    table: ViewTable

    @staticmethod
    def make(device: torch.device) -> "Window":
        rng = np.random.default_rng(0)
        noise = cv2.GaussianBlur(rng.random((PHOTO.height, PHOTO.width, 3)), (0, 0), 3.0)
        texture = np.clip(127 + 2500 * (noise - 0.5), 0, 255)
        height, width = RENDER.height, RENDER.width
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        depth = 2 + 0.2 * torch.sin(x / 60) + 0.15 * torch.cos(y / 55)
        table = ViewTable(RENDER, PHOTO, device)
        views, photos = [], []
        for k in range(VIEWS):
            image = (texture + 2 * rng.normal(size=texture.shape)).clip(0, 255).astype(np.uint8)
            move = torch.tensor([0.01 * k, 0.005 * k, 0.0, 0.0, 0.001 * k, 0.0]).double()
            confidence = torch.from_numpy(rng.random((height, width))).float()
            view = ViewConstants.prepare(image, RENDER, 1.01 * depth, confidence)
            photo = PhotoView.prepare(image, PHOTO, se3_exp(move), blur=0.3)
            table.add(view, photo)
            moved = {n: v.to(device) for n, v in vars(view).items() if torch.is_tensor(v)}
            views.append(replace(view, **moved))
            photos.append(replace(photo, grey=photo.grey.to(device), T_cw=photo.T_cw.to(device)))
        batch = depth.expand(VIEWS, -1, -1)
        normal = torch.tensor([0.1, -0.1, -0.9])[:, None, None].expand(VIEWS, 3, height, width)
        maps = [batch, normal, torch.full_like(batch, 0.95), torch.full_like(batch, 0.01)]
        maps = [m.to(device).contiguous() for m in maps]
        partners = [[(k + 1) % VIEWS, (k + 2) % VIEWS] for k in range(VIEWS)]
        return Window(views, photos, maps, maps[0].clone(), partners, table)

    def plain(self, config: LossConfig) -> list[torch.Tensor]:
        """Losses and gradients in the maps by autograd, view by view."""
        leaves = [m.detach().requires_grad_() for m in self.maps]
        losses = []
        for k in range(VIEWS):
            depth, normal, alpha, spread = (m[k] for m in leaves)
            view, photo = self.views[k], self.photos[k]
            normal = normal.permute(1, 2, 0)
            loss = single_view_loss(depth, normal, alpha, spread, view, config, UNIT)
            shown = torch.where(alpha.detach() > MIN_ALPHA, depth, 0.0)
            for i in self.partners[k]:
                pair = multi_view_loss(shown, photo, self.photos[i], self.rendered[i], config)
                loss = loss + pair / PARTNERS
            loss.backward()
            losses.append(loss.detach())
        return [torch.stack(losses), *(m.grad for m in leaves if m.grad is not None)]

    def fused(self, config: LossConfig) -> tuple[Step, list[torch.Tensor]]:
        """A launch of the fused losses, and where it puts losses and gradients."""
        device = self.maps[0].device
        losses = WindowLosses(self.table, config, UNIT, VIEWS, PARTNERS, 1 / PARTNERS)
        batch = torch.arange(VIEWS, dtype=torch.int32, device=device)
        pairs = torch.tensor(self.partners, dtype=torch.int32, device=device)
        results = [torch.zeros(VIEWS, device=device), *(torch.zeros_like(m) for m in self.maps)]
        losses.store_rendered(batch, self.rendered, self.maps[2])
        return lambda: losses.launch(batch, pairs, *self.maps, *results[1:], results[0]), results


def captured(step: Step) -> Step:
    """Replay of a step as a CUDA graph."""
    step()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        step()
    return graph.replay


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=50)
    repeat = parser.parse_args().repeat
    if not torch.cuda.is_available():
        raise SystemExit("This benchmark needs an NVIDIA GPU.")
    window = Window.make(torch.device("cuda"))
    cases = {
        "default": LossConfig(),
        "with SSIM, smoothness": LossConfig(ssim_weight=0.2, smoothness_weight=0.1),
    }
    print(f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}\n")
    print("| losses | plain (ms) | fused (ms) | fused, graph (ms) | plain / graph |")
    print("|---|---|---|---|---|")
    for name, config in cases.items():
        step, results = window.fused(config)
        step()
        for a, b in zip(results, window.plain(config), strict=True):
            assert float((a - b).norm() / b.norm().clamp(min=1e-12)) < 1e-2, name
        plain = median_milliseconds(lambda c=config: window.plain(c), max(repeat // 5, 3))
        fused = median_milliseconds(step, repeat)
        replayed = median_milliseconds(captured(step), repeat)
        print(
            f"| {name} | {plain:.2f} | {fused:.3f} | {replayed:.3f} | {plain / replayed:.0f} |",
            flush=True,
        )
    for name, config in cases.items():
        print(f"\nKernels, {name} (ms):")
        step = window.fused(config)[0]
        step()
        torch.cuda.synchronize()
        for kernel, time in kernel_milliseconds(step, 10).items():
            print(f"  {time:7.4f}  {kernel}")


if __name__ == "__main__":
    main()
