"""The RAFT operator around its network; with made-up weights, so not how right the flow is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.config import TrackingConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.tracking.flow.base import FlowOperator
from geogs.tracking.flow.classical import ClassicalFlow
from geogs.tracking.flow.correlation import CorrelationVolume
from geogs.tracking.flow.raft import (
    RaftFlow,
    RaftOptions,
    checked_matches,
    padded,
    sample_flow,
    start_in_cells,
)
from geogs.tracking.flow.raft_network import SMALL, RaftEstimate, RaftFeatures
from geogs.tracking.tracker import Tracker
from geogs.world.grid import SampleGrid
from raft_oracle import original, published
from tracking_runs import error_cm
from tracking_scenes import CAMERA as ROOM_CAMERA
from tracking_scenes import frames, render, sideways

# Neither side is a multiple of 8: 17 x 20 cells of the network, 16 x 19 of the grid.
CAMERA = Camera(fx=150.0, fy=150.0, cx=78.0, cy=66.0, width=157, height=133)
GRID = SampleGrid(CAMERA)
OPTIONS = RaftOptions(cold_iterations=4, warm_iterations=4, coarse_iterations=2)


def image(k: int) -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    waves = [
        np.sin((0.31 + 0.02 * c) * (u - 2 * k) + 0.05 * v) * np.cos(0.23 * (v + k) + c)
        for c in range(3)
    ]
    return np.round(127.5 + 120 * np.stack(waves, -1)).astype(np.uint8)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "small.pth"
    torch.save(published("small"), path)
    return path


@pytest.fixture(scope="module")
def operator(weights) -> RaftFlow:
    return RaftFlow(GRID, weights, OPTIONS)


@pytest.fixture(scope="module")
def views(operator) -> list:
    return [operator.encode(image(k)) for k in range(4)]


def with_options(operator: RaftFlow, **changes) -> RaftFlow:
    other = object.__new__(RaftFlow)
    other.__dict__.update(operator.__dict__, options=replace(OPTIONS, **changes))
    return other


def test_it_is_a_flow_operator(operator):
    assert isinstance(operator, FlowOperator)


def test_texture_is_the_classical_operators(operator, views):
    classical = ClassicalFlow(GRID)
    assert operator.texture(views[0]) == classical.texture(classical.encode(image(0))) > 0.5
    grey = classical.grey(classical.encode(image(0)))
    torch.testing.assert_close(operator.grey(views[0]), grey, rtol=0, atol=0)
    flat = np.full_like(image(0), 90)
    assert operator.texture(operator.encode(flat)) == 0.0


def test_images_are_continued_below_and_to_the_right():
    found = padded(torch.from_numpy(image(0)))
    assert found.shape == (1, 3, 136, 160)
    wanted = np.pad(image(0), ((0, 3), (0, 3), (0, 0)), mode="edge") / 127.5 - 1
    np.testing.assert_allclose(found[0].permute(1, 2, 0).numpy(), wanted, atol=1e-6)


def test_matches_are_the_networks_flow_at_the_cells(operator, views):
    there, back = operator.measure([views[0]], [views[1]])
    assert there.pixels.shape == there.weight.shape == (1, GRID.size, 2)
    a, b = (operator.network.encode(padded(torch.from_numpy(image(k)))) for k in (0, 1))
    for match, first, second in ((there, a, b), (back, b, a)):
        lookup = CorrelationVolume(first.features, second.features, radius=3)
        flow = operator.network.estimate(first, lookup, None, 4).pixels[0]
        assert float(flow.std()) > 1.0
        for row, column in ((0, 0), (3, 7), (15, 18)):
            x, y = 4 + 8 * column, 4 + 8 * row
            wanted = torch.tensor([x, y]) + flow[:, y, x]
            found = match.pixels[0, row * GRID.width + column]
            torch.testing.assert_close(found, wanted, atol=1e-4, rtol=0)


def test_many_edges_are_the_single_ones(operator, views):
    first, second = [views[0], views[1], views[0]], [views[1], views[2], views[3]]
    start = GRID.pixels + torch.tensor([[[2.0, 0.0]], [[0.0, -3.0]], [[5.0, 5.0]]])
    back_start = GRID.pixels - torch.tensor([[[2.0, 0.0]], [[0.0, -3.0]], [[5.0, 5.0]]])
    for chunk in (OPTIONS.memory, 1):  # all at once, one by one
        many = with_options(operator, memory=chunk).measure(first, second, start, back_start)
        for n in range(3):
            one = operator.measure([first[n]], [second[n]], start[n : n + 1], back_start[n : n + 1])
            for found, wanted in zip(many, one, strict=True):
                torch.testing.assert_close(found.pixels[n], wanted.pixels[0], atol=1e-3, rtol=0)
    assert float((many[0].pixels[0] - many[0].pixels[2]).abs().max()) > 1.0


def test_there_and_back_change_places_with_the_images(operator, views):
    there, back = operator.measure([views[0]], [views[1]])
    other_there, other_back = operator.measure([views[1]], [views[0]])
    torch.testing.assert_close(there.pixels, other_back.pixels, atol=1e-3, rtol=0)
    torch.testing.assert_close(back.pixels, other_there.pixels, atol=1e-3, rtol=0)
    assert float((there.pixels - back.pixels).abs().max()) > 1.0


def test_a_start_of_no_motion_is_a_cold_start(operator, views):
    rest = GRID.pixels[None]
    cold = operator.measure([views[0]], [views[1]])[0]
    warm = operator.measure([views[0]], [views[1]], rest, rest)[0]
    torch.testing.assert_close(warm.pixels, cold.pixels, atol=1e-4, rtol=0)
    moved = operator.measure([views[0]], [views[1]], rest + 6, rest - 6)[0]
    assert float((moved.pixels - cold.pixels).abs().max()) > 1.0


def test_number_of_updates_depends_on_what_is_known(weights, views):
    counts = []
    operator = RaftFlow(GRID, weights, RaftOptions())
    estimate = operator.network.estimate
    operator.network.estimate = lambda a, c, s, n: counts.append(n) or estimate(a, c, s, 1)
    rest = GRID.pixels[None]
    operator.measure([views[0]], [views[1]])
    operator.measure([views[0]], [views[1]], rest, rest)
    operator.measure([views[0]], [views[1]], rest, rest, fine=False)
    assert counts == [20, 8, 4]


def test_start_is_the_flow_at_the_networks_cells():
    """Linear flow: exact inside, where the network's cell (r, c) is at pixel (8 c, 8 r)."""
    x, y = GRID.pixels.unbind(-1)
    flow = torch.stack([0.1 * x - 0.05 * y + 3, 0.02 * y - 4], -1)
    start = start_in_cells(GRID, (GRID.pixels + flow)[None], 17, 20)
    assert start.shape == (1, 2, 17, 20)
    v, u = torch.meshgrid(8.0 * torch.arange(17), 8.0 * torch.arange(20), indexing="ij")
    wanted = torch.stack([0.1 * u - 0.05 * v + 3, 0.02 * v - 4]) / 8
    torch.testing.assert_close(start[0, :, 1:16, 1:19], wanted[:, 1:16, 1:19], atol=1e-5, rtol=0)
    # At the border the nearest cells count: 4 pixels or less away.
    assert float((start[0] - wanted).abs().max()) < 4 * 0.15 / 8 + 1e-5


