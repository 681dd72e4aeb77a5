"""A mesh made in boxes of space against the same made in one volume."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.mesh.blocks import (
    blocks_of,
    boxes_of,
    expanded_mesh,
    mesh_block,
    sees_box,
    stitched_blocks,
)
from geogs.mesh.extract import VolumePlan, extract_mesh, plan_volume
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.mesh.volume.level_set import CHUNK
from geogs.mesh.volume.tsdf import BlockBox

CAMERA = Camera(fx=60.0, fy=60.0, cx=39.5, cy=29.5, width=80, height=60)
HALF = torch.tensor([1.3, 0.8, 1.1], dtype=torch.float64)
CONFIG = MeshConfig(voxel=0.03, detail=0, colour=False, min_component_faces=20)


def inside_of_a_box(count: int = 8) -> list[DepthMapView]:
    """Views from about the middle, each a bit wrong, with a gap here and there."""
    random, views = torch.Generator().manual_seed(1), []
    for k in range(count):
        turn = torch.tensor([0.0, 0.0, 0.0, 0.4 * math.sin(k), 2 * math.pi * k / count, 0.0])
        T = se3_exp(turn.double())
        T[:3, 3] += 0.1 * torch.randn(3, generator=random).double()
        origin, d = -T[:3, :3].T @ T[:3, 3], CAMERA.rays(torch.float64) @ T[:3, :3]
        t = (torch.sign(d) * HALF - origin) / torch.where(d.abs() < 1e-12, 1e-12, d)
        depth = t.amin(-1).float()
        depth = depth * (1 + 0.002 * torch.randn(depth.shape, generator=random))
        depth[20:22, 30:33] = 0
        views.append(DepthMapView(depth, (depth > 0).float(), CAMERA, T))
    return views


def before_a_background(count: int = 8) -> list[DepthMapView]:
    """The same, in every other place the wall of a hall that is twenty times as large."""
    views, far = inside_of_a_box(count), torch.zeros(60, 80, dtype=torch.bool)
    far[::12], far[:, 40:] = True, True
    return [replace(v, depth=torch.where(far, 20 * v.depth, v.depth)) for v in views]


def in_boxes(views: list[DepthMapView], plan: VolumePlan, most: int) -> tuple[Mesh, list[BlockBox]]:
    blocks = torch.unique(torch.cat([blocks_of(view, plan) for view in views]), dim=0).numpy()
    boxes = boxes_of(blocks, most)
    made = []
    for box in boxes:
        seen = [v for v in views if sees_box(v.camera, v.T_cw, plan, box)]
        made.append(mesh_block(seen, plan, box, CONFIG.min_weight))
    return stitched_blocks(made[::-1], plan, CONFIG), boxes


def test_boxes_hold_every_block_once_and_no_more_than_they_may():
    random = np.random.default_rng(2)
    blocks = np.unique(random.integers(-60, 60, (4000, 3)), axis=0)
    boxes = boxes_of(blocks, 600)
    held = np.array([[((blocks >= b.low) & (blocks < b.high)).all(axis=1)] for b in boxes])[:, 0]
    assert (held.sum(axis=0) == 1).all()
    for box, inside in zip(boxes, held, strict=True):
        is_one_chunk = (np.array(box.high) - box.low == CHUNK).all()
        assert 0 < inside.sum() <= 600 or is_one_chunk
    assert len(boxes) >= 4000 // 600
    assert boxes_of(np.zeros((0, 3), np.int64), 5) == []


@pytest.mark.parametrize("scene", [inside_of_a_box, before_a_background])
def test_the_mesh_is_that_of_one_volume_to_the_last_digit(scene):
    views = scene()
    plan = plan_volume(views, CONFIG)
    assert bool(plan.contraction) == (scene is before_a_background)
    whole = extract_mesh(views, CONFIG)
    mesh, boxes = in_boxes(views, plan, 60)
    mesh = expanded_mesh(mesh, plan.contraction)
    assert len(boxes) >= 4
    for part in fields(Mesh)[:3]:
        assert np.array_equal(getattr(mesh, part.name), getattr(whole, part.name)), part.name


@pytest.mark.parametrize("scene", [inside_of_a_box, before_a_background])
def test_a_view_is_left_out_of_a_box_only_where_it_could_change_nothing(scene):
    views = scene()
    plan = plan_volume(views, CONFIG)
    box = BlockBox((4, -2, -2), (6, 2, 2))
    left_out = 0
    for view in views:
        block = mesh_block([view], plan, box, 0.5)
        if not sees_box(view.camera, view.T_cw, plan, box):
            left_out += 1
            assert not block.parts
            assert not block.free.bits.any()
    assert 2 < left_out < len(views)


def test_a_box_without_surface_and_a_place_without_any():
    views = inside_of_a_box(2)
    plan = plan_volume(views, CONFIG)
    far = mesh_block(views, plan, BlockBox((500, 0, 0), (516, 16, 16)), 1.0)
    assert far.parts == ()
    assert len(far.free.keys) == 0
    with pytest.raises(InputError, match="No surface was seen"):
        stitched_blocks([far], plan, CONFIG)
