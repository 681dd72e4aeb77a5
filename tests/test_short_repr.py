"""What a prompt shows of records with large arrays."""

import numpy as np
import torch

import geogs
from geogs.mesh.triangle_mesh import Mesh
from geogs.on_demand import OnDemand
from geogs.types import MapSnapshot, Trajectory


def test_arrays_are_shown_by_their_shape():
    frame = geogs.Frame(3, 0.1, np.zeros((72, 96, 3), np.uint8), left=7)
    assert repr(frame).startswith("Frame(index=3, timestamp=0.1, image=72×96×3, follows_cut=False")


def test_what_is_counted_is_shown_by_its_number():
    n = 1000
    path = Trajectory(np.zeros(n), np.zeros((n, 4, 4)), np.ones(n, bool))
    assert repr(path) == "Trajectory(1000 poses, 1000 tracked)"
    disks = MapSnapshot(torch.zeros(n, 3), torch.zeros(n, 4), torch.zeros(n, 2), torch.zeros(n))
    assert repr(disks) == "MapSnapshot(1000 disks, cpu)"
    mesh = Mesh.from_triangles(np.eye(3), np.array([[0, 1, 2]]))
    assert repr(mesh) == "Mesh(3 vertices, 1 triangles, without colours)"
    assert repr(geogs.GaussianMap.empty()) == "GaussianMap(0 disks, cpu)"
    slam = geogs.Slam(geogs.Camera(80.0, 80.0, 47.5, 35.5, 96, 72), device="cpu")
    assert repr(slam) == "Slam(0 frames, 0 keyframes, 0 disks)"
    pose = slam.process(np.zeros((72, 96, 3), np.uint8), 0.25)
    assert repr(pose) == "PoseEstimate(initializing at 0.25 s: 1 frames, 0 keyframes, 0 disks)"
    assert repr(slam) == "Slam(1 frames, 0 keyframes, 0 disks)"
    assert repr(OnDemand(range(7), float)) == "OnDemand(7 elements)"
