"""Mesh extraction from depth maps in one call."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.mesh.clean import cleaned
from geogs.mesh.colour import filled, seen_colours
from geogs.mesh.decimation.decimate import merged
from geogs.mesh.denoise import denoised
from geogs.mesh.tensor_mesh import TensorMesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.mesh.volume.contraction import UNCONTRACTED, Contraction
from geogs.mesh.volume.free_space import FreeSpace
from geogs.mesh.volume.level_set import device_surface, extract_surface
from geogs.mesh.volume.pixel_planes import PixelPlanes
from geogs.mesh.volume.tsdf import (
    BLOCK,
    BYTES_PER_BLOCK,
    HALF,
    LIMIT,
    SparseTsdf,
    band_blocks,
    footprint_points,
    pack,
    unpack,
)
from geogs.threads import on_one_torch_thread

_log = logging.getLogger(__name__)
_SAMPLED_VIEWS = 40
_SAMPLED_POINTS = 400_000
_MOST_OUT_OF_REACH = 0.05
"""Fraction of the surface that may lie beyond the volume, as stray points do."""
_CROWDED = 0.1
"""Fraction of the memory limit, estimated from a sample of the pixels, above which the blocks of
all pixels are counted: a scattered surface, as outdoors, has several times as many."""
_COARSEST = 4.0
"""Largest ratio of the voxel to the footprint of the nearest tenth of the pixels, if there is room
for smaller ones: a background may fill most of the image behind near surfaces."""
_AROUND = 0.95
"""Quantile of the distances of cameras and of surface from the middle."""
_FAR = 4.0
"""Ratio of the surface's distance to the radius of the scene around the cameras above which there
is a background, which is contracted."""
_OVERRUN = 1.5
"""Factor on the memory limit that a volume may take, as the plan may be from a sample."""
_COARSER = 1.5
"""Growth of the voxels from one fusion to the next."""
_SLIGHTLY_COARSER = 1.1
"""Growth of the voxels from one count of the blocks to the next."""
_CELLS_PER_BLOCK = 3
"""Half blocks with surface, per block that fits, above which voxels are certainly too small."""
_FACES_PER_SQUARE = 2.4
"""Approximate number of triangles of marching cubes per voxel face of surface."""


@dataclass(frozen=True, slots=True)
class VolumePlan:
    """Plan of a scene's fusion, chosen from its depth maps."""

    voxel: float
    """Side of a voxel, map units where space is not contracted."""
    truncation: float
    """Truncation distance, voxels."""
    max_depth: float
    """Map units; pixels farther away are left out."""
    blocks: int
    """Estimated number of blocks."""
    triangles: int
    """Estimated number of triangles before those that the surface does not need are merged."""
    contraction: Contraction = UNCONTRACTED
    """Contraction of the space in which the voxels are a grid."""

    @property
    def bytes(self) -> int:
        """Estimated memory of the volume; extraction needs little more."""
        return self.blocks * BYTES_PER_BLOCK


