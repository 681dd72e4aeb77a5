"""The surface of a joint map: boxes of space, meshed concurrently and stitched here."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, UInt8
from torch import Tensor

from geogs.application.results.saved_result import load_result
from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.guard.documents import open_file
from geogs.io.writers.keyframe_folder import image_path, read_image
from geogs.mesh.blocks import (
    MeshBlock,
    blocks_of,
    boxes_of,
    expanded_mesh,
    mesh_block,
    near,
    sees_box,
    stitched_blocks,
)
from geogs.mesh.colour import colour_mesh
from geogs.mesh.decimation.decimate import decimate
from geogs.mesh.extract import VolumePlan, plan_volume
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.mesh.volume.tsdf import BYTES_PER_BLOCK, BlockBox
from geogs.on_demand import OnDemand
from geogs_fleet.workers import Workers


@dataclass(frozen=True)
class StoredView:
    """A depth map in a file."""

    file: Path
    image: Path
    camera: Camera
    T_cw: Float64[np.ndarray, "4 4"]

    def load(self, with_image: bool = False) -> DepthMapView:
        """Load the depth map, and the image if requested."""
        with open_file(self.file) as stored, np.load(stored, allow_pickle=False) as file:
            depth = torch.from_numpy(file["depth"])
            weight = torch.from_numpy(file["weight"])
        image = read_image(self.image) if with_image else None
        return DepthMapView(depth, weight.float(), self.camera, self.pose, image)

    @property
    def pose(self) -> Float[Tensor, "4 4"]:
        """World to camera; a copy, as Ray's arrays are read-only."""
        return torch.tensor(self.T_cw)


def loaded(views: Sequence[StoredView], with_images: bool = False) -> Sequence[DepthMapView]:
    """Sequence of views, each loaded on demand."""
    return OnDemand(views, lambda view: view.load(with_images))


def render_views(
    written: Path, places: Sequence[int], folder: Path, device: str = "cpu"
) -> list[StoredView]:
    """Render some keyframes of a written result into files of a folder."""
    result = load_result(written, device)
    made = []
    for n in places:
        T_cw = result.views.T_cw[n]
        maps = result.renderer.surface(torch.from_numpy(T_cw))
        file = folder / f"{n:06d}.npz"
        # The weights 0, a half and 1 are exact in half precision.
        np.savez(file, depth=maps.depth.cpu().numpy(), weight=maps.weight.cpu().half().numpy())
        image = image_path(written, int(result.views.keyframe_id[n]))
        made.append(StoredView(file, image, result.depth_camera, T_cw))
    return made


def equal_runs(count: int, parts: int) -> list[tuple[int, ...]]:
    """Split the numbers below ``count`` into ``parts`` runs of about equal length, none empty."""
    ends = np.linspace(0, count, min(max(parts, 1), max(count, 1)) + 1).round().astype(int)
    return [tuple(range(a, b)) for a, b in pairwise(ends) if b > a]


_BOXES_PER_WORKER = 3
"""Least number of boxes for each worker, so that none waits long for the last."""
_NO_FACES = np.zeros((0, 3), np.int32)


def occupied(views: Sequence[StoredView], plan: VolumePlan) -> Int[np.ndarray, "k 3"]:
    """Coordinates of the blocks that contain surface."""
    found = [blocks_of(view, plan) for view in loaded(views)]
    return torch.unique(torch.cat(found), dim=0).cpu().numpy()


def box_surface(
    views: Sequence[StoredView], plan: VolumePlan, box: BlockBox, min_weight: float, device: str
) -> MeshBlock:
    """Mesh of a box of space, from the views that may change it, in their order."""
    return mesh_block(loaded(views), plan, box, min_weight, device)


def colours_of(
    views: Sequence[StoredView],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    tolerance: float,
) -> UInt8[np.ndarray, "n 3"]:
    """Colours of points in the images."""
    mesh = Mesh(points.copy(), _NO_FACES, normals.copy())  # Ray's arrays are read-only
    colours = colour_mesh(mesh, loaded(views, True), tolerance).colours
    assert colours is not None
    return colours


@dataclass(frozen=True)
class SpacePlan:
    """Division of the space of all views into boxes."""

    volume: VolumePlan
    boxes: tuple[BlockBox, ...]
    views: tuple[tuple[StoredView, ...], ...]
    """Views that see each box."""


def plan_space(views: Sequence[StoredView], config: MeshConfig, workers: Workers) -> SpacePlan:
    """Choose voxels for all views, and boxes that each fit into the memory limit.

    Raises:
        InputError: no view has a valid depth.
    """
    volume = plan_volume(loaded(views), config)
    jobs = [
        (tuple(views[n] for n in run), volume)
        for run in equal_runs(len(views), _BOXES_PER_WORKER * workers.at_once)
    ]
    found = np.concatenate(workers.map("looking for surface", occupied, jobs))
    blocks = np.unique(found, axis=0)
    most = min(
        int(config.memory_limit * 2**30 / BYTES_PER_BLOCK),
        1 + len(blocks) // (_BOXES_PER_WORKER * workers.at_once if workers.at_once > 1 else 1),
    )
    boxes = boxes_of(blocks, most)
    seen = (tuple(v for v in views if sees_box(v.camera, v.pose, volume, box)) for box in boxes)
    return SpacePlan(volume, tuple(boxes), tuple(seen))


def joint_mesh(space: SpacePlan, config: MeshConfig, workers: Workers, device: str) -> Mesh:
    """Fuse, extract, colour, decimate and smooth.

    Except for the colours of points that no image shows, the mesh is that of one volume.

    Raises:
        InputError: there is no surface.
    """
    jobs = [
        (views, space.volume, box, config.min_weight, device)
        for box, views in zip(space.boxes, space.views, strict=True)
    ]
    blocks = workers.map("meshing", box_surface, jobs)
    mesh = stitched_blocks(blocks, space.volume, config)
    del blocks
    if config.colour:
        colours = coloured(mesh, 2 * space.volume.voxel, space, workers)
        mesh = Mesh(mesh.vertices, mesh.faces, mesh.normals, colours)
    voxel = space.volume.voxel
    few = decimate(mesh, config.detail * voxel, config.smoothing * voxel)
    return expanded_mesh(few, space.volume.contraction)


def coloured(
    mesh: Mesh, tolerance: float, space: SpacePlan, workers: Workers
) -> UInt8[np.ndarray, "n 3"]:
    """Colours of the vertices of a mesh in contracted space, box by box; grey where there is no
    box."""
    world = expanded_mesh(mesh, space.volume.contraction)
    colours = np.full((len(mesh.vertices), 3), 128, np.uint8)
    inside = [np.flatnonzero(near(mesh, box, space.volume)) for box in space.boxes]
    some = [n for n, at in enumerate(inside) if len(at)]
    jobs = [
        (space.views[n], world.vertices[inside[n]], world.normals[inside[n]], tolerance)
        for n in some
    ]
    for n, made in zip(some, workers.map("colouring", colours_of, jobs), strict=True):
        colours[inside[n]] = made
    return colours
