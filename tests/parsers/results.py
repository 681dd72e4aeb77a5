"""What the folder of a result holds, read back by the commands that go on with it."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import mutations
from geogs.application.evaluate import evaluate
from geogs.application.export.image_sets import write_colmap_set, write_nerfstudio_set
from geogs.application.result_settings import EvalSettings
from geogs.application.results.output_folder import chosen_folder
from geogs.application.results.result_page import shown_model, shown_views, write_page_anew
from geogs.application.results.revise import mesh_settings
from geogs.application.results.saved_result import load_result
from geogs.application.settings_file import read_settings
from geogs.camera.shutter.rows import CELL
from geogs.config import ReconstructConfig
from geogs.evaluation.pages.run_page import lengths
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.sniff import open_posed_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.keyframe_folder import (
    image_path,
    mask_path,
    read_image,
    read_mask,
    rows_path,
    write_rows,
)
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.mapping.rendered import SurfaceMaps
from geogs.types import SeenRows, Uncertainty
from parsers.base import Damage, Parser
from saved_results import CAMERA, make_result

SUMMARY = {
    "source": "room", "kind": "images", "frames": 5, "keyframes": 5, "disks": 900,
    "mesh_faces": 3, "seconds": {"total": 8.5, "tracking": 2.0}, "scale": "arbitrary",
    "frames_per_second": {"tracking": 3.0, "with_final_stages": 0.6}, "moving": 0.1,
    "lost_spans": [[0.1, 0.2]], "orientation_only_spans": [], "skipped_images": 1,
    "peak_memory_bytes": 123456789, "fingerprint": "0123456789abcdef", "loops": 1,
    "verdict": {"is_reliable": True, "sentence": "Good.", "lost": 0.0, "position": 0.01,
                "orientation_only": 0.0, "rotation_deg": 0.2, "depth": 0.02},
    "shutter": {"readout": 0.02, "origin": "given"}, "versions": {"geogs": "1"},
    "segments": [{"first_time": 0.0, "last_time": 1.0, "keyframes": 5, "fate": "kept"}],
}  # fmt: skip


def results() -> dict[str, Parser]:
    """By the file that is damaged."""
    files: dict[str, tuple[str, Damage, Callable[[Path], object]]] = {
        "map": ("map.safetensors", mutations.safetensors, whole),
        "map-shown": ("map.safetensors", mutations.safetensors, shown),
        "config-of-a-result": ("config.yaml", mutations.yaml_text, whole),
        "config-given": ("config.yaml", mutations.yaml_text, given),
        "trajectory-of-a-result": ("trajectory.tum", mutations.text, whole),
        "trajectory-shown": ("trajectory.tum", mutations.text, shown),
        "uncertainty-of-a-result": ("trajectory_uncertainty.csv", mutations.text, whole),
        "summary-of-a-result": ("summary.json", mutations.json_text, page),
        "summary-evaluated": ("summary.json", mutations.json_text, judged),
        "camera-evaluated": ("intrinsics.json", mutations.json_text, judged),
        "summary-of-another": (
            "summary.json", mutations.json_text, lambda f: chosen_folder(None, str(f), False)
        ),
    }  # fmt: skip
    found = {k: Parser(complete, (file,), damage, use) for k, (file, damage, use) in files.items()}
    rows = ("keyframes/rows.safetensors",)
    found["keyframe-rows"] = Parser(complete, rows, mutations.safetensors, whole)
    pictures = ("keyframes/000003.jpg", "keyframes/000003.mask.png")
    found["keyframe-images"] = Parser(complete, pictures, mutations.binary, shown)
    exported = ("out/transforms.json", "out/masks/000003.png", "out/points.ply")
    found["export-nerfstudio"] = Parser(nerfstudio, exported[:1], mutations.json_text, read_back)
    found["export-nerfstudio-files"] = Parser(nerfstudio, exported[1:], mutations.binary, read_back)
    model = tuple(f"out/sparse/0/{name}.bin" for name in ("cameras", "images", "points3D"))
    masks = ("out/masks/000003.jpg.png",)
    found["export-colmap"] = Parser(colmap, model + masks, mutations.binary, read_back)
    return found


def given(folder: Path) -> None:
    """What ``--config`` reads."""
    read_settings(folder / "config.yaml", ReconstructConfig())


def complete(folder: Path) -> None:
    """A result with all that a run leaves, but for its mesh."""
    make_result(folder)
    trajectory = read_tum_trajectory(folder / "trajectory.tum")
    deviations = np.full(len(trajectory.timestamps), 0.01)
    known = Uncertainty(trajectory.timestamps, deviations, deviations, deviations)
    write_uncertainty(folder / "trajectory_uncertainty.csv", trajectory, known)
    (folder / "summary.json").write_text(json.dumps(SUMMARY))
    write_intrinsics(folder / "intrinsics.json", CAMERA)
    (folder / "truth.txt").write_bytes((folder / "trajectory.tum").read_bytes())
    (folder / "report").mkdir()
    size = tuple(-(-n // CELL) + 2 for n in (CAMERA.height, CAMERA.width))
    seen = SeenRows(torch.zeros(*size, 2).half(), torch.zeros(size).half())
    write_rows(rows_path(folder), {3: seen})


def page(folder: Path) -> None:
    """The page of what is read."""
    result = load_result(folder)
    write_page_anew(folder, result, result.mesh)


def whole(folder: Path) -> object:
    """What is read of a result before anything is computed."""
    found = load_result(folder)
    settings = mesh_settings(folder)
    return found.trajectory, found.camera, len(found.keyframes), found.rows(), settings


def shown(folder: Path) -> SurfaceMaps:
    """A result on its page, and a view of its map."""
    found = load_result(folder)
    views = shown_views(found)
    shown_model(found.trajectory, views, found.camera, None, found.disks, lengths(found.summary))
    id = int(found.views.keyframe_id[0])
    read_image(image_path(folder, 3))
    read_mask(mask_path(folder, 3))
    return found.keyframes[0], id


def judged(folder: Path) -> object:
    """A result beside the truth."""
    return evaluate(EvalSettings(folder, folder / "truth.txt", surface=False, plots=False))


def nerfstudio(folder: Path) -> None:
    """A result as nerfstudio takes it."""
    complete(folder)
    write_nerfstudio_set(folder / "out", load_result(folder), 50)


def colmap(folder: Path) -> None:
    """A result as COLMAP takes it."""
    complete(folder)
    write_colmap_set(folder / "out", load_result(folder), 50, as_text=False)


def read_back(folder: Path) -> object:
    """An export as the source of another reconstruction."""
    source = open_posed_source(folder / "out")
    return [(image.image, image.mask) for image in source], source.points
