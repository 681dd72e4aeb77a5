"""A mapper's work so far as plain tensors, to go on from later, perhaps on another device."""

from dataclasses import dataclass

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from geogs.depth.view import DenseDepth, DepthSearch
from geogs.mapping.mapper import Mapper
from geogs.mapping.training.base import TrainingPlace
from geogs.splat.map import DiskParameters


@dataclass(frozen=True, eq=False)
class DepthState:
    """The dense depths of the mapped keyframes, on the CPU."""

    keyframe_id: Int64[Tensor, "v"]
    depth: Float32[Tensor, "v h w"]
    """z in map units."""
    confidence: Float32[Tensor, "v h w"]
    limits: Float64[Tensor, "v 3"]
    """Nearest, typical and farthest depth of the search."""


@dataclass(frozen=True, eq=False)
class DiskState:
    """The disks with what their optimiser remembers, on the CPU."""

    parameters: DiskParameters
    first: DiskParameters
    """Running means of the gradients."""
    second: DiskParameters
    """Running means of their squares."""
    keyframe_id: Int64[Tensor, "n"]
    steps: Int64[Tensor, "n"]
    seen: Int64[Tensor, "n"]


@dataclass(frozen=True, eq=False)
class MapperState:
    """Depths, disks, and how far their training is."""

    depths: DepthState
    disks: DiskState
    trained: TrainingPlace


def mapper_state(mapper: Mapper) -> MapperState:
    """Copies of the work of a mapper whose depths were all searched between given limits."""
    views = [mapper.views[i] for i in mapper.mapped]
    searches = [view.search for view in views if view.search is not None]
    optimizer, disks = mapper.optimizer, mapper.map
    return MapperState(
        DepthState(
            torch.tensor(mapper.mapped),
            torch.stack([view.dense.depth.cpu() for view in views]),
            torch.stack([view.dense.confidence.cpu() for view in views]),
            torch.tensor([[s.near, s.typical, s.far] for s in searches], dtype=torch.float64),
        ),
        DiskState(
            DiskParameters(*map(_copied, disks.parameters)),
            DiskParameters(*map(_copied, optimizer.first)),
            DiskParameters(*map(_copied, optimizer.second)),
            *map(_copied, (disks.keyframe_id, disks.steps, disks.seen)),
        ),
        mapper.trained,
    )


@torch.no_grad()
def restore_mapper(mapper: Mapper, state: MapperState) -> None:
    """Give a mapper that knows the same keyframes, but has no map yet, the work of another."""
    depths, disks, device = state.depths, state.disks, mapper.map.device
    mapper.mapped = depths.keyframe_id.tolist()
    for n, i in enumerate(mapper.mapped):
        view = mapper.views[i]
        view.search = DepthSearch(*depths.limits[n].tolist())
        depth, confidence = depths.depth[n].to(device), depths.confidence[n].to(device)
        median = depths.depth[n].median()
        mapper.pool.set_depth(i, DenseDepth(depth, confidence, median))
    mapper.choose_partners()
    mapper.trained = state.trained
    optimizer = mapper.optimizer
    optimizer.append(disks.parameters, disks.keyframe_id)
    mapper.map.steps.copy_(disks.steps)
    mapper.map.seen.copy_(disks.seen)
    for rows, saved in zip(optimizer.first, disks.first, strict=True):
        rows.copy_(saved)
    for rows, saved in zip(optimizer.second, disks.second, strict=True):
        rows.copy_(saved)


def _copied(x: Tensor) -> Tensor:
    return x.detach().cpu().clone()
