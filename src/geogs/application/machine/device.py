"""What a run computes on: the device made ready, and the memory that is used."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from geogs.documents import in_short
from geogs.errors import DeviceError
from geogs.gpu.kernel_source import PACKAGE
from geogs.gpu.kernels import prepare_kernels

REMEDY = (
    "use fewer images (--stride), a smaller --long-edge, a GPU with more memory, or --device cpu"
)
"""What helps where the memory of a GPU is full."""

_GPU_FAILS = ("CUDA error", "CUDA driver error", "cuDNN error", "cuBLAS", "CUBLAS", "NVRTC")


def compile_gpu_kernels(device: torch.device) -> float:
    """Have all kernels of a GPU compiled, once per machine; the seconds that took."""
    start = time.perf_counter()
    if device.type == "cuda":
        prepare_kernels(PACKAGE, device)
    return time.perf_counter() - start


@contextmanager
def gpu_errors_in_a_sentence(way_on: Callable[[], str] = str) -> Iterator[None]:
    """Inside, errors of a GPU that fails or is full become a DeviceError with the remedy.

    ``way_on`` gives a sentence on how to go on with the work, behind a space, or nothing; a second
    Ctrl-C says it, too. Where one such block is in another, the inner one says the way.
    """
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceError(f"The memory of the GPU is full; {REMEDY}.{way_on()}") from error
    except KeyboardInterrupt as interrupt:
        way = way_on().strip()
        raise KeyboardInterrupt(*((way,) if way else interrupt.args)) from None
    except RuntimeError as error:
        if not is_gpu_failure(error):
            raise
        raise DeviceError(f"The GPU failed ({in_short(error).rstrip('.')}).{way_on()}") from error


def is_gpu_failure(error: Exception) -> bool:
    """Whether an error came from a GPU that fails or is full, not from what was computed on it."""
    if isinstance(error, torch.cuda.OutOfMemoryError):
        return True
    # Of a class of its own in some versions of PyTorch only.
    return isinstance(error, RuntimeError) and any(w in in_short(error) for w in _GPU_FAILS)


def device_summary(device: torch.device) -> dict[str, object]:
    """What the map was trained on, and a GPU's memory at its fullest (PyTorch's tensors)."""
    if device.type != "cuda":
        return {"device": "cpu"}
    name = torch.cuda.get_device_name(device)
    return {"device": name, "peak_gpu_memory_bytes": torch.cuda.max_memory_allocated(device)}


def peak_memory() -> int:
    """Largest resident size of this process so far, bytes."""
    import resource

    try:  # of this program alone: what the system counts begins with the size of who started it
        status = Path("/proc/self/status").read_text()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024
