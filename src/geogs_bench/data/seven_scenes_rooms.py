"""7-Scenes: ``<scene>/seq-01/frame-000000.color.png`` with ``frame-000000.pose.txt``."""

from pathlib import Path

from geogs.io.sources.formats.seven_scenes import is_posed_seven_scenes
from geogs_bench.data.benchmark_scene import BenchmarkScene, Truth
from geogs_bench.data.scene_folders import first_file, folders_like


def find_seven_scenes(root: Path) -> list[BenchmarkScene]:
    """Every sequence of the scenes below ``root``, which may be a scene or a sequence itself."""
    folders = folders_like(root, is_posed_seven_scenes)
    sequences = [path for folder in folders for path in _sequences(folder)]
    return [_scene(sequence.resolve()) for sequence in sequences]


def _sequences(folder: Path) -> list[Path]:
    below = sorted(path for path in folder.glob("seq-*") if is_posed_seven_scenes(path))
    return below or [folder]


def _scene(sequence: Path) -> BenchmarkScene:
    surface = first_file(sequence.parent / "tsdf_pseudo_gt.ply", sequence.parent / "mesh.ply")
    name = f"{sequence.parent.name}-{sequence.name}"
    has_depth = next(sequence.glob("frame-*.depth.png"), None) is not None
    return BenchmarkScene(name, sequence, Truth(sequence, surface), has_depth=has_depth)
