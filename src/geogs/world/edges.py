"""Edges between keyframes: measured optical flow, in full precision or packed.

A packed edge takes a third of the memory, for graphs over thousands of keyframes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import torch
from jaxtyping import Float, Float16, Float32, Int16
from torch import Tensor

from geogs.config.setting import Range
from geogs.geometry.camera import Camera
from geogs.limits import POSITIVE, KeyframeId, Pose
from geogs.world.arrays import NOT_STORED
from geogs.world.grid import SampleGrid

Pair = tuple[KeyframeId, KeyframeId]
"""Two keyframe ids: source and target of a directed edge, or the earlier first for both."""


@dataclass(eq=False)
class MeasuredEdge:
    """One direction of a measured pair."""

    pixels: Float32[Tensor, "p 2"]
    """Position in the target of each cell of the source."""
    weight: Annotated[Float32[Tensor, "p 2"], Range(0)]
    """Inverse variance of x and y in 1 / pixel^2; zero where there is no match."""
    reprojection: Float32[Tensor, "p 2"]
    """Projections of the cells by the poses and depths when the flow was measured."""
    damping: Annotated[Float32[Tensor, "p"], Range(0)] | None = None
    """Damping of the source's inverse depth, if the flow operator gives one."""
    memory: Any = field(default=None, metadata=NOT_STORED)
    """Optional cache of the flow operator for this edge."""


@dataclass(eq=False)
class PackedEdge:
    """One direction of a measured pair, packed.

    Positions are kept in steps of 2^-15 of the long edge (1/64 pixel at 512; matches half an image
    outside are clamped to its border) and weights in half precision. The projections of the cells
    when the flow was measured are recomputed from the poses and depths of that time, which many
    edges share.
    """

    position: Int16[Tensor, "p 2"]
    half_weight: Annotated[Float16[Tensor, "p 2"], Range(0)]
    T_source: Pose
    """World to camera of the source when the flow was measured."""
    T_target: Pose
    inverse_depth: Annotated[Float32[Tensor, "p"], POSITIVE]
    """Inverse depth of the source when the flow was measured."""
    damping: Annotated[Float32[Tensor, "p"], Range(0)] | None = None
    """Damping of the source's inverse depth, if the flow operator gives one."""
    memory: Any = field(default=None, metadata=NOT_STORED)
    """Optional cache of the flow operator for this edge."""

    def moved(self, camera: Camera, shift: Float[Tensor, "p 2"]) -> "PackedEdge":
        """Return a copy with its matches shifted by so many pixels."""
        return replace(self, position=self.position + in_steps(camera, shift))


Edge = MeasuredEdge | PackedEdge


def edge_matches(
    grid: SampleGrid, edges: Sequence[Edge]
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
    """Return the measured positions and weights of some edges."""
    packed = [e for e in edges if isinstance(e, PackedEdge)]
    if packed and len(packed) == len(edges):
        position = torch.stack([e.position for e in packed])
        weight = torch.stack([e.half_weight for e in packed]).float()
        return unpacked_positions(grid, position), weight
    each = [
        (e.pixels, e.weight)
        if isinstance(e, MeasuredEdge)
        else (unpacked_positions(grid, e.position), e.half_weight.float())
        for e in edges
    ]
    return torch.stack([pixels for pixels, _ in each]), torch.stack([weight for _, weight in each])


def pack_matches(
    grid: SampleGrid, pixels: Float[Tensor, "*b 2"], weight: Float[Tensor, "*b 2"]
) -> tuple[Int16[Tensor, "*b 2"], Float16[Tensor, "*b 2"]]:
    """Pack positions in whole steps from the image's centre, zero where unmatched, and weights."""
    steps = (pixels - grid.centre) / position_step(grid.camera)
    position = torch.where(weight > 0, steps.round(), 0.0).clamp(-32768, 32767).short()
    return position, weight.clamp(max=6e4).half()  # half precision holds hardly more


def unpacked_positions(grid: SampleGrid, position: Int16[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Return packed positions in pixels; the image's centre where unmatched."""
    return position.float() * position_step(grid.camera) + grid.centre


def position_step(camera: Camera) -> float:
    """Return the step of packed positions in pixels."""
    return 2.0**-15 * camera.long_edge


def in_steps(camera: Camera, shift: Float[Tensor, "*b 2"]) -> Int16[Tensor, "*b 2"]:
    """Convert a shift in pixels to whole steps."""
    return (shift / position_step(camera)).round().short()
