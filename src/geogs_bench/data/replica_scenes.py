"""Scenes in the layout of Replica, as rendered for iMAP, and rooms with their own mesh.

``<scene>/results/frame000000.jpg``, ``<scene>/traj.txt``; surfaces beside the scenes
(``<scene>_mesh.ply``, ``cull_replica_mesh/<scene>.ply``) or inside (``mesh.ply``,
``points_seen_*.ply``).
"""

from dataclasses import replace
from pathlib import Path

from geogs.io.sources.formats.replica import is_replica
from geogs_bench.data.benchmark_scene import BenchmarkScene, Truth
from geogs_bench.data.scene_folders import first_file, folders_like

_RELIGHTED = "-light"
"""Ending of the name of a scene that is another one under other light, with the same surface."""
_CULLED_FOLDERS = ("cull_replica_mesh", "gt_mesh_culled")


def find_replica(root: Path) -> list[BenchmarkScene]:
    """Find scenes below ``root``, or ``root`` itself; those without poses are left out."""
    return [_scene(folder) for folder in folders_like(root, _is_scene, ("Replica",))]


def find_rooms(root: Path) -> list[BenchmarkScene]:
    """Scenes of :func:`find_replica` with a true surface."""
    return [scene for scene in find_replica(root) if scene.truth.surface is not None]


def find_relighted(root: Path) -> list[BenchmarkScene]:
    """Find pairs of a scene under steady and under changing light (``<scene>-light``)."""
    scenes = {scene.name: scene for scene in find_rooms(root)}
    pairs = [
        (scenes[name.removesuffix(_RELIGHTED)], scene)
        for name, scene in scenes.items()
        if name.endswith(_RELIGHTED) and name.removesuffix(_RELIGHTED) in scenes
    ]
    return [scene for pair in pairs for scene in pair]


def _is_scene(folder: Path) -> bool:
    return is_replica(folder) and (folder / "traj.txt").is_file()


def _scene(folder: Path) -> BenchmarkScene:
    truth = _truth(folder)
    if truth.surface is None and folder.name.endswith(_RELIGHTED):
        truth = _truth(folder.with_name(folder.name.removesuffix(_RELIGHTED)))
    poses = folder / "traj.txt"
    return BenchmarkScene(folder.resolve().name, folder, replace(truth, poses=poses))


def _truth(folder: Path) -> Truth:
    """The surface of a scene: culled as NICE-SLAM provides it, else whole."""
    folder = folder.resolve()
    root, name = folder.parent, folder.name
    places = [place / kind for place in (root, root.parent) for kind in _CULLED_FOLDERS]
    culled = first_file(*(place / f"{name}.ply" for place in places))
    if culled is not None:
        return Truth(surface=culled, culling="done")
    whole = first_file(root / f"{name}_mesh.ply")
    if whole is not None:
        return Truth(surface=whole, culling="frustum")
    surface = first_file(folder / "mesh.ply", folder / "mesh_*.ply")
    return Truth(surface=surface, points=first_file(folder / "points_seen_*.ply"))
