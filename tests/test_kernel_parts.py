"""What compiled kernels compute depends on nothing that was compiled or called before them."""

import importlib
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import geogs
import geogs_synth
from geogs.depth.revision import photo_vote_kernels
from geogs.kernel_parts import inlined


def kernels() -> list[Dispatcher]:
    """All that is compiled for the CPU, parts of kernels too."""
    found = {}
    for package in (geogs, geogs_synth):
        folder = Path(package.__file__).parent
        for path in sorted(folder.glob("**/*.py")):
            if "njit" in path.read_text():
                parts = path.relative_to(folder).with_suffix("").parts
                module = importlib.import_module(".".join([package.__name__, *parts]))
                named = [v for v in vars(module).values() if isinstance(v, Dispatcher)]
                found |= {id(kernel): kernel for kernel in named}
    return list(found.values())


def called(kernel: Dispatcher) -> Iterator[Dispatcher]:
    """The functions of ours that it calls."""
    function = kernel.py_func
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            yield value


def is_fast(kernel: Dispatcher) -> bool:
    """Whether the compiler may round otherwise each time that it optimises the kernel."""
    return bool(kernel.targetoptions.get("fastmath")) or any(map(is_fast, called(kernel)))


def is_inlined(kernel: Dispatcher) -> bool:
    options = kernel.targetoptions
    return options.get("forceinline", False) or options.get("inline") == "always"


def test_what_may_be_rounded_otherwise_is_inlined_wherever_it_is_called():
    """A copy of another kernel could be called in its place, which is optimised otherwise."""
    pairs = [(kernel, part) for kernel in kernels() for part in called(kernel)]
    fast = [(kernel, part) for kernel, part in pairs if is_fast(part)]
    assert len(fast) > 60
    wrong = [(k.__name__, p.__name__) for k, p in fast if not is_inlined(p)]
    assert wrong == []


def test_what_a_fast_kernel_calls_says_itself_how_it_is_rounded():
    """Else numba takes it from the kernel for which it is compiled first."""
    calls = [(k, p) for k in kernels() if k.targetoptions.get("fastmath") for p in called(k)]
    assert len(calls) > 60
    assert [(k.__name__, p.__name__) for k, p in calls if "fastmath" not in p.targetoptions] == []


def test_no_part_is_kept_by_itself():
    """A kernel is compiled of the same parts, whatever was compiled before: none from the disk."""
    parts = [kernel for kernel in kernels() if kernel.targetoptions.get("forceinline")]
    assert len(parts) > 40
    assert [part.__name__ for part in parts if not isinstance(part._cache, NullCache)] == []


@pytest.mark.parametrize("forced", [True, False])
def test_a_compiled_kernel_contains_its_parts(forced):
    """``better_half`` is too large for LLVM to inline it unasked."""
    options = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
    half = photo_vote_kernels.better_half.py_func
    part = numba.njit(**inlined(options) if forced else options)(half)

    @numba.njit(**options)
    def kernel(costs, count):
        return part(costs, count) + part(costs, count - 1)

    kernel.compile((numba.float32[::1], numba.int64))
    (code,) = kernel.inspect_llvm().values()
    calls = [line for line in code.splitlines() if "call" in line and "better_half" in line]
    assert bool(calls) is not forced
