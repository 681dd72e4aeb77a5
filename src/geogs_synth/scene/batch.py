"""Dataclasses of tensors, or of such dataclasses, whose first axis counts the scenes of a batch."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from geogs.gpu.transfer import to_device

Part = TypeVar("Part")


def map_tensors(change: Callable[..., Tensor], first: Part, *others: Part) -> Part:
    """Apply ``change`` to the tensors of one part, or to corresponding tensors of several."""
    values: list[Any] = []
    for field in fields(first):  # type: ignore[arg-type]
        own = [getattr(part, field.name) for part in (first, *others)]
        if isinstance(own[0], Tensor):
            values.append(change(*own))
        else:
            values.append(map_tensors(change, *own) if is_dataclass(own[0]) else own[0])
    return type(first)(*values)


def on_device(part: Part, device: torch.device) -> Part:
    """Copy to a device, without waiting for it."""
    return map_tensors(lambda t: to_device(t.contiguous(), device), part)


def one_scene(part: Part, scene: int) -> Part:
    """One scene as a batch of its own."""
    return map_tensors(lambda t: t[scene : scene + 1], part)


def where(which: Bool[Tensor, "*b"], first: Part, second: Part) -> Part:
    """Return the first where ``which``, else the second."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(which.reshape(*which.shape, *[1] * (a.ndim - which.ndim)), a, b)

    return map_tensors(pick, first, second)


def gather(part: Part, index: Int[Tensor, "b m"]) -> Part:
    """Take some entries of each scene along the second axis."""
    rows = torch.arange(len(index), device=index.device)[:, None]
    return map_tensors(lambda t: t[rows, index], part)


def concatenate(first: Part, *others: Part) -> Part:
    """Concatenate the entries of each scene along the second axis."""
    return map_tensors(lambda *tensors: torch.cat(tensors, 1), first, *others)
