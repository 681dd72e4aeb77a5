"""Scenes of data sets in the user's folder, with their truth.

- Replica's layout, as rendered for iMAP, and rooms with their own mesh:
  ``<scene>/results/frame000000.jpg``, ``<scene>/traj.txt``; surfaces beside the scenes
  (``<scene>_mesh.ply``, ``cull_replica_mesh/<scene>.ply``) or inside (``mesh.ply``,
  ``points_seen_*.ply``).
- Sequences to run: TUM RGB-D, 7-Scenes, ScanNet and ScanNet++.
- DTU scans as prepared for IDR and 2DGS (``scan24/{images,mask,cameras.npz}``), and the official
  files that its protocol needs (``SampleSet/MVS Data/{ObsMask,Points/stl}``).
- For reconstruction from known poses, objects with masks and rooms in the layout of Replica. The
  input is the same for every method: images of one size, about a hundred of a room, and the same
  surface from its depths (metres).
- Sequences with known depth in their views: rendered, measured, or from a true surface.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from geogs.io.sources.formats.colmap import is_model
from geogs.io.sources.formats.dtu import is_dtu
from geogs.io.sources.formats.image_files import natural_key
from geogs.io.sources.formats.replica import is_replica, open_replica
from geogs.io.sources.formats.scannet import is_posed_scannet
from geogs.io.sources.formats.seven_scenes import is_posed_seven_scenes
from geogs.io.sources.formats.tum import is_posed_tum, is_tum
from geogs_bench.data.benchmark_scene import BenchmarkScene, DtuTruth, Option, Truth, same_surface


def folders_like(
    root: Path, is_scene: Callable[[Path], bool], below: tuple[str, ...] = ()
) -> list[Path]:
    """``root`` if it is a scene, else the scenes directly in it or in its folders ``below``.

    They are in natural order of their names, so scan40 comes before scan105.
    """
    if is_scene(root):
        return [root]
    places = [root, *(root / name for name in below)]
    found = [
        folder
        for place in places
        if place.is_dir()
        for folder in place.iterdir()
        if folder.is_dir() and not folder.name.startswith(".") and is_scene(folder)
    ]
    return sorted(found, key=lambda folder: natural_key(folder.name))


def first_file(*candidates: Path) -> Path | None:
    """The first file that exists, or none; a name may be a pattern such as ``mesh_*.ply``."""
    for candidate in candidates:
        matches = sorted(candidate.parent.glob(candidate.name))
        if matches:
            return matches[0]
    return None


_RELIGHTED = "-light"
"""Ending of the name of a scene that is another one under other light, with the same surface."""
_CULLED_FOLDERS = ("cull_replica_mesh", "gt_mesh_culled")


def find_replica(root: Path) -> list[BenchmarkScene]:
    """Find scenes below ``root``, or ``root`` itself; those without poses are left out."""
    return [_replica(folder) for folder in folders_like(root, _is_posed_replica, ("Replica",))]


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


def _is_posed_replica(folder: Path) -> bool:
    return is_replica(folder) and (folder / "traj.txt").is_file()


def _replica(folder: Path) -> BenchmarkScene:
    truth = _replica_truth(folder)
    if truth.surface is None and folder.name.endswith(_RELIGHTED):
        truth = _replica_truth(folder.with_name(folder.name.removesuffix(_RELIGHTED)))
    poses = folder / "traj.txt"
    return BenchmarkScene(folder.resolve().name, folder, replace(truth, poses=poses))


def _replica_truth(folder: Path) -> Truth:
    """The surface of a scene: culled as NICE-SLAM provides it, else whole."""
    folder = folder.resolve()
    root = folder.parent
    name = folder.name
    places = [place / kind for place in (root, root.parent) for kind in _CULLED_FOLDERS]
    culled = first_file(*(place / f"{name}.ply" for place in places))
    if culled is not None:
        return Truth(surface=culled, culling="done")
    whole = first_file(root / f"{name}_mesh.ply")
    if whole is not None:
        return Truth(surface=whole, culling="frustum")
    surface = first_file(folder / "mesh.ply", folder / "mesh_*.ply")
    return Truth(surface=surface, points=first_file(folder / "points_seen_*.ply"))


def find_tum(root: Path) -> list[BenchmarkScene]:
    """Find sequences below ``root``: ``<sequence>/rgb.txt`` and ``groundtruth.txt``.

    The truth, by motion capture, has poses and no surface.
    """
    return [
        BenchmarkScene(
            folder.resolve().name,
            folder,
            Truth(folder / "groundtruth.txt"),
            has_depth=(folder / "depth.txt").is_file(),
        )
        for folder in folders_like(root, is_posed_tum)
    ]


def find_seven_scenes(root: Path) -> list[BenchmarkScene]:
    """Find every sequence of the scenes below ``root``, which may be a scene or a sequence itself.

    ``<scene>/seq-01/frame-000000.color.png`` with ``frame-000000.pose.txt``.
    """
    folders = folders_like(root, is_posed_seven_scenes)
    sequences = [path for folder in folders for path in _sequences(folder)]
    return [_seven_scenes(sequence.resolve()) for sequence in sequences]


def find_scannet(root: Path) -> list[BenchmarkScene]:
    """Find scenes exported from their ``.sens`` files below ``root`` or its ``scans``.

    ``<scene>/color``, ``pose`` and ``intrinsic``; an exporter may add a folder ``frames``.
    """
    folders = folders_like(root, lambda f: is_posed_scannet(_exported(f)), ("scans", "scannet"))
    return [_scannet(folder) for folder in folders]


def find_scannetpp(root: Path) -> list[BenchmarkScene]:
    """Find scenes with frames and COLMAP poses below ``root`` or its ``data``.

    The iPhone's captures with their COLMAP poses, and the laser scan's mesh:
    ``data/<id>/iphone/{rgb.mkv or rgb/, colmap/}`` and ``data/<id>/scans/mesh_aligned_0.05.ply``.
    """
    return [_scannetpp(folder) for folder in folders_like(root, _is_scannetpp, ("data",))]


def _sequences(folder: Path) -> list[Path]:
    below = sorted(path for path in folder.glob("seq-*") if is_posed_seven_scenes(path))
    return below or [folder]


def _seven_scenes(sequence: Path) -> BenchmarkScene:
    surface = first_file(sequence.parent / "tsdf_pseudo_gt.ply", sequence.parent / "mesh.ply")
    name = f"{sequence.parent.name}-{sequence.name}"
    has_depth = next(sequence.glob("frame-*.depth.png"), None) is not None
    return BenchmarkScene(name, sequence, Truth(sequence, surface), has_depth=has_depth)


def _exported(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames" / "color").is_dir() else folder


def _scannet(folder: Path) -> BenchmarkScene:
    frames = _exported(folder)
    name = folder.resolve().name
    surface = first_file(folder / f"{name}_vh_clean_2.ply", folder / f"{name}_vh_clean.ply")
    has_depth = next((frames / "depth").glob("*.png"), None) is not None
    options = _intrinsics(frames / "intrinsic" / "intrinsic_color.txt")
    return BenchmarkScene(
        name, frames / "color", Truth(frames, surface), options, has_depth=has_depth
    )


def _filmed(folder: Path) -> Path | None:
    """Folder of the extracted frames if there are some, else the video."""
    phone = folder / "iphone"
    extracted = first_file(phone / "rgb" / "frame_*.jpg", phone / "rgb" / "frame_*.png")
    return phone / "rgb" if extracted is not None else first_file(phone / "rgb.m[kp][v4]")


def _is_scannetpp(folder: Path) -> bool:
    return is_model(folder / "iphone" / "colmap") and _filmed(folder) is not None


def _scannetpp(folder: Path) -> BenchmarkScene:
    frames = _filmed(folder)
    model = folder / "iphone" / "colmap"
    assert frames is not None  # it is a scene
    # Every second of 60 frames a second; the paper does not state its stride.
    options = (Option("input.stride", "2"), *_intrinsics(model / "cameras.txt"))
    surface = first_file(folder / "scans" / "mesh_aligned_0.05.ply")
    truth = Truth(frames if frames.is_dir() else model, surface)
    return BenchmarkScene(folder.resolve().name, frames, truth, options)


def _intrinsics(file: Path) -> tuple[Option, ...]:
    return (Option("input.intrinsics", str(file)),) if file.is_file() else ()


_OFFICIAL = (
    "",
    "SampleSet/MVS Data",
    "MVS Data",
    "Official_DTU_Dataset/SampleSet/MVS Data",
    "Official_DTU_Dataset",
    "official",
)


def find_dtu(root: Path) -> list[BenchmarkScene]:
    """Find scans below ``root`` (or its ``DTU`` or ``dtu``), with their truth if it is there."""
    folders = folders_like(root, is_dtu, ("DTU", "dtu"))
    return [_scan(folder) for folder in folders]


def official_truth(scan: int, *roots: Path) -> DtuTruth | None:
    """The official files of a scan below one of ``roots``, if they are complete there."""
    for root in roots:
        for name in _OFFICIAL:
            folder = root / name
            mask = folder / "ObsMask" / f"ObsMask{scan}_10.mat"
            if mask.is_file() and (folder / "Points" / "stl").is_dir():
                return DtuTruth(folder, scan)
    return None


def _scan(folder: Path) -> BenchmarkScene:
    place = folder.resolve()
    number = re.search(r"(\d+)$", place.name)
    dtu = official_truth(int(number[1]), *place.parents[:2]) if number else None
    name = f"scan{number[1]}" if number else place.name
    options = same_surface("800", "1")  # images of half size; voxels in millimetres
    if dtu is None:  # some images are held out, to measure their photo-consistency
        options = (*options, Option("hold-out", "8"))
    return BenchmarkScene(name, folder, Truth(dtu=dtu), options, kind="scan")


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
    stride = Option("input.stride", str(max(1, round(count / 100))))
    return replace(scene, options=(*scene.options, *same_surface("600", "0.01"), stride))


def find_depth(root: Path) -> list[BenchmarkScene]:
    """Find rooms, streets and sequences of sensors below ``root``, or ``root`` itself.

    Sequences in the layout of Replica have depth images or a true surface, others depth images.
    """
    rendered = []
    for scene in find_replica(root):
        folder = scene.source
        if scene.truth.surface or any((folder / "results").glob("depth*.png")):
            if (folder / "groundtruth.txt").is_file():  # by geogs synth, with times
                scene = replace(scene, truth=replace(scene.truth, poses=folder))
            rendered.append(scene)
    kinect = [_with_sensor(folder) for folder in folders_like(root, _is_tum_with_depth)]
    seven_scenes = [scene for scene in find_seven_scenes(root) if scene.has_depth]
    return [replace(scene, kind="depth") for scene in (*rendered, *kinect, *seven_scenes)]


def _with_sensor(folder: Path) -> BenchmarkScene:
    poses = folder / "groundtruth.txt"
    truth = Truth(poses if poses.is_file() else None)
    return BenchmarkScene(folder.resolve().name, folder, truth, has_depth=True)


def _is_tum_with_depth(folder: Path) -> bool:
    """Whether a folder is TUM's, with depth; ``geogs synth`` lists no depths in TUM's layout."""
    return is_tum(folder) and (folder / "depth.txt").is_file()


def find_motions(root: Path) -> list[BenchmarkScene]:
    """Find every sequence below ``root``, or ``root`` itself if it is one."""
    return [
        BenchmarkScene(folder.resolve().name, folder, Truth(poses=folder), kind="motion")
        for folder in folders_like(root, _is_sequence)
    ]


def _is_sequence(folder: Path) -> bool:
    return (folder / "cam_params.json").is_file() and (folder / "traj.txt").is_file()
