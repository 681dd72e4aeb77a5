"""A result read from its folder by ``load_result``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8

from geogs.application.results.output_folder import claimed, read_summary
from geogs.application.results.upright import upright
from geogs.application.results.verdict import Verdict
from geogs.camera.shutter.rows import CELL
from geogs.config.arguments import checks_arguments
from geogs.errors import InputError
from geogs.evaluation.model_view.levelling import Level
from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import GivenPose
from geogs.geometry.lie import se3_inverse
from geogs.guard.documents import UNUSABLE, expanded
from geogs.guard.replacement import is_half_done
from geogs.io.pictures import upright_size
from geogs.io.pose_files import read_frame_poses
from geogs.io.writers.keyframe_folder import (
    image_path,
    mask_path,
    read_image,
    read_mask,
    read_rows,
    rows_path,
)
from geogs.io.writers.map_file import MapViews, load_map_views
from geogs.io.writers.uncertainty import read_states
from geogs.mapping.map_frame import MapFrame
from geogs.mapping.rendered import MapRenderer, RenderedView, SurfaceRules
from geogs.mesh.mesh_file import read_mesh
from geogs.mesh.triangle_mesh import Mesh
from geogs.on_demand import OnDemand
from geogs.short_repr import ShortRepr
from geogs.threads import on_one_torch_thread
from geogs.tracking.frames.interpolation import bridged
from geogs.types import MapSnapshot, RenderedKeyframe, SeenRows, Trajectory

_MOST_UNSEEN = 1 << 24
"""Most pixels of a depth map in a result that has no images."""


@dataclass(frozen=True, slots=True, repr=False)
class SavedKeyframe(ShortRepr):
    """A keyframe of a result, with the map rendered from it."""

    keyframe_id: int
    timestamp: float
    """Seconds."""
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera."""
    camera: Camera
    """Camera of the maps."""
    depth: Float32[np.ndarray, "h w"]
    """z in map units; 0 where the map is too thin."""
    normal: Float32[np.ndarray, "h w 3"]
    """Camera frame, unit and facing the camera; zero where there is no depth."""
    weight: Float32[np.ndarray, "h w"]
    """Confidence of the depth in [0, 1]."""
    image: UInt8[np.ndarray, "h2 w2 3"] | None
    """RGB at working resolution; None in a result that was written without images."""
    mask: Bool[np.ndarray, "h w"] | None
    """Pixels that belong to the scene; None where all do."""

    @staticmethod
    def of(seen: RenderedKeyframe) -> "SavedKeyframe":
        """Copy a rendered keyframe from its device."""
        return SavedKeyframe(
            seen.keyframe_id,
            seen.timestamp,
            seen.T_cw.numpy(),
            seen.camera,
            seen.depth.cpu().numpy(),
            seen.normal.cpu().numpy(),
            seen.weight.cpu().numpy(),
            seen.image,
            None if seen.mask is None else seen.mask.cpu().numpy(),
        )


