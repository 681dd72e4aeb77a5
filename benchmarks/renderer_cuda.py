"""Speed of the CUDA renderer against gsplat's 2-D renderer, forward and backward.

    python benchmarks/renderer_cuda.py [--rounds 30] [--json FILE]

Needs a GPU. Ours is measured twice: differentiated by autograd, and by the pull-back of
``render_vjp``. If gsplat (1.5) can be imported, all render the same room in turns, so that other
load of the machine affects them alike. Its times are for its public autograd function, unchanged,
which blends the depths of the disks' centres, not of the hits, and waits for the GPU at the end of
its backward pass (the sums over the kernels leave that out). Each time is the median over the
rounds of one forward and backward pass: between CUDA events around a burst of passes, the same with
the backward pass on the calling thread, summed over the kernels alone, and on the host's clock
until the calls return.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import matrix_to_quaternion, se3_inverse
from geogs.splat.render import render, render_vjp
from geogs.world.disks import DiskParameters
from gpu_times import kernel_milliseconds

CASES = [(100_000, 1200, 680), (30_000, 616, 344), (1_000_000, 1200, 680)]
NEAR = 0.05
FIELD_OF_VIEW = 75.0
ROOM = (5.0, 4.0, 2.6)
FURNITURE = [
    ((3.6, 2.9, 0.40), (0.9, 0.7, 0.80)),
    ((3.9, 1.0, 0.50), (0.6, 0.6, 1.00)),
    ((2.5, 1.9, 0.22), (0.8, 0.5, 0.44)),
]
"""Centre and size of boxes, metres."""
OVERLAP = 0.75
"""Standard deviation of a disk over the mean distance to the next."""
BURST = 20
"""Passes in a turn, so that the host may run ahead as in training."""


@dataclass(frozen=True)
class Case:
    """Input of the renderers."""

    disks: DiskParameters
    camera: Camera
    T_cw: Tensor


@dataclass(frozen=True)
class Timing:
    """Milliseconds of one forward and backward pass."""

    device: float
    """Median between two CUDA events."""
    host: float
    """Median time until the calls have returned."""
    one_thread: float
    """The same with the backward pass run by the calling thread instead of one of PyTorch's."""
    kernels: float
    """Sum over the kernels, from the profiler, without the gaps between them."""


def room_faces() -> np.ndarray:
    """(n, 3, 3): centre and the two half edges of every rectangle of the room and its boxes."""
    boxes = [(tuple(s / 2 for s in ROOM), ROOM), *FURNITURE]
    faces = []
    for centre, size in boxes:
        half = np.diag(size) / 2
        for axis in range(3):
            u, v = half[(axis + 1) % 3], half[(axis + 2) % 3]
            faces += [(centre + sign * half[axis], u, v) for sign in (-1, 1)]
    return np.array(faces)


def room_camera(width: int, height: int) -> tuple[Camera, Tensor]:
    """A camera in one corner of the room that looks at the boxes, and its pose, float64."""
    focal = float(width / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2))
    eye, target = np.array([0.5, 0.7, 1.6]), np.array([3.6, 2.4, 0.9])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T_wc = np.eye(4)
    T_wc[:3] = np.stack([right, np.cross(forward, right), forward, eye], 1)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    return camera, se3_inverse(torch.from_numpy(T_wc))


