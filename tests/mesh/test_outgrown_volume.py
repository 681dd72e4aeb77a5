"""Volumes of scattered surfaces stay within the memory that they may take."""

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.mesh import extract
from geogs.mesh.extract import extract_mesh, plan_volume
from geogs.mesh.triangle_mesh import DepthMapView
from geogs.mesh.volume.tsdf import BYTES_PER_BLOCK

CAMERA = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)


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
    fuse = extract.fuse

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
