"""SO(3), SE(3), Sim(3): group axioms, exp/log bijection, adjoint, derivatives."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from geogs.geometry import lie
from geogs.geometry.lie import TranslationMap

F64 = torch.float64
GROUPS = {
    "so3": (3, lie.so3_exp, lie.so3_log, lambda R: R.mT),
    "se3": (6, lie.se3_exp, lie.se3_log, lie.se3_inverse),
    "sim3": (7, lie.sim3_exp, lie.sim3_log, lie.sim3_inverse),
}


def tangents(dim: int, scale: float, n: int = 64) -> torch.Tensor:
    xi = torch.randn(n, dim, dtype=F64, generator=torch.Generator().manual_seed(dim))
    return xi / xi.norm(dim=-1, keepdim=True) * scale


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 1e-2, 0.0316, 0.5, 3.1])
@pytest.mark.parametrize("name", GROUPS)
def test_log_inverts_exp(name, scale):
    dim, exp, log, _ = GROUPS[name]
    xi = tangents(dim, scale)
    assert (log(exp(xi)) - xi).abs().max() < 1e-12 * max(1.0, scale) + 1e-15


@pytest.mark.parametrize("name", GROUPS)
def test_group_axioms(name):
    dim, exp, _, inverse = GROUPS[name]
    a, b, c = (exp(tangents(dim, s)) for s in (0.3, 1.1, 2.0))
    eye = torch.eye(a.shape[-1], dtype=F64)
    assert ((a @ b) @ c - a @ (b @ c)).abs().max() < 1e-12
    assert (a @ inverse(a) - eye).abs().max() < 1e-12
    assert (inverse(a @ b) - inverse(b) @ inverse(a)).abs().max() < 1e-12
    assert (exp(torch.zeros(dim, dtype=F64)) - eye).abs().max() == 0


@pytest.mark.parametrize("name", GROUPS)
def test_exp_is_the_matrix_exponential(name):
    dim, exp, _, _ = GROUPS[name]
    xi = tangents(dim, 1.7)
    generator = torch.zeros(64, 4, 4, dtype=F64)
    phi = xi if dim == 3 else xi[:, 3:6]
    generator[:, :3, :3] = lie.so3_hat(phi)
    if dim > 3:
        generator[:, :3, 3] = xi[:, :3]
    if dim == 7:
        generator[:, :3, :3] += xi[:, 6, None, None] * torch.eye(3, dtype=F64)
    size = 3 if dim == 3 else 4
    expected = torch.linalg.matrix_exp(generator[:, :size, :size])
    assert (exp(xi) - expected).abs().max() < 1e-12


@pytest.mark.parametrize(
    ("exp", "adjoint", "dim"),
    [(lie.se3_exp, lie.se3_adjoint, 6), (lie.sim3_exp, lie.sim3_adjoint, 7)],
)
def test_adjoint_moves_a_tangent_across(exp, adjoint, dim):
    T, xi = exp(tangents(dim, 1.3)), tangents(dim, 0.7).flip(0)
    moved = (adjoint(T) @ xi[..., None])[..., 0]
    assert (T @ exp(xi) - exp(moved) @ T).abs().max() < 1e-11


@pytest.mark.parametrize("scale", [0.0, 1e-6, 0.9])
@pytest.mark.parametrize("name", GROUPS)
def test_derivatives_match_finite_differences(name, scale):
    dim, exp, log, _ = GROUPS[name]
    xi = tangents(dim, scale, n=3).requires_grad_()
    assert torch.autograd.gradcheck(exp, xi, atol=1e-7)
    assert torch.autograd.gradcheck(lambda x: log(exp(x)), xi, atol=1e-6)


def test_log_just_below_a_half_turn():
    axis = torch.tensor([0.36, -0.48, 0.8], dtype=F64)
    for angle in (math.pi - 1e-3, math.pi - 1e-7):
        assert (lie.so3_log(lie.so3_exp(axis * angle)) - axis * angle).abs().max() < 1e-8


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_quaternion_round_trip(values):
    q = torch.tensor(values, dtype=F64)
    if q.norm() < 1e-3:
        return
    R = lie.quaternion_to_matrix(q)
    assert (R @ R.mT - torch.eye(3, dtype=F64)).abs().max() < 1e-12
    back = lie.matrix_to_quaternion(R)
    unit = q / q.norm()
    assert min((back - unit).abs().max(), (back + unit).abs().max()) < 1e-7


def test_quaternion_product_is_the_product_of_rotations():
    a, b = torch.randn(2, 50, 4, dtype=F64, generator=torch.Generator().manual_seed(3)).unbind(0)
    product = lie.quaternion_to_matrix(lie.quaternion_multiply(a, b))
    assert (product - lie.quaternion_to_matrix(a) @ lie.quaternion_to_matrix(b)).abs().max() < 1e-12


@pytest.mark.parametrize(("turn", "growth"), [(0.0, 0.0), (1e-6, 1e-6), (0.4, 0.2), (3.1, 2.0)])
def test_a_similarity_s_translation_is_the_integral_of_its_linear_part(turn, growth):
    phi = turn * torch.nn.functional.normalize(torch.tensor([[1.0, -2.0, 0.5]]).double())
    sigma, tau = torch.tensor([growth], dtype=F64), torch.tensor([[0.3, 1.0, -2.0]], dtype=F64)
    M = growth * torch.eye(3, dtype=F64) + lie.so3_hat(phi)[0]
    # The upper right block of the exponential of [[M, I], [0, 0]] is the integral of exp(s M).
    both = torch.zeros(6, 6, dtype=F64)
    both[:3, :3], both[:3, 3:] = M, torch.eye(3)
    V = torch.linalg.matrix_exp(both)[:3, 3:]
    found = TranslationMap(phi, sigma)
    torch.testing.assert_close((found @ tau)[0], V @ tau[0], rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(found.solve(found @ tau), tau, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.1, 0.3, 2.0])
def test_the_inverse_jacobian_undoes_the_jacobian(size):
    random = torch.Generator().manual_seed(4)
    xi = size * torch.randn(20, 7, dtype=F64, generator=random)
    product = lie.sim3_inverse_jacobian(xi) @ lie.sim3_left_jacobian(xi)
    eye = torch.eye(7, dtype=F64).expand(20, 7, 7)
    torch.testing.assert_close(product, eye, rtol=0, atol=1e-12)
