"""The surface of a joint map, made by several workers, is that of one volume."""

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.io.writers.keyframe_folder import write_image
from geogs.mesh.extract import extract_mesh
from geogs_fleet.join.joined_surface import StoredView, equal_runs, joint_mesh, loaded, plan_space
from one_process import OneProcess

CAMERA = Camera(fx=40.0, fy=40.0, cx=31.5, cy=23.5, width=64, height=48)


class FourWorkers(OneProcess):
    at_once = 4


@pytest.fixture
def views(tmp_path) -> list[StoredView]:
    """A bent wall, from a few places."""
    made, random = [], np.random.default_rng(0)
    for n in range(4):
        T = se3_exp(torch.tensor([-0.5 * n, 0.0, 0.0, 0.0, 0.1 * n, 0.0]).double())
        rays = CAMERA.rays(torch.float64) @ T[:3, :3]
        origin = -T[:3, :3].T @ T[:3, 3]
        depth = ((2.0 + 0.1 * n - origin[2]) / rays[..., 2]).clamp(0.5, 6).float()
        file, picture = tmp_path / f"{n}.npz", tmp_path / f"{n}.jpg"
        np.savez(file, depth=depth.numpy(), weight=np.ones((48, 64), np.float16))
        write_image(picture, random.integers(0, 255, (48, 64, 3), dtype=np.uint8))
        made.append(StoredView(file, picture, CAMERA, T.numpy()))
    return made


def test_several_workers_make_the_mesh_of_one_volume(views):
    config = MeshConfig(voxel=0.06, detail=1.0, min_component_faces=10)
    space = plan_space(views, config, FourWorkers())
    assert len(space.boxes) > 2
    mesh = joint_mesh(space, config, FourWorkers(), "cpu")
    whole = extract_mesh(loaded(views, with_images=True), config)
    assert np.array_equal(mesh.vertices, whole.vertices)
    assert np.array_equal(mesh.faces, whole.faces)
    assert (mesh.colours == whole.colours).mean() > 0.98  # but for what no image shows


@pytest.mark.parametrize(("count", "parts"), [(0, 3), (2, 5), (10, 3), (7, 1)])
def test_shares_are_all_of_it_and_about_equal(count, parts):
    found = equal_runs(count, parts)
    assert [n for run in found for n in run] == list(range(count))
    sizes = [len(run) for run in found]
    assert not sizes or (min(sizes) > 0 and max(sizes) - min(sizes) <= 1)
    assert len(sizes) == min(count, parts)
