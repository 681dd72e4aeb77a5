"""Correlation of the errors of flow in neighbouring cells and in edges with a common image.

    python benchmarks/flow_correlation.py [--weights FILE] [--scenes usual,shaken] [--batches 4]

The adjustment assumes that the errors of cells are independent, in one edge and across edges. If
they are correlated, its standard deviations have to be larger. Errors over the predicted standard
deviation, z, are compared between cells some cells apart and between two edges with the same first
image. A mean of n such errors has the variance of n / f independent ones, with

    f = (sum over all lags of their correlation in space) * (1 + (E - 1) * correlation over edges)

and the factor on the standard deviations is sqrt(f var z). The sum stops where the correlation
first falls below a twentieth; E is the number of edges of a cell in the tracker. Printed for both
operators on the same pairs, and for the network where the classical operator has no match or a
different one.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.networks.weights_files import PACKAGED
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.flow.own import OwnFlowOptions
from geogs.tracking.flow.own_network import load_flow_network
from geogs.world.grid import SampleGrid
from geogs_synth.clips.room_options import only_scene
from geogs_synth.clips.sampler import RoomSampler
from geogs_train.flow.flow_loss import run_network
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch, flow_batch
from geogs_train.flow.starts import StartOptions

EDGES = 6
"""Approximate number of edges of a keyframe's cell in the tracker's window."""
LARGEST = 2.0
"""Largest error of a start of the tracker, pixels."""
CUT = 4.0
"""Limit to which errors are clamped, in predicted standard deviations: the adjustment is robust."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=PACKAGED / "flow.safetensors")
    parser.add_argument("--scenes", default="usual,shaken")
    parser.add_argument("--batches", type=int, default=4)
    parser.add_argument("--clips", type=int, default=8, help="of a batch, three views each")
    parser.add_argument("--iterations", type=int, default=4)
    parser.add_argument("--width", type=int, default=416)
    parser.add_argument("--height", type=int, default=288)
    options = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = load_flow_network(options.weights).to(device)
    bank = None
    for scene in options.scenes.split(","):
        rooms = replace(
            FlowTraining().rooms, width=options.width, height=options.height, views=3,
            validation=True, scenes=only_scene(scene),
        )  # fmt: skip
        sampler = RoomSampler(rooms, device, 1618, bank)
        bank = sampler.bank
        found: dict[str, list[torch.Tensor]] = {}
        for number in range(options.batches):
            generator = torch.Generator(device).manual_seed(number)
            starts = StartOptions(cold=0.0, largest=LARGEST)
            batch = flow_batch(sampler.sample(number, options.clips), starts, generator)
            for name, z in errors(network, batch, options.iterations).items():
                found.setdefault(name, []).append(z)
        for name, parts in found.items():
            print(f"{scene:8} {name:22} {factor(torch.cat(parts), EDGES)}", flush=True)


@torch.no_grad()
def errors(network, batch: FlowBatch, iterations: int) -> dict[str, torch.Tensor]:  # type: ignore[no-untyped-def]
    """z of the edges from the middle view of each clip: clips, two edges, rows, columns, x and y;
    NaN where there is no match or the point is not seen."""
    _, estimates, _ = run_network(network, batch, iterations)
    last, own = estimates[-1], OwnFlowOptions()
    height, width = batch.images.shape[-2:]
    grid = SampleGrid(Camera(fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=width, height=height))
    good = 2**0.5 * last.error.log_scale.exp().amax(-1) < own.max_deviation
    good &= last.error.logit[..., 0].sigmoid() > own.min_probability
    mine = torch.where(good[..., None], last.error.weight(own.floor), 0.0).float().cpu()
    truth, seen = (batch.at_cells(x).cpu() for x in (batch.truth, batch.visible))
    pixels = last.pixels.cpu()
    theirs, weight = classical_matches(grid, batch)
    gone = (theirs - pixels).square() * mine * weight / (mine + weight).clamp(min=1e-9)
    joined = (weight > 0).all(-1) & (gone.amax(-1) < own.agreement**2)
    kinds = {
        "own": z_of(pixels, mine, truth, seen),
        "own, where alone": z_of(pixels, mine, truth, seen & ~joined),
        "classical": z_of(theirs, weight, truth, seen),
        "classical, where joined": z_of(theirs, weight, truth, seen & joined & good.cpu()),
    }
    # The order of the edges is 0-1, 1-0, 1-2, 2-1, each of all clips.
    count = len(truth) // 4
    rows = grid.height
    return {
        name: z.unflatten(0, (4, count))[1:3].transpose(0, 1).unflatten(2, (rows, -1))
        for name, z in kinds.items()
    }


