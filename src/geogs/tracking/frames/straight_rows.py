"""Rolling-shutter rows of straightened images."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.camera.shutter.rows import CELL
from geogs.camera.straight_view import StraightView
from geogs.tracking.frames.row_errors import seen_rows
from geogs.types import SeenRows


def straight_rows(rows: SeenRows, view: StraightView) -> SeenRows:
    """Convert the rows of a distorted image to those of the straightened one."""
    v, u = torch.meshgrid(*(_nodes(count) for count in rows.seconds.shape), indexing="ij")
    nodes = torch.stack([u, v], -1).reshape(-1, 2)
    bent = view.bent(nodes)
    (offset,), (seconds,) = seen_rows([rows], torch.zeros(1, dtype=torch.long), bent[None])
    straight = view.straight(bent + offset) - nodes
    offset = torch.where(straight.isfinite(), straight, offset)
    return replace(
        rows,
        offset=offset.reshape(rows.offset.shape).to(rows.offset),
        seconds=seconds.reshape(rows.seconds.shape).to(rows.seconds),
    )


def _nodes(count: int) -> Float[Tensor, "n"]:
    """Return the pixel positions of the nodes along one side."""
    return (torch.arange(count) - 1) * CELL + (CELL - 1) / 2
