"""Loading and launching compiled kernels through the CUDA driver, on PyTorch's context and stream.

A few calls of the driver's C interface, so that nothing needs to be installed or compiled.
"""

import ctypes
import functools
import struct
from collections.abc import Sequence

import torch

from geogs.errors import DeviceError
from geogs.gpu.source import KernelSignature

Dimensions = int | tuple[int, ...]
Argument = torch.Tensor | int | float | None

_MAX_STATIC_SHARED = 48 * 1024
_MAX_DYNAMIC_SHARED = 8  # CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES


@functools.cache
def _driver() -> tuple[ctypes.CDLL, ctypes.PyDLL]:
    """The driver for calls that may take long, and once more for those that must not be torn.

    A PyDLL keeps the interpreter lock, so that a kernel's argument buffer is not refilled by
    another thread while it is read.
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
        self._types = signature.parameters
        count = len(self._types)
        self._slots = (ctypes.c_uint64 * count)()
        start = ctypes.addressof(self._slots)
        self._pointers = (ctypes.c_void_p * count)(*(start + 8 * i for i in range(count)))
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
        if len(arguments) != len(self._types):
            raise TypeError(f"{self.name} takes {len(self._types)} arguments, not {len(arguments)}")
        slots = self._slots
        for i, value in enumerate(arguments):
            if isinstance(value, torch.Tensor):
                slots[i] = value.data_ptr()
            elif value is None:
                slots[i] = 0
            elif self._types[i] == "float":
                slots[i] = struct.unpack("I", struct.pack("f", value))[0]
            elif self._types[i] == "double":
                slots[i] = struct.unpack("Q", struct.pack("d", value))[0]
            else:
                slots[i] = int(value) & 0xFFFFFFFFFFFFFFFF
        if shared > self._dynamic:
            self._allow_shared(shared)
        if torch.cuda.current_device() != self._index:
            with torch.cuda.device(self._index):
                code = self._start(gx, gy, gz, block, shared)
        else:
            code = self._start(gx, gy, gz, block, shared)
        if code:
            raise DeviceError(f"The kernel {self.name} could not start ({driver_error(code)}).")

    def _start(self, gx: int, gy: int, gz: int, block: Dimensions, shared: int) -> int:
        stream = torch.cuda.current_stream(self._index).cuda_stream
        return self._launch(
            self._function, gx, gy, gz, *_three(block), shared, stream, self._pointers, None
        )

    def _allow_shared(self, size: int) -> None:
        code = _driver()[0].cuFuncSetAttribute(self._function, _MAX_DYNAMIC_SHARED, size)
        if code:
            raise DeviceError(
                f"The kernel {self.name} needs {size} bytes of shared memory, more than this GPU "
                f"has ({driver_error(code)})."
            )
        self._dynamic = size


def load_kernels(
    cubin: bytes, signatures: Sequence[KernelSignature], index: int
) -> dict[str, DeviceKernel]:
    """The kernels of a cubin on the GPU ``index``; raises DeviceError if the driver refuses it."""
    cuda, _ = _driver()
    with torch.cuda.device(index):
        torch.cuda.current_stream(index).synchronize()  # makes PyTorch's context current
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
