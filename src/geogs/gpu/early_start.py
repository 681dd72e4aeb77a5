"""Initialise a GPU while Python still imports PyTorch."""

import contextlib
import ctypes
import importlib.util
import threading
from pathlib import Path


def start_gpu(name: str) -> None:
    """Initialise the GPU of a device's name in a thread; ``auto`` is the first.

    PyTorch then finds it initialised, or initialises it itself. Nothing is done if PyTorch has no
    CUDA. A failure is not reported here, but at the first use of the GPU.
    """
    device, _, index = name.partition(":")
    if device in ("auto", "cuda") and (index or "0").isdecimal() and _has_cuda():
        number = int(index or 0)
        threading.Thread(target=_make_ready, args=(number,), name="gpu", daemon=True).start()


def is_gpu(name: str) -> bool:
    """Whether the device of that name is a GPU; for ``auto``, whether one can be used, which is
    initialised meanwhile."""
    if name != "auto":
        return name.startswith("cuda")
    start_gpu(name)
    from geogs.gpu.installation import gpu_problem

    return gpu_problem() is None


def _has_cuda() -> bool:
    """Whether PyTorch was built with CUDA, without importing it."""
    spec = importlib.util.find_spec("torch")
    return spec is not None and any(
        Path(folder, "lib", "libtorch_cuda.so").exists()
        for folder in spec.submodule_search_locations or ()
    )


def _make_ready(index: int) -> None:
    """Make the context that PyTorch is going to use, without holding the interpreter lock."""
    with contextlib.suppress(OSError, AttributeError):
        cuda = ctypes.CDLL("libcuda.so.1")
        device = ctypes.c_int()
        context = ctypes.c_void_p()
        if not (cuda.cuInit(0) or cuda.cuDeviceGet(ctypes.byref(device), index)):
            cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
