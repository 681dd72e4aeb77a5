"""Losses on poses and depths: known errors, invariance to scale, weights of the updates."""

import pytest
import torch

from geogs.geometry.lie import retract, se3_exp
from geogs_train.flow.bundle import ClipCameras, ClipEdges, ClipState, reproject
from geogs_train.flow.pose_loss import (
    PoseLossOptions,
    geodesic_errors,
    induced_flow_error,
    pose_loss,
)

EDGES = ClipEdges(torch.tensor([0, 1, 2, 0]), torch.tensor([1, 2, 0, 2]))
CELLS = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0)) * 2
CAMERAS = ClipCameras(torch.tensor([[10.0, 10.0, 6.0, 4.0]]), CELLS)


def truth() -> ClipState:
    g = torch.Generator().manual_seed(0)
    xi = 0.2 * torch.randn(1, 3, 6, generator=g, dtype=torch.float64)
    return ClipState(se3_exp(xi), 0.3 + 0.5 * torch.rand(1, 3, 20, generator=g))


def scaled(state: ClipState, factor: float) -> ClipState:
    T = state.T_cw.clone()
    T[..., :3, 3] *= factor
    return ClipState(T, state.inverse_depth / factor)


def test_a_turned_view_counts_by_its_angle_on_its_edges():
    state = truth()
    turn = torch.zeros(1, 3, 6, dtype=torch.float64)
    turn[0, 1, 4] = 0.1
    shift, angle = geodesic_errors(retract(turn, state.T_cw), state.T_cw, EDGES)
    expected = torch.tensor([[0.1, 0.1, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(angle, expected, rtol=0, atol=1e-6)
    # A turn of the target alone moves nothing; one of the source swings the target around it.
    assert float(shift[0, 0]) < 1e-6
    assert float(shift[0, 1]) > 0.005


def test_a_common_scale_moves_poses_and_not_the_flow():
    state = truth()
    wrong = scaled(state, 2.5)
    assert float(geodesic_errors(wrong.T_cw, state.T_cw, EDGES)[0].mean()) > 0.1
    flow, valid = induced_flow_error(CAMERAS, wrong, state, EDGES)
    assert float(valid.mean()) > 0.9
    assert float(flow.max()) < 1e-4


def test_flow_error_is_the_distance_of_projections():
    state = truth()
    other = ClipState(state.T_cw, state.inverse_depth * 1.2)
    flow, valid = induced_flow_error(CAMERAS, other, state, EDGES)
    a, b = (reproject(CAMERAS, s, EDGES).pixels for s in (other, state))
    torch.testing.assert_close(flow, (a - b).square().sum(-1).sqrt() * valid)
    assert float(flow.max()) > 0.1


def test_later_updates_count_more():
    state = truth()
    wrong = scaled(state, 1.3)
    options = PoseLossOptions(decay=0.5, pose=3.0, flow=0.0)
    error = float(torch.stack(geodesic_errors(wrong.T_cw, state.T_cw, EDGES)).mean((1, 2)).sum())
    assert error > 0.02
    assert float(pose_loss(CAMERAS, [state], state, EDGES, options)) < 1e-5
    early = pose_loss(CAMERAS, [wrong, state], state, EDGES, options)
    late = pose_loss(CAMERAS, [state, wrong], state, EDGES, options)
    assert float(late) == pytest.approx(3 * error, rel=1e-5)
    assert float(early) == pytest.approx(0.5 * 3 * error, rel=1e-5)


def test_gradients_are_finite_at_the_truth():
    state = truth()
    xi = torch.zeros(1, 3, 6, dtype=torch.float64, requires_grad=True)
    moved = ClipState(retract(xi, state.T_cw), state.inverse_depth.requires_grad_())
    pose_loss(CAMERAS, [moved], state, EDGES).backward()
    assert torch.isfinite(xi.grad).all()
    assert torch.isfinite(state.inverse_depth.grad).all()
