"""How well a frame's pose is known."""

import numpy as np
import pytest
import torch

from geogs.bundle.uncertainty.marginals import ALIKE
from geogs.geometry.lie import retract, se3_inverse
from geogs.tracking.locate.pose_deviation import pose_deviation
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from keyframe_samples import Sample, segment_of
from tracking_scenes import CAMERA, pose, render


def scene():
    image, depth = render(pose(0.0))
    grid = SampleGrid(CAMERA)
    x, y = grid.pixels.long().unbind(-1)
    z = torch.from_numpy(depth)[y, x].float()
    shape = grid.height, grid.width
    information = 1 / (0.01 / z).square()
    T = torch.from_numpy(np.linalg.inv(pose(0.0)))
    sample = Sample(0, image, T, (1 / z).reshape(shape), information.reshape(shape))
    keyframe = next(iter(segment_of([sample], CAMERA)))
    T_cw = torch.from_numpy(np.linalg.inv(pose(0.2, 0.05, 0.1, 0.05)))
    random = torch.Generator().manual_seed(0)
    weight = 4.0 * (torch.rand(grid.size, generator=random) > 0.85).float()
    return (
        grid,
        keyframe,
        T_cw,
        FlowMatch(grid.pixels[None], weight[None, :, None].expand(1, -1, 2)),
    )


def where(grid, ray, d, T):
    """Where one cell falls, written out."""
    y = T[:3, :3] @ ray.double() + float(d) * T[:3, 3]
    c = grid.camera
    return torch.stack([c.fx * y[0] / y[2] + c.cx, c.fy * y[1] / y[2] + c.cy])


def test_it_is_the_inverse_of_what_the_cells_say_one_by_one():
    grid, keyframe, T_cw, match = scene()
    found = pose_deviation(grid, keyframe, T_cw, match)
    H = torch.zeros(6, 6, dtype=torch.float64)
    T, step = T_cw @ se3_inverse(keyframe.T_cw), 1e-6
    for n in range(grid.size):
        w = float(match.weight[0, n, 0])
        if w == 0:
            continue
        ray, d = grid.rays[n], keyframe.inverse_depth[n]
        J = torch.zeros(2, 6, dtype=torch.float64)
        for k in range(6):
            xi = torch.zeros(6, dtype=torch.float64)
            xi[k] = step
            ahead, behind = (where(grid, ray, d, retract(s * xi, T)) for s in (1, -1))
            J[:, k] = (ahead - behind) / (2 * step)
        by_depth = (where(grid, ray, d + step, T) - where(grid, ray, d - step, T)) / (2 * step)
        variance = 1 / w + by_depth.square() / float(keyframe.confident_information[n])
        H += J.T @ (J / variance[:, None])
    C = ALIKE * torch.linalg.inv(H)
    assert found.position == pytest.approx(float(C.diagonal()[:3].sum().sqrt()), rel=0.02)
    assert found.rotation == pytest.approx(float(C.diagonal()[3:].sum().sqrt()), rel=0.02)
    assert 1e-4 < found.position < 0.02


def test_without_matches_nothing_is_known():
    grid, keyframe, T_cw, match = scene()
    none = FlowMatch(match.pixels, torch.zeros_like(match.weight))
    found = pose_deviation(grid, keyframe, T_cw, none)
    assert found.position == found.rotation == float("inf")
