"""Which of two depths the images speak for: against a loop, and on a square before a wall."""

import numpy as np
import pytest
import torch
from torch.nn.functional import max_pool2d

from cuda_emulator import use_emulator
from depth_scene import RENDER, WORKING, make_scene
from geogs.depth.classical import CpuDepthEngine
from geogs.depth.cuda import revision as on_gpu
from geogs.depth.cuda.classical import CudaDepthEngine
from geogs.depth.depth_engine import AlternativeSearch, DepthTask
from geogs.depth.depth_view import DenseDepth
from geogs.depth.revision import revised_searches
from geogs.depth.revision.photo_vote import CONTRAST, DEVIATIONS, LEAST_DEVIATION, RADIUS
from geogs.depth.revision.revised_searches import MIN_GAP, REACH, FarSideSearch
from geogs.geometry.camera import Camera
from oracles.revision_reference import (
    averaged_by_colour,
    best_half,
    farther_surface,
    photo_costs,
    seen_from,
    truncated,
)


def test_grey_values_are_looked_up_as_a_loop_does():
    scene = make_scene()
    reference, other = scene.views[0], scene.views[1]
    pose = other.T_cw @ np.linalg.inv(reference.T_cw)
    grey, depth = torch.from_numpy(other.grey), torch.from_numpy(scene.truth[0])
    found = seen_from(grey[None], pose[None], depth, RENDER)[0].numpy()
    K = RENDER.matrix().numpy()
    inside = 0
    for v, u in ((10, 12), (36, 48), (40, 90), (70, 3), (5, 94)):
        point = pose[:3, :3] @ (np.linalg.inv(K) @ [u, v, 1] * scene.truth[0][v, u]) + pose[:3, 3]
        x, y, _ = K @ point / point[2]
        if not (0 <= x <= RENDER.width - 1 and 0 <= y <= RENDER.height - 1):
            assert np.isnan(found[v, u])
            continue
        inside += 1
        i, j = int(y), int(x)
        a, b = y - i, x - j
        corner = other.grey[i : i + 2, j : j + 2]
        expected = np.array([1 - a, a]) @ corner @ np.array([1 - b, b])
        assert found[v, u] == pytest.approx(expected, abs=1e-4)
    assert inside >= 3


def test_the_lower_half_counts_and_what_is_not_seen_does_not():
    nan = float("nan")
    costs = torch.tensor([[0.9, 0.2, 0.4, nan], [nan, 0.3, nan, nan]]).T[:, None, :]
    found = best_half(costs)[0]
    assert found.tolist() == pytest.approx([(0.2 + 0.4) / 2, 0.3])
    assert float(best_half(torch.full((3, 1, 1), nan))) == 1


def test_light_and_noise_of_a_neighbour_are_taken_out():
    rng = torch.Generator().manual_seed(0)
    noise = 0.01 * torch.randn(2, 1, 60, 60, generator=rng)
    same = torch.ones(60, 60, dtype=torch.bool)
    costs = truncated(noise + 0.3, same)
    deviation = float((noise[0] - noise[0].median()).abs().median())
    assert deviation > LEAST_DEVIATION
    expected = ((noise - noise[0].median()).abs() / (DEVIATIONS * deviation)).clamp(max=1)
    assert torch.allclose(costs, expected, atol=1e-4)
    assert 0.01 < float((costs == 1).float().mean()) < 0.1  # beyond two deviations


def test_the_mean_is_over_what_has_the_same_colour():
    rng = np.random.default_rng(1)
    values = rng.standard_normal((14, 16)).astype(np.float32)
    guide = rng.choice([0.2, 0.6], (1, 14, 16)).repeat(3, 0).astype(np.float32)
    found = averaged_by_colour(torch.from_numpy(values), torch.from_numpy(guide)).numpy()
    padded = np.pad(values, RADIUS, mode="edge")
    colours = np.pad(guide[0], RADIUS, mode="edge")
    side = 2 * RADIUS + 1
    for y, x in ((0, 0), (7, 8), (13, 3)):
        weight = np.exp(-abs(colours[y : y + side, x : x + side] - guide[0, y, x]) / CONTRAST)
        expected = (weight * padded[y : y + side, x : x + side]).sum() / weight.sum()
        assert found[y, x] == pytest.approx(expected, abs=1e-5)


