"""A full GPU memory as a sentence."""

from collections.abc import Iterator
from contextlib import contextmanager

from geogs.errors import DeviceError

REMEDY = (
    "use fewer images (--stride), a smaller --long-edge, a GPU with more memory, or --device cpu"
)
"""What helps."""


@contextmanager
def full_memory_in_a_sentence() -> Iterator[None]:
    """Inside, PyTorch's error about a GPU without memory becomes a DeviceError with the remedy."""
    import torch

    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceError(f"The memory of the GPU is full; {REMEDY}.") from error
