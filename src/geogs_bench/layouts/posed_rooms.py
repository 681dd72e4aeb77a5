"""Rooms for reconstruction from known poses: about a hundred images of each sequence."""

from dataclasses import replace
from pathlib import Path

from geogs.io.sources.formats.replica import open_replica
from geogs_bench.layouts.dtu import find_dtu
from geogs_bench.layouts.objects import find_objects
from geogs_bench.layouts.replica import find_rooms
from geogs_bench.scene import Option, Scene

_IMAGES = 100
# What every method gets: images of the same size, and the same surface from its depths (metres).
_SAME = (
    Option("input.long-edge", "600"),
    Option("mesh.voxel", "0.01"),
    Option("mesh.truncation", "5"),
)


def find_posed_rooms(root: Path) -> list[Scene]:
    """The rooms below ``root``, with the stride that leaves about a hundred images."""
    return [_thinned(scene) for scene in find_rooms(root) if not _has_masks(scene)]


def find_any_posed(root: Path) -> list[Scene]:
    """DTU scans whose truth is there, else objects, else rooms: whatever ``root`` holds."""
    scans = [scene for scene in find_dtu(root) if scene.truth.dtu is not None]
    return scans or find_objects(root) or find_posed_rooms(root)


def _has_masks(scene: Scene) -> bool:
    return any((scene.source / "results").glob("mask*.png"))


def _thinned(scene: Scene) -> Scene:
    count = open_replica(scene.source).length or 1
    stride = Option("input.stride", str(max(1, round(count / _IMAGES))))
    return replace(scene, options=(*scene.options, *_SAME, stride))