def test_positions_that_are_no_numbers_are_no_start(operator, views):
    start = GRID.pixels[None].clone()
    start[0, :40] = torch.nan
    start[0, 40:60] = 1e30
    there, back = operator.measure([views[0]], [views[1]], start, start)
    for match in (there, back):
        assert bool(torch.isfinite(match.pixels).all() & torch.isfinite(match.weight).all())


def constant_flow(x: float, y: float) -> torch.Tensor:
    return torch.tensor([float(x), float(y)])[:, None, None].expand(2, CAMERA.height, CAMERA.width)


def test_what_comes_home_counts():
    flow = torch.stack([constant_flow(3, -2), constant_flow(-3, 2.5)])
    there, back = checked_matches(GRID, flow, RaftOptions())
    torch.testing.assert_close(there.pixels[0], GRID.pixels + torch.tensor([3.0, -2.0]))
    weight = there.weight[0].reshape(GRID.height, GRID.width, 2)
    # Half a pixel of disagreement.
    assert weight[5, 5].tolist() == pytest.approx([(0.15 + 0.8 * 0.5) ** -2] * 2, rel=1e-4)
    # Column 18 is at pixel 148 + 3 of 157; row 0 at 4 - 2 is inside by 2.
    assert int((there.weight > 0).all(-1).sum()) == GRID.size
    assert int((back.weight > 0).all(-1).sum()) == GRID.size


def test_what_leaves_or_does_not_come_home_does_not_count():
    flow = torch.stack([constant_flow(10, 0), constant_flow(-10, 0)])
    used = checked_matches(GRID, flow, RaftOptions())[0].weight[0, :, 0] > 0
    used = used.reshape(GRID.height, GRID.width)
    assert bool(used[:, :-1].all())
    assert not bool(used[:, -1].any())  # 148 + 10 > 155
    flow = torch.stack([constant_flow(10, 0), constant_flow(-10, 1.2)])
    assert float(checked_matches(GRID, flow, RaftOptions())[0].weight.max()) == 0.0
    broken = torch.full((2, 2, CAMERA.height, CAMERA.width), torch.nan)
    there, _ = checked_matches(GRID, broken, RaftOptions())
    assert float(there.weight.max()) == 0.0
    assert bool(torch.isfinite(there.pixels).all())


