"""TUM RGB-D sequences: ``<sequence>/rgb.txt`` and ``groundtruth.txt``."""

from pathlib import Path

from geogs.io.sources.formats.tum import is_posed_tum
from geogs_bench.data.benchmark_scene import BenchmarkScene, Truth
from geogs_bench.data.scene_folders import folders_like


def find_tum(root: Path) -> list[BenchmarkScene]:
    """Sequences below ``root``; motion capture gives poses and no surface."""
    return [
        BenchmarkScene(
            folder.resolve().name,
            folder,
            Truth(folder / "groundtruth.txt"),
            has_depth=(folder / "depth.txt").is_file(),
        )
        for folder in folders_like(root, is_posed_tum)
    ]
