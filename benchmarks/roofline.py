"""How near the renderer's kernels come to what the GPU can do at most.

    python benchmarks/roofline.py [--repeat 20] [--json FILE]

Needs a GPU. For every kernel: the least bytes (each input read once, each output written once),
the least arithmetic, and the warp instructions of its loops, from counts made on the GPU from the
buffers of the same rendering; how long the GPU needs at least for each, at rates measured here
(a copy of a large tensor, chains of multiply-adds); and the kernel's time from the profiler.
``measured / floor`` compares with the longest of the three. Data that stay in the L2 cache can come
faster than memory gives them, so single small kernels may lie below their memory floor.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from geogs.gpu.kernels import kernels_for
from geogs.splat.render import render
from geogs.world.disks import DiskParameters
from gpu_times import kernel_milliseconds, median_milliseconds
from renderer_cuda import CASES, NEAR, Case, room_case
from roofline_counts import TILE, Counts, count_work

KERNELS = (
    "project_disks", "list_disks", "sort_tiles", "blend_tiles", "unblend_tiles", "project_backward",
)  # fmt: skip
# Single-precision operations per blended pixel, counted in ``hit_of`` (32), in the rest of
# blend_tiles (20), and in ``unblend_hit`` (78) with the 13 additions to the disk's sums.
BLEND_OPERATIONS, UNBLEND_OPERATIONS = 32 + 20, 32 + 78 + 13
# Double-precision operations per disk in the PTX, where a multiply-add counts twice.
PROJECT_OPERATIONS, PROJECT_BACKWARD_OPERATIONS = 462, 600
# Instructions in the PTX without moves: the test of a tile or of a part, hits with and without a
# blended pixel, and an exchange of the sorting network.
TILE_TEST, EXCHANGE = 53, 16
BLEND_TEST, BLEND_MISS, BLEND_HIT = 68, 61, 79
UNBLEND_TEST, UNBLEND_MISS, UNBLEND_HIT = 67, 44, 212
WARP = 32


@dataclass(frozen=True)
class Work:
    """What a kernel has to do at least."""

    bytes: float
    operations: float = 0.0
    is_double: bool = False
    instructions: float = 0.0
    """Warp instructions in its inner loops; 0 where they were not counted."""


@dataclass(frozen=True)
class Rates:
    """What the GPU does in a second."""

    bytes: float
    single: float
    """Operations; a multiply-add is two."""
    double: float
    instructions: float
    """Warp instructions: one multiply-add of 32 lanes each."""


def least_work(c: Counts) -> dict[str, Work]:
    """From the data that the kernels in ``splat/cuda`` exchange; numbers are bytes per item."""
    record, outline, parameters, sums = 64, 32, 40, 64
    lists = 4 * c.entries + (record + outline) * c.listed + 4 * c.tiles
    exchanges = EXCHANGE * c.exchanges / WARP
    return {
        "project_disks": Work(
            (parameters + outline + 1) * c.disks + record * c.boxed + 8 * c.tiles,
            PROJECT_OPERATIONS * c.boxed, True, TILE_TEST * c.candidates / WARP,
        ),
        # Of a record it reads the centre and the inverse depth, half of it in memory's pieces.
        "list_disks": Work(
            outline * c.disks + record / 2 * c.boxed + 8 * c.entries + 8 * c.tiles,
            instructions=TILE_TEST * c.candidates / WARP,
        ),
        "sort_tiles": Work((8 + 4) * c.entries + 4 * c.tiles, instructions=exchanges),
        "blend_tiles": Work(
            lists + 40 * c.pixels + c.visible, BLEND_OPERATIONS * c.blended,
            instructions=BLEND_TEST * c.tests + BLEND_HIT * c.hits_blended
            + BLEND_MISS * (c.hits - c.hits_blended),
        ),
        # Sums are added to, so read and written.
        "unblend_tiles": Work(
            lists + 36 * c.pixels + 2 * 13 * 4 * c.visible, UNBLEND_OPERATIONS * c.blended,
            instructions=UNBLEND_TEST * c.backward_tests + UNBLEND_HIT * c.hits_blended
            + UNBLEND_MISS * (c.backward_hits - c.hits_blended),
        ),
        "project_backward": Work(
            (outline / 2 + parameters) * c.disks + (parameters + 2 * sums) * c.boxed,
            PROJECT_BACKWARD_OPERATIONS * c.boxed, True,
        ),
    }  # fmt: skip


def floors(work: Work, rates: Rates) -> dict[str, float]:
    """Least milliseconds for memory, arithmetic and the issue of instructions."""
    return {
        "memory": 1e3 * work.bytes / rates.bytes,
        "arithmetic": 1e3 * work.operations / (rates.double if work.is_double else rates.single),
        "issue": 1e3 * work.instructions / rates.instructions,
    }


def multiply_add(dtype: torch.dtype, blocks: int, rounds: int, device: torch.device) -> Tensor:
    """One launch of 8 chains of so many multiply-adds in 256 threads of each block."""
    name = "multiply_add_double" if dtype == torch.float64 else "multiply_add_single"
    out = torch.empty(blocks * 256, dtype=dtype, device=device)
    kernels_for(Path(__file__).with_suffix(".cu"), device)[name](blocks, 256, rounds, 0.999, out)
    return out


def measure_rates() -> Rates:
    """Rates of the current GPU."""
    device = torch.device("cuda")
    source = torch.zeros(2**28, device=device)  # 1 GiB
    target = torch.empty_like(source)
    copied = 2e3 * source.nbytes / median_milliseconds(lambda: target.copy_(source), 20)
    blocks = 8 * torch.cuda.get_device_properties(device).multi_processor_count

    def rate(dtype: torch.dtype, rounds: int) -> float:
        time = median_milliseconds(lambda: multiply_add(dtype, blocks, rounds, device), 20)
        return 2e3 * 8 * rounds * 256 * blocks / time

    single = rate(torch.float32, 2**14)
    return Rates(copied, single, rate(torch.float64, 2**13), single / 2 / WARP)


def pass_milliseconds(case: Case, repeat: int) -> dict[str, float]:
    """Mean time of each kernel in a forward and backward pass."""
    disks = DiskParameters(*(p.clone().requires_grad_() for p in case.disks))
    torch.manual_seed(0)

    weights: list[Tensor] = []

    def step() -> None:
        out = render(disks, case.camera, case.T_cw, "cuda", NEAR)
        maps = (out.depth, out.normal, out.alpha, out.distortion)
        weights.extend(torch.randn_like(m) for m in maps[len(weights) :])
        torch.autograd.grad(maps, disks, weights)

    for _ in range(3):
        step()
    torch.cuda.synchronize()
    found = {k.split("(")[0]: time for k, time in kernel_milliseconds(step, repeat).items()}
    return {name: found.get(name, float("nan")) for name in KERNELS}


def measure(case: Case, rates: Rates, repeat: int) -> dict:
    """Counts of a case and a row per kernel."""
    counts = count_work(case.disks, case.camera, case.T_cw, NEAR)
    times, rows = pass_milliseconds(case, repeat), []
    for name, work in least_work(counts).items():
        least = floors(work, rates)
        bound = max(least, key=lambda k: least[k])
        rows.append(
            {"kernel": name, "measured": times[name], **asdict(work), "floors": least,
             "bound": bound, "ratio": times[name] / least[bound]}
        )  # fmt: skip
    return {"width": case.camera.width, "height": case.camera.height, "counts": asdict(counts),
            "kernels": rows}  # fmt: skip


def report(result: dict) -> str:
    """Markdown: counts and the table of a case."""
    c = Counts(**result["counts"])
    per_pixel, lanes = c.blended / c.pixels, c.blended / max(c.hits_blended, 1)
    lines = [
        f"\n{c.disks:,} disks, {result['width']}x{result['height']}: {c.entries:,} list entries "
        f"(disk and tile of {TILE}x{TILE}), {c.hits:,} hits of a disk and a warp's 8x4 pixels "
        f"forward ({c.hits_blended:,} with a blended pixel), {c.backward_hits:,} backward; "
        f"{c.blended:,} blended pixels of disks, {per_pixel:.1f} per pixel, {lanes:.1f} of "
        f"{WARP} lanes in such a hit. Alpha rebuilt from the counted ones differs by "
        f"{c.alpha_error:.1e}: {'OK' if c.alpha_error < 4e-3 else 'BAD'}\n",
        "| kernel | measured (ms) | MB | memory (ms) | G operations | arithmetic (ms) |"
        " M warp instructions | issue (ms) | bound by | measured / floor |",
        "|---|" + "---:|" * 7 + "---|---:|",
    ]
    for r in result["kernels"]:
        least = r["floors"]
        lines.append(
            f"| {r['kernel']} | {r['measured']:.4f} | {r['bytes'] / 1e6:.1f} "
            f"| {least['memory']:.4f} | {r['operations'] / 1e9:.3f}"
            f"{' double' if r['is_double'] else ''} | {least['arithmetic']:.4f} "
            f"| {r['instructions'] / 1e6:.1f} | {least['issue']:.4f} | {r['bound']} "
            f"| {r['ratio']:.2f} |"
        )
    measured = sum(r["measured"] for r in result["kernels"])
    floor = sum(max(r["floors"].values()) for r in result["kernels"])
    lines.append(
        f"| sum | {measured:.4f} |  |  |  |  |  | {floor:.4f} |  | {measured / floor:.2f} |"
    )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--repeat", type=int, default=20)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("This benchmark needs a GPU.")
    rates = measure_rates()
    print(
        f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}; measured: copies "
        f"{rates.bytes / 1e12:.2f} TB/s, multiply-adds {rates.single / 1e12:.1f} TFLOP/s single, "
        f"{rates.double / 1e12:.1f} double, {rates.instructions / 1e9:.0f} G warp instructions/s",
        flush=True,
    )
    results = []
    for case in CASES:
        results.append(measure(room_case(*case), rates, args.repeat))
        print(report(results[-1]), flush=True)
    names = "|".join(KERNELS)
    print(
        f"\nWhat the hardware counts: ncu --set full -k 'regex:{names}' --launch-skip 60 "
        "--launch-count 6 python benchmarks/renderer_cuda.py --rounds 5"
    )
    if args.json:
        args.json.write_text(json.dumps({"rates": asdict(rates), "cases": results}, indent=2))


if __name__ == "__main__":
    main()
