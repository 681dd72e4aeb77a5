"""Runs the project's CUDA sources on a CPU: compiled by g++ against ``emulator.h``.

The kernels take CPU tensors and check their types, so that the Python code around them is tested,
too. A few thousand times slower than a GPU.
"""

import ctypes
import functools
import hashlib
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
import torch

from geogs.gpu.kernel_source import kernel_signatures, read_source

HERE = Path(__file__).parent
_POINTERS = {
    "float*": torch.float32, "double*": torch.float64, "int*": torch.int32,
    "float4*": torch.float32, "float2*": torch.float32, "int2*": torch.int32,
    "long long*": torch.int64, "unsigned long long*": torch.int64, "unsigned char*": torch.uint8,
    "bool*": torch.bool, "unsigned*": torch.int32, "short*": torch.int16, "uint2*": torch.int32,
}  # fmt: skip
_NUMBERS = {"int": ctypes.c_int, "float": ctypes.c_float, "unsigned": ctypes.c_uint,
            "double": ctypes.c_double, "long long": ctypes.c_longlong}  # fmt: skip


class EmulatedKernel:
    """A kernel of an emulated library; called like the real one."""

    def __init__(self, function, name: str, parameters: tuple[str, ...]) -> None:
        self._function = function
        self._name = name
        self._parameters = parameters

    def __call__(self, grid, block, *arguments, shared: int = 0) -> None:
        assert len(arguments) == len(self._parameters), self._name
        values = [self._convert(*pair) for pair in zip(self._parameters, arguments, strict=True)]
        array = (ctypes.c_void_p * len(values))(*(ctypes.addressof(v) for v in values))
        sizes = [(ctypes.c_uint * 3)(*_three(s)) for s in (grid, block)]
        self._function(*sizes, ctypes.c_size_t(shared), array)

    def _convert(self, kind: str, value):
        if not kind.endswith("*"):
            assert not isinstance(value, torch.Tensor), (self._name, kind)
            return _NUMBERS[kind](value)
        if value is None:
            return ctypes.c_void_p(0)
        assert value.device.type == "cpu", self._name
        assert value.is_contiguous(), (self._name, kind, value.shape, value.stride())
        expected = _POINTERS[kind]
        allowed = {expected, torch.bool} if expected == torch.uint8 else {expected}
        assert value.dtype in allowed, (self._name, kind, value.dtype)
        return ctypes.c_void_p(value.data_ptr())


@functools.cache
def emulated_kernels(source: Path) -> dict[str, EmulatedKernel]:
    """The kernels of a ``.cu`` file; skips the test where there is no g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("emulating CUDA needs g++")
    text = read_source(source)
    signatures = kernel_signatures(text)
    program = '#include "emulator.h"\n' + text + '\nextern "C" {\n'
    program += "".join(_runner(*signature) for signature in signatures.items()) + "}\n"
    key = hashlib.sha256((program + (HERE / "emulator.h").read_text()).encode()).hexdigest()[:24]
    folder = Path(tempfile.gettempdir()) / "geogs-emulated"
    folder.mkdir(exist_ok=True)
    library = folder / f"{source.stem}-{key}.so"
    if not library.exists():
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            code, binary = Path(scratch) / "code.cpp", Path(scratch) / "code.so"
            code.write_text(program)
            # fibers jump to each other's stacks, which _FORTIFY_SOURCE takes for an error
            flags = ["-std=c++17", "-O1", "-shared", "-fPIC", "-w", "-U_FORTIFY_SOURCE"]
            command = [compiler, *flags, f"-I{HERE}"]
            subprocess.run([*command, "-o", str(binary), str(code)], check=True)
            binary.replace(library)
    loaded = ctypes.CDLL(str(library))
    return {n: EmulatedKernel(getattr(loaded, f"emu_{n}"), n, s) for n, s in signatures.items()}


def use_emulator(monkeypatch: pytest.MonkeyPatch, *modules) -> None:
    """Let modules that imported ``kernels_for`` run their kernels in the emulator."""
    for module in modules:
        monkeypatch.setattr(module, "kernels_for", lambda source, device: emulated_kernels(source))


def _runner(name: str, parameters: tuple[str, ...]) -> str:
    values = ", ".join(f"*({kind}*)a[{i}]" for i, kind in enumerate(parameters))
    return (
        f"void emu_{name}(const unsigned* g, const unsigned* b, size_t s, void** a) "
        f"{{ emu_run(g, b, s, [=] {{ {name}({values}); }}); }}\n"
    )


def _three(size) -> tuple[int, int, int]:
    return (size, 1, 1) if isinstance(size, int) else (*size, 1, 1)[:3]