def room_case(count: int, width: int, height: int, device: str = "cuda", seed: int = 0) -> Case:
    """Make disks spread evenly over the surfaces in the view, about like a trained map's."""
    random = np.random.default_rng(seed)
    camera, T_cw = room_camera(width, height)
    faces = room_faces()
    area = 4 * np.linalg.norm(np.cross(faces[:, 1], faces[:, 2]), axis=1)
    chosen: list[np.ndarray] = []
    tried = found = 0
    while found < count:
        face = faces[random.choice(len(faces), 2 * count, p=area / area.sum())]
        place = random.uniform(-1, 1, (2 * count, 2, 1))
        centre = face[:, 0] + (place * face[:, 1:]).sum(1)
        inside = _in_view(centre, camera, T_cw.numpy())
        chosen.append(np.concatenate([centre[:, None], face[:, 1:]], 1)[inside])
        tried, found = tried + 2 * count, found + int(inside.sum())
    centre, u, v = np.concatenate(chosen)[:count].transpose(1, 0, 2)
    spacing = np.sqrt(area.sum() * found / tried / count)
    u, v = (e / np.linalg.norm(e, axis=1, keepdims=True) for e in (u, v))
    normal = np.cross(u, v)
    angle = random.uniform(0, 2 * np.pi, (count, 1))
    tangent = np.cos(angle) * u + np.sin(angle) * v
    rotation = np.stack([tangent, np.cross(normal, tangent), normal], 2)
    quaternion = matrix_to_quaternion(torch.from_numpy(rotation)).numpy()
    quaternion = quaternion + random.normal(0, 0.03, quaternion.shape)
    position = centre + normal * random.normal(0, 0.004, (count, 1))
    log_scale = np.log(OVERLAP * spacing) + random.normal(0, 0.25, (count, 2))
    opacity = random.uniform(0.4, 0.95, count)
    numbers = (position, quaternion, log_scale, np.log(opacity / (1 - opacity)))
    tensors = (torch.from_numpy(x).to(device, torch.float32) for x in numbers)
    return Case(DiskParameters(*tensors), camera, T_cw.to(device, torch.float32))


def _in_view(points: np.ndarray, camera: Camera, T_cw: np.ndarray, margin: int = 8) -> np.ndarray:
    x, y, z = (points @ T_cw[:3, :3].T + T_cw[:3, 3]).T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0.15) & (u > -margin) & (u < camera.width + margin)
    return inside & (v > -margin) & (v < camera.height + margin)


class Ours:
    """This project's renderer, differentiated by autograd."""

    name = "geogs"

    def __init__(self, case: Case) -> None:
        self.case = case
        self.disks = DiskParameters(*(p.clone().requires_grad_() for p in case.disks))
        self.T_cw = case.T_cw.clone().requires_grad_()
        self.weights = [torch.randn_like(m) for m in self.maps()]

    def maps(self) -> tuple[Tensor, ...]:
        """Depth, normal, alpha, distortion."""
        out = render(self.disks, self.case.camera, self.T_cw, near=NEAR)
        return out.depth, out.normal, out.alpha, out.distortion

    def step(self) -> None:
        """One forward and backward pass."""
        torch.autograd.grad(self.maps(), [*self.disks, self.T_cw], self.weights)

    def alpha_and_normal(self) -> tuple[Tensor, Tensor]:
        """Normals in the world frame."""
        with torch.no_grad():
            _, normal, alpha, _ = self.maps()
            return alpha, normal @ self.T_cw[:3, :3]


class OursByPullBack(Ours):
    """This project's renderer, differentiated by its pull-back."""

    name = "geogs, render_vjp"

    def __init__(self, case: Case) -> None:
        super().__init__(case)
        self.disks, self.T_cw = case.disks, case.T_cw

    def step(self) -> None:
        """One forward and backward pass."""
        _, pull_back = render_vjp(self.disks, self.case.camera, self.T_cw, near=NEAR)
        pull_back(*self.weights)


class Gsplat:
    """gsplat's 2-D renderer on the same disks; raises ImportError if it is not installed."""

    name = "gsplat"

    def __init__(self, case: Case) -> None:
        from gsplat import rasterization_2dgs

        self._rasterize = rasterization_2dgs
        self.camera = case.camera
        p, q, s, o = case.disks
        scale = torch.cat([s.exp(), torch.ones_like(s[:, :1])], 1)
        leaves = (p, q, scale, o.sigmoid(), case.T_cw)
        self.leaves = [x.clone().requires_grad_() for x in leaves]
        self.colours = torch.ones_like(p[:, :1])
        K = case.camera.matrix()
        K[:2, 2] += 0.5  # its pixel centres lie at halves
        self.K = K.to(p)[None]
        self.weights = [torch.randn_like(m) for m in self.maps()]

    def maps(self) -> tuple[Tensor, ...]:
        """Depth (of the centres), normal, alpha, distortion."""
        position, quaternion, scale, opacity, T_cw = self.leaves
        depth, alpha, normal, _, distortion, _, self.meta = self._rasterize(
            position, quaternion, scale, opacity, self.colours, T_cw[None], self.K,
            self.camera.width, self.camera.height,
            near_plane=NEAR, render_mode="D", distloss=True, packed=False,
        )  # fmt: skip
        return depth, normal, alpha, distortion

    def step(self) -> None:
        """One forward and backward pass."""
        torch.autograd.grad(self.maps(), self.leaves, self.weights)

    def alpha_and_normal(self) -> tuple[Tensor, Tensor]:
        """Normals in the world frame."""
        with torch.no_grad():
            _, normal, alpha, _ = self.maps()
            return alpha[0, ..., 0], normal[0]

    def pairs(self) -> int:
        """Disk-tile pairs (tiles of 16 x 16 pixels) of the last rendering."""
        return len(self.meta["flatten_ids"])


