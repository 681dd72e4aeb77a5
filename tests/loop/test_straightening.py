"""What a tracker knows, straightened: against a slanted wall that lens and pinhole both see."""

import numpy as np
import pytest
import torch
from torch import Tensor

from geogs.camera.shutter.rows import CELL, node_count
from geogs.camera.straight_view import StraightView
from geogs.geometry.camera import Camera
from geogs.tracking.frames.seen_rows import straight_rows
from geogs.types import FoundLens, SeenRows
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable

CAMERA = Camera(fx=110.0, fy=110.0, cx=79.5, cy=59.5, width=160, height=120)
GRID = SampleGrid(CAMERA)
VIEW = StraightView(CAMERA, CAMERA, FoundLens(0.1, -0.2, 0.001, 0.002, 0.97, 0.01))
NORMAL, OFFSET = torch.tensor([0.3, 0.2, 1.0]), 2.5


def inverse_depth(pixels: Tensor) -> Tensor:
    """Of the wall n . X = o where the pinhole shows it at pixels."""
    plane = (pixels - torch.tensor([79.5, 59.5])) / 110
    return (plane @ NORMAL[:2] + NORMAL[2]) / OFFSET


def one_keyframe(image: np.ndarray | None = None) -> KeyframeSet:
    keyframes = KeyframeTable.on(GRID).new_set()
    blank = np.zeros((120, 160, 3), np.uint8)
    keyframes.add(0, 0.0, blank if image is None else image, None, torch.eye(4).double())
    return keyframes


def test_cells_are_shown_as_those_of_the_straight_image():
    """Beside that of the cells, depth and what moves where a straight image has them."""
    keyframes = one_keyframe()
    keyframe, table = keyframes[0], keyframes.table
    table.lens = VIEW.lens
    table.see_by(VIEW.seen_by)
    keyframe.inverse_depth = inverse_depth(VIEW.straight(GRID.pixels))
    keyframe.information = torch.full((GRID.size,), 100.0)
    keyframe.moving = torch.arange(GRID.size) % 2 == 0
    bent = VIEW.bent(GRID.pixels)
    nearest, is_cell = GRID.cells_of(bent)
    inner = is_cell & ((bent > 4) & (bent < torch.tensor([155.0, 115.0]))).all(-1)
    depth, information = (torch.from_numpy(field).reshape(-1) for field in keyframe.depth_field())
    wanted = inverse_depth(GRID.pixels)
    np.testing.assert_allclose(depth[inner], wanted[inner], rtol=4e-3)
    floor = (0.004 * keyframe.inverse_depth).square()
    known = (100 / (1 + 100 * floor))[nearest]
    np.testing.assert_allclose(information[inner], known[inner], rtol=2e-3)
    assert torch.equal(keyframe.shown_moving[is_cell], nearest[is_cell] % 2 == 0)
    table.lens = None
    assert torch.equal(
        torch.from_numpy(keyframe.depth_field()[0]).reshape(-1), keyframe.inverse_depth
    )
    assert keyframe.shown_moving is keyframe.moving


def test_a_table_that_is_read_again_sees_its_cells_by_the_lens():
    table = KeyframeTable(lens=VIEW.lens).attached(GRID)
    assert table.camera == CAMERA
    assert table.grid.camera == VIEW.seen_by
    np.testing.assert_allclose(
        table.grid.rays[:, :2] * 110 + torch.tensor([79.5, 59.5]),
        VIEW.straight(GRID.pixels),
        atol=1e-3,
    )


def test_rows_are_those_that_straight_pixels_were_seen_in():
    count = node_count(120), node_count(160)
    v, u = torch.meshgrid(
        *((torch.arange(n) - 1) * CELL + (CELL - 1) / 2 for n in count), indexing="ij"
    )
    offset = torch.stack([1.0 + 0.01 * u, -2.0 + 0.02 * v], -1)
    rows = SeenRows(offset.half(), (1e-3 * v).half(), 0.1)
    straight = straight_rows(rows, VIEW)
    assert straight.doubt == rows.doubt
    for row, column in [(3, 4), (8, 10), (12, 17)]:
        node = torch.stack([u[row, column], v[row, column]])[None].double()
        bent = VIEW.bent(node)
        moved = torch.stack([1.0 + 0.01 * bent[:, 0], -2.0 + 0.02 * bent[:, 1]], -1)
        wanted = (VIEW.straight(bent + moved) - node)[0]
        np.testing.assert_allclose(straight.offset[row, column], wanted, atol=4e-3)
        assert float(straight.seconds[row, column]) == pytest.approx(
            1e-3 * float(bent[0, 1]), rel=2e-3
        )


def test_images_are_those_of_the_pinhole_and_normals_and_depths_go_along():
    rng = np.random.default_rng(0)
    image = rng.integers(1, 255, (120, 160, 3), dtype=np.uint8)
    keyframes = one_keyframe(image)
    depth = rng.uniform(1, 4, (120, 160)).astype(np.float32)
    keyframes[0].sensor_depth = depth
    keyframes[0].prior_normal = torch.from_numpy(np.repeat(depth[..., None], 3, 2))
    keyframes.table.straighten(VIEW.lens, {})
    assert np.array_equal(keyframes[0].image, image)
    assert np.array_equal(keyframes[0].straight_image, VIEW.image(image))
    assert np.array_equal(keyframes.table.reader(0)(), VIEW.image(image))
    np.testing.assert_allclose(
        keyframes[0].sensor_depth, VIEW.depth(depth.astype(np.float16).astype(np.float32))
    )
    np.testing.assert_allclose(keyframes[0].prior_normal[..., 1], VIEW.nearest(depth), rtol=1e-3)
    assert keyframes.table.lens == VIEW.lens
