"""DTU scans as prepared for IDR and 2DGS, and the official files that its protocol needs.

``scan24/{images,mask,cameras.npz}``; ``SampleSet/MVS Data/{ObsMask,Points/stl}``.
"""

import re
from pathlib import Path

from geogs.io.sources.formats.dtu import is_dtu
from geogs_bench.data.benchmark_scene import BenchmarkScene, DtuTruth, Option, Truth, same_surface
from geogs_bench.data.scene_folders import folders_like

_OFFICIAL = (
    "", "SampleSet/MVS Data", "MVS Data", "Official_DTU_Dataset/SampleSet/MVS Data",
    "Official_DTU_Dataset", "official",
)  # fmt: skip

_HELD_OUT = 8
"""Stride of the held-out images."""
_SAME = same_surface("800", "1")
"""Images of half size; voxels in millimetres."""


def find_dtu(root: Path) -> list[BenchmarkScene]:
    """Find scans below ``root`` (or its ``DTU`` or ``dtu``), with their truth if it is there."""
    folders = folders_like(root, is_dtu, ("DTU", "dtu"))
    return [_scene(folder) for folder in folders]


def official_truth(scan: int, *roots: Path) -> DtuTruth | None:
    """The official files of a scan below one of ``roots``, if they are complete there."""
    for root in roots:
        for name in _OFFICIAL:
            folder = root / name
            mask = folder / "ObsMask" / f"ObsMask{scan}_10.mat"
            if mask.is_file() and (folder / "Points" / "stl").is_dir():
                return DtuTruth(folder, scan)
    return None


def _scene(folder: Path) -> BenchmarkScene:
    place = folder.resolve()
    number = re.search(r"(\d+)$", place.name)
    dtu = official_truth(int(number[1]), *place.parents[:2]) if number else None
    name = f"scan{number[1]}" if number else place.name
    # Without a true surface some images are held out, to measure their photo-consistency.
    options = _SAME if dtu else (*_SAME, Option("hold-out", str(_HELD_OUT)))
    return BenchmarkScene(name, folder, Truth(dtu=dtu), options, kind="scan")
