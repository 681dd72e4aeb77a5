"""Kernels of a source file for a device: shipped, from the cache, or compiled now.

They are loaded and launched on PyTorch's context and stream by a few calls of the CUDA driver's C
interface, so that nothing needs to be installed or compiled.
"""

import contextlib
import ctypes
import functools
import os
import struct
import threading
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

Dimensions = int | tuple[int, ...]
Argument = torch.Tensor | int | float | None
Kernel = Callable[..., None]
"""``kernel(grid, block, *arguments, shared=0)``; grid and block are ints or tuples of ints."""

_FORMATS = {"int": "i4x", "unsigned": "I4x", "float": "f4x", "double": "d", "long long": "q"}
"""Formats by which ``struct`` packs a parameter into eight bytes."""


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
    text = read_source(source)
    signatures = kernel_signatures(text)
    major, minor = torch.cuda.get_device_capability(index)
    for code in shipped_code(text, (major, minor)):
        with contextlib.suppress(DeviceError):  # the driver is older than what compiled it
            return load_kernels(code, signatures, index)
    architecture = f"sm_{major}{minor}"
    try:
        return load_kernels(find_cubin(text, source.name, architecture), signatures, index)
    except DeviceError:
        # The cached code may be of another compiler than today's.
        return load_kernels(compile_cubin(text, source.name, architecture), signatures, index)


def find_cubin(text: str, name: str, architecture: str) -> bytes:
    """Machine code of a source for an architecture such as ``sm_90``, from the cache if there."""
    key = cache_key(text, architecture, *OPTIONS, str(torch.version.cuda))
    cubin = read_cubin(key)
    if cubin is None:
        cubin = compile_cubin(text, name, architecture)
        write_cubin(key, cubin)
    return cubin


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


@functools.cache
def _driver() -> tuple[ctypes.CDLL, ctypes.PyDLL]:
    """The driver for calls that may take long, and once more for launches.

    A PyDLL keeps the interpreter lock: releasing it takes longer than a launch.
    """
    try:
        return ctypes.CDLL("libcuda.so.1"), ctypes.PyDLL("libcuda.so.1")
    except OSError:
        raise DeviceError("The NVIDIA driver (libcuda.so.1) is missing on this machine.") from None


def driver_error(code: int) -> str:
    """The driver's name and text of an error."""
    cuda, _ = _driver()
    name = ctypes.c_char_p()
    text = ctypes.c_char_p()
    cuda.cuGetErrorName(code, ctypes.byref(name))
    cuda.cuGetErrorString(code, ctypes.byref(text))
    return f"{(name.value or b'?').decode()}: {(text.value or b'?').decode()}"