@on_one_torch_thread
def plan_volume(views: Sequence[DepthMapView], config: MeshConfig) -> VolumePlan:
    """Choose voxel size and depth range from the depth maps, before anything is allocated.

    The voxel is the footprint of a pixel at the median depth, smaller if near surfaces are much
    nearer than that, larger if the triangle budget or the memory limit demand it. A background far
    beyond the cameras and their surroundings is contracted. The depth range is twice the 95 %
    quantile, so that a few stray far pixels do not blow up the volume. At most 40 views are used.

    Raises InputError if no pixel has a depth, or a voxel size is given that does not fit into the
    memory limit or whose volume does not reach as far as the scene.
    """
    stride = max(1, len(views) // _SAMPLED_VIEWS)
    sampled = views[::stride]
    depths, footprints, points = _sample_points(sampled)
    if not len(depths):
        raise InputError("No depth map has a valid pixel, so there is no surface to extract.")
    max_depth = 2 * float(depths.quantile(0.95))
    voxel = float(min(footprints.median(), _COARSEST * footprints.quantile(0.1)))
    near = float(depths[footprints <= voxel].amax())
    points = points[depths <= max_depth]
    contraction = _contraction([view.T_cw for view in sampled], points, near)
    points = contraction.contracted(points)
    if config.voxel is not None:
        voxel = config.voxel
        blocks = _blocks_of_given_voxel(points, config.voxel, config)
        faces = _FACES_PER_SQUARE * _area(points, voxel)
    else:
        faces = _FACES_PER_SQUARE * _area(points, voxel)
        voxel = max(voxel, math.sqrt(faces / config.triangle_budget))
        voxel, blocks = _fitting(points, voxel, config.truncation, _most_blocks(config))
    triangles = round(faces / voxel**2)
    return VolumePlan(voxel, config.truncation, max_depth, blocks, triangles, contraction)


def _blocks_of_given_voxel(points: Float[Tensor, "n 3"], voxel: float, config: MeshConfig) -> int:
    """Blocks around a surface; InputError if they are too many or do not reach far enough."""
    reach = LIMIT * voxel
    if float((points.abs() > reach).any(1).double().mean()) > _MOST_OUT_OF_REACH:
        raise InputError(
            f"A voxel of {voxel:g} is too small: the volume would end at {reach:.3g} map units, "
            "within the scene; use a larger voxel or leave it to be chosen."
        )
    blocks = len(band_blocks(points, voxel, config.truncation))
    if blocks * BYTES_PER_BLOCK > config.memory_limit * 2**30:
        raise InputError(
            f"A voxel of {voxel:g} needs about {blocks * BYTES_PER_BLOCK / 2**30:.1f} GiB for the "
            f"volume, more than the limit of {config.memory_limit:g}; use a larger voxel or leave "
            "it to be chosen."
        )
    return blocks


def _most_blocks(config: MeshConfig) -> int:
    """Blocks that fit into the memory limit."""
    return int(config.memory_limit * 2**30 / BYTES_PER_BLOCK)


@on_one_torch_thread
def extract_mesh(
    views: Sequence[DepthMapView],
    config: MeshConfig | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Mesh:
    """Fuse depth maps; return their surface cleaned, coloured by images, decimated and smoothed.

    ``views`` is iterated up to four times (plan, count, fuse, colour) in order, so a lazy sequence
    may render on demand. If a sample of the pixels predicts a volume near its limit, all are
    counted, and voxels are enlarged until they fit; if it exceeds the limit by half it is fused
    again with larger ones. The work is done on the device of the first depth map. ``progress`` is
    called with the stage ("fuse", "colour", "merge"), the finished steps of it and their total.

    Raises InputError if there are no views, no valid depth or no surface.
    """
    config = config or MeshConfig()
    if not len(views):
        raise InputError("There are no depth maps to make a mesh from.")
    plan = plan_volume(views, config)
    if config.voxel is None and plan.bytes > _CROWDED * config.memory_limit * 2**30:
        plan = _counted(plan, views, config)
    _log.info("voxel %.4g, about %.0f MiB", plan.voxel, plan.bytes / 2**20)
    most = _OVERRUN * config.memory_limit * 2**30
    while (tsdf := fuse(views, plan, progress, most)) is None:
        if config.voxel is not None:
            raise InputError(
                f"A voxel of {config.voxel:g} needs more than {most / 2**30:.1f} GiB for the "
                "volume; use a larger voxel or leave it to be chosen."
            )
        plan = replace(plan, voxel=_COARSER * plan.voxel)
        _log.info("too large: voxel %.4g", plan.voxel)
    extract = extract_surface if tsdf.device.type == "cpu" else device_surface
    found = extract(tsdf, config.min_weight)
    is_free = FreeSpace.of(tsdf, config.min_weight)
    del tsdf  # takes most of the memory
    surface, normals = cleaned(found, config, is_free)
    seen = None
    if config.colour and any(view.image is not None for view in views):
        report = None if progress is None else lambda done, of: progress("colour", done, of)
        world = _expanded(surface, normals, plan.contraction)
        seen = seen_colours(*world, views, 2 * plan.voxel, report)
        del world
    if progress:
        progress("merge", 0, 1)
    mesh = _merged_mesh(surface, normals, seen, config, plan)
    if progress:
        progress("merge", 1, 1)
    return mesh


def _counted(plan: VolumePlan, views: Sequence[DepthMapView], config: MeshConfig) -> VolumePlan:
    """The plan with all pixels of all views counted.

    A sample of the pixels suffices for a surface that many of them see. A scattered surface, such
    as trees and the far end of an outdoor view, has further blocks for each further pixel.
    """
    voxel, blocks = fitting_voxel(views, plan, _most_blocks(config))
    triangles = round(plan.triangles * (plan.voxel / voxel) ** 2)
    return replace(plan, voxel=voxel, blocks=blocks, triangles=triangles)


def fitting_voxel(views: Sequence[DepthMapView], plan: VolumePlan, most: int) -> tuple[float, int]:
    """The planned voxel, or the least one larger by steps of 10 %, with which ``most`` blocks hold
    the surface of all views with its band; and the number of blocks."""
    voxel = plan.voxel
    cells = torch.empty(0, dtype=torch.long, device=views[0].depth.device)
    for view in views:
        planes, T_cw = pixel_planes(view, plan)
        points = footprint_points(planes, T_cw, voxel, plan.contraction)
        cells = torch.unique(torch.cat([cells, _half_blocks(points, voxel)]))
        while len(cells) > _CELLS_PER_BLOCK * most:
            points = _centres(cells, voxel)
            voxel *= _SLIGHTLY_COARSER
            cells = torch.unique(_half_blocks(points, voxel))
    return _fitting(_centres(cells, voxel), voxel, plan.truncation, most)


def _fitting(
    points: Float[Tensor, "n 3"], voxel: float, truncation: float, most: int
) -> tuple[float, int]:
    """:func:`fitting_voxel` for a surface sampled by points of contracted space."""
    while (blocks := len(band_blocks(points, voxel, truncation))) > most:
        voxel *= _SLIGHTLY_COARSER
    return voxel, blocks


def pixel_planes(view: DepthMapView, plan: VolumePlan) -> tuple[PixelPlanes, Float[Tensor, "4 4"]]:
    """Planes of the pixels of a view up to the planned depth, and its pose on their device."""
    valid = view.valid() & (view.depth <= plan.max_depth)
    T_cw = view.T_cw.to(view.depth.device, torch.float64)
    planes = PixelPlanes.of(view.depth.float(), valid, view.camera)
    return planes.grown(T_cw, plan.contraction), T_cw


def _half_blocks(points: Float[Tensor, "n 3"], voxel: float) -> Int[Tensor, "n"]:
    """Keys of the half blocks that points lie in, except those out of the volume's reach."""
    cells = torch.floor(points / (voxel * HALF)).long()
    return pack(cells[(cells.abs() < LIMIT // HALF).all(-1)])


def _centres(cells: Int[Tensor, "n"], voxel: float) -> Float[Tensor, "n 3"]:
    return (unpack(cells).double() + 0.5) * (voxel * HALF)


def _expanded(
    mesh: TensorMesh, normals: Float[Tensor, "n 3"], contraction: Contraction
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Vertices and normals of a mesh of contracted space in the world."""
    if not contraction:
        return mesh.vertices, normals
    world = TensorMesh(contraction.expanded(mesh.vertices), mesh.faces)
    return world.vertices, world.normals()


def _merged_mesh(
    surface: TensorMesh,
    normals: Float[Tensor, "n 3"],
    seen: tuple[Tensor, Tensor] | None,
    config: MeshConfig,
    plan: VolumePlan,
) -> Mesh:
    """Decimate and smooth a surface in contracted space; return it in the world and on the host,
    with the colours of the vertices that were seen.

    Unseen vertices take their colours only now, when there are few.
    """
    few = merged(surface.vertices, surface.faces.to(torch.int32), config.detail * plan.voxel)
    if few is not None:
        vertices = denoised(few.position, few.faces, config.smoothing * plan.voxel).float()
        surface = TensorMesh(vertices, few.faces.long())
        normals = surface.normals()
        seen = None if seen is None else few.means(*seen)
    colours = None if seen is None else filled(surface.vertices, *seen).cpu().numpy()
    vertices, normals = _expanded(surface, normals, plan.contraction)
    faces = surface.faces.to(torch.int32)
    return Mesh(vertices.cpu().numpy(), faces.cpu().numpy(), normals.cpu().numpy(), colours)


def fuse(
    views: Sequence[DepthMapView],
    plan: VolumePlan,
    progress: Callable[[str, int, int], None] | None = None,
    most: float = math.inf,
) -> SparseTsdf | None:
    """Fuse all views in one volume, on the device of the first depth map; None as soon as that
    takes more than ``most`` bytes."""
    device = views[0].depth.device
    tsdf = SparseTsdf(
        plan.voxel, plan.truncation, device, plan.blocks, contraction=plan.contraction
    )
    for number, view in enumerate(views):
        integrate(tsdf, view, plan)
        if len(tsdf) * BYTES_PER_BLOCK > most:
            return None
        if progress:
            progress("fuse", number + 1, len(views))
    return tsdf


def integrate(tsdf: SparseTsdf, view: DepthMapView, plan: VolumePlan) -> None:
    """Fuse a view into a volume, without pixels beyond the planned depth."""
    weight = torch.where(view.depth <= plan.max_depth, view.weight, 0.0)
    tsdf.integrate(view.depth, weight, view.camera, view.T_cw)


def _sample_points(
    views: Sequence[DepthMapView],
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Depths, pixel footprints and world points of a regular subset of all pixels."""
    depths = []
    footprints = []
    points = []
    step = 0
    for view in views:
        if not step:  # a view may be rendered on access; they are of one size
            pixels = len(views) * view.depth.numel()
            step = max(1, round((pixels / _SAMPLED_POINTS) ** 0.5))
        valid = view.valid()[::step, ::step]
        depth = view.depth[::step, ::step][valid].double()
        rays = view.camera.rays(torch.float64, depth.device)[::step, ::step][valid]
        T_cw = view.T_cw.to(depth)
        depths.append(depth)
        footprints.append(depth / (0.5 * (view.camera.fx + view.camera.fy)))
        points.append((rays * depth[:, None] - T_cw[:3, 3]) @ T_cw[:3, :3])
    return torch.cat(depths), torch.cat(footprints), torch.cat(points)


def _contraction(
    poses: Sequence[Float[Tensor, "4 4"]], points: Float[Tensor, "n 3"], near: float
) -> Contraction:
    """The contraction of a scene's background; none where there is no background.

    Around the cameras, up to the depth ``near``, space stays as it is.
    """
    centres = torch.stack([-(T[:3, :3].mT @ T[:3, 3]) for T in poses]).to(points)
    middle = centres.mean(0)
    radius = float((centres - middle).norm(dim=1).quantile(_AROUND)) + near
    if not len(points) or (points - middle).norm(dim=1).quantile(_AROUND) <= _FAR * radius:
        return UNCONTRACTED
    x, y, z = middle.tolist()
    return Contraction((x, y, z), radius)


def _area(points: Float[Tensor, "n 3"], voxel: float) -> float:
    """Area of the surface through the points.

    It is that of the cells of a coarse grid that hold a point: a plane at any slant meets about 1.5
    cells of area side^2 per side^2.
    """
    side = BLOCK * voxel
    cells = len(torch.unique(pack(torch.floor(points / side).long())))
    return cells * side**2 / 1.5