def test_the_images_speak_for_the_true_depth():
    scene = make_scene()
    truth = torch.from_numpy(scene.truth[0])
    wrong = 1.15 * truth
    left = torch.arange(RENDER.width).expand(RENDER.height, -1) < 40
    depths = torch.stack([torch.where(left, truth, wrong), torch.where(left, wrong, truth)])
    depths[:, :, 80:] = truth[:, 80:]
    same = (depths[0] - depths[1]).abs() < 1e-6
    costs = photo_costs(scene.views[0], scene.views[1:], depths, same, RENDER)
    assert float(costs.min()) >= 0
    assert float(costs.max()) <= 1
    vote = costs[0] - costs[1]
    inner = torch.zeros_like(left)
    inner[8:-8, 8:72] = True
    assert float((vote[inner & left] < 0).float().mean()) > 0.95
    assert float((vote[inner & ~left] > 0).float().mean()) > 0.95
    turned = photo_costs(scene.views[0], scene.views[1:], depths.flip(0), same, RENDER)
    # The light is learned from the first of two depths that are the same where it counts.
    assert torch.allclose(turned, costs.flip(0), atol=1e-5)


def asked_of(scene):
    """Two depths of each pixel, where they are the same, and a mask of where they differ."""
    depth = torch.from_numpy(scene.truth[0]).clone()
    depth[20:40, 30:60] *= 0.8
    depth[:, :4] = 0
    beyond = depth.clone()
    beyond[15:45, 25:70] *= 1.1
    beyond[25:30, 40:45] *= 40  # out of most images
    return torch.stack([depth, beyond]), beyond == depth, beyond != depth


@pytest.mark.parametrize("everywhere", [False, True])
def test_compiled_loops_say_the_same(everywhere):
    scene = make_scene()
    depths, same, mask = asked_of(scene)
    views, mask = (scene.views[0], scene.views[1:]), None if everywhere else mask
    expected = photo_costs(*views, depths, same, RENDER, mask)
    found = CpuDepthEngine(RENDER, WORKING, 8).photo_costs(*views, depths, same, mask)
    assert float((expected[0] - expected[1]).abs().max()) > 0.3
    assert float((found - expected).abs().max()) < 2e-3
    if not everywhere:
        assert not found[:, ~(depths[0] != depths[1])].any()
    again = CpuDepthEngine(RENDER, WORKING, 8).photo_costs(*views, depths, same, mask)
    assert torch.equal(found, again)  # whatever was in memory


