"""The depth network's parts against slow versions, and what it must not depend on."""

import math
from dataclasses import replace

import pytest
import torch

from depth_tuples import NETWORK, random_views
from geogs.depth.network.decoder import bounded, concentration, facing
from geogs.depth.network.layers import Norm, upsampled
from geogs.depth.network.model import DepthNetwork
from geogs.depth.network.plane_views import TriedDepths, cell_rays
from geogs.depth.network.surface_normals import normals_of
from geogs.depth.network.volume import combined
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import normals_from_depth


def network(seed: int = 0) -> DepthNetwork:
    torch.manual_seed(seed)
    made = DepthNetwork(NETWORK).eval()
    for parameter in made.readout.planes[-1].parameters():  # an opinion of the planes
        torch.nn.init.normal_(parameter, std=1.0)
    return made


def test_as_many_weights_as_may_be_shipped():
    count = sum(p.numel() for p in DepthNetwork().parameters())
    assert 4e6 < count < 6e6
    assert 2 * count < 12e6


def test_the_norm_is_that_of_groups():
    norm = Norm(16)
    torch.nn.init.normal_(norm.weight)
    x = torch.randn(2, 16, 5, 7).to(memory_format=torch.channels_last)
    expected_ = torch.nn.functional.group_norm(x, 2, norm.weight, norm.bias)
    torch.testing.assert_close(norm(x), expected_)


