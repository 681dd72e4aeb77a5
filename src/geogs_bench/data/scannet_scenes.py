"""ScanNet as exported from its ``.sens`` files: ``<scene>/color``, ``pose`` and ``intrinsic``."""

from pathlib import Path

from geogs.io.sources.formats.scannet import is_posed_scannet
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option, Truth
from geogs_bench.data.scene_folders import first_file, folders_like


def find_scannet(root: Path) -> list[BenchmarkScene]:
    """Exported scenes below ``root`` or its ``scans``; an exporter may add a folder ``frames``."""
    folders = folders_like(root, _is_scene, ("scans", "scannet"))
    return [_scene(folder) for folder in folders]


def _frames(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames" / "color").is_dir() else folder


def _is_scene(folder: Path) -> bool:
    return is_posed_scannet(_frames(folder))


def _scene(folder: Path) -> BenchmarkScene:
    frames = _frames(folder)
    name = folder.resolve().name
    calibration = frames / "intrinsic" / "intrinsic_color.txt"
    options = (Option("input.intrinsics", str(calibration)),) if calibration.is_file() else ()
    surface = first_file(folder / f"{name}_vh_clean_2.ply", folder / f"{name}_vh_clean.ply")
    has_depth = next((frames / "depth").glob("*.png"), None) is not None
    return BenchmarkScene(
        name, frames / "color", Truth(frames, surface), options, has_depth=has_depth
    )
