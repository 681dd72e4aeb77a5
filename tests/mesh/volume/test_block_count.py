"""Blocks of a volume are counted as they are when it is fused."""

import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.mesh.extract import VolumePlan, fuse
from geogs.mesh.triangle_mesh import DepthMapView
from geogs.mesh.volume.block_count import fitting_voxel
from geogs.mesh.volume.contraction import UNCONTRACTED

CAMERA = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
PLENTY = 10**6


def views(count: int, seed: int = 0) -> list[DepthMapView]:
    """Upper halves are scattered between 3 and 9, each view's otherwise; below is a wall at 2."""
    g = torch.Generator().manual_seed(seed)
    found = []
    for k in range(count):
        depth = torch.full((72, 96), 2.0)
        depth[:36] = 3 + 6 * torch.rand(36, 96, generator=g)
        T_cw = torch.eye(4, dtype=torch.float64)
        T_cw[0, 3] = -0.02 * k
        found.append(DepthMapView(depth, torch.ones_like(depth), CAMERA, T_cw))
    return found


def fused_blocks(seen: list[DepthMapView], voxel: float, max_depth: float = 20.0) -> int:
    volume = fuse(seen, VolumePlan(voxel, 4.0, max_depth, 1, 1))
    assert volume is not None
    return len(volume)


@pytest.mark.parametrize("max_depth", [20.0, 5.0])
def test_what_fits_is_counted_exactly(max_depth):
    seen = views(3)
    voxel, blocks = fitting_voxel(seen, 0.05, 4.0, max_depth, PLENTY, UNCONTRACTED)
    assert voxel == 0.05
    assert blocks == fused_blocks(seen, 0.05, max_depth)


def test_voxels_are_as_large_as_it_takes():
    seen = views(4)
    whole = fused_blocks(seen, 0.03)
    for most in (whole // 2, whole // 20):
        voxel, blocks = fitting_voxel(seen, 0.03, 4.0, 20.0, most, UNCONTRACTED)
        assert voxel > 0.03
        assert 0.6 * most < blocks <= most
        assert fused_blocks(seen, voxel) == pytest.approx(blocks, rel=0.15)
