"""Our flow network against the classical operator on the same pairs of images.

    python benchmarks/flow.py [--weights FILE] [--batches 4]       unseen synthetic rooms (a GPU)
    python benchmarks/flow.py --scenes usual,shaken,people,papered,bare,street    other kinds, too
    python benchmarks/flow.py --data ROOM_DIR [--gaps 5,15,40]     rendered rooms with depth images

ROOM_DIR is in Replica layout with some depth images: every frame that has one is matched with the
frames before and after it; occlusions are unknown there, so medians and fractions are more reliable
than means. Both operators start from the same disturbed flow ("warm", 0.05 to 16 pixels; "far", 16
to 64) or from zero flow ("cold").
"""

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from geogs.config import InputConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.io.pose_files import read_replica_trajectory
from geogs.io.sources.sniff import open_source
from geogs.networks.weights_files import PACKAGED
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.flow.lookup import Edges
from geogs.tracking.flow.network_parts import cell_pixels
from geogs.tracking.flow.own_network import FlowNetwork, load_flow_network
from geogs.world.grid import SampleGrid
from geogs_train.flow.flow_loss import run_network
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch
from geogs_train.flow.flow_validation import CellErrors, Validation, cell_errors, summarise
from geogs_train.flow.starts import StartOptions, disturbed_starts

STARTS = {
    "warm": StartOptions(cold=0.0),
    "far": StartOptions(cold=0.0, far=1.0),
    "cold": StartOptions(cold=1.0),
}
DEPTH_UNIT = 6553.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=PACKAGED / "flow.safetensors")
    parser.add_argument("--batches", type=int, default=4)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--gaps", default="5,15,40")
    parser.add_argument("--iterations", type=int, nargs=2, default=(4, 12), help="warm, others")
    parser.add_argument("--scenes", default="usual", help="kinds, separated by commas")
    options = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = load_flow_network(options.weights).to(device)
    bank = None
    for scene in options.scenes.split(",") if options.data is None else ["data"]:
        validation: Validation | None = None
        if options.data is None:
            validation = Validation(FlowTraining(), device, options.batches, scene, bank)
            bank = validation.bank
        for name, starts in STARTS.items():
            batches = (
                data_batches(options.data, [int(g) for g in options.gaps.split(",")], starts)
                if validation is None
                else (validation.batch(n, starts) for n in range(options.batches))
            )
            compare(network, batches, f"{scene:8} {name:5}", options.iterations[name != "warm"])


def compare(network: FlowNetwork, batches: Iterable[FlowBatch], name: str, count: int) -> None:
    """Print the scores of both operators on the same pairs."""
    found: dict[str, list[CellErrors]] = {"own": [], "classical": []}
    device = next(network.parameters()).device
    for batch in batches:
        found["own"].append(own_errors(network, on_device(batch, device), count))
        found["classical"].append(classical_errors(batch, "cold" in name))
    for operator, parts in found.items():
        print(f"{name} {operator:9} {summarise(parts).line()}", flush=True)


def on_device(batch: FlowBatch, device: torch.device) -> FlowBatch:
    """Move a batch to a device."""
    edges = Edges(batch.edges.first.to(device), batch.edges.second.to(device))
    moved = {k: v.to(device) for k, v in vars(batch).items() if isinstance(v, torch.Tensor)}
    return FlowBatch(edges=edges, **moved)


@torch.no_grad()
def own_errors(network: FlowNetwork, batch: FlowBatch, iterations: int) -> CellErrors:
    """Errors of the network, on the device of the batch."""
    _, estimates, dense = run_network(network, batch, iterations)
    last = estimates[-1]
    parts = cell_errors(batch, last.pixels, last.error.variance().sqrt(), dense)
    return CellErrors(**{k: v.cpu() for k, v in vars(parts).items()})


