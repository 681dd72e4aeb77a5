"""The compute device: kernels, errors and memory use."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from geogs.errors import DeviceError
from geogs.gpu.kernel_source import PACKAGE
from geogs.gpu.kernels import prepare_kernels
from geogs.guard.documents import in_short

REMEDY = (
    "use fewer images (--stride), a smaller --long-edge, a GPU with more memory, or --device cpu"
)
"""Remedy for a full GPU memory."""

_GPU_FAILS = ("CUDA error", "CUDA driver error", "cuDNN error", "cuBLAS", "CUBLAS", "NVRTC")


def compile_gpu_kernels(device: torch.device) -> float:
    """Compile all kernels of a GPU, once per machine. Returns the seconds it took."""
    start = time.perf_counter()
    if device.type == "cuda":
        prepare_kernels(PACKAGE, device)
    return time.perf_counter() - start


@contextmanager
def gpu_errors_in_a_sentence(way_on: Callable[[], str] = str) -> Iterator[None]:
    """Turn errors of a GPU that fails or is full into a DeviceError with the remedy.

    ``way_on`` gives a sentence on how to resume, after a space, or nothing; a second Ctrl-C reports
    it, too. Of nested blocks, the inner one gives the sentence.
    """
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceError(f"The memory of the GPU is full; {REMEDY}.{way_on()}") from error
    except KeyboardInterrupt as interrupt:
        if way := way_on().strip():
            interrupt.args = (way,)
        raise
    except RuntimeError as error:
        if not is_gpu_failure(error):
            raise
        raise DeviceError(f"The GPU failed ({in_short(error).rstrip('.')}).{way_on()}") from error


def is_gpu_failure(error: Exception) -> bool:
    """Whether an error came from a GPU that fails or is full, not from the computation."""
    if isinstance(error, torch.cuda.OutOfMemoryError):
        return True
    # Only some versions of PyTorch have a class for it.
    return isinstance(error, RuntimeError) and any(w in in_short(error) for w in _GPU_FAILS)


def device_summary(device: torch.device) -> dict[str, object]:
    """Name of the device, and peak GPU memory (PyTorch's tensors)."""
    if device.type != "cuda":
        return {"device": "cpu"}
    name = torch.cuda.get_device_name(device)
    return {"device": name, "peak_gpu_memory_bytes": torch.cuda.max_memory_allocated(device)}


def peak_memory() -> int:
    """Largest resident size of this process so far, bytes."""
    import resource

    try:  # of this program alone: getrusage includes the size of the parent process
        status = Path("/proc/self/status").read_text()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024
