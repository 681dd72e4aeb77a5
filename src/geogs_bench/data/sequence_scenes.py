"""Sequences of data sets to run: TUM RGB-D, 7-Scenes, ScanNet and ScanNet++."""

from pathlib import Path

from geogs.io.sources.formats.colmap import is_model
from geogs.io.sources.formats.scannet import is_posed_scannet
from geogs.io.sources.formats.seven_scenes import is_posed_seven_scenes
from geogs.io.sources.formats.tum import is_posed_tum
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option, Truth
from geogs_bench.data.scene_folders import first_file, folders_like

_STRIDE = 2
"""Stride through the 60 frames a second of ScanNet++; the paper does not state its own."""


def find_tum(root: Path) -> list[BenchmarkScene]:
    """Find sequences below ``root``: ``<sequence>/rgb.txt`` and ``groundtruth.txt``.

    The truth, by motion capture, has poses and no surface.
    """
    return [
        BenchmarkScene(
            folder.resolve().name,
            folder,
            Truth(folder / "groundtruth.txt"),
            has_depth=(folder / "depth.txt").is_file(),
        )
        for folder in folders_like(root, is_posed_tum)
    ]


def find_seven_scenes(root: Path) -> list[BenchmarkScene]:
    """Find every sequence of the scenes below ``root``, which may be a scene or a sequence itself.

    ``<scene>/seq-01/frame-000000.color.png`` with ``frame-000000.pose.txt``.
    """
    folders = folders_like(root, is_posed_seven_scenes)
    sequences = [path for folder in folders for path in _sequences(folder)]
    return [_seven_scenes(sequence.resolve()) for sequence in sequences]


def find_scannet(root: Path) -> list[BenchmarkScene]:
    """Find scenes exported from their ``.sens`` files below ``root`` or its ``scans``.

    ``<scene>/color``, ``pose`` and ``intrinsic``; an exporter may add a folder ``frames``.
    """
    folders = folders_like(root, lambda f: is_posed_scannet(_exported(f)), ("scans", "scannet"))
    return [_scannet(folder) for folder in folders]


def find_scannetpp(root: Path) -> list[BenchmarkScene]:
    """Find scenes with frames and COLMAP poses below ``root`` or its ``data``.

    The iPhone's captures with their COLMAP poses, and the laser scan's mesh:
    ``data/<id>/iphone/{rgb.mkv or rgb/, colmap/}`` and ``data/<id>/scans/mesh_aligned_0.05.ply``.
    """
    return [_scannetpp(folder) for folder in folders_like(root, _is_scannetpp, ("data",))]


def _sequences(folder: Path) -> list[Path]:
    below = sorted(path for path in folder.glob("seq-*") if is_posed_seven_scenes(path))
    return below or [folder]


def _seven_scenes(sequence: Path) -> BenchmarkScene:
    surface = first_file(sequence.parent / "tsdf_pseudo_gt.ply", sequence.parent / "mesh.ply")
    name = f"{sequence.parent.name}-{sequence.name}"
    has_depth = next(sequence.glob("frame-*.depth.png"), None) is not None
    return BenchmarkScene(name, sequence, Truth(sequence, surface), has_depth=has_depth)


def _exported(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames" / "color").is_dir() else folder


def _scannet(folder: Path) -> BenchmarkScene:
    frames = _exported(folder)
    name = folder.resolve().name
    surface = first_file(folder / f"{name}_vh_clean_2.ply", folder / f"{name}_vh_clean.ply")
    has_depth = next((frames / "depth").glob("*.png"), None) is not None
    options = _intrinsics(frames / "intrinsic" / "intrinsic_color.txt")
    return BenchmarkScene(
        name, frames / "color", Truth(frames, surface), options, has_depth=has_depth
    )


def _filmed(folder: Path) -> Path | None:
    """Folder of the extracted frames if there are some, else the video."""
    phone = folder / "iphone"
    extracted = first_file(phone / "rgb" / "frame_*.jpg", phone / "rgb" / "frame_*.png")
    return phone / "rgb" if extracted is not None else first_file(phone / "rgb.m[kp][v4]")


def _is_scannetpp(folder: Path) -> bool:
    return is_model(folder / "iphone" / "colmap") and _filmed(folder) is not None


def _scannetpp(folder: Path) -> BenchmarkScene:
    frames, model = _filmed(folder), folder / "iphone" / "colmap"
    assert frames is not None  # it is a scene
    options = (Option("input.stride", str(_STRIDE)), *_intrinsics(model / "cameras.txt"))
    surface = first_file(folder / "scans" / "mesh_aligned_0.05.ply")
    truth = Truth(frames if frames.is_dir() else model, surface)
    return BenchmarkScene(folder.resolve().name, frames, truth, options)


def _intrinsics(file: Path) -> tuple[Option, ...]:
    return (Option("input.intrinsics", str(file)),) if file.is_file() else ()