def classical_matches(grid: SampleGrid, batch: FlowBatch) -> tuple[torch.Tensor, torch.Tensor]:
    """Matches and weights of the classical operator, from the same starts."""
    operator = ClassicalFlow(grid)
    images = (batch.images.permute(0, 2, 3, 1).cpu().numpy() * 255).round().astype(np.uint8)
    encoded = [operator.encode(np.ascontiguousarray(i)) for i in images]
    first, second = ([encoded[k] for k in e.tolist()] for e in vars(batch.edges).values())
    start = batch.start.cpu()
    there, back = (x.flatten(0, 1) for x in _ways(torch.arange(len(first))))
    ways = operator.measure(
        [first[k] for k in there], [second[k] for k in there], start[there], start[back]
    )
    order = torch.cat([there, back]).argsort()
    pixels, weight = (torch.cat([getattr(w, k) for w in ways]) for k in ("pixels", "weight"))
    return pixels[order], weight[order]


def _ways(edges: torch.Tensor) -> torch.Tensor:
    """Split edges (0-1, 1-0, 1-2, 2-1, each of all clips) into forward and back ones."""
    return edges.reshape(2, 2, -1).transpose(0, 1)


def z_of(
    pixels: torch.Tensor, weight: torch.Tensor, truth: torch.Tensor, seen: torch.Tensor
) -> torch.Tensor:
    """Errors over the predicted standard deviation, clamped; NaN where there is none."""
    z = ((truth - pixels) * weight.sqrt()).clamp(-CUT, CUT)
    return z.masked_fill(~(seen[..., None] & (weight > 0)), torch.nan)


def factor(z: torch.Tensor, edges: int) -> str:
    """Text of the factor on the standard deviations, and of its parts."""
    variance = float(z.square().nanmean())
    space, reach = 0.0, 0
    for lag in range(z.shape[3]):
        ring = [
            correlation(z, z, dy, dx)
            for dy in range(-min(lag, z.shape[2] - 1), min(lag, z.shape[2] - 1) + 1)
            for dx in (range(-lag, lag + 1) if abs(dy) == lag else (-lag, lag))
        ]
        mean = float(np.nanmean(ring))
        if not mean >= 0.05:
            break
        space, reach = space + mean * (1 if lag == 0 else 8 * lag), lag
    across = correlation(z[:, :1], z[:, 1:], 0, 0)
    total = variance * space * (1 + (edges - 1) * max(across, 0.0))
    share = float((~z.isnan()).float().mean())
    return (
        f"cells {100 * share:.0f} %  deviation of z {variance**0.5:.2f}  cells alike {space:.1f} "
        f"(reach {reach})  over edges {across:.2f}  factor {total**0.5:.2f}"
    )


def correlation(a: torch.Tensor, b: torch.Tensor, dy: int, dx: int) -> float:
    """Correlation of a with b some rows and columns away, over the cells where both are known."""
    h, w = a.shape[2:4]
    if abs(dy) >= h or abs(dx) >= w:
        return float("nan")
    first = a[:, :, max(dy, 0) : h + min(dy, 0), max(dx, 0) : w + min(dx, 0)]
    second = b[:, :, max(-dy, 0) : h + min(-dy, 0), max(-dx, 0) : w + min(-dx, 0)]
    both = ~(first.isnan() | second.isnan())
    x, y = first[both], second[both]
    if len(x) < 100:
        return float("nan")
    return float((x * y).mean() / (x.square().mean() * y.square().mean()).sqrt().clamp(min=1e-9))


if __name__ == "__main__":
    main()
