"""The run-time compiler that comes inside PyTorch's CUDA wheels."""

import contextlib
import ctypes
import functools
import glob
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from geogs.errors import DeviceError


class Nvrtc:
    """Compiler from CUDA C++ to machine code (cubin) or PTX."""

    def __init__(self, path: str) -> None:
        library = ctypes.CDLL(path)
        self.path = path
        """Path as opened; a bare name was found by the system's loader."""
        self._library = library
        major = ctypes.c_int()
        minor = ctypes.c_int()
        self._check(library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
        self.version = f"{major.value}.{minor.value}"

    def compile(self, source: str, name: str, architecture: str, options: Sequence[str]) -> bytes:
        """The cubin of a source for ``sm_90``, its PTX for ``compute_90``.

        Raises DeviceError with the compiler's message if it has errors.
        """
        rtc = self._library
        program = ctypes.c_void_p()
        self._check(
            rtc.nvrtcCreateProgram(
                ctypes.byref(program), source.encode(), name.encode(), 0, None, None
            )
        )
        try:
            words = [f"--gpu-architecture={architecture}".encode(), *(o.encode() for o in options)]
            flags = (ctypes.c_char_p * len(words))(*words)
            if rtc.nvrtcCompileProgram(program, len(words), flags):
                log = self._text(program, rtc.nvrtcGetProgramLogSize, rtc.nvrtcGetProgramLog)
                raise DeviceError(f"The CUDA kernels in {name} do not compile: {log.decode()}")
            if architecture.startswith("compute"):
                return self._text(program, rtc.nvrtcGetPTXSize, rtc.nvrtcGetPTX)
            return self._text(program, rtc.nvrtcGetCUBINSize, rtc.nvrtcGetCUBIN)
        finally:
            rtc.nvrtcDestroyProgram(ctypes.byref(program))

    def _text(self, program: ctypes.c_void_p, size_of, copy) -> bytes:  # type: ignore[no-untyped-def]
        size = ctypes.c_size_t()
        self._check(size_of(program, ctypes.byref(size)))
        buffer = ctypes.create_string_buffer(size.value)
        self._check(copy(program, buffer))
        return buffer.raw

    def _check(self, code: int) -> None:
        if code:
            self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
            message = self._library.nvrtcGetErrorString(code).decode()
            raise DeviceError(f"The CUDA run-time compiler failed: {message}.")


@functools.cache
def load_nvrtc(cuda_major: str) -> Nvrtc:
    """The compiler of PyTorch's CUDA version; raises DeviceError where there is none."""
    for path in [*_candidates(cuda_major), f"libnvrtc.so.{cuda_major}", "libnvrtc.so"]:
        try:
            _preload_builtins(path)
            return Nvrtc(path)
        except OSError:
            continue
    raise DeviceError(
        f"The CUDA {cuda_major} run-time compiler (libnvrtc) is missing; install "
        f"nvidia-cuda-nvrtc or a CUDA build of PyTorch."
    )


def _candidates(cuda_major: str) -> list[str]:
    """Copies in Python packages first, then those of an installed toolkit."""
    name = f"libnvrtc.so.{cuda_major}"
    folders = [Path(p) / "nvidia" for p in sys.path if p]
    spec = importlib.util.find_spec("torch")
    if spec is not None and spec.origin is not None:
        folders += [Path(spec.origin).parents[1] / "nvidia", Path(spec.origin).parent / "lib"]
    # Only the folders that packages use: a walk through all of NVIDIA's takes seconds.
    places = [name, f"*/lib/{name}"]
    found = [str(p) for f in folders for place in places for p in sorted(f.glob(place))]
    return list(dict.fromkeys(found + sorted(glob.glob(f"/usr/local/cuda*/lib64/{name}"))))


def _preload_builtins(path: str) -> None:
    """NVRTC opens its builtins by bare name, which fails outside the loader's path."""
    for builtins in sorted(Path(path).parent.glob("libnvrtc-builtins.so*")):
        with contextlib.suppress(OSError):
            ctypes.CDLL(str(builtins), mode=ctypes.RTLD_GLOBAL)
