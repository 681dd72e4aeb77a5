"""Speed of one mapping iteration on a GPU: the CUDA graph of a run against plain PyTorch losses.

    python benchmarks/mapping_cuda.py [--rounds 30] [--steps 40] [--json FILE]

Ten views at 616x344 of a synthetic room, 30 000 disks, two photometric partners per view at
1232x688, with the losses of a run and with all of the paper's. ``fused`` is the trainer of a run;
``plain`` is the same renderer with the losses in PyTorch, autograd and PyTorch's fused Adam. Both
do the whole step with learning rates of zero, so that the map and with it the work stay the same.
Times are medians between CUDA events, in turns; those of kernels are sums from the profiler.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import torch
from torch import Tensor

from geogs.config import LossAblation, LossConfig, MappingConfig
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.depth_maps import normals_from_depth
from geogs.geometry.lie import se3_inverse
from geogs.losses.single_view import MIN_ALPHA
from geogs.mapping.keyframe_views import KeyframeViews, MapView
from geogs.mapping.training.cuda.trainer import CudaTrainer
from geogs.mapping.training.map_trainer import Batch
from geogs.mapping.view_arrays import MapCameras, ViewArrays
from geogs.splat.cuda import rasterize
from geogs.splat.init import initialise_disks
from geogs.splat.render import NEAR, Rasterized, RenderOutput
from geogs.world.disks import DiskParameters, GaussianMap
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from geogs.world.map import MapTable
from geogs_synth.motion.handheld import HandheldPath
from geogs_synth.places.room import make_room
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.sequence.location import centred_camera
from gpu_times import kernel_milliseconds
from oracles.multi_view_reference import multi_view_loss
from oracles.single_view_reference import single_view_loss

FRAMES_APART = 6
"""Frames between two views on the path."""
NOISE = 0.005
"""Relative standard deviation of the disks' depths."""
SCALE, OPACITY = 1.0, 0.9
"""Standard deviation of a disk over the distance to the next ones, and opacity: as in training."""
CONFIGS = {
    "of a run": LossConfig(),
    "all of the paper": LossConfig(
        normal_weight=0.05,
        smoothness_weight=0.1,
        ssim_weight=0.2,
        ablation=LossAblation(smoothness_rewards_edges=True),
    ),
}
PARTS = {
    "rendering": ("project_disks", "scan_tiles", "list_disks", "sort_tiles", "blend_tiles"),
    "rendering, backward": ("unblend_tiles", "project_backward", "sum_poses"),
    "Adam": ("adam_step", "begin_step"),
}
"""Kernels by name; all others, except copies, belong to the losses."""


@dataclass(frozen=True)
class Window:
    """Views with true depths as priors, and disks near the surfaces that they see."""

    cameras: MapCameras
    batch: Batch
    disks: DiskParameters
    unit: float

    @staticmethod
    def make(views: int, disks: int, width: int, height: int, device: torch.device) -> "Window":
        photo = centred_camera(2 * width, 2 * height)
        cameras = MapCameras(photo, photo.with_long_edge(max(width, height)), photo)
        scene = make_room(0)
        caster, poses = (
            Raycaster(scene),
            HandheldPath(scene).at_frames(np.arange(FRAMES_APART * views)),
        )
        own, depths = [], []
        segment = KeyframeTable.on(SampleGrid(photo, device), None, views).new_set()
        pool = _views(segment, cameras, device)
        for T_wc in poses[::FRAMES_APART]:
            depths.append(torch.from_numpy(caster.render(cameras.render, T_wc).depth).float())
            image = caster.render(photo, T_wc).image
            own.append(_view(segment, pool, image, T_wc, depths[-1]))
        batch = []
        for k, view in enumerate(own):  # partners are the two nearest on the path
            first = min(max(k - 1, 0), views - 3)
            batch.append((view, [v for v in own[first : first + 3] if v is not view]))
        unit = float(torch.stack(depths).median())
        made = _disks(own, depths, cameras, disks)
        bounds = MappingConfig().disk.min_scale * unit, MappingConfig().disk.max_scale * unit
        made.log_scale.clamp_(*np.log(bounds))  # as in every step
        return Window(cameras, batch, DiskParameters(*(p.to(device) for p in made)), unit)


def _views(segment: KeyframeSet, cameras: MapCameras, device: torch.device) -> KeyframeViews:
    return KeyframeViews(ViewArrays(MapTable.empty(device), segment.table, cameras, LossConfig()))


def _view(
    segment: KeyframeSet, pool: KeyframeViews, image: np.ndarray, T_wc: np.ndarray, depth: Tensor
) -> MapView:
    n, T_cw = len(segment), se3_inverse(torch.from_numpy(T_wc))
    view = pool.add(segment.add(n, n / 30, image, None, T_cw).id)
    dense = depth.to(pool.arrays.device)
    view.set_depth(DenseDepth(dense, torch.ones_like(dense), depth.median()))
    normal, _ = normals_from_depth(dense, pool.arrays.cameras.render)
    pool.arrays.load(view.id).constants = replace(view.constants, prior_normal=normal)
    return view


