"""Speed of the compiled losses beside the plain PyTorch ones, forward and backward.

    python benchmarks/losses.py [--threads 2] [--repeat 30]

Render size 320x240, photometric size 640x480. Prints a Markdown table: milliseconds (the fastest
of all repeats, which other load disturbs least) and their ratio, both with the same number of
threads in float32; then the CPU seconds that compiling at first use takes.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import cv2
import numpy as np
import torch

from geogs.config import LossConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.losses.cpu import fused_multi_view, fused_single_view
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import ViewConstants
from oracles.multi_view_reference import multi_view_loss
from oracles.single_view_reference import single_view_loss

RENDER = Camera(280.0, 280.0, 159.5, 119.5, 320, 240)
PHOTO = RENDER.resized(640, 480)
Step = Callable[[], None]


def wavy_maps() -> list[torch.Tensor]:
    """Depth, normal, alpha and distortion of a wavy surface."""
    rows, columns = torch.meshgrid(torch.arange(240), torch.arange(320), indexing="ij")
    depth = 2 + 0.2 * torch.sin(columns / 40) + 0.15 * torch.cos(rows / 37)
    normal = torch.tensor([0.1, -0.1, -0.9]).expand(240, 320, 3).contiguous()
    return [depth, normal, torch.full_like(depth, 0.95), torch.full_like(depth, 0.01)]


def textured_image(rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.random((480, 640, 3)), (0, 0), 4.0)
    return np.clip(127 + 3000 * (noise - 0.5), 0, 255).astype(np.uint8)


def single_view_cases() -> list[tuple[str, Step, Step]]:
    """Name, plain and compiled step of each single-view case."""
    rng = np.random.default_rng(0)
    maps = wavy_maps()
    prior = (maps[0] * torch.from_numpy(1 + 0.02 * rng.random((240, 320)))).float()
    confidence = torch.from_numpy(rng.random((240, 320))).float()
    view = ViewConstants.prepare(textured_image(rng), RENDER, prior, confidence, maps[1])

    def step(loss: Callable, config: LossConfig) -> Step:
        def run() -> None:
            inputs = [m.clone().requires_grad_() for m in maps]
            loss(*inputs, view, config, 2.0).backward()

        return run

    every = replace(LossConfig(), normal_weight=0.1, smoothness_weight=0.05)
    return [
        (name, step(single_view_loss, config), step(fused_single_view, config))
        for name, config in (("single view", LossConfig()), ("single view, all terms", every))
    ]


def multi_view_cases() -> list[tuple[str, Step, Step]]:
    """Name, plain and compiled step of each multi-view case, one neighbour."""
    depth = wavy_maps()[0]
    image = textured_image(np.random.default_rng(0))
    aside = se3_exp(torch.tensor([0.005, 0.003, -0.004, 0.001, 0.001, -0.0005]).double())
    reference = PhotoView.prepare(image, PHOTO, torch.eye(4, dtype=torch.float64))
    target = PhotoView.prepare(image, PHOTO, aside)

    def step(loss: Callable, pose: bool) -> Step:
        def run() -> None:
            moved = reference.at(reference.T_cw.clone().requires_grad_(pose))
            loss(depth.clone().requires_grad_(), moved, target, depth, LossConfig()).backward()

        return run

    return [
        (name, step(multi_view_loss, pose), step(fused_multi_view, pose))
        for name, pose in (("multi view", False), ("multi view, with pose", True))
    ]


def best_ms(step: Step, repeat: int) -> float:
    """Fastest of ``repeat`` runs after one to warm up, in milliseconds."""
    step()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def first_use() -> None:
    """CPU seconds of the first compiled steps of this process, beyond numba's own start."""
    from numba import njit

    njit(lambda x: x + 1)(1)
    start = time.process_time()
    single_view_cases()[0][2]()
    multi_view_cases()[2][2]()
    print(f"{time.process_time() - start:.1f}")


def compile_seconds() -> float:
    """:func:`first_use` in a fresh process without cached code."""
    with tempfile.TemporaryDirectory() as empty:
        environment = {**os.environ, "NUMBA_CACHE_DIR": empty}
        command = [sys.executable, __file__, "--first-use"]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    return float(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description="Compiled against plain losses.")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=30)
    parser.add_argument("--first-use", action="store_true", help="only time the first use")
    options = parser.parse_args()
    torch.set_num_threads(1 if options.first_use else options.threads)
    if options.first_use:
        first_use()
        return
    print("| forward + backward | PyTorch ms | compiled ms | ratio |\n|---|---|---|---|")
    for name, plain, compiled in [*single_view_cases(), *multi_view_cases()]:
        slow = best_ms(plain, max(3, options.repeat // 5))
        fast = best_ms(compiled, options.repeat)
        print(f"| {name} | {slow:.1f} | {fast:.2f} | {slow / fast:.0f} |")
    print(f"\ncompiling at first use: {compile_seconds():.1f} s of CPU time")


if __name__ == "__main__":
    main()
