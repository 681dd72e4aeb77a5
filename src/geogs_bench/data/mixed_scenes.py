"""Whatever scenes there are below a folder: rooms and sequences to run, objects and scans."""

from dataclasses import replace
from pathlib import Path

from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.data.dtu_scenes import find_dtu
from geogs_bench.data.posed_scenes import find_objects
from geogs_bench.data.replica_scenes import find_rooms
from geogs_bench.data.sequence_scenes import find_seven_scenes


def find_mixed(root: Path) -> list[BenchmarkScene]:
    """Rooms of ``root`` or of its folders, 7-Scenes, objects with masks, DTU scans; each once."""
    folders = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
    found: dict[Path, BenchmarkScene] = {}
    for find in (find_objects, find_dtu, find_rooms, find_seven_scenes):
        for folder in folders:
            for scene in find(folder):
                found.setdefault(scene.source.resolve(), scene)
    scenes = sorted(found.values(), key=lambda scene: (scene.kind != "room", scene.name))
    names = [scene.name for scene in scenes]
    return [
        replace(s, name=f"{s.source.parent.name}-{s.name}") if names.count(s.name) > 1 else s
        for s in scenes
    ]
