"""Where pixels lie in a rolling image: against rays followed through time one by one."""

import numpy as np
import pytest
import torch

from geogs.camera.shutter.angular_motion import AngularMotion
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.rows import RowOffsets
from geogs.camera.shutter.shutter import Shutter
from geogs.geometry.camera import Camera
from geogs.geometry.lie import so3_exp
from lenses import with_lens

CAMERA = Camera(420.0, 415.0, 255.0, 190.0, 512, 384)
FAST = AngularMotion(np.array([1.2, -1.5, 0.8]), np.array([10.0, -12.0, 8.0]))
"""115 degrees per second, and shaken."""
READOUT = 0.033


def seen_at(rolling: RollingCamera, ray: np.ndarray, turning: AngularMotion) -> np.ndarray:
    """The pixel at which a distant point is seen: the row's time and its place have to agree."""
    early, late = -0.75, 0.75
    for _ in range(60):  # bisection: a row passes the point once
        middle = (early + late) / 2
        angles = turning.angles(np.array([READOUT * middle]))[0]
        moved = so3_exp(torch.tensor(angles)).numpy() @ ray
        pixel = rolling.pixels(moved[None])
        late, early = (middle, early) if rolling.line_times(pixel)[0] < middle else (late, middle)
    return pixel[0]


def dense(offsets: RowOffsets, motion: AngularMotion, readout: float = READOUT) -> np.ndarray:
    return offsets.dense(offsets.nodes(motion, readout))


@pytest.mark.parametrize("distortion", [(), (-0.28, 0.08, 0.001, -0.002)])
@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_offsets_at_pixels_are_those_of_single_rays(distortion, quarter_turns):
    rolling = RollingCamera(with_lens(CAMERA, distortion), quarter_turns)
    zoom = 1.15 if distortion else 1.0
    target = Camera(420.0 * zoom, 415.0 * zoom, 255.0, 190.0, 512, 384)
    offsets = dense(RowOffsets(rolling, target), FAST)
    assert np.abs(offsets).max() > 9
    for u, v in [(0, 0), (511, 383), (0, 383), (511, 0), (256, 190), (37, 290), (400, 101)]:
        ray = np.array([(u - target.cx) / target.fx, (v - target.cy) / target.fy, 1.0])
        still = rolling.pixels(ray[None])[0]
        expected = seen_at(rolling, ray, FAST) - still
        np.testing.assert_allclose(offsets[v, u], expected, atol=0.02)


def test_a_camera_that_stands_or_reads_at_once_has_no_offsets():
    offsets = RowOffsets(RollingCamera(with_lens(CAMERA, (-0.2, 0.05, 0.0, 0.0))), CAMERA)
    assert not dense(offsets, AngularMotion()).any()
    assert not dense(offsets, FAST, 0.0).any()


def test_the_middle_row_stays_and_the_edges_go_opposite_ways():
    """At a steady turn to the side, half a readout moves a row by f w readout / 2."""
    steady = AngularMotion(np.array([0.0, 1.0, 0.0]))
    offsets = dense(RowOffsets(RollingCamera(CAMERA), CAMERA), steady)
    edge = 420 * 1.0 * READOUT / 2
    assert abs(offsets[191, 255, 0]) < 0.03
    assert offsets[0, 255, 0] == pytest.approx(-edge, rel=0.01)
    assert offsets[383, 255, 0] == pytest.approx(edge, rel=0.02)


def test_parallax_moves_rows_by_its_own_velocity():
    """Beside no turn at all: x/z and y/z per second, at the row's own time."""
    drift = np.broadcast_to([0.3, 0.0], (12, 16, 2))
    offsets = dense(RowOffsets(RollingCamera(CAMERA), CAMERA), AngularMotion(parallax=drift))
    for row in (0, 100, 383):
        expected = 420 * 0.3 * READOUT * ((row + 0.5) / 384 - 0.5) * 384 / 383
        np.testing.assert_allclose(offsets[row, :, 0], expected, atol=0.02)
    np.testing.assert_allclose(offsets[..., 1], 0, atol=1e-6)


def test_parallax_counts_little_where_the_rate_changes_fast():
    drift = np.broadcast_to([0.3, 0.0], (12, 16, 2))
    shaken = AngularMotion(acceleration=np.array([0.0, 60.0, 0.0]))
    offsets = RowOffsets(RollingCamera(CAMERA), CAMERA)
    alone = dense(offsets, shaken)
    both = dense(offsets, AngularMotion(acceleration=shaken.acceleration, parallax=drift))
    assert np.abs(both - alone).max() < 0.05 * 420 * 0.3 * READOUT / 2


@pytest.mark.parametrize("distortion", [(), (-0.28, 0.08, 0.001, -0.002)])
def test_what_is_kept_of_the_rows_says_where_and_when_each_node_was_seen(distortion):
    rolling, zoom = RollingCamera(with_lens(CAMERA, distortion)), 1.15
    target = Camera(420.0 * zoom, 415.0 * zoom, 255.0, 190.0, 512, 384)
    offsets = RowOffsets(rolling, target)
    rows = offsets.seen(offsets.nodes(FAST, READOUT), Shutter(READOUT, error=0.003))
    assert rows.seconds.shape == (384 // 8 + 2, 512 // 8 + 2)
    assert rows.doubt == pytest.approx(0.003 / READOUT)
    for line, column in [(3, 4), (25, 33), (46, 60)]:
        u, v = 8 * column - 4.5, 8 * line - 4.5  # of the node after the border's
        ray = np.array([(u - target.cx) / target.fx, (v - target.cy) / target.fy, 1.0])
        pixel = seen_at(rolling, ray, FAST)
        seconds = READOUT * rolling.line_times(pixel[None])[0]
        assert float(rows.seconds[line, column]) == pytest.approx(seconds, abs=2e-5)
        moved = so3_exp(torch.tensor(FAST.angles(np.array([seconds]))[0])).numpy() @ ray
        there = moved[:2] / moved[2] * [target.fx, target.fy] + [target.cx, target.cy]
        np.testing.assert_allclose(rows.offset[line, column], there - [u, v], atol=0.03)
