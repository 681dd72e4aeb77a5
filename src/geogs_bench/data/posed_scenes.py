"""Scenes for reconstruction from known poses: objects with masks, rooms, and DTU's scans.

Objects and rooms are in the layout of Replica. The input is the same for every method: images of
one size, about a hundred of a room, and the same surface from its depths (metres).
"""

from dataclasses import replace
from pathlib import Path

from geogs.io.sources.formats.replica import open_replica
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option, same_surface
from geogs_bench.data.dtu_scenes import find_dtu
from geogs_bench.data.replica_scenes import find_rooms

_IMAGES = 100


def find_objects(root: Path) -> list[BenchmarkScene]:
    """Find scenes with masks and a surface below ``root`` (or its folder ``objects``)."""
    folders = (folder for folder in (root, root / "objects") if folder.is_dir())
    found = ([s for s in find_rooms(folder) if _has_masks(s)] for folder in folders)
    objects = next((scenes for scenes in found if scenes), [])
    same = same_surface("800", "0.001")
    return [replace(s, kind="object", options=(*s.options, *same)) for s in objects]


def find_posed_rooms(root: Path) -> list[BenchmarkScene]:
    """Find rooms below ``root``, with the stride that leaves about a hundred images."""
    return [_thinned(scene) for scene in find_rooms(root) if not _has_masks(scene)]


def find_any_posed(root: Path) -> list[BenchmarkScene]:
    """Find DTU scans with their truth, else objects, else rooms below ``root``."""
    scans = [scene for scene in find_dtu(root) if scene.truth.dtu is not None]
    return scans or find_objects(root) or find_posed_rooms(root)


def _has_masks(scene: BenchmarkScene) -> bool:
    return any((scene.source / "results").glob("mask*.png"))


def _thinned(scene: BenchmarkScene) -> BenchmarkScene:
    count = len(open_replica(scene.source).files)
    stride = Option("input.stride", str(max(1, round(count / _IMAGES))))
    return replace(scene, options=(*scene.options, *same_surface("600", "0.01"), stride))
