"""The plane sweep of ``plane_sweep.py`` on a GPU."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from geogs.depth import plane_sweep
from geogs.depth.cuda.images import KeyframeImages
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload

MATCHING = Path(__file__).with_name("matching.cu")
AGGREGATION = Path(__file__).with_name("aggregation.cu")

MAX_PLANES = 256
"""Most planes that fit into the registers of a warp."""
MAX_NEIGHBOURS = 16
_PLANES_PER_LANE = (1, 3, 4, 5, 8)
_TILE_W, _TILE_H, _SLOT_GROUP = 32, 8, 8


@dataclass(frozen=True, eq=False)
class PlaneSlots:
    """Planes of equally spaced inverse depth, as the lanes of a warp hold them."""

    rho: Float32[Tensor, "s"]
    """Inverse depth of every slot, -1 where there is no plane."""
    per: int
    """Planes in each of the 32 lanes."""
    count: int
    """Number of planes."""
    first: float
    """Smallest inverse depth."""
    spacing: float
    """Difference of inverse depth between neighbouring planes."""

    @staticmethod
    def of(planes: Float32[np.ndarray, "p"], device: torch.device) -> "PlaneSlots":
        """Slot i * 32 + lane holds plane lane * per + i; raises ValueError above MAX_PLANES."""
        count = len(planes)
        if count > MAX_PLANES:
            raise ValueError(f"{count} planes are more than {MAX_PLANES}")
        per = next(n for n in _PLANES_PER_LANE if 32 * n >= count)
        rho = np.full(32 * per, -1.0, np.float32)
        rho[:count] = planes
        rho = np.ascontiguousarray(rho.reshape(32, per).T).ravel()
        spacing = (planes[-1] - planes[0]) / np.float32(count - 1)
        return PlaneSlots(upload(rho, device), per, count, float(planes[0]), float(spacing))


@dataclass(frozen=True, eq=False)
class SweptDepth:
    """``SweepResult`` on the device."""

    inverse_depth: Float32[Tensor, "h w"]
    cost: Float32[Tensor, "h w"]
    margin: Float32[Tensor, "h w"]
    planes: PlaneSlots
    costs: Float32[Tensor, "h w s"]
    """Cost of each slot's plane."""


def match_planes(
    grey: Float32[Tensor, "h w"],
    images: Float32[Tensor, "n h w"],
    homographies: Float32[Tensor, "n 12"],
    planes: PlaneSlots,
    window: int = plane_sweep.WINDOW,
) -> Float32[Tensor, "h w s"]:
    """Mean 1 - NCC of the better half (at least two) of the neighbours that see a point."""
    (h, w), n, radius = grey.shape, len(images), window // 2
    keep = max(min(2, n), (n + 1) // 2)
    size = (_TILE_W + 2 * radius) * (_TILE_H + 2 * radius)
    threads = min(1024, max(-(-size // 32) * 32, _TILE_W * _TILE_H))
    grid = (-(-w // _TILE_W), -(-h // _TILE_H), len(planes.rho) // _SLOT_GROUP)
    volume = grey.new_empty(h, w, len(planes.rho))
    kernels_for(MATCHING, grey.device)["match_planes"](
        grid, threads, grey, images, homographies, planes.rho, len(planes.rho), n, h, w, radius,
        keep, plane_sweep.VARIANCE_FLOOR, volume, shared=4 * (3 * size + 12 * n),
    )  # fmt: skip
    return volume


def average_support(
    volume: Float32[Tensor, "h w s"],
    colours: Float32[Tensor, "3 h w"],
    planes: PlaneSlots,
    prior: Float32[Tensor, "h w"],
    prior_weight: Float32[Tensor, "h w"],
) -> Float32[Tensor, "h w s"]:
    """Costs averaged over pixels of like colour, and pulled to the prior inverse depth."""
    h, w = volume.shape[:2]
    radius = plane_sweep.SUPPORT_RADIUS
    out = torch.empty_like(volume)
    kernels_for(MATCHING, volume.device)["average_support"](
        (-(-w // 8), -(-h // 4)), (32, 8, 4), volume, colours, planes.rho, prior, prior_weight,
        planes.per, h, w, radius, plane_sweep.SUPPORT_SHARPNESS, plane_sweep.PRIOR_PULL,
        plane_sweep.PRIOR_TOLERANCE, out, shared=32 * 4 * (2 * radius + 1) ** 2,
    )  # fmt: skip
    return out


def follow_paths(
    volume: Float32[Tensor, "h w s"], smooth: Float32[Tensor, "h w"], planes: PlaneSlots
) -> Float32[Tensor, "8 h w s"]:
    """Semi-global path costs in each of the eight directions."""
    h, w = smooth.shape
    paths = volume.new_empty(8, *volume.shape)
    kernels_for(AGGREGATION, volume.device)["follow_paths"](
        (-(-(w + h - 1) // 4), 8), (32, 4), volume, smooth, planes.per, h, w,
        plane_sweep.SMALL_JUMP, plane_sweep.LARGE_JUMP, plane_sweep.JUMP_CONTRAST, paths,
    )  # fmt: skip
    return paths


def pick_planes(
    paths: Float32[Tensor, "8 h w s"], volume: Float32[Tensor, "h w s"], planes: PlaneSlots
) -> SweptDepth:
    """The winners of the summed path costs."""
    h, w = volume.shape[:2]
    rho, cost, margin = (volume.new_empty(h, w) for _ in range(3))
    kernels_for(AGGREGATION, volume.device)["pick_planes"](
        -(-h * w // 4), (32, 4), paths, volume, planes.per, h * w, planes.count, planes.first,
        planes.spacing, rho, cost, margin,
    )  # fmt: skip
    return SweptDepth(rho, cost, margin, planes, volume)


def sweep(
    reference: KeyframeImages,
    images: Float32[Tensor, "n h w"],
    homographies: Float32[Tensor, "n 12"],
    planes: PlaneSlots,
    prior: Float32[Tensor, "h w"],
    prior_weight: Float32[Tensor, "h w"],
) -> SweptDepth:
    """``plane_sweep`` over the grey images of at most MAX_NEIGHBOURS neighbours."""
    raw = match_planes(reference.grey, images, homographies, planes)
    volume = average_support(raw, reference.colours, planes, prior, prior_weight)
    del raw
    return pick_planes(follow_paths(volume, reference.smooth, planes), volume, planes)
