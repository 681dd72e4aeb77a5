"""Filling in of flow at unmatched cells from the matches around."""

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid


def filled_positions(grid: SampleGrid, match: FlowMatch) -> Float[Tensor, "p 2"]:
    """Return positions of a single edge, unmatched cells filled in from the flow around them."""
    return grid.pixels + filled_flow(grid, match)


def filled_flow(grid: SampleGrid, match: FlowMatch) -> Float[Tensor, "p 2"]:
    """Return flow of a single edge, unmatched cells filled in from around them."""
    flow = match.pixels[0] - grid.pixels
    weight = match.weight[0, :, 0]
    return grid_fields(grid).fill(flow.mT, weight.expand(2, -1)).mT.contiguous()