def classical_errors(batch: FlowBatch, cold: bool) -> CellErrors:
    """Errors of the classical operator, on the CPU; edges are pairs of both directions."""
    batch = on_device(batch, torch.device("cpu"))
    height, width = batch.images.shape[-2:]
    grid = SampleGrid(Camera(fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=width, height=height))
    operator = ClassicalFlow(grid)
    images = (batch.images.permute(0, 2, 3, 1).numpy() * 255).round().astype(np.uint8)
    encoded = [operator.encode(np.ascontiguousarray(i)) for i in images]
    n = len(batch.start) // 2
    first, second = ([encoded[k] for k in e[:n].tolist()] for e in vars(batch.edges).values())
    start = (None, None) if cold else (batch.start[:n], batch.start[n:])
    matches = operator.measure(first, second, *start)
    pixels, weight = (torch.cat([getattr(m, k) for m in matches]) for k in ("pixels", "weight"))
    deviation = torch.where(weight > 0, weight.rsqrt(), torch.inf)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    flows = (
        operator._dense(a, b, None if cold else s.numpy(), True)
        for a, b, s in zip([*first, *second], [*second, *first], batch.start, strict=True)
    )
    dense = [
        np.stack([flow.at(np.stack(row, -1), 0.0) for row in zip(u, v, strict=True)])
        for flow in flows
    ]
    return cell_errors(batch, pixels, deviation, torch.from_numpy(np.stack(dense)))


def data_batches(folder: Path, gaps: list[int], starts: StartOptions) -> Iterator[FlowBatch]:
    """Batches of a frame with depth and frames before and after it; truth in one direction only."""
    source = open_source(folder, InputConfig())
    camera, poses = source.camera, read_replica_trajectory(folder / "traj.txt").T_wc
    depths = {int(p.stem[5:]): p for p in (folder / "results").glob("depth*.png")}
    frames = {f.index: f.image for f in source}
    generator = torch.Generator().manual_seed(0)
    for index, path in sorted(depths.items()):
        depth = working_depth(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / DEPTH_UNIT, camera)
        others = [k for g in gaps for k in (index - g, index + g) if k in frames]
        yield pairs_with(index, others, depth, frames, poses, camera, starts, generator)


def working_depth(depth: np.ndarray, camera: Camera) -> torch.Tensor:
    """Depth nearest to every pixel's centre."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rows = ((v + 0.5) * depth.shape[0] / camera.height - 0.5).round().astype(int)
    columns = ((u + 0.5) * depth.shape[1] / camera.width - 0.5).round().astype(int)
    return torch.from_numpy(depth[rows, columns]).float()


def pairs_with(index, others, depth, frames, poses, camera, starts, generator) -> FlowBatch:  # type: ignore[no-untyped-def]
    """Edges from one frame to others, then back; the back edges have no truth and no score."""
    n, (height, width) = len(others), depth.shape
    images = torch.from_numpy(np.stack([frames[index], *(frames[k] for k in others)]))
    T_cw = se3_inverse(torch.from_numpy(poses[[index, *others]])).float()
    T = T_cw[1:] @ se3_inverse(T_cw[:1])
    K = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy]).repeat(n, 1).float()
    v, u = torch.meshgrid(torch.arange(height) * 1.0, torch.arange(width) * 1.0, indexing="ij")
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 0 * u + 1], -1)
    y = (T[:, None, None, :3, :3] @ (rays * depth[..., None])[..., None])[..., 0]
    y = y + T[:, None, None, :3, 3]
    truth = y[..., :2] / y[..., 2:].clamp(min=1e-3) * K[0, :2] + K[0, 2:]
    size = torch.tensor([width - 1, height - 1])
    seen = ((truth >= 0) & (truth <= size)).all(-1) & (y[..., 2] > 0.05) & (depth > 0)
    at = (slice(None), slice(4, -3, 8), slice(4, -3, 8))
    shape = truth[at].shape[1:3]
    cells = cell_pixels(*shape, truth).reshape(*shape, 2)
    start = disturbed_starts(
        truth[at], depth[None][at].expand(n, -1, -1), rays[None][at].expand(n, -1, -1, -1), T, K,
        cells, starts, generator,
    )  # fmt: skip
    back = 2 * cells - start  # an approximation, good enough for a check
    zero, k = torch.zeros(n, dtype=torch.int32), torch.arange(1, n + 1, dtype=torch.int32)
    both = [torch.cat([x, torch.zeros_like(x)]) for x in (truth, seen)]
    return FlowBatch(
        images.permute(0, 3, 1, 2).float() / 255, Edges(torch.cat([zero, k]), torch.cat([k, zero])),
        both[0], both[1], both[1], torch.cat([start, back]).flatten(1, 2),
        torch.cat([start, back]).flatten(1, 2),
    )  # fmt: skip


if __name__ == "__main__":
    main()