@pytest.mark.parametrize("device", ["emulated", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("everywhere", [False, True])
def test_a_gpu_says_the_same(device, everywhere, monkeypatch):
    if device == "emulated":
        use_emulator(monkeypatch, on_gpu)
        device = "cpu"
    elif not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    scene = make_scene()
    depths, same, mask = asked_of(scene)
    views, mask = (scene.views[0], scene.views[1:]), None if everywhere else mask
    expected = photo_costs(*views, depths, same, RENDER, mask)
    engine = CudaDepthEngine(torch.device(device), RENDER, WORKING, 128, 8)
    mask = None if mask is None else mask.to(device)
    found = engine.photo_costs(*views, depths.to(device), same.to(device), mask)
    assert float((found.cpu() - expected).abs().max()) < 2e-3


def steps(seed: int) -> torch.Tensor:
    """A rough depth map of slanted pieces that end at each other."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:60.0, :80.0]
    inverse = 0.3 + 0.001 * u + 0.0007 * v
    for _ in range(12):
        y, x = rng.integers(0, (60, 80))
        inside = (abs(v - y) < rng.integers(2, 15)) & (abs(u - x) < rng.integers(2, 20))
        slope = rng.normal(0, 0.002, 2)
        inverse[inside] = (rng.uniform(0.3, 0.9) + slope[0] * (u - x) + slope[1] * (v - y))[inside]
    return torch.from_numpy(1 / inverse.clip(0.1)).float()


@pytest.mark.parametrize("where", ["cpu", "emulated", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("reach", [1, 3, 6])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_surfaces_go_on(seed, reach, where, monkeypatch):
    depth = steps(seed)
    expected = farther_surface(depth, reach)
    if where == "emulated":
        use_emulator(monkeypatch, on_gpu)
        found = on_gpu.farther_surface(depth, reach)
    elif where == "cpu":
        found = revised_searches.farther_surface(depth, reach)
    elif torch.cuda.is_available():
        found = on_gpu.farther_surface(depth.cuda(), reach).cpu()
    else:
        pytest.skip("needs an NVIDIA GPU")
    assert 0.02 < float((expected > 0).float().mean()) < 0.6
    same = (found - expected).abs() <= 1e-4 * expected
    assert float((~same).float().mean()) < 2e-3  # a plane that is at a limit by one rounding


def test_a_farther_plane_goes_on_beneath_the_foreground():
    v, u = torch.meshgrid(torch.arange(30.0), torch.arange(50.0), indexing="ij")
    floor = 1 / (0.25 + 0.002 * v)  # slanted along the edge, at which no slope is known across it
    depth = torch.where(u < 20, torch.full_like(floor, 2.0), floor)
    found = farther_surface(depth, 5)
    assert not found[:, 20:].any()
    assert not found[:, :15].any()
    beneath = (slice(6, -6), slice(15, 20))
    assert found[beneath].numpy() == pytest.approx(floor[beneath].numpy(), rel=1e-4)
    assert not farther_surface(1 / (0.25 + 0.001 * u), 5).any()  # a slanted plane has none
    assert (found[found > 0] > depth[found > 0] / (1 - 0.9 * MIN_GAP)).all()


class _Grown(AlternativeSearch):
    """Finds the true depth, but for a foreground that is some pixels too large."""

    def __init__(self, depth, confidence, render):
        super().__init__(CpuDepthEngine(render, WORKING, 8))
        self.found = DenseDepth(depth, confidence, depth.median())

    def estimate(self, tasks, progress=None):
        return [self.found for _ in tasks]


def test_a_foreground_that_has_grown_gives_back_what_is_behind_it():
    working = Camera(fx=320.0, fy=320.0, cx=191.5, cy=143.5, width=384, height=288)
    render = working.resized(192, 144)
    scene = make_scene(0, working, render)
    truth = torch.from_numpy(scene.truth[0])
    ball = (truth < 2.1)[None, None].float()
    fringe = (max_pool2d(ball, 5, 1, 2) > ball)[0, 0]
    nearest = max_pool2d(ball / truth, 5, 1, 2)[0, 0]
    depth = torch.where(fringe, 1 / nearest.clamp(min=1e-6), truth)
    engine = FarSideSearch(_Grown(depth, torch.full_like(depth, 0.9), render))
    (found,) = engine.estimate([DepthTask(scene.views[0], scene.views[1:])])
    wrong = lambda z, where: float(((z / truth - 1).abs() > 0.05)[where].float().mean())  # noqa: E731
    assert round(REACH * 192) >= 3
    assert wrong(depth, fringe) > 0.95
    assert wrong(found.depth, fringe) < 0.35
    assert wrong(found.depth, ball[0, 0] > 0) < 0.05
    moved = found.depth != depth
    assert float(found.confidence[moved].max()) < 0.5
    assert found.typical == pytest.approx(float(found.depth.median()))
