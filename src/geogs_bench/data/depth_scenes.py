"""Sequences with known depth in their views: rendered, measured, or from a true surface."""

from dataclasses import replace
from pathlib import Path

from geogs.io.sources.formats.tum import is_tum
from geogs_bench.data.benchmark_scene import BenchmarkScene, Truth
from geogs_bench.data.motion_cells import Cell
from geogs_bench.data.replica_scenes import find_replica
from geogs_bench.data.scene_folders import folders_like
from geogs_bench.data.sequence_scenes import find_seven_scenes
from geogs_synth.camera.flaws import Flaws

CELLS: tuple[Cell, ...] = (
    Cell("room-0", "handheld", Flaws(), 100, 400, 300),
    Cell("room-1", "handheld", Flaws(), 100, 400, 300, seed=1),
    Cell("dining-0", "dining", Flaws(), 100, 400, 300),
    Cell("dining-1", "dining", Flaws(), 100, 400, 300, seed=1),
    Cell("street-0", "driving", Flaws(), 60, 496, 150),
)
"""Rendered scenes if the user gives no data: rooms, rooms of thin things, a street."""


def find_depth(root: Path) -> list[BenchmarkScene]:
    """Find rooms, streets and sequences of sensors below ``root``, or ``root`` itself.

    Sequences in the layout of Replica have depth images or a true surface, others depth images.
    """
    rendered = [
        _with_times(scene)
        for scene in find_replica(root)
        if scene.truth.surface is not None or _has_rendered_depth(scene.source)
    ]
    kinect = [_with_sensor(folder) for folder in folders_like(root, _is_tum_with_depth)]
    seven_scenes = [scene for scene in find_seven_scenes(root) if scene.has_depth]
    return [replace(scene, kind="depth") for scene in (*rendered, *kinect, *seven_scenes)]


def _with_times(scene: BenchmarkScene) -> BenchmarkScene:
    """The scene with timed poses, if ``geogs synth`` wrote them, too."""
    if not (scene.source / "groundtruth.txt").is_file():
        return scene
    return replace(scene, truth=replace(scene.truth, poses=scene.source))


def _with_sensor(folder: Path) -> BenchmarkScene:
    poses = folder / "groundtruth.txt"
    truth = Truth(poses if poses.is_file() else None)
    return BenchmarkScene(folder.resolve().name, folder, truth, has_depth=True)


def _is_tum_with_depth(folder: Path) -> bool:
    """Whether a folder is TUM's, with depth; ``geogs synth`` lists no depths in TUM's layout."""
    return is_tum(folder) and (folder / "depth.txt").is_file()


def _has_rendered_depth(folder: Path) -> bool:
    return next((folder / "results").glob("depth*.png"), None) is not None
