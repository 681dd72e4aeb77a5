"""Exports that are folders of images: COLMAP, nerfstudio, depth maps, normal maps."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool

from geogs.application.export.originals import keyframe_images
from geogs.application.export.seen_points import seen_points
from geogs.application.results.saved_result import SavedResult
from geogs.geometry.camera import Camera
from geogs.guard.atomic import atomic_file
from geogs.guard.documents import read_bytes
from geogs.io.sources.frame_source import Source
from geogs.io.writers.exports.colmap_writer import write_colmap_model
from geogs.io.writers.exports.exported import ExportedImage
from geogs.io.writers.exports.maps import (
    STEPS,
    depth_unit,
    write_depth_png,
    write_description,
    write_normal_png,
    write_npz,
)
from geogs.io.writers.exports.nerfstudio_writer import DEPTH_UNIT, write_transforms
from geogs.io.writers.keyframe_folder import image_path, write_image, write_mask
from geogs.io.writers.ply_writer import write_points


def write_colmap_set(
    folder: Path, result: SavedResult, points: int, as_text: bool, originals: Source | None = None
) -> None:
    """Write ``images/``, ``masks/`` and ``sparse/0/`` with about ``points`` points and tracks.

    Images are those of ``originals``, if given, at full size.

    Raises:
        InputError: the result has no images, or shows no surface.
        OutputError: a file cannot be written.
    """
    images = _write_images(folder, result, originals)
    camera = result.camera if originals is None else originals.camera
    for number, image in enumerate(images):
        mask = _mask(number, result, camera)
        if mask is not None:
            write_mask(folder / "masks" / f"{image.name}.png", mask)
    seen = seen_points(result.renders, camera, points)
    write_colmap_model(folder / "sparse" / "0", camera, images, seen, as_text)


def write_nerfstudio_set(
    folder: Path, result: SavedResult, points: int, originals: Source | None = None
) -> None:
    """Write ``transforms.json``, start points, images, and depth, normals and masks of their size.

    Images are those of ``originals``, if given, at full size.

    Raises:
        InputError: the result has no images, or shows no surface.
        OutputError: a file cannot be written.
    """
    images = _write_images(folder, result, originals)
    camera = result.camera if originals is None else originals.camera
    unit = _nerfstudio_unit(result)
    masked = []
    for number, image in enumerate(images):
        name = Path(image.name).with_suffix(".png").name
        mask = _mask(number, result, camera)
        masked.append(mask is not None)
        if mask is not None:
            write_mask(folder / "masks" / name, mask)
        depth, normal = _maps(number, result, camera)
        write_depth_png(folder / "depth" / name, depth, unit)
        write_normal_png(folder / "normals" / name, normal)
    seen = seen_points(result.renders, camera, points)
    write_points(folder / "points.ply", seen.positions, seen.colours, seen.normals)
    path = folder / "transforms.json"
    write_transforms(path, camera, images, masked, unit)


def write_map_set(folder: Path, result: SavedResult, kind: Literal["depth", "normals"]) -> None:
    """Write a PNG and an NPZ of image size for every keyframe, and ``description.json``.

    Raises:
        OutputError: a file cannot be written.
    """
    unit = depth_unit(_farthest(result))
    for number, id in enumerate(result.views.keyframe_id.tolist()):
        path = folder / f"{id:06d}.png"
        depth, normal = _maps(number, result, result.camera)
        if kind == "depth":
            write_depth_png(path, depth, unit)
            write_npz(path.with_suffix(".npz"), "depth", depth)
        else:
            write_normal_png(path, normal)
            write_npz(path.with_suffix(".npz"), "normal", normal)
    poses = {
        f"{id:06d}": T.tolist()
        for id, T in zip(result.views.keyframe_id, result.views.T_cw, strict=True)
    }
    layouts: dict[str, object] = {
        "depth": {
            "png": f"z along the optical axis in steps of {unit:g} map units, 0 unknown",
            "png_unit": unit,
            "npz": "the same in map units",
        },
        "normals": {
            "png": f"2 v / {STEPS} - 1 of red, green, blue is x, y, z; black is unknown",
            "npz": "x, y, z",
            "frame": "camera: x right, y down, z forward",
        },
    }
    metadata = {"values": layouts[kind], "T_cw": poses}
    write_description(folder / "description.json", result.camera, metadata)


def _write_images(
    folder: Path, result: SavedResult, originals: Source | None
) -> list[ExportedImage]:
    """Copy the stored images, or write the originals. Returns their names and poses."""
    views = result.views
    names = [image_path(result.folder, id).name for id in views.keyframe_id.tolist()]
    images = [ExportedImage(name, T_cw) for name, T_cw in zip(names, views.T_cw, strict=True)]
    if originals is not None:
        for number, image in keyframe_images(result, originals):
            write_image(folder / "images" / names[number], image)
        return images
    result.require_images()
    for number, id in enumerate(views.keyframe_id.tolist()):
        result.image(number)  # checks that it is a picture, even through a link
        with atomic_file(folder / "images" / names[number]) as stream:
            stream.write(read_bytes(image_path(result.folder, id)))
    return images


def _mask(number: int, result: SavedResult, camera: Camera) -> Bool[np.ndarray, "h w"] | None:
    """The mask of a keyframe as a camera with its pose sees it; none if it has none."""
    mask = result.mask(number)
    if mask is None:
        return None
    pixels = camera.rays(torch.float64).numpy()
    own = result.depth_camera
    u = (own.fx * pixels[..., 0] + own.cx).astype(np.float32)
    v = (own.fy * pixels[..., 1] + own.cy).astype(np.float32)
    return cv2.remap(mask.astype(np.uint8), u, v, cv2.INTER_NEAREST) > 0


def _maps(number: int, result: SavedResult, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and normals of a keyframe inside its mask, as a camera with its pose sees them."""
    maps = result.renderer.surface(torch.from_numpy(result.views.T_cw[number]), camera)
    depth = maps.depth.cpu().numpy()
    normal = maps.normal.cpu().numpy()
    mask = _mask(number, result, camera)
    if mask is not None:
        depth = np.where(mask, depth, 0)
        normal = np.where(mask[..., None], normal, 0)
    return depth.astype(np.float32), normal.astype(np.float32)


def _farthest(result: SavedResult) -> float:
    return max((float(keyframe.depth.max()) for keyframe in result.renders), default=0.0)


def _nerfstudio_unit(result: SavedResult) -> float:
    """nerfstudio's default unit of depth where its resolution and range suffice."""
    farthest = _farthest(result)
    return DEPTH_UNIT if 0.5 < farthest < DEPTH_UNIT * STEPS else depth_unit(farthest)
