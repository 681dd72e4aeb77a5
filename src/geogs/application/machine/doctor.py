"""Diagnosis of this machine: versions, GPUs, kernels, a self-test of the renderer; what to fix."""

import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path
from typing import cast

import cv2
import numba
import torch
from torch import Tensor

from geogs.application.machine import compilation
from geogs.errors import DeviceError
from geogs.geometry.camera import Camera
from geogs.gpu import binaries, cache, installation, kernels
from geogs.gpu.kernel_source import PACKAGE, kernel_sources
from geogs.networks.weights_files import CATALOGUE, checksum, locate
from geogs.splat.reference import PixelValues, blend, project_disks
from geogs.splat.render import NEAR, Backend, RenderOutput, render
from geogs.threads import on_one_torch_thread, worker_count
from geogs.version import __version__
from geogs.world.disks import DiskParameters


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
    folder = cache.cache_folder()
    size = f"{state.bytes / 2**20:.1f} MiB"
    use = "read-only" if state.problem else "writable"
    text = f"{folder}, {state.kernels} compiled files, {size}, {use}"
    problem = (
        f"Compiled kernels cannot be kept in {folder} ({state.problem}), so every start "
        "compiles them again; set GEOGS_CACHE to a folder that can be written."
    )
    return Finding("kernel cache", text, problem if state.problem and is_needed else None)


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
    before = cache.cache_state().kernels
    start = time.perf_counter()
    try:
        count = kernels.prepare_kernels(PACKAGE, device)
    except DeviceError as error:
        return Finding("kernels", "BAD", str(error), is_fatal=True)
    seconds = time.perf_counter() - start
    new = cache.cache_state().kernels - before
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


_PIXEL_STEP = 4
_TESTED_DISKS, _TIMED_DISKS = 2000, 30_000


@dataclass(frozen=True)
class Agreement:
    """Largest relative errors of a backend in float32 against the reference in float64."""

    maps: float
    gradients: float

    @property
    def is_good(self) -> bool:
        """Whether both are within the tolerances; false for NaN."""
        # Gradients are less exact in single precision, where hits are close to a threshold.
        return self.maps < 1e-3 and self.gradients < 1e-2


@on_one_torch_thread
def check_renderer(device: torch.device) -> Agreement:
    """Compare the backend of ``device`` with the specification, forward and backward.

    The image has 160 x 120 pixels, of which every fourth in either direction is compared, as the
    specification is slow.
    """
    camera = _camera(160, 120)
    scene = wavy_wall(_TESTED_DISKS, camera)
    T_cw = torch.eye(4, dtype=torch.float64)
    rows = torch.arange(1, camera.height, _PIXEL_STEP)
    columns = torch.arange(1, camera.width, _PIXEL_STEP)
    random = torch.Generator().manual_seed(0)
    weights = torch.randn(len(rows), len(columns), 6, generator=random, dtype=torch.float64)
    tested = _render(scene, camera, T_cw, device)
    chosen = tested.maps[rows.to(device)[:, None], columns.to(device)]
    own = torch.autograd.grad(chosen, tested.leaves, weights.to(chosen))
    v, u = torch.meshgrid(rows.double(), columns.double(), indexing="ij")
    specified = _specification(scene, camera, T_cw, torch.stack([u, v], -1).flatten(0, 1))
    true = torch.autograd.grad(specified.maps, specified.leaves, weights.flatten(0, 1))
    pairs = zip(
        chosen.detach().flatten(0, 1).unbind(-1), specified.maps.detach().unbind(-1), strict=True
    )
    return Agreement(
        max(_relative(a, b) for a, b in pairs),
        max(_relative(a, b) for a, b in zip(own, true, strict=True)),
    )


@on_one_torch_thread
def time_renderer(device: torch.device, repeats: int = 20) -> float:
    """Median milliseconds of one forward and backward pass at 616 x 344 pixels."""
    camera = _camera(616, 344)
    scene = DiskParameters(*(p.to(device, torch.float32) for p in wavy_wall(_TIMED_DISKS, camera)))
    T_cw = torch.eye(4, device=device)
    weights: Tensor | None = None
    times = []
    for number in range(repeats + 2):
        start = _now(device)
        rendered = _render(scene, camera, T_cw, device)
        weights = torch.ones_like(rendered.maps) if weights is None else weights
        torch.autograd.grad(rendered.maps, rendered.leaves, weights)
        if number >= 2:
            times.append(_now(device) - start)
    return 1e3 * sorted(times)[len(times) // 2]


def wavy_wall(count: int, camera: Camera) -> DiskParameters:
    """Disks (float64) on a wavy wall that fills the view, overlapping like those of a map."""
    random = torch.Generator().manual_seed(0)

    def uniform(*size: int) -> Tensor:
        return torch.rand(size, generator=random, dtype=torch.float64)

    def normal(*size: int) -> Tensor:
        return torch.randn(size, generator=random, dtype=torch.float64)

    u, v = uniform(count) * camera.width, uniform(count) * camera.height
    z = 3 + 0.5 * torch.sin(u / 40) + 0.5 * torch.sin(v / 55) + 0.01 * normal(count)
    ray = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], 1)
    spacing = (camera.width * camera.height / max(count, 1)) ** 0.5 / camera.fx
    return DiskParameters(
        position=torch.cat([ray, torch.ones_like(z)[:, None]], 1) * z[:, None],
        quaternion=torch.tensor([1.0, 0, 0, 0]) + 0.25 * normal(count, 4),
        log_scale=(0.75 * spacing * z).log()[:, None] + 0.25 * normal(count, 2),
        opacity_logit=3 * uniform(count) - 0.4,
    )


@dataclass(frozen=True)
class _Rendered:
    maps: Tensor
    """(..., 6): depth, normal, alpha, distortion."""
    leaves: list[Tensor]
    """Inputs of the maps: the disks' parameters and the pose."""


def _render(scene: DiskParameters, camera: Camera, T_cw: Tensor, device: torch.device) -> _Rendered:
    disks = DiskParameters(*(p.to(device, torch.float32).detach().requires_grad_() for p in scene))
    pose = T_cw.to(device).clone().requires_grad_()
    out = render(disks, camera, pose, backend=cast(Backend, device.type))
    return _joined(out, disks, pose)


def _specification(
    scene: DiskParameters, camera: Camera, T_cw: Tensor, pixels: Tensor
) -> _Rendered:
    disks = DiskParameters(*(p.clone().requires_grad_() for p in scene))
    pose = T_cw.clone().requires_grad_()
    out = blend(project_disks(disks, pose, NEAR), pixels, camera, NEAR)
    return _joined(out, disks, pose)


def _joined(out: RenderOutput | PixelValues, disks: DiskParameters, pose: Tensor) -> _Rendered:
    parts = [out.depth[..., None], out.normal, out.alpha[..., None], out.distortion[..., None]]
    return _Rendered(torch.cat(parts, -1), [*disks, pose])


def _camera(width: int, height: int) -> Camera:
    return Camera(0.65 * width, 0.65 * width, (width - 1) / 2, (height - 1) / 2, width, height)


def _relative(value: Tensor, truth: Tensor) -> float:
    truth = truth.double()
    return float((value.cpu().double() - truth).norm() / truth.norm().clamp(min=1e-30))


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
