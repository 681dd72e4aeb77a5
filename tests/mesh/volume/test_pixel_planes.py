"""Pixels as planes against the analytic plane, and a floor that is seen at a slant only."""

import math

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.geometry.camera import Camera
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import DepthMapView
from geogs.mesh.volume.pixel_planes import LEAST_BAND, PixelPlanes, widest

CAMERA = Camera(fx=120.0, fy=120.0, cx=79.5, cy=59.5, width=160, height=120)
EYE = torch.eye(4, dtype=torch.float64)


def plane_depth(normal: torch.Tensor, farthest: float = 1e3) -> torch.Tensor:
    """Depth of the plane normal . X = 1, 0 where it is farther."""
    inverse = CAMERA.rays(torch.float64) @ normal
    return torch.where(inverse > 1 / farthest, 1 / inverse, 0.0).float()


def slanted(degrees: float) -> torch.Tensor:
    """Normal that the axis meets at an angle, turned out of the image's rows and columns."""
    a = math.radians(degrees)
    return torch.tensor([0.6 * math.sin(a), 0.8 * math.sin(a), math.cos(a)]).double()


@pytest.mark.parametrize("degrees", [45, 80, 86, 89])
def test_what_is_seen_edge_on_counts_less(degrees):
    normal = slanted(degrees)
    depth = plane_depth(normal, 6.0)
    planes = PixelPlanes.of(depth, depth > 0, CAMERA)
    weight = planes.table(torch.full_like(depth, 0.5))[:, 3].view_as(depth)
    along_axis = (CAMERA.rays(torch.float64) @ normal).float()
    reference = 0.5 * (along_axis / 0.1).square().clamp(0.1, 1)
    shrunk = torch.nn.functional.max_pool2d(-(depth > 0)[None].float(), 7, 1, 3)[0] < -0.5
    shrunk[:3], shrunk[-3:], shrunk[:, :3], shrunk[:, -3:] = False, False, False, False
    assert shrunk.sum() > 500
    assert weight[shrunk] == pytest.approx(reference[shrunk], rel=0.02)
    assert (weight[depth <= 0] == 0).all()


@pytest.mark.parametrize("degrees", [0, 45, 75, 84])
def test_truncation_is_half_along_the_normal_at_least(degrees):
    normal = slanted(degrees)
    depth = plane_depth(normal, 6.0)
    truncation = PixelPlanes.of(depth, depth > 0, CAMERA).truncation(0.08)
    # Of a step along the axis at the pixel, the part along the unit normal.
    along_axis = (CAMERA.rays(torch.float64) @ normal).float().flatten()
    reference = 0.08 * (LEAST_BAND / along_axis).clamp(min=1)
    inside = torch.zeros_like(depth, dtype=torch.bool)
    inside[3:-3, 3:-3] = (depth > 0)[3:-3, 3:-3]
    for _ in range(3):
        inside[1:] &= (depth > 0)[:-1]
        inside[:, 1:] &= (depth > 0)[:, :-1]
    inside &= depth < 4  # away from where it ends
    inside = inside.flatten()
    assert inside.float().mean() > 0.1
    assert truncation[inside] == pytest.approx(reference[inside], rel=2e-3)
    assert truncation.max() <= widest(0.08)


def test_footprints_leave_no_gaps_on_a_floor():
    """Points along the floor's footprints lie on it, one behind the other no farther than asked."""
    depth = plane_depth(torch.tensor([0.0, 1.0, 0.0]).double(), 8.0)  # the floor, 1 below the eye
    points = PixelPlanes.of(depth, depth > 0, CAMERA).footprints(0.05).double()
    assert (points[:, 1] - 1).abs().max() < 1e-4
    column = points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx
    gaps = points[(column - 80).abs() < 0.4, 2].sort().values.diff()
    gaps = gaps[: int(0.8 * len(gaps))]
    assert gaps.max() < 0.06
    assert gaps.max() > 0.03
    rows = (depth[:, 80] > 0) & (depth[:, 80] < 5)
    assert depth[rows, 80].diff().abs().max() > 0.15  # of the pixels themselves


def test_a_pixel_between_two_walls_is_no_slope():
    """A step with a blurred pixel on it: the truncation stays what it is, the point is one."""
    depth = torch.full((120, 160), 2.0)
    depth[:, 81:] = 1.0
    depth[:, 80] = 1.4
    planes = PixelPlanes.of(depth, depth > 0, CAMERA)
    assert (planes.truncation(0.08) == 0.08).all()
    assert len(planes.footprints(0.01)) == depth.numel()


def test_a_floor_seen_at_a_slant_is_whole():
    """A camera drives 0.4 above a floor and sees it at 3 to 8 degrees: the mesh covers it."""
    depth, views = plane_depth(torch.tensor([0.0, 2.5, 0.0]).double(), 8.0), []
    for step in range(5):
        T_cw = EYE.clone()
        T_cw[2, 3] = -0.2 * step
        views.append(DepthMapView(depth, torch.ones_like(depth), CAMERA, T_cw))
    mesh = extract_mesh(views, MeshConfig(voxel=0.03, detail=0, min_weight=0.5))
    near = mesh.vertices[mesh.vertices[:, 2] < 6]  # farther on, nothing tells the slope
    assert np.abs(near[:, 1] - 0.4).max() < 0.002
    seen = render_mesh(mesh.vertices, mesh.faces, CAMERA, EYE.numpy())[0]
    assert np.isfinite(seen[((depth > 3) & (depth < 7)).numpy()]).mean() > 0.97
