"""Edges between keyframes: the flow measured from one to another, in full or packed.

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

MAX_WEIGHT = 6e4
"""Largest weight that half precision holds, 1 / pixel^2."""

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
    """Where the cells fell when the flow was measured."""
    damping: Annotated[Float32[Tensor, "p"], Range(0)] | None = None
    """Damping of the source's inverse depth, if the operator gives one."""
    memory: Any = field(default=None, metadata=NOT_STORED)
    """What the operator keeps of this edge, and can do without."""


@dataclass(eq=False)
class PackedEdge:
    """One direction of a measured pair, packed.

    Positions are kept in steps of 2^-15 of the long edge (1/64 pixel at 512; matches half an image
    outside are clamped to its border) and weights in half precision. Where the cells fell when the
    flow was measured is computed again from the poses and depths of that time, which many edges
    share.
    """

    position: Int16[Tensor, "p 2"]
    half_weight: Annotated[Float16[Tensor, "p 2"], Range(0)]
    T_source: Pose
    """World to camera of the source when the flow was measured."""
    T_target: Pose
    inverse_depth: Annotated[Float32[Tensor, "p"], POSITIVE]
    """The source's when the flow was measured."""
    damping: Annotated[Float32[Tensor, "p"], Range(0)] | None = None
    """Damping of the source's inverse depth, if the operator gives one."""
    memory: Any = field(default=None, metadata=NOT_STORED)
    """What the operator keeps of this edge, and can do without."""

    def moved(self, camera: Camera, shift: Float[Tensor, "p 2"]) -> "PackedEdge":
        """With its matches so many pixels elsewhere."""
        return replace(self, position=self.position + in_steps(camera, shift))


Edge = MeasuredEdge | PackedEdge


def edge_matches(
    grid: SampleGrid, edges: Sequence[Edge]
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
    """Measured positions and weights of some edges."""
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
    """Positions in whole steps from the image's centre, zero where unmatched; half weights."""
    steps = (pixels - grid.centre) / position_step(grid.camera)
    position = torch.where(weight > 0, steps.round(), 0.0).clamp(-32768, 32767).short()
    return position, weight.clamp(max=MAX_WEIGHT).half()


def unpacked_positions(grid: SampleGrid, position: Int16[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Pixels of packed positions; the image's centre where unmatched."""
    return position.float() * position_step(grid.camera) + grid.centre


def position_step(camera: Camera) -> float:
    """Pixels between two packed positions that differ by one."""
    return 2.0**-15 * camera.long_edge


def in_steps(camera: Camera, shift: Float[Tensor, "*b 2"]) -> Int16[Tensor, "*b 2"]:
    """Pixels by which positions are moved, in whole steps."""
    return (shift / position_step(camera)).round().short()
