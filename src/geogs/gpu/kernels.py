"""Kernels of a source file for a device: shipped, from the cache, or compiled now."""

import contextlib
import functools
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from geogs.errors import DeviceError
from geogs.gpu.binaries import shipped_code
from geogs.gpu.cache import cache_key, read_cubin, write_cubin
from geogs.gpu.kernel_source import OPTIONS, kernel_signatures, kernel_sources, read_source

if TYPE_CHECKING:
    from geogs.gpu.nvrtc import Nvrtc

Kernel = Callable[..., None]
"""``kernel(grid, block, *arguments, shared=0)``; grid and block are ints or tuples of ints."""


def kernels_for(source: Path, device: torch.device) -> Mapping[str, Kernel]:
    """The kernels that a ``.cu`` file defines, by name, ready to be launched on a GPU.

    Raises DeviceError where there is no such GPU or its kernels cannot be compiled or loaded.
    """
    if device.type != "cuda":
        raise DeviceError(f"CUDA kernels do not run on {device}.")
    index = torch.cuda.current_device() if device.index is None else device.index
    return _device_kernels(source, index)


def prepare_kernels(folder: Path, device: torch.device) -> int:
    """Compile or load every source below ``folder`` now, many at once; return the kernel count.

    Otherwise each would be compiled when it is first used. Raises as :func:`kernels_for` does.
    """
    sources = kernel_sources(folder)
    torch.cuda.init()
    with ThreadPoolExecutor(min(16, os.cpu_count() or 1)) as pool:
        return sum(pool.map(lambda source: len(kernels_for(source, device)), sources))


@functools.cache
def _device_kernels(source: Path, index: int) -> Mapping[str, Kernel]:
    from geogs.gpu.cuda_driver import load_kernels

    text = read_source(source)
    signatures = list(kernel_signatures(text).values())
    major, minor = torch.cuda.get_device_capability(index)
    for code in shipped_code(text, (major, minor)):
        with contextlib.suppress(DeviceError):  # the driver is older than what compiled it
            return load_kernels(code, signatures, index)
    cubin, key = find_cubin(text, source.name, f"sm_{major}{minor}")
    try:
        return load_kernels(cubin, signatures, index)
    except DeviceError:
        if read_cubin(key) is None:
            raise
    # The cached file may be damaged.
    return load_kernels(compile_cubin(text, source.name, f"sm_{major}{minor}"), signatures, index)


def find_cubin(text: str, name: str, architecture: str) -> tuple[bytes, str]:
    """Machine code of a source for an architecture such as ``sm_90``, and its key in the cache."""
    key = cache_key(text, architecture, *OPTIONS, str(torch.version.cuda))
    cubin = read_cubin(key)
    if cubin is None:
        cubin = compile_cubin(text, name, architecture)
        write_cubin(key, cubin)
    return cubin, key


def compile_cubin(text: str, name: str, architecture: str) -> bytes:
    """Compile a source whatever the cache holds."""
    return compiler().compile(text, name, architecture, OPTIONS)


def compiler() -> "Nvrtc":
    """The run-time compiler that belongs to PyTorch; raises DeviceError where there is none."""
    from geogs.gpu.nvrtc import load_nvrtc

    version = torch.version.cuda
    if version is None:
        raise DeviceError("This PyTorch was built without CUDA; install a CUDA build of PyTorch.")
    return load_nvrtc(version.split(".")[0])
