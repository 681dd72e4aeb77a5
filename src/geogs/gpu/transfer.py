"""Copies from the host's memory to a GPU without waiting."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor


def to_device(
    tensor: Shaped[Tensor, "*n"], device: torch.device, dtype: torch.dtype | None = None
) -> Shaped[Tensor, "*n"]:
    """The tensor on the device; a copy from the host to a GPU is only enqueued.

    It goes through pinned memory, which PyTorch keeps until the copy is done. From ordinary memory
    a driver may read after the call has returned, when a temporary source is already overwritten.
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor if dtype is None else tensor.to(dtype)
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device, dtype or tensor.dtype)


def upload(array: Shaped[np.ndarray, "*n"], device: torch.device) -> Shaped[Tensor, "*n"]:
    """The array on the device, without waiting for what runs there; on a CPU the same memory."""
    return to_device(torch.from_numpy(np.ascontiguousarray(array)), device)


def upload_indices(parts: Sequence[np.ndarray], device: torch.device) -> tuple[Tensor, ...]:
    """Index arrays of any length as int32 on the device, sent there in one piece."""
    return upload(np.concatenate(parts).astype(np.int32), device).split([len(p) for p in parts])
