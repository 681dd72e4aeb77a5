"""Diagnosis of this machine: versions, GPUs, kernels, and problems to fix."""

import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path

import cv2
import numba
import torch

from geogs.application.machine import compilation
from geogs.application.machine.self_test import check_renderer, time_renderer
from geogs.errors import DeviceError
from geogs.gpu import binaries, cache, installation, kernels
from geogs.gpu.kernel_source import PACKAGE, kernel_sources
from geogs.networks.weights_files import CATALOGUE, checksum, locate
from geogs.threads import worker_count
from geogs.version import __version__


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str
    text: str
    problem: str | None = None
    """A sentence with the problem and its remedy, if any."""
    is_fatal: bool = False
    """Whether nothing works before it is fixed."""


def examine(device_name: str = "auto") -> Iterator[Finding]:
    """Yield every finding as soon as it is made.

    Raises DeviceError if the named device cannot be used.
    """
    yield from _versions()
    device = installation.require_device(device_name)
    yield from _gpus()
    yield _binaries()
    yield _cache(device.type == "cuda")
    yield _weights()
    if device.type == "cuda":
        yield _compiler()
        kernels = _kernels(device)
        yield kernels
        if kernels.is_fatal:
            return
    yield _cpu_kernels()
    yield from _self_test(device)


def _versions() -> Iterator[Finding]:
    system = f"{platform.system()} {platform.machine()}, {worker_count()} threads"
    yield Finding("geogs", __version__)
    yield Finding("Python", f"{platform.python_version()}, {system}")
    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
    yield Finding(
        "PyTorch", f"{torch.__version__}, built {'for ' * bool(torch.version.cuda)}{build}"
    )
    yield _bytecode()
    yield Finding("OpenCV", cv2.__version__)
    yield Finding("numba", numba.__version__)
    try:
        import av
    except ImportError as error:
        yield Finding("video", f"PyAV does not load ({error})", "Install av to read videos.")
    else:
        yield Finding("video", f"PyAV {av.__version__}, FFmpeg {av.ffmpeg_version_info}")


def _bytecode() -> Finding:
    """Whether Python keeps bytecode of PyTorch, the largest library that every command loads."""
    if Path(cache_from_source(str(torch.__file__))).exists():
        return Finding("bytecode", "kept")
    return Finding(
        "bytecode",
        "none of PyTorch",
        "Python keeps no bytecode of PyTorch, so every command compiles it again, some seconds: "
        f"unset PYTHONDONTWRITEBYTECODE, or run {sys.executable} -m compileall -q "
        f"{Path(str(torch.__file__)).parent}",
    )


def _gpus() -> Iterator[Finding]:
    """Every GPU and the driver; or why there is none.

    A machine without a driver has no problem.
    """
    supported = installation.driver_cuda()
    if problem := installation.gpu_problem():
        yield Finding("GPU", f"none. {problem}", problem if supported else None)
        return
    for index in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(index)
        text = f"{gpu.name}, {gpu.total_memory / 2**30:.1f} GiB, capability {gpu.major}.{gpu.minor}"
        yield Finding(f"GPU {index}", text)
    newest = ".".join(map(str, supported)) if supported else "?"
    yield Finding("driver", f"{installation.driver_release() or '?'}, supports CUDA {newest}")


def _binaries() -> Finding:
    """GPU kernels shipped as binaries; those of a clone are compiled at their first use."""
    sources = kernel_sources(PACKAGE)
    came = [a for a, n in binaries.shipped_sources(sources).items() if n == len(sources)]
    text = f"of all {len(sources)} sources for {', '.join(came)}" if came else "none came along"
    return Finding("binaries", text)


def _cache(is_needed: bool) -> Finding:
    state = cache.cache_state()
    folder, size = cache.cache_folder(), f"{state.bytes / 2**20:.1f} MiB"
    use = "read-only" if state.problem else "writable"
    text = f"{folder}, {state.kernels} compiled files, {size}, {use}"
    if not (state.problem and is_needed):
        return Finding("kernel cache", text)
    return Finding(
        "kernel cache",
        text,
        f"Compiled kernels cannot be kept in {folder} ({state.problem}), so every start "
        "compiles them again; set GEOGS_CACHE to a folder that can be written.",
    )


def _weights() -> Finding:
    """The weights files found, and their checksums."""
    found = {known: checksum(path) for known in CATALOGUE if (path := locate(known))}
    text = ", ".join(f"{k.name} ({k.purpose}: {c.verdict})" for k, c in found.items())
    wrong = [k.name for k, c in found.items() if c.is_wrong]
    problem = f"Get {', '.join(wrong)} again; geogs weights says where." if wrong else None
    return Finding("weights", text or "none", problem)


def _compiler() -> Finding:
    try:
        nvrtc = kernels.compiler()
    except DeviceError as error:
        return Finding("NVRTC", "missing", str(error))
    return Finding("NVRTC", f"{nvrtc.version}, {nvrtc.path}")


def _kernels(device: torch.device) -> Finding:
    """Every CUDA source of the package, from the cache or compiled now."""
    before, start = cache.cache_state().kernels, time.perf_counter()
    try:
        count = kernels.prepare_kernels(PACKAGE, device)
    except DeviceError as error:
        return Finding("kernels", "BAD", str(error), is_fatal=True)
    seconds, new = time.perf_counter() - start, cache.cache_state().kernels - before
    how = f"{new} files compiled now" if new else "none to compile"
    return Finding("kernels", f"{count}, {how}, {seconds:.1f} s")


def _cpu_kernels() -> Finding:
    """CPU kernels of numba, from its cache or compiled now."""
    start = time.perf_counter()
    is_there = compilation.is_compiled()
    if not is_there:
        compilation.compile_now()
    how = "none to compile" if is_there else "compiled now"
    return Finding("for the CPU", f"{how}, {time.perf_counter() - start:.1f} s")


def _self_test(device: torch.device) -> Iterator[Finding]:
    name = f"{device.type} renderer against its specification"
    try:
        agreement = check_renderer(device)
        errors = f"maps {agreement.maps:.1e}, gradients {agreement.gradients:.1e}"
        if not agreement.is_good:
            problem = f"The renderer gives wrong results on {device} (relative errors: {errors})."
            yield Finding("self-test", f"{name}: {errors}  BAD", problem, is_fatal=True)
            return
        yield Finding("self-test", f"{name}: relative error {errors}  OK")
        repeats = 20 if device.type == "cuda" else 3
        milliseconds = time_renderer(device, repeats=repeats)
    except Exception as error:  # any failure is to be reported
        problem = f"The renderer does not run on {device} ({_first_line(error)})."
        yield Finding("self-test", f"{name}: BAD", problem, is_fatal=True)
        return
    text = f"30 000 disks, 616 x 344: {milliseconds:.2f} ms forward and backward"
    yield Finding("speed", text)


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