@dataclass(frozen=True, repr=False)
class SavedResult:
    """A result of ``geogs run`` or ``geogs reconstruct`` in a folder; files are read on demand.

    Poses are world to camera where they are called ``T_cw``; lengths are in map units.
    """

    folder: Path
    disks: MapSnapshot
    """Disks in the world, on the chosen device."""
    views: MapViews
    rotation: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """From the world of the files to that of disks, views, trajectory and mesh."""

    def __repr__(self) -> str:
        counts = f"{len(self.views.keyframe_id)} keyframes, {len(self.disks)} disks"
        return f"SavedResult({str(self.folder)!r}: {counts})"

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    @property
    def camera(self) -> Camera:
        """Camera of the keyframes' images."""
        return self.views.camera

    @property
    def depth_camera(self) -> Camera:
        """Camera of the keyframes' depth maps."""
        return self.views.render_camera

    @cached_property
    def upright(self) -> Level:
        """Upright orientation, as the page shows it. Raises InputError if a file is damaged."""
        return upright(self.trajectory, self.mesh)

    def rotated(self, R: Float64[np.ndarray, "3 3"]) -> "SavedResult":
        """The result in a world that ``R`` maps this one to; files are read as they are."""
        disks = self.disks.rotated(R)
        views = self.views.rotated(R)
        return replace(self, disks=disks, views=views, rotation=R @ self.rotation)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of all frames; frames of unknown position are interpolated between neighbours.

        Raises InputError if a file of them is missing or damaged.
        """
        return self._tracked().rotated(self.rotation)

    def _tracked(self) -> Trajectory:
        """Poses of all frames in the world of the files."""
        poses = read_frame_poses(self.folder)
        table = self.folder / "trajectory_uncertainty.csv"
        if not table.is_file():
            return poses
        T = se3_inverse(torch.from_numpy(poses.T_wc))
        T_cw = dict(zip(poses.timestamps.tolist(), T, strict=True))
        frames = read_states(table)
        known = [T_cw.get(t) if state == "tracked" else None for t, state, _ in frames]
        turned = [T_cw.get(t) if state == "orientation only" else None for t, state, _ in frames]
        only = [None if T is None else T[:3, :3] for T in turned]
        if not any(T is not None for T in known):
            raise InputError(f"{table} names no tracked frame of trajectory.tum; leave it out.")
        return bridged(np.array([t for t, _, _ in frames]), known, only)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Content of ``summary.json``. Raises InputError if it is missing or damaged."""
        return read_summary(self.folder)

    @cached_property
    def mesh(self) -> Mesh | None:
        """The mesh as it was written; none if there is none. Raises InputError if it is damaged."""
        path = self.folder / "mesh.ply"
        return read_mesh(path).rotated(self.rotation) if path.is_file() else None

    @cached_property
    def verdict(self) -> Verdict | None:
        """Reliability of trajectory and shape; none where the poses were given.

        Raises InputError if ``summary.json`` is missing or damaged.
        """
        said = self.summary.get("verdict")
        try:
            return None if said is None else _verdict(said)
        except UNUSABLE as error:
            path = self.folder / "summary.json"
            raise InputError(f"{path} is damaged; its verdict is none.") from error

    @cached_property
    def keyframes(self) -> Sequence[SavedKeyframe]:
        """Image, pose, depth, normal and weight of the keyframes, rendered on demand, as arrays."""
        return OnDemand(self.renders, SavedKeyframe.of)

    @cached_property
    def renders(self) -> Sequence[RenderedKeyframe]:
        """The same, with tensors on the device of the disks."""
        return OnDemand(range(len(self.views.keyframe_id)), self._keyframe)

    @cached_property
    def renderer(self) -> MapRenderer:
        """Renderer of the map from any pose."""
        views = self.views
        frame = MapFrame(views.origin, views.unit)
        rules = SurfaceRules(views.min_alpha, views.max_spread, views.plane_reach)
        return MapRenderer(views.disks, frame, views.render_camera, rules)

    @on_one_torch_thread
    def render(self, T_cw: GivenPose, camera: Camera | None = None) -> RenderedView:
        """The map seen from a pose; as :meth:`MapRenderer.render`."""
        return self.renderer.render(T_cw, camera)

    def rows(self) -> dict[int, SeenRows]:
        """Rolling-shutter rows of the keyframes, by their index.

        Raises InputError if the file is damaged.
        """
        path = rows_path(self.folder)
        place = {id: number for number, id in enumerate(self.views.keyframe_id.tolist())}
        size = tuple(-(-n // CELL) + 2 for n in (self.camera.height, self.camera.width))
        rows = {place[id]: r for id, r in read_rows(path).items() if id in place}
        if any(r.seconds.shape != size for r in rows.values()):
            raise InputError(f"{path} is of another size than the result says; was it changed?")
        return rows

    def require_images(self) -> None:
        """Raise InputError where the images of the keyframes were not kept."""
        if not self.views.has_images:
            raise InputError("The result was written without keyframe images, which this needs.")

    def image(self, number: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """The image of a keyframe, by its index; none if the result has none.

        Raises InputError if its file is missing, damaged or of another size.
        """
        if not self.views.has_images:
            return None
        path = image_path(self.folder, int(self.views.keyframe_id[number]))
        image = read_image(path)
        _check_size(path, image, self.camera)
        return image

    def mask(self, number: int) -> Bool[np.ndarray, "h w"] | None:
        """The mask of a keyframe's depth, by its index; none if it has none.

        Raises InputError if its file is missing, damaged or of another size.
        """
        if not self.views.has_mask[number]:
            return None
        path = mask_path(self.folder, int(self.views.keyframe_id[number]))
        mask = read_mask(path)
        _check_size(path, mask, self.depth_camera)
        return mask

    def image_mask(self, number: int) -> Bool[np.ndarray, "h w"] | None:
        """The mask of a keyframe at the size of its image; none if it has none."""
        mask = self.mask(number)
        size = (self.camera.width, self.camera.height)
        if mask is None:
            return None
        return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0

    @on_one_torch_thread
    def _keyframe(self, number: int) -> RenderedKeyframe:
        views = self.views
        number = range(len(views.keyframe_id))[number]
        id = int(views.keyframe_id[number])
        mask = None
        T_cw = torch.from_numpy(views.T_cw[number])
        if (stored := self.mask(number)) is not None:
            mask = torch.from_numpy(stored).to(self.disks.position.device)
        image = self.image(number)
        maps = self.renderer.surface(T_cw, mask=mask)
        seconds = float(views.timestamp[number])
        return RenderedKeyframe(id, self.depth_camera, T_cw, *maps, image, seconds, mask)


def _verdict(said: dict[str, Any]) -> Verdict:
    """The verdict of a summary, which has none in place of infinity."""
    known = {f.name: f.type for f in fields(Verdict) if f.name in said}
    values = {name: math.inf if said[name] is None else said[name] for name in known}
    return Verdict(**{name: kind(values[name]) for name, kind in known.items()})  # type: ignore[operator]


@checks_arguments
@on_one_torch_thread
def load_result(folder: str | Path, device: torch.device | str = "cpu") -> SavedResult:
    """Read a result from its folder; the map goes to ``device``, where it is rendered.

    Raises:
        InputError: there is no result, it is damaged, or an older geogs wrote it.
        OutputError: a command was interrupted while replacing it, and that cannot be completed.
    """
    folder = result_folder(folder)
    result = SavedResult(folder, *load_map_views(folder / "map.safetensors", device))
    _check_render_size(result)
    return result


def _check_render_size(result: SavedResult) -> None:
    """Raise InputError where the first image does not confirm the size that the map states.

    That size bounds that of depth maps. Where there is no image, they have a fixed bound.
    """
    path = image_path(result.folder, int(next(iter(result.views.keyframe_id), 0)))
    size = upright_size(path) if result.views.has_images else None
    depth = result.depth_camera
    if size is None and depth.width * depth.height > _MOST_UNSEEN:
        raise InputError(
            f"{result.folder} asks for depth maps far larger than any; was it changed?"
        )
    if size not in (None, (result.camera.width, result.camera.height)):
        raise InputError(f"{path} is of another size than the result says; was it changed?")


def result_folder(folder: str | Path) -> Path:
    """The folder of a result; an interrupted replacement is completed.

    Raises:
        InputError: there is no result.
        OutputError: as of ``load_result``.
    """
    folder = expanded(folder)
    if is_half_done(folder):
        with claimed(folder):
            pass
    if not (folder / "map.safetensors").is_file():
        raise InputError(f"{folder} holds no result of geogs: there is no map.safetensors in it.")
    return folder


def _check_size(path: Path, picture: np.ndarray, camera: Camera) -> None:
    """Raise InputError if a picture of the result is not of the size given by the map."""
    if picture.shape[:2] != (camera.height, camera.width):
        raise InputError(f"{path} is of another size than the result says; was it changed?")