def _disks(
    views: list[MapView], depths: list[Tensor], cameras: MapCameras, count: int
) -> DiskParameters:
    """Make exactly ``count`` disks at evenly drawn pixels of all views, about like a run."""
    random, camera = torch.Generator().manual_seed(0), cameras.render
    area = camera.width * camera.height
    points, spans = [], []
    for k, (view, depth) in enumerate(zip(views, depths, strict=True)):
        share = count * (k + 1) // len(views) - count * k // len(views)
        pixels = torch.randperm(area, generator=random)[:share]
        noisy = depth * (1 + NOISE * torch.randn(depth.shape, generator=random))
        T_wc = view.T_wc.float().cpu()
        seen = camera.back_project(noisy).reshape(-1, 3)[pixels]
        points.append(seen @ T_wc[:3, :3].T + T_wc[:3, 3])
        spans.append((area / count) ** 0.5 * depth.flatten()[pixels] / camera.fx)
    centre = torch.stack([v.T_wc[:3, 3].float().cpu() for v in views]).mean(0)
    disk = replace(MappingConfig().disk, scale_factor=SCALE, opacity=OPACITY)
    new = initialise_disks(torch.cat(points), centre, torch.cat(spans), points[0][:0], disk)
    assert len(new.position) == count
    return new


class Fused:
    """The trainer of a run."""

    def __init__(self, window: Window, config: LossConfig) -> None:
        disks = GaussianMap.empty(window.disks.position.device)
        disks.append(DiskParameters(*(p.clone() for p in window.disks)), 0)
        settings = replace(MappingConfig(), loss=config)
        self.window = window
        self.trainer = CudaTrainer(disks, window.cameras, settings, window.unit, len(window.batch))

    def train(self, steps: int) -> None:
        """So many whole steps that leave the map as it is."""
        self.trainer.train([self.window.batch] * steps, [0.0] * steps)

    def result(self) -> tuple[float, Tensor]:
        """Loss of the last step and the gradient of the positions."""
        (program,) = self.trainer._programs.values()
        own = program.window
        assert own.d_disks is not None
        return float(own.loss.sum()), own.d_disks.position[: len(self.trainer.disks)]


class Plain:
    """The same renderer with PyTorch's operations for the rest."""

    def __init__(self, window: Window, config: LossConfig) -> None:
        device = window.disks.position.device
        self.window, self.config = window, config
        self.disks = DiskParameters(*(p.clone().requires_grad_() for p in window.disks))
        self.photos = {v.id: v.photo.at(v.T_cw.to(device)) for v, _ in window.batch}
        self.poses = torch.stack([v.T_cw for v, _ in window.batch]).to(device)
        self.rendered: dict[int, Tensor] = {}
        self.loss = torch.zeros((), device=device)
        groups = [{"params": [p], "lr": 0.0} for p in self.disks]
        self.adam = torch.optim.Adam(groups, betas=(0.9, 0.99), fused=True)

    def train(self, steps: int) -> None:
        """So many whole steps that leave the map as it is."""
        for _ in range(steps):
            self.adam.zero_grad()
            self.loss = self._loss()
            self.loss.backward()
            self.adam.step()

    def _loss(self) -> Tensor:
        window, config = self.window, self.config
        camera = window.cameras.render
        out = RenderOutput(*Rasterized.apply("cuda", camera, NEAR, self.poses, *self.disks))
        shown = torch.where(out.alpha.detach() > MIN_ALPHA, out.depth, 0.0)
        losses = []
        for k, (view, partners) in enumerate(window.batch):
            losses.append(
                single_view_loss(
                    out.depth[k], out.normal[k], out.alpha[k], out.distortion[k], view.constants,
                    config, window.unit,
                )
            )  # fmt: skip
            for other in partners:
                pair = multi_view_loss(
                    shown[k], self.photos[view.id], self.photos[other.id],
                    self.rendered.get(other.id), config,
                )  # fmt: skip
                losses.append(pair / len(partners))
        for k, (view, _) in enumerate(window.batch):
            self.rendered[view.id] = shown[k].detach()
        return torch.stack(losses).sum()

    def result(self) -> tuple[float, Tensor]:
        """Loss of the last step and the gradient of the positions."""
        assert self.disks.position.grad is not None
        return float(self.loss.detach()), self.disks.position.grad


Contestant = TypeVar("Contestant", Fused, Plain)


def agreement(fused: Fused, plain: Plain) -> tuple[float, float]:
    """Relative difference of the losses and cosine of the gradients.

    Both are of a second step, which tests occlusion by the renderings of the first one.
    """
    for contestant in (fused, plain):
        contestant.train(2)
    (a, g), (b, h) = fused.result(), plain.result()
    return abs(a - b) / abs(b), float(torch.cosine_similarity(g.flatten(), h.flatten(), dim=0))


