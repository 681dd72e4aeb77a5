"""What compiled kernels compute depends on nothing that was compiled or called before them."""

import importlib
import os
import subprocess
import sys
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


TWICE = """
import hashlib, os, sys
import numpy as np
from geogs.depth.edge_kernels import resolve_edges

def resolved():
    random, f = np.random.default_rng(0), np.float32
    rho = np.where(random.random((24, 40)) < 0.5, 1, 0.7) * random.uniform(0.98, 1, (24, 40))
    slopes = random.normal(0, 1e-3, (2, 24, 40))
    maps = [m.astype(f) for m in (rho, *slopes, random.random((24, 40)))]
    guide, costs = (random.random(s).astype(f) for s in ((3, 24, 40), (24, 40, 16)))
    settings = [f(x) for x in (50, 0.015, 0.02, 2)]
    new = [np.empty_like(m) for m in maps]
    resolve_edges(0, 24, *maps, guide, costs, f(0.5), f(0.04), 4, *settings, 3, f(0.9), *new)
    assert (new[0] != maps[0]).sum() > 50
    return hashlib.sha256(b"".join(m.tobytes() for m in new)).hexdigest()

for _ in range(2):
    child = os.fork()
    if not child:
        print(resolved(), sum(resolve_edges.stats.cache_hits.values()), flush=True)
        os._exit(0)
    os.waitpid(child, 0)
"""


@pytest.mark.system
def test_a_kernel_rounds_alike_just_compiled_and_from_the_disk(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", TWICE]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    compiled, from_disk = map(str.split, done.stdout.splitlines())
    assert (compiled[1], from_disk[1]) == ("0", "1")
    assert compiled[0] == from_disk[0]
