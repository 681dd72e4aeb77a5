"""From the host's memory to a GPU without waiting."""

import torch
from jaxtyping import Shaped
from torch import Tensor


def to_device(
    tensor: Shaped[Tensor, "*n"], device: torch.device, dtype: torch.dtype | None = None
) -> Shaped[Tensor, "*n"]:
    """The tensor on the device; a copy from the host to a GPU is only enqueued.

    It goes through pinned memory, which PyTorch keeps until the copy is done. From ordinary memory
    a driver may read later than it says, when a temporary source has been overwritten.
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor if dtype is None else tensor.to(dtype)
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device, dtype or tensor.dtype)
