"""Loading and launching compiled kernels through the CUDA driver, on PyTorch's context and stream.

A few calls of the driver's C interface, so that nothing needs to be installed or compiled.
"""

import ctypes
import functools
import struct
import threading
from collections.abc import Sequence

import torch

from geogs.errors import DeviceError
from geogs.gpu.kernel_source import KernelSignature

Dimensions = int | tuple[int, ...]
Argument = torch.Tensor | int | float | None

_MAX_STATIC_SHARED = 48 * 1024
_MAX_DYNAMIC_SHARED = 8  # CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
_INVALID_CONTEXT = 201
_FORMATS = {"int": "i4x", "unsigned": "I4x", "float": "f4x", "double": "d", "long long": "q"}
"""Formats by which ``struct`` packs a parameter into eight bytes."""


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
    name, text = ctypes.c_char_p(), ctypes.c_char_p()
    cuda.cuGetErrorName(code, ctypes.byref(name))
    cuda.cuGetErrorString(code, ctypes.byref(text))
    return f"{(name.value or b'?').decode()}: {(text.value or b'?').decode()}"


class DeviceKernel:
    """One kernel on one GPU; call it with the grid, the block and the arguments."""

    def __init__(self, function: ctypes.c_void_p, signature: KernelSignature, index: int) -> None:
        self.name = signature.name
        self._function = function
        self._index = index
        # Every argument has eight bytes of a buffer, which the driver reads through pointers.
        formats = ("Q" if p.endswith("*") else _FORMATS[p] for p in signature.parameters)
        self._packer = struct.Struct("<" + "".join(formats))
        self._buffer = ctypes.create_string_buffer(self._packer.size)
        start = ctypes.addressof(self._buffer)
        places = range(start, start + self._packer.size, 8)
        self._pointers = (ctypes.c_void_p * len(places))(*places)
        self._lock = threading.Lock()
        self._dynamic = _MAX_STATIC_SHARED
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
        if code == _INVALID_CONTEXT:  # the first use of the GPU by this thread
            with torch.cuda.device(index):
                _use_primary_context(index)
                code = self._launch(self._function, *sizes, stream, self._pointers, None)
        return code

    def _allow_shared(self, size: int) -> None:
        code = _driver()[0].cuFuncSetAttribute(self._function, _MAX_DYNAMIC_SHARED, size)
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
    device, context = ctypes.c_int(), ctypes.c_void_p()
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
    cubin: bytes, signatures: Sequence[KernelSignature], index: int
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
        for signature in signatures:
            function = ctypes.c_void_p()
            code = cuda.cuModuleGetFunction(ctypes.byref(function), module, signature.name.encode())
            if code:
                raise DeviceError(f"No kernel {signature.name} ({driver_error(code)}).")
            kernels[signature.name] = DeviceKernel(function, signature, index)
    return kernels


def _three(size: Dimensions) -> tuple[int, int, int]:
    if isinstance(size, int):
        return size, 1, 1
    x, y, z = (*size, 1, 1)[:3]
    return x, y, z
