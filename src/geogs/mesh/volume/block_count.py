"""Number of blocks of a volume, from every pixel of every view, and the voxel with which they fit.

A sample of the pixels suffices for a surface that many of them see. A scattered surface, such as
trees and the far end of an outdoor view, has further blocks for each further pixel.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.mesh.triangle_mesh import DepthMapView
from geogs.mesh.volume.contraction import Contraction
from geogs.mesh.volume.pixel_planes import PixelPlanes
from geogs.mesh.volume.tsdf import HALF, LIMIT, band_blocks, footprint_points, pack, unpack

COARSER = 1.1
"""Growth of the voxels from one trial to the next."""
_CELLS_PER_BLOCK = 3
"""Half blocks with surface, per block that fits, above which voxels are certainly too small."""


def fitting_voxel(
    views: Sequence[DepthMapView],
    voxel: float,
    truncation: float,
    max_depth: float,
    most: int,
    contraction: Contraction,
) -> tuple[float, int]:
    """The voxel, or the least one larger by steps of ``COARSER``, with which ``most`` blocks hold
    the surface of all views with its band; and the number of blocks.

    ``truncation`` is in voxels; pixels beyond ``max_depth`` are left out.
    """
    cells = torch.empty(0, dtype=torch.long, device=views[0].depth.device)
    for view in views:
        new = _cells(_surface(view, voxel, max_depth, contraction), voxel)
        cells = torch.unique(torch.cat([cells, new]))
        while len(cells) > _CELLS_PER_BLOCK * most:
            points = _centres(cells, voxel)
            voxel *= COARSER
            cells = torch.unique(_cells(points, voxel))
    return fitting(_centres(cells, voxel), voxel, truncation, most)


def fitting(
    points: Float[Tensor, "n 3"], voxel: float, truncation: float, most: int
) -> tuple[float, int]:
    """:func:`fitting_voxel` for a surface sampled by points of contracted space."""
    while (blocks := len(band_blocks(points, voxel, truncation))) > most:
        voxel *= COARSER
    return voxel, blocks


def _surface(
    view: DepthMapView, voxel: float, max_depth: float, contraction: Contraction
) -> Float[Tensor, "n 3"]:
    """Points of contracted space along the footprints of the pixels."""
    valid = view.valid() & (view.depth <= max_depth)
    T_cw = view.T_cw.to(view.depth.device, torch.float64)
    planes = PixelPlanes.of(view.depth.float(), valid, view.camera).grown(T_cw, contraction)
    return footprint_points(planes, T_cw, voxel, contraction)


def _cells(points: Float[Tensor, "n 3"], voxel: float) -> Int[Tensor, "n"]:
    """Keys of the half blocks that points lie in, except those out of the volume's reach."""
    cells = torch.floor(points / (voxel * HALF)).long()
    return pack(cells[(cells.abs() < LIMIT // HALF).all(-1)])


def _centres(cells: Int[Tensor, "n"], voxel: float) -> Float[Tensor, "n 3"]:
    return (unpack(cells).double() + 0.5) * (voxel * HALF)
