"""ScanNet++: the iPhone captures with their COLMAP poses and the laser scan's mesh.

``data/<id>/iphone/{rgb.mkv or rgb/, colmap/}`` and ``data/<id>/scans/mesh_aligned_0.05.ply``.
"""

from pathlib import Path

from geogs.io.sources.formats.colmap import is_model
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option, Truth
from geogs_bench.data.scene_folders import first_file, folders_like

_STRIDE = 2
"""Stride through the 60 frames a second; the paper does not say which it used."""


def find_scannetpp(root: Path) -> list[BenchmarkScene]:
    """Scenes below ``root`` or its ``data``; those without frames or COLMAP poses are left out."""
    return [_scene(folder) for folder in folders_like(root, _is_scene, ("data",))]


def _frames(folder: Path) -> Path | None:
    """Extracted frames where there are some, else the video."""
    phone = folder / "iphone"
    extracted = first_file(phone / "rgb" / "frame_*.jpg", phone / "rgb" / "frame_*.png")
    return phone / "rgb" if extracted is not None else first_file(phone / "rgb.m[kp][v4]")


def _is_scene(folder: Path) -> bool:
    return is_model(folder / "iphone" / "colmap") and _frames(folder) is not None


def _scene(folder: Path) -> BenchmarkScene:
    frames, model = _frames(folder), folder / "iphone" / "colmap"
    assert frames is not None  # it is a scene
    cameras = model / "cameras.txt"
    stride = Option("input.stride", str(_STRIDE))
    intrinsics = (Option("input.intrinsics", str(cameras)),) if cameras.is_file() else ()
    surface = first_file(folder / "scans" / "mesh_aligned_0.05.ply")
    truth = Truth(frames if frames.is_dir() else model, surface)
    return BenchmarkScene(folder.resolve().name, frames, truth, (stride, *intrinsics))
