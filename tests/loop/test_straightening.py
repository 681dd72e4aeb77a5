"""What a tracker knows, straightened: against a slanted wall that lens and pinhole both see."""

import numpy as np
import pytest
import torch
from torch import Tensor

from geogs.camera.shutter.rows import CELL, node_count
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.loop.camera.straightening import (
    BentImages,
    straight_rows,
    straighten_cells,
    straighten_frames,
)
from geogs.priors.monocular_prior import DepthKind
from geogs.tracking.frames.frame_recorder import sparse_cells
from geogs.types import FoundLens, SeenRows
from geogs.world.cell_depths import KeyframePrior, MeasuredCells
from geogs.world.edges import pack_matches, unpacked_positions
from geogs.world.frames import FrameLog, FrameRecord, Observation
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable

CAMERA = Camera(fx=110.0, fy=110.0, cx=79.5, cy=59.5, width=160, height=120)
GRID = SampleGrid(CAMERA)
VIEW = StraightView(CAMERA, FoundLens(0.1, -0.2, 0.001, 0.002, 0.97, 0.01))
NORMAL, OFFSET = torch.tensor([0.3, 0.2, 1.0]), 2.5


def inverse_depth(pixels: Tensor) -> Tensor:
    """Of the wall n . X = o where the pinhole shows it at pixels."""
    plane = (pixels - torch.tensor([79.5, 59.5])) / 110
    return (plane @ NORMAL[:2] + NORMAL[2]) / OFFSET


def carried(pixels: Tensor, T: Tensor) -> Tensor:
    """Where a camera at T from the first shows what is at pixels of the first."""
    plane = (pixels - torch.tensor([79.5, 59.5])) / 110
    points = torch.cat([plane, torch.ones_like(plane[:, :1])], 1) / inverse_depth(pixels)[:, None]
    there = points @ T[:3, :3].mT + T[:3, 3]
    return there[:, :2] / there[:, 2:] * 110 + torch.tensor([79.5, 59.5])


def one_keyframe(image: np.ndarray | None = None, encode=None) -> KeyframeSet:
    keyframes = KeyframeTable.on(GRID, encode).new_set()
    blank = np.zeros((120, 160, 3), np.uint8)
    keyframes.add(0, 0.0, blank if image is None else image, None, torch.eye(4).double())
    return keyframes


def test_cells_are_those_of_the_straight_image():
    keyframes = one_keyframe()
    keyframe = keyframes[0]
    keyframe.inverse_depth = inverse_depth(VIEW.straight(GRID.pixels))
    keyframe.information = torch.full((GRID.size,), 100.0)
    number = torch.arange(float(GRID.size))
    keyframe.moving = number % 2 == 0
    keyframe.measured = MeasuredCells(number.clone(), torch.ones(GRID.size))
    keyframe.prior = KeyframePrior(
        DepthKind.METRIC, number.clone(), number.clone(), torch.ones(1), torch.ones(GRID.size)
    )
    straighten_cells(keyframes, FrameViews(VIEW))
    nearest, is_cell = GRID.cells_of(VIEW.bent(GRID.pixels))
    inner = is_cell & (VIEW.bent(GRID.pixels) > 4).all(-1)
    inner &= (VIEW.bent(GRID.pixels) < torch.tensor([155.0, 115.0])).all(-1)
    wanted = inverse_depth(GRID.pixels)
    np.testing.assert_allclose(keyframe.inverse_depth[inner], wanted[inner], rtol=4e-3)
    assert torch.equal(keyframe.moving[is_cell], nearest[is_cell] % 2 == 0)
    for found in (keyframe.measured.inverse_depth, keyframe.prior.inverse_depth):
        assert torch.equal(found[is_cell], nearest[is_cell].float())


def test_what_was_found_of_frames_is_as_if_the_pinhole_had_seen_both():
    keyframes = one_keyframe()
    keyframes[0].inverse_depth = inverse_depth(GRID.pixels)
    T = se3_exp(torch.tensor([0.25, -0.1, 0.15, 0.02, -0.05, 0.03], dtype=torch.float64))
    cells = sparse_cells(GRID)
    bent = VIEW.bent(carried(VIEW.straight(GRID.pixels[cells]), T.float()))
    inside = GRID.inside(bent, 4.0)
    weight = inside.float()[:, None].expand(-1, 2)
    log = FrameLog([FrameRecord(1, 0.1, 0, torch.eye(4).double())])  # as tracking left it
    log.records[0].observations = [Observation(0, *pack_matches(GRID, bent, weight))]
    straighten_frames(log, keyframes, FrameViews(VIEW), {1: T})
    (found,) = log.records[0].observations
    kept = found.half_weight[:, 0] > 0
    assert int(kept.sum()) > 0.95 * int(inside.sum()) > 20
    wanted = carried(GRID.pixels[cells], T.float())
    off = (unpacked_positions(GRID, found.position) - wanted)[kept]
    shown = VIEW.straight(GRID.pixels[cells])[kept]
    is_inner = ((shown >= 4) & (shown <= torch.tensor([156.0, 116.0]))).all(-1)
    assert float(off[is_inner].norm(dim=-1).max()) < 0.05
    assert float(off.norm(dim=-1).max()) < 0.4  # depths are repeated beyond the outer cells
    assert float((bent - wanted)[kept].norm(dim=-1).max()) > 1.0


def test_rows_are_those_that_straight_pixels_were_seen_in():
    count = node_count(120), node_count(160)
    v, u = torch.meshgrid(
        *((torch.arange(n) - 1) * CELL + (CELL - 1) / 2 for n in count), indexing="ij"
    )
    offset = torch.stack([1.0 + 0.01 * u, -2.0 + 0.02 * v], -1)
    rows = SeenRows(offset.half(), (1e-3 * v).half(), 0.1)
    other = SeenRows(rows.offset + 1, rows.seconds, 0.2)
    straight, second = straight_rows([rows, other], VIEW)
    assert second.doubt == 0.2
    assert torch.equal(second.offset, straight_rows([other], VIEW)[0].offset)
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


def test_images_are_always_made_of_those_that_were_tracked():
    rng = np.random.default_rng(0)
    image = rng.integers(1, 255, (120, 160, 3), dtype=np.uint8)
    keyframes = one_keyframe(image, encode=lambda image: float(image.mean()))
    depth = rng.uniform(1, 4, (120, 160)).astype(np.float32)
    keyframes[0].sensor_depth = depth
    images = BentImages.of(keyframes)
    for lens in (FoundLens(0.3, 0.0, 0.001, 0.001), VIEW.lens):
        images.straighten(FrameViews(StraightView(CAMERA, lens)))
        view = StraightView(CAMERA, lens)
        assert np.array_equal(keyframes[0].image, view.image(image))
        assert keyframes[0].encoded == float(view.image(image).mean())
        np.testing.assert_allclose(keyframes[0].sensor_depth, view.nearest(depth), rtol=1e-3)
        assert keyframes.table.lens == lens
