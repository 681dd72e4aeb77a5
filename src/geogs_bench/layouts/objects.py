"""Single objects with masks, poses in ``traj.txt`` and an exact mesh, in the layout of Replica."""

from dataclasses import replace
from pathlib import Path

from geogs_bench.layouts.replica import find_rooms
from geogs_bench.scene import Option, Scene

# What every method gets: images of the same size, and the same surface from its depths (metres).
_SAME = (
    Option("input.long-edge", "800"),
    Option("mesh.voxel", "0.001"),
    Option("mesh.truncation", "5"),
)


def find_objects(root: Path) -> list[Scene]:
    """Scenes below ``root`` (or its folder ``objects``) whose images have masks and a surface."""
    folders = (root, root / "objects")
    return next((scenes for folder in folders if (scenes := _masked(folder))), [])


def _masked(folder: Path) -> list[Scene]:
    if not folder.is_dir():
        return []
    scenes = [s for s in find_rooms(folder) if any((s.source / "results").glob("mask*.png"))]
    return [replace(s, kind="object", options=(*s.options, *_SAME)) for s in scenes]
