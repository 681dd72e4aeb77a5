"""Blocks are counted as they are when they are fused, and stay within the memory limit."""

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.mesh import extract
from geogs.mesh.extract import VolumePlan, extract_mesh, fitting_voxel, fuse, plan_volume
from geogs.mesh.triangle_mesh import DepthMapView
from geogs.mesh.volume.tsdf import BYTES_PER_BLOCK

CAMERA = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
PLENTY = 10**6


def scattered(count: int) -> list[DepthMapView]:
    """A wall at 2, and behind its upper half far points of which no two are neighbours."""
    random, views = np.random.default_rng(0), []
    for k in range(count):
        depth = torch.full((72, 96), 2.0)
        depth[:36] = torch.from_numpy(random.uniform(3, 9, (36, 96))).float()
        T_cw = torch.eye(4, dtype=torch.float64)
        T_cw[0, 3] = -0.02 * k
        views.append(DepthMapView(depth, torch.ones_like(depth), CAMERA, T_cw))
    return views


def test_scattered_points_do_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(extract, "_SAMPLED_POINTS", 300)
    views, sizes = scattered(5), []

    def noted(*given: object) -> object:
        found = fuse(*given)
        sizes.append(None if found is None else len(found) * BYTES_PER_BLOCK)
        return found

    monkeypatch.setattr(extract, "fuse", noted)
    free = MeshConfig(min_component_faces=0)
    wanted = plan_volume(views, free)
    extract_mesh(views, free)
    (whole,) = sizes
    assert whole > 1.5 * wanted.bytes
    limit = 1.01 * wanted.bytes / 2**30  # so that the plan is the same
    tight = MeshConfig(min_component_faces=0, memory_limit=limit)
    assert plan_volume(views, tight) == wanted
    sizes.clear()
    mesh = extract_mesh(views, tight)
    (size,) = sizes  # every pixel was counted, so that it is fused once
    assert 0.6 < size / (limit * 2**30) < 1.1
    assert len(mesh.faces)
    monkeypatch.setattr(extract, "_CROWDED", 2.0)
    sizes.clear()
    extract_mesh(views, tight)
    assert sizes[0] is None  # a sample's plan is outgrown: anew with larger voxels
    assert sizes[-1] <= 1.5 * limit * 2**30
    with pytest.raises(InputError, match="for the volume; use a larger voxel"):
        extract_mesh(views, MeshConfig(voxel=wanted.voxel, memory_limit=limit))


def fused_blocks(seen: list[DepthMapView], voxel: float, max_depth: float = 20.0) -> int:
    volume = fuse(seen, VolumePlan(voxel, 4.0, max_depth, 1, 1))
    assert volume is not None
    return len(volume)


@pytest.mark.parametrize("max_depth", [20.0, 5.0])
def test_what_fits_is_counted_exactly(max_depth):
    seen = scattered(3)
    voxel, blocks = fitting_voxel(seen, VolumePlan(0.05, 4.0, max_depth, 1, 1), PLENTY)
    assert voxel == 0.05
    assert blocks == fused_blocks(seen, 0.05, max_depth)


def test_voxels_are_as_large_as_it_takes():
    seen = scattered(4)
    whole = fused_blocks(seen, 0.03)
    for most in (whole // 2, whole // 20):
        voxel, blocks = fitting_voxel(seen, VolumePlan(0.03, 4.0, 20.0, 1, 1), most)
        assert voxel > 0.03
        assert 0.6 * most < blocks <= most
        assert fused_blocks(seen, voxel) == pytest.approx(blocks, rel=0.15)