def test_flow_is_sampled_at_pixel_centres():
    v, u = torch.meshgrid(torch.arange(133.0), torch.arange(157.0), indexing="ij")
    points = torch.tensor([[[3.0, 5.0], [10.25, 7.5], [156.0, 132.0], [156.2, 9.0], [-0.1, 9.0]]])
    found, inside = sample_flow(torch.stack([u, v])[None], points)
    torch.testing.assert_close(found[0, :3], points[0, :3], atol=1e-3, rtol=0)
    assert inside.tolist() == [[True, True, True, False, False]]


def test_in_little_memory_the_matches_are_the_same(operator, views):
    little = with_options(operator, without_volume=True)
    found, wanted = (o.measure([views[0]], [views[1]])[0] for o in (little, operator))
    torch.testing.assert_close(found.pixels, wanted.pixels, atol=1e-3, rtol=0)


def test_half_precision_as_on_a_gpu_is_nearly_the_same(operator, views, monkeypatch):
    wanted = operator.measure([views[0]], [views[1]])[0]
    monkeypatch.setattr(SampleGrid, "on_gpu", property(lambda self: True))
    halves = [operator.encode(image(k)) for k in (0, 1)]
    assert halves[0].features.features.dtype == torch.float16
    found = operator.measure(halves[:1], halves[1:])[0]
    assert found.pixels.dtype == torch.float32
    assert float((found.pixels - wanted.pixels).norm(dim=-1).median()) < 0.1


@pytest.mark.parametrize("make", [published, original])
def test_both_sizes_load(tmp_path, make):
    torch.save(make("large"), tmp_path / "large.pth")
    assert not RaftFlow(GRID, tmp_path / "large.pth").network.shape.is_small


def test_other_weights_are_told_in_one_sentence(tmp_path):
    tensors = published("small")
    tensors["surplus.weight"] = tensors.pop("update_block.flow_head.conv2.weight")
    torch.save(tensors, tmp_path / "other.pth")
    with pytest.raises(InputError) as caught:
        RaftFlow(GRID, tmp_path / "other.pth")
    assert "does not fit RAFT: 1 tensor is missing" in str(caught.value)
    assert "1 tensor is unknown (such as surplus.weight)." in str(caught.value)
    assert "\n" not in str(caught.value)


def test_another_image_size_is_told(operator):
    with pytest.raises(InputError, match="does not fit a camera of 157 x 133"):
        operator.encode(np.zeros((64, 64, 3), np.uint8))


class KnowingNetwork:
    """Gives the true flow of a rendered path instead of estimating it."""

    shape = SMALL

    def __init__(self, path: list[np.ndarray]) -> None:
        self.path = path
        views = [render(T) for T in path]
        self.depth = [depth for _, depth in views]
        shown = [padded(torch.from_numpy(image)).numpy().tobytes() for image, _ in views]
        self.frame = {content: k for k, content in enumerate(shown)}

    def encode(self, image: torch.Tensor) -> RaftFeatures:
        # One feature, the number of the frame plus one: products tell both frames of a pair.
        number = torch.full((1, 1, 18, 24), self.frame[image.numpy().tobytes()] + 1.0)
        return RaftFeatures(number, number, number)

    def estimate(self, first, correlation, start, iterations) -> RaftEstimate:
        at = torch.full((len(first.hidden), 18, 24, 2), 8.0)
        products = correlation(at)[:, 24, 0, 0]
        numbers = first.hidden[:, 0, 0, 0]
        pairs = zip(numbers.tolist(), (products / numbers).tolist(), strict=True)
        flow = torch.stack([self.flow(round(a) - 1, round(b) - 1) for a, b in pairs])
        return RaftEstimate(flow[..., ::8, ::8] / 8, flow)

    def flow(self, a: int, b: int) -> torch.Tensor:
        rays = ROOM_CAMERA.rays(torch.float64).numpy()
        T = np.linalg.inv(self.path[b]) @ self.path[a]
        points = (rays * self.depth[a][..., None]) @ T[:3, :3].T + T[:3, 3]
        u = ROOM_CAMERA.fx * points[..., 0] / points[..., 2] + ROOM_CAMERA.cx
        v = ROOM_CAMERA.fy * points[..., 1] / points[..., 2] + ROOM_CAMERA.cy
        y, x = np.mgrid[: ROOM_CAMERA.height, : ROOM_CAMERA.width]
        return torch.from_numpy(np.stack([u - x, v - y])).float()


def test_the_tracker_follows_a_network_that_is_right(weights):
    """All between network and tracker: cells, directions, starts, confidence."""
    path = sideways(25)
    operator = RaftFlow(SampleGrid(ROOM_CAMERA), weights)
    operator.network = KnowingNetwork(path)
    tracker = Tracker(ROOM_CAMERA, TrackingConfig(init_keyframes=5), operator=operator)
    for frame in frames(path):
        tracker.track(frame)
    tracker.finish()
    trajectory = tracker.trajectory()
    assert trajectory.tracked.all()
    # Between keyframes what is kept of the flow is rounded to a fraction of a pixel.
    assert error_cm(trajectory.T_wc[:, :3, 3], np.stack(path)[:, :3, 3]) < 0.005