def test_upsampling_is_a_convex_combination_of_nine():
    x, logits = torch.randn(1, 2, 3, 4), torch.randn(1, 36, 3, 4)
    found = upsampled(x, logits, torch.inf)
    for row, column in ((0, 0), (5, 7), (2, 3), (3, 6)):
        i, j, sub = row // 2, column // 2, 2 * (row % 2) + column % 2
        weights = [math.exp(float(logits[0, 4 * k + sub, i, j])) for k in range(9)]
        near = [
            x[0, 0, min(max(i + k // 3 - 1, 0), 2), min(max(j + k % 3 - 1, 0), 3)] for k in range(9)
        ]
        mean = sum(w * float(n) for w, n in zip(weights, near, strict=True)) / sum(weights)
        assert float(found[0, 0, row, column]) == pytest.approx(mean, abs=1e-5)


def test_upsampling_averages_nothing_across_an_edge():
    x = torch.tensor([[0.0, 0.01, 1.0], [0.0, 0.01, 1.0], [0.0, 0.01, 1.0]])
    x = torch.stack([x, 10 * x])[None]  # what lies beside follows the depth
    logits = torch.randn(1, 36, 3, 3, generator=torch.Generator().manual_seed(1))
    found = upsampled(x, logits, 0.04)
    blended = upsampled(x, logits, torch.inf)
    assert ((blended[0, 0] > 0.05) & (blended[0, 0] < 0.95)).sum() > 5
    for row in range(6):
        for column in range(6):
            i, j, sub = row // 2, column // 2, 2 * (row % 2) + column % 2
            places = [
                (min(max(i + k // 3 - 1, 0), 2), min(max(j + k % 3 - 1, 0), 2)) for k in range(9)
            ]
            near = [float(x[0, 0, r, c]) for r, c in places]
            weights = [math.exp(float(logits[0, 4 * k + sub, i, j])) for k in range(9)]
            best = near[weights.index(max(weights))]
            some = [(w, n) for w, n in zip(weights, near, strict=True) if abs(n - best) <= 0.04]
            mean = sum(w * n for w, n in some) / sum(w for w, _ in some)
            assert float(found[0, 0, row, column]) == pytest.approx(mean, abs=1e-5)
            assert float(found[0, 1, row, column]) == pytest.approx(10 * mean, abs=1e-4)


def test_neighbours_are_weighted_by_a_softmax_of_those_that_see():
    scores, logits = torch.randn(1, 3, 2, 4), torch.randn(1, 3, 2, 4)
    mask = torch.rand(1, 3, 2, 4) < 0.6
    mask[..., 0, 0] = False
    found = combined(scores, logits, mask)
    assert found[0, 0, 0] == 0
    for d in range(2):
        for p in range(4):
            some = [k for k in range(3) if mask[0, k, d, p]]
            weight = [math.exp(float(logits[0, k, d, p])) for k in some]
            total = sum(w * float(scores[0, k, d, p]) for w, k in zip(weight, some, strict=True))
            if some:
                assert float(found[0, d, p]) == pytest.approx(total / sum(weight), abs=1e-4)


def test_normals_equal_those_of_the_whole_system():
    camera = Camera(fx=20.0, fy=22.0, cx=7.0, cy=5.0, width=16, height=12)
    depth = 2 + 0.3 * torch.rand(12, 16)
    rays = cell_rays(torch.tensor([[20.0, 22.0, 7.0, 5.0]]), 12, 16, 1).unflatten(2, (12, 16))
    tilted = torch.tensor([0.3, -0.2, -1.0])
    plane = -2.0 / (rays[0] * tilted[:, None, None]).sum(0)
    found = normals_of(plane.log()[None], rays)[0]
    # The logarithm is not straight along a plane, but nearly.
    cosine = (found * torch.nn.functional.normalize(tilted, dim=0)[:, None, None]).sum(0)
    assert cosine[1:-1, 1:-1].min() > 0.9999
    theirs, _ = normals_from_depth(depth, camera)
    mine = normals_of(depth.log()[None], rays)[0].movedim(0, -1)
    assert (mine * theirs).sum(-1)[1:-1, 1:-1].min() > 0.98


def test_normals_face_the_camera_and_bounds_hold():
    rays = cell_rays(torch.tensor([[20.0, 22.0, 7.0, 5.0]]), 12, 16, 1).unflatten(2, (12, 16))
    found = facing(torch.randn(1, 3, 12, 16), rays)
    assert (found * rays).sum(1).max() < 0
    assert torch.allclose(found.norm(dim=1), torch.ones(()), atol=1e-4)
    assert float(bounded(torch.zeros(1)).exp()) == pytest.approx(0.03, rel=1e-4)
    assert -6.5 <= float(bounded(torch.tensor([-99.0]))) < float(bounded(torch.tensor([99.0]))) <= 0
    assert float(concentration(torch.zeros(1))) == pytest.approx(2.0)


def test_the_unit_of_length_does_not_matter():
    views = random_views(1, 3, 48, 64)
    T = views.T_nk.clone()
    T[..., :3, 3] *= 7.0
    larger = replace(
        views, T_nk=T, near=7 * views.near, far=7 * views.far, typical=7 * views.typical
    )
    model = network()
    with torch.no_grad():
        one, other = model(views), model(larger)
    torch.testing.assert_close(one.log_depth, other.log_depth, atol=1e-4, rtol=0)
    torch.testing.assert_close(
        7 * one.depth(views.typical), other.depth(larger.typical), atol=0, rtol=1e-3
    )
    assert one.log_depth.std() > 0.01


def test_the_order_of_neighbours_and_those_that_are_not_there_do_not_matter():
    views, model = random_views(1, 3, 32, 32), network()
    order = [2, 0, 1]
    swapped = replace(views, others=views.others[:, order], T_nk=views.T_nk[:, order])
    valid = torch.tensor([[True, True, False]])
    fewer = replace(
        views,
        others=views.others[:, :2],
        T_nk=views.T_nk[:, :2],
        other_intrinsics=views.other_intrinsics[:, :2],
        valid=valid[:, :2],
    )
    with torch.no_grad():
        found = [model(v).log_depth for v in (views, swapped)]
        masked = model.volume(*volume_inputs(model, replace(views, valid=valid)))
        alone = model.volume(*volume_inputs(model, fewer))
    torch.testing.assert_close(found[0], found[1], atol=1e-4, rtol=0)
    torch.testing.assert_close(masked[:, :-1], alone[:, :-1], atol=1e-4, rtol=1e-4)


def volume_inputs(model: DepthNetwork, views) -> tuple:
    own = torch.randn(1, 8, 8, 8, generator=torch.Generator().manual_seed(1))
    theirs = torch.randn(1, 3, 8, 8, 8, generator=torch.Generator().manual_seed(2))
    planes = TriedDepths.planes(torch.linspace(-1, 1, NETWORK.planes)[None])
    return own, theirs[:, : views.others.shape[1]], views, planes


def test_any_size_of_image_is_taken():
    views = random_views(1, 2, 37, 50)
    with torch.no_grad():
        found = network()(views)
    assert found.log_depth.shape == (1, 37, 50)
    assert found.normal.shape == (1, 3, 37, 50)
    low, high = (x.log() - views.typical.log() for x in (views.near, views.far))
    assert found.log_depth.min() > low - 0.5
    assert found.log_depth.max() < high + 0.5