def time_in_turns(steps: list[Callable[[], None]], rounds: int) -> list[tuple[float, float]]:
    """Median milliseconds on the device and on the host of each step, one after the other."""
    times: list[list[tuple[float, float]]] = [[] for _ in steps]
    for number in range(rounds + 5):
        for step, record in zip(steps, times, strict=True):
            before, after = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            start = time.perf_counter()
            before.record()
            for _ in range(BURST):
                step()
            after.record()
            host = 1e3 * (time.perf_counter() - start)
            torch.cuda.synchronize()
            if number >= 5:
                record.append((before.elapsed_time(after) / BURST, host / BURST))
    return [tuple(np.median(record, 0).tolist()) for record in times]


def contestants(count: int, width: int, height: int) -> list[Ours | Gsplat]:
    """The renderers on the same room."""
    case = room_case(count, width, height)
    found: list[Ours | Gsplat] = [Ours(case), OursByPullBack(case)]
    try:
        found.append(Gsplat(case))
    except ImportError as error:
        print(f"gsplat is not available: {error}")
    return found


def measure(cases: list[tuple[int, int, int]], rounds: int) -> list[dict]:
    """Measure a row per case: times of the renderers and their differences."""
    fields = [contestants(*case) for case in cases]
    times, alone = [], []
    for renderers in fields:
        steps = [r.step for r in renderers]
        times.append(time_in_turns(steps, rounds))
        with torch.autograd.set_multithreading_enabled(False):
            alone.append(time_in_turns(steps, rounds))
    rows = []  # the profiler comes last, because it makes later launches slower
    for case, renderers, timed, single in zip(cases, fields, times, alone, strict=True):
        row: dict = dict(zip(("disks", "width", "height"), case, strict=True)) | {"times": {}}
        for renderer, (device, host), (one, _) in zip(renderers, timed, single, strict=True):
            kernels = sum(kernel_milliseconds(renderer.step, 10).values())
            row["times"][renderer.name] = asdict(Timing(device, host, one, kernels))
        if isinstance(renderers[-1], Gsplat):
            row |= compare(renderers[0], renderers[-1])
        rows.append(row)
    return rows


def compare(ours: Ours | Gsplat, theirs: Gsplat) -> dict:
    """Mean differences of the maps, and the number of disk-tile pairs."""
    pairs = zip(ours.alpha_and_normal(), theirs.alpha_and_normal(), strict=True)
    alpha, normal = (float((a - b).abs().mean()) for a, b in pairs)
    return {"alpha_difference": alpha, "normal_difference": normal, "pairs": theirs.pairs()}


def table(rows: list[dict]) -> str:
    """Markdown table of milliseconds; gsplat's time over a renderer's is above 1 if that is
    faster."""
    kinds = ("device", "one_thread", "kernels")
    lines = [
        "| disks | image | renderer | ms | one thread | kernels | host |"
        " gsplat over it | one thread | kernels |",
        "|---:|---:|---|" + "---:|" * 7,
    ]
    for row in rows:
        theirs = row["times"].get("gsplat")
        for name, timing in row["times"].items():
            cells = [f"{row['disks']:,}", f"{row['width']}x{row['height']}", name]
            cells += [_number(timing[k]) for k in (*kinds, "host")]
            cells += [_number(theirs[k] / timing[k] if theirs else None, 2) for k in kinds]
            lines.append("| " + " | ".join(cells) + " |")
    for row in rows:
        if "pairs" in row:
            lines.append(
                f"{row['disks']:,} disks: {row['pairs']:,} of them in a tile; mean difference of"
                f" alpha {row['alpha_difference']:.5f}, of normals {row['normal_difference']:.5f}"
            )
    return "\n".join(lines)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> None:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("This benchmark needs a GPU.")
    torch.manual_seed(0)
    rows = measure(CASES, args.rounds)
    print(f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}, medians of {args.rounds}")
    print(table(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
