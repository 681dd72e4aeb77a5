"""TUM RGB-D sequences: ``<sequence>/rgb.txt`` and ``groundtruth.txt``."""

from pathlib import Path

from geogs.io.sources.formats.tum import is_posed_tum
from geogs_bench.layouts.places import folders_like
from geogs_bench.scene import Scene, TruePoses, Truth


def find_tum(root: Path) -> list[Scene]:
    """Sequences below ``root``; motion capture gives poses and no surface."""
    return [
        Scene(
            folder.resolve().name,
            folder,
            Truth(TruePoses(folder / "groundtruth.txt")),
            has_depth=(folder / "depth.txt").is_file(),
        )
        for folder in folders_like(root, is_posed_tum)
    ]
