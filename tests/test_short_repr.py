"""What a prompt shows of records with large arrays."""

import numpy as np
import torch

import geogs
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import MapSnapshot, Trajectory


def test_arrays_are_shown_by_their_shape():
    n = 1000
    path = Trajectory(np.zeros(n), np.zeros((n, 4, 4)), np.ones(n, bool))
    assert repr(path) == "Trajectory(timestamps=1000, T_wc=1000×4×4, tracked=1000, oriented=None)"
    disks = MapSnapshot(torch.zeros(n, 3), torch.zeros(n, 4), torch.zeros(n, 2), torch.zeros(n))
    shown = "MapSnapshot(position=1000×3, quaternion=1000×4, scale=1000×2, opacity=1000)"
    assert repr(disks) == shown
    mesh = Mesh.from_triangles(np.eye(3), np.array([[0, 1, 2]]))
    assert repr(mesh) == "Mesh(vertices=3×3, faces=1×3, normals=3×3, colours=None)"
    assert repr(geogs.GaussianMap.empty()) == "GaussianMap(0 disks, cpu)"