def time_in_turns(fused: Fused, plain: Plain, steps: int, rounds: int) -> tuple[float, float]:
    """Median milliseconds of a step of each."""
    turns: list[tuple[Callable[[int], None], int, list[float]]]
    turns = [(fused.train, steps, []), (plain.train, 1, [])]
    for number in range(rounds + 2):
        for train, count, times in turns:
            before, after = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            before.record()
            train(count)
            after.record()
            after.synchronize()
            if number >= 2:
                times.append(before.elapsed_time(after) / count)
    a, b = (statistics.median(times) for _, _, times in turns)
    return a, b


def parts_of(kernels: dict[str, float]) -> dict[str, float]:
    """The kernels' times by their part of the step."""
    parts = dict.fromkeys(("rendering", "losses", "rendering, backward", "Adam", "copies"), 0.0)
    for name, time in kernels.items():
        part = next((p for p, names in PARTS.items() if name.startswith(names)), "losses")
        if name.startswith(("Memcpy", "Memset")):
            part = "copies"
        elif "adam" in name.lower():
            part = "Adam"
        parts[part] += time
    return parts


def started(make: Callable[[], Contestant]) -> tuple[Contestant, float]:
    """A contestant after two steps, and the peak memory of its tensors in MiB."""
    rasterize._resting.cache_clear()  # no buffers of earlier renderings
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    contestant = make()
    contestant.train(2)
    torch.cuda.synchronize()
    return contestant, (torch.cuda.max_memory_allocated() - before) / 2**20


def measure(name: str, window: Window, steps: int, rounds: int) -> dict:
    """One row: agreement, times and memory of both for one set of losses."""
    config = CONFIGS[name]
    fused, fused_memory = started(lambda: Fused(window, config))
    plain, plain_memory = started(lambda: Plain(window, config))
    memory = {"fused": fused_memory, "plain": plain_memory}
    difference, cosine = agreement(fused, plain)
    a, b = time_in_turns(fused, plain, steps, rounds)
    kernels = {
        "fused": kernel_milliseconds(lambda: fused.train(1), 10),
        "plain": kernel_milliseconds(lambda: plain.train(1), 3),
    }
    return {
        "losses": name, "loss_difference": difference, "gradient_cosine": cosine,
        "ok": difference < 1e-4 and cosine > 0.999, "fused_ms": a, "plain_ms": b, "ratio": b / a,
        "memory_mib": memory, "parts": {k: parts_of(v) for k, v in kernels.items()},
        "kernel_ms": {k: sum(v.values()) for k, v in kernels.items()},
        "kernels": dict(list(kernels["fused"].items())[:10]),
    }  # fmt: skip


def report(rows: list[dict]) -> str:
    """Markdown tables of milliseconds of a step."""
    lines = [
        "| losses | fused | its kernels | plain | its kernels | plain / fused | fused (MiB) |"
        " plain (MiB) | loss differs by | cosine of gradients | |",
        "|---|" + "---:|" * 9 + "---|",
    ]
    for r in rows:
        kernels, memory = r["kernel_ms"], r["memory_mib"]
        lines.append(
            f"| {r['losses']} | {r['fused_ms']:.3f} | {kernels['fused']:.3f} | {r['plain_ms']:.2f} "
            f"| {kernels['plain']:.2f} | {r['ratio']:.1f} | {memory['fused']:.0f} "
            f"| {memory['plain']:.0f} | {r['loss_difference']:.1e} | {r['gradient_cosine']:.6f} "
            f"| {'OK' if r['ok'] else 'BAD'} |"
        )
    columns = [(r, side) for r in rows for side in ("fused", "plain")]
    lines += ["", "| kernels for | " + " | ".join(f"{s}, {r['losses']}" for r, s in columns) + " |"]
    lines.append("|---|" + "---:|" * len(columns))
    for part in rows[0]["parts"]["fused"]:
        cells = (f"{r['parts'][side][part]:.3f}" for r, side in columns)
        lines.append(f"| {part} | " + " | ".join(cells) + " |")
    for r in rows:
        lines += ["", f"Largest kernels of the fused step, losses {r['losses']} (ms):", ""]
        lines += [f"    {time:7.4f}  {name}" for name, time in r["kernels"].items()]
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--disks", type=int, default=30_000)
    parser.add_argument("--width", type=int, default=616)
    parser.add_argument("--height", type=int, default=344)
    parser.add_argument("--steps", type=int, default=40, help="steps per call of the trainer")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("This benchmark needs a GPU.")
    # The profiler only records the kernels of graphs captured after its first start.
    kernel_milliseconds(torch.cuda.synchronize, 1)
    window = Window.make(args.views, args.disks, args.width, args.height, torch.device("cuda"))
    rows = [measure(name, window, args.steps, args.rounds) for name in CONFIGS]
    print(
        f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}: {args.views} views "
        f"{args.width}x{args.height}, {args.disks:,} disks, medians of {args.rounds}\n"
    )
    print(report(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
