"""Rows of rolling-shutter images: offsets and times at pixels, and those of straightened images."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.camera.shutter.rows import CELL
from geogs.camera.straight_view import StraightView
from geogs.types import SeenRows


def rows_at(
    rows: Sequence[SeenRows], which: Int[Tensor, "e"], pixels: Float[Tensor, "e p 2"]
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p"]]:
    """Return offsets and seconds at pixels, each in ``which`` of the rows, bilinear between the
    nodes as in the rectification."""
    field = torch.stack([node_values(r) for r in rows]).to(pixels).permute(0, 3, 1, 2)[which]
    size = pixels.new_tensor([field.shape[3] * CELL, field.shape[2] * CELL])
    position = 2 * (pixels + CELL + 0.5) / size - 1
    values = torch.nn.functional.grid_sample(
        field, position[:, :, None], padding_mode="border", align_corners=False
    )[..., 0]
    return values[:, :2].mT, values[:, 2]


def node_values(rows: SeenRows) -> Float[Tensor, "r c 3"]:
    """Return offsets and seconds of the nodes in one tensor."""
    return torch.cat([rows.offset, rows.seconds[..., None]], -1)


def straight_rows(rows: SeenRows, view: StraightView) -> SeenRows:
    """Convert the rows of a distorted image to those of the straightened one."""
    # The middle of each eight pixels, and a step beyond the border
    sides = [(torch.arange(count) - 1) * CELL + (CELL - 1) / 2 for count in rows.seconds.shape]
    v, u = torch.meshgrid(*sides, indexing="ij")
    nodes = torch.stack([u, v], -1).reshape(-1, 2)
    bent = view.bent(nodes)
    (offset,), (seconds,) = rows_at([rows], torch.zeros(1, dtype=torch.long), bent[None])
    straight = view.straight(bent + offset) - nodes
    offset = torch.where(straight.isfinite(), straight, offset)
    return replace(
        rows,
        offset=offset.reshape(rows.offset.shape).to(rows.offset),
        seconds=seconds.reshape(rows.seconds.shape).to(rows.seconds),
    )