class DeviceKernel:
    """One kernel on one GPU; call it with the grid, the block and the arguments."""

    def __init__(
        self, function: ctypes.c_void_p, name: str, parameters: tuple[str, ...], index: int
    ) -> None:
        self.name = name
        self._function = function
        self._index = index
        # Every argument has eight bytes of a buffer, which the driver reads through pointers.
        formats = ("Q" if p.endswith("*") else _FORMATS[p] for p in parameters)
        self._packer = struct.Struct("<" + "".join(formats))
        self._buffer = ctypes.create_string_buffer(self._packer.size)
        start = ctypes.addressof(self._buffer)
        places = range(start, start + self._packer.size, 8)
        self._pointers = (ctypes.c_void_p * len(places))(*places)
        self._lock = threading.Lock()
        self._dynamic = 48 * 1024  # bytes of shared memory that every kernel may use
        launch = _driver()[1].cuLaunchKernel
        launch.argtypes = [ctypes.c_void_p, *[ctypes.c_uint] * 7, *[ctypes.c_void_p] * 3]
        self._launch = launch

    def __call__(
        self, grid: Dimensions, block: Dimensions, *arguments: Argument, shared: int = 0
    ) -> None:
        """Launch on PyTorch's current stream of the device; a grid without blocks does nothing.

        Tensors are passed as pointers and None as the null pointer; numbers are passed as the
        parameter's type. ``shared`` is the dynamic shared memory in bytes.
        """
        gx, gy, gz = _three(grid)
        if gx == 0 or gy == 0 or gz == 0:
            return
        if shared > self._dynamic:
            self._allow_shared(shared)
        values = [a.data_ptr() if isinstance(a, torch.Tensor) else a or 0 for a in arguments]
        sizes = (gx, gy, gz, *_three(block), shared)
        with self._lock:  # another thread may launch the same kernel
            self._packer.pack_into(self._buffer, 0, *values)
            code = self._start(sizes)
        if code:
            raise DeviceError(f"The kernel {self.name} could not start ({driver_error(code)}).")

    def _start(self, sizes: tuple[int, ...]) -> int:
        index = self._index
        stream = _current_stream(index)
        if torch.cuda.current_device() == index:
            code = self._launch(self._function, *sizes, stream, self._pointers, None)
        else:
            with torch.cuda.device(index):
                code = self._launch(self._function, *sizes, stream, self._pointers, None)
        if code == 201:  # CUDA_ERROR_INVALID_CONTEXT: the first use of the GPU by this thread
            with torch.cuda.device(index):
                _use_primary_context(index)
                code = self._launch(self._function, *sizes, stream, self._pointers, None)
        return code

    def _allow_shared(self, size: int) -> None:
        # 8 is CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES.
        code = _driver()[0].cuFuncSetAttribute(self._function, 8, size)
        if code:
            raise DeviceError(
                f"The kernel {self.name} needs {size} bytes of shared memory, more than this GPU "
                f"has ({driver_error(code)})."
            )
        self._dynamic = size


def _current_stream(index: int) -> int:
    """Handle of PyTorch's current stream; a tenth of the time of making a Stream object."""
    raw = getattr(torch._C, "_cuda_getCurrentRawStream", None)
    return torch.cuda.current_stream(index).cuda_stream if raw is None else raw(index)


@functools.cache
def _primary_context(index: int) -> ctypes.c_void_p:
    """The context that PyTorch uses on a GPU."""
    cuda, _ = _driver()
    device = ctypes.c_int()
    context = ctypes.c_void_p()
    code = cuda.cuDeviceGet(ctypes.byref(device), index)
    code = code or cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
    if code:
        raise DeviceError(f"GPU {index} cannot be used ({driver_error(code)}).")
    return context


def _use_primary_context(index: int) -> None:
    """Make PyTorch's context the calling thread's."""
    code = _driver()[0].cuCtxSetCurrent(_primary_context(index))
    if code:
        raise DeviceError(f"GPU {index} cannot be used ({driver_error(code)}).")


def load_kernels(
    cubin: bytes, signatures: Mapping[str, tuple[str, ...]], index: int
) -> dict[str, DeviceKernel]:
    """The kernels of a cubin on the GPU ``index``; raises DeviceError if the driver refuses it."""
    cuda, _ = _driver()
    with torch.cuda.device(index):
        _use_primary_context(index)
        module = ctypes.c_void_p()
        code = cuda.cuModuleLoadData(ctypes.byref(module), cubin)
        if code:
            raise DeviceError(
                f"The driver cannot load the compiled kernels ({driver_error(code)}); it may be "
                "older than the CUDA version of PyTorch."
            )
        kernels = {}
        for name, parameters in signatures.items():
            function = ctypes.c_void_p()
            code = cuda.cuModuleGetFunction(ctypes.byref(function), module, name.encode())
            if code:
                raise DeviceError(f"No kernel {name} ({driver_error(code)}).")
            kernels[name] = DeviceKernel(function, name, parameters, index)
    return kernels


def _three(size: Dimensions) -> tuple[int, int, int]:
    if isinstance(size, int):
        return size, 1, 1
    x, y, z = (*size, 1, 1)[:3]
    return x, y, z
