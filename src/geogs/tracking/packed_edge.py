"""Edges of the frame graph in a third of the memory, for graphs over thousands of keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Float16, Int16
from torch import Tensor

from geogs.bundle.projection import project
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe

MAX_WEIGHT = 6e4
"""Largest weight that half precision holds, 1 / pixel^2."""


@dataclass(frozen=True, eq=False)
class PackedFlow:
    """What is kept of an edge.

    Positions are kept in steps of 2^-15 of the long edge (1/64 pixel at 512; matches half an image
    outside are held at its border) and weights in half precision. Where the cells fell when the
    flow was measured is computed again from the poses and depths of that time, which many edges
    share.
    """

    position: Int16[Tensor, "p 2"]
    half_weight: Float16[Tensor, "p 2"]
    T_source: Float[Tensor, "4 4"]
    """World to camera of the source when the flow was measured."""
    T_target: Float[Tensor, "4 4"]
    inverse_depth: Float[Tensor, "p"]
    """Of the source when the flow was measured."""
    damping: Float[Tensor, "p"] | None


@dataclass
class PackedEdge:
    """One direction of a measured pair; reads like a ``MeasuredEdge``."""

    grid: SampleGrid
    flow: PackedFlow
    memory: Any = None

    @staticmethod
    def all_of(
        match: FlowMatch,
        grid: SampleGrid,
        source: Sequence[Keyframe],
        target: Sequence[Keyframe],
    ) -> list["PackedEdge"]:
        """The edges of a measurement that started from the present state."""
        position, half_weight = pack_matches(grid, match.pixels, match.weight)
        return [
            PackedEdge(
                grid,
                PackedFlow(
                    position[n],
                    half_weight[n],
                    i.T_cw,
                    j.T_cw,
                    i.inverse_depth,
                    None if match.damping is None else match.damping[n],
                ),
                None if match.memory is None else match.memory[n],
            )
            for n, (i, j) in enumerate(zip(source, target, strict=True))
        ]

    @property
    def pixels(self) -> Float[Tensor, "p 2"]:
        """Position in the target of each cell of the source; the image's centre where unmatched."""
        return unpacked_positions(self.grid, self.flow.position)

    @property
    def weight(self) -> Float[Tensor, "p 2"]:
        """Inverse variance of x and y in 1 / pixel^2."""
        return self.flow.half_weight.float()

    @property
    def damping(self) -> Float[Tensor, "p"] | None:
        """Of the source's inverse depth, if the operator gives one."""
        return self.flow.damping

    @property
    def reprojection(self) -> Float[Tensor, "p 2"]:
        """Where the cells fell when the flow was measured."""
        return packed_reprojections([self])[0]


def position_step(camera: Camera) -> float:
    """Pixels between two positions that can be told apart."""
    return 2.0**-15 * max(camera.width, camera.height)


def in_steps(camera: Camera, shift: Float[Tensor, "*b 2"]) -> Int16[Tensor, "*b 2"]:
    """Pixels by which positions are moved, in whole steps."""
    return (shift / position_step(camera)).round().short()


def pack_matches(
    grid: SampleGrid, pixels: Float[Tensor, "*b 2"], weight: Float[Tensor, "*b 2"]
) -> tuple[Int16[Tensor, "*b 2"], Float16[Tensor, "*b 2"]]:
    """Positions in whole steps from the image's centre, zero where unmatched; half weights."""
    steps = (pixels - grid.centre) / position_step(grid.camera)
    position = torch.where(weight > 0, steps.round(), 0.0).clamp(-32768, 32767).short()
    return position, weight.clamp(max=MAX_WEIGHT).half()


def unpacked_positions(grid: SampleGrid, position: Int16[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Pixels of packed positions."""
    return position.float() * position_step(grid.camera) + grid.centre


def packed_matches(
    edges: Sequence[PackedEdge],
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
    """Positions and weights of edges, all unpacked at once."""
    position = torch.stack([e.flow.position for e in edges])
    weight = torch.stack([e.flow.half_weight for e in edges]).float()
    return unpacked_positions(edges[0].grid, position), weight


def packed_reprojections(edges: Sequence[PackedEdge]) -> Float[Tensor, "e p 2"]:
    """Where the cells fell when the flow of each edge was measured."""
    grid, flows = edges[0].grid, [e.flow for e in edges]
    source, target = (torch.stack([getattr(f, k) for f in flows]) for k in ("T_source", "T_target"))
    depth = torch.stack([f.inverse_depth for f in flows])
    return project(grid.camera, grid.rays, target @ se3_inverse(source), depth).pixels
