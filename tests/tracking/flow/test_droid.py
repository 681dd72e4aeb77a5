"""DROID-SLAM's operator: geometry of its cells, units of its weights and damping, its memory."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from droid_state import public_state
from geogs.bundle.dense import DenseBundle
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import linearise, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import DepthDamping
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.networks.tensor_files import read_tensors
from geogs.tracking.flow.droid import DroidFlow, DroidOptions
from geogs.tracking.flow.droid_network import DroidNetwork, load_droid
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.flow.lookup import CorrelationVolume
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from tracking_scenes import CAMERA, pose, render

GRID = SampleGrid(CAMERA)
POSES = [pose(0.0), pose(0.12, 0.02, 0.05, 0.03), pose(0.2, 0.0, 0.05, 0.05)]


def narrow(seed: int = 0, delta: tuple[float, float] | None = None) -> DroidNetwork:
    """A small network with random weights; with ``delta`` all its updates are that many cells."""
    torch.manual_seed(seed)
    network = DroidNetwork(8)
    for head in (network.update.delta, network.update.weight):
        head[2].weight.data *= 5
    if delta is not None:
        network.update.delta[2].weight.data.zero_()
        network.update.delta[2].bias.data = torch.tensor(delta)
    return network


@pytest.fixture(scope="module")
def operator() -> DroidFlow:
    return DroidFlow(GRID, narrow())


@pytest.fixture(scope="module")
def views(operator):
    return [operator.encode(render(T)[0]) for T in POSES]


@pytest.fixture
def start() -> tuple[torch.Tensor, torch.Tensor]:
    wave = 3 * torch.sin(GRID.pixels.flip(-1) / 30)
    return (GRID.pixels + wave)[None], (GRID.pixels - wave)[None]


def test_the_public_weights_load_from_their_file(tmp_path: Path):
    path = tmp_path / "droid.pth"
    torch.save(public_state(), path)
    grid = SampleGrid(Camera(fx=40.0, fy=40.0, cx=24.0, cy=20.0, width=48, height=40))
    operator = DroidFlow(grid, load_droid(read_tensors(path)))
    assert isinstance(operator, FlowOperator)
    image = np.random.default_rng(0).integers(0, 255, (40, 48, 3), np.uint8)
    encoded = operator.encode(image)
    assert encoded.features.shape == encoded.hidden.shape == (128, 5, 6)
    there, back = operator.measure([encoded], [encoded])
    assert there.pixels.shape == back.weight.shape == (1, grid.size, 2)
    assert torch.isfinite(there.pixels).all()
    (tmp_path / "short.pth").write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="is damaged"):
        read_tensors(tmp_path / "short.pth")


@pytest.mark.parametrize("width", [144, 149, 151])
def test_cells_are_centred_on_the_grid(width):
    """The columns that change a cell's context lie evenly around its pixel, 4 + 8 c."""
    grid = SampleGrid(Camera(fx=90.0, fy=90.0, cx=72.0, cy=20.0, width=width, height=45))
    operator = DroidFlow(grid, narrow())
    image = np.random.default_rng(1).integers(60, 190, (45, width, 3), np.uint8)
    plain = operator.encode(image)
    assert plain.hidden.shape == (32, grid.height, grid.width)
    column = 8
    seen = []
    for x in [*range(8, 24), *range(112, 130)]:
        changed = image.copy()
        changed[:, x] += 60
        other = operator.encode(changed)
        if not torch.equal(other.static[:, :, column], plain.static[:, :, column]):
            seen.append(x)
    assert (seen[0] + seen[-1]) / 2 == 4 + 8 * column
    assert 8 < seen[0] < 24


def test_positions_come_back_to_the_hundredth_of_a_pixel(start):
    """Without a change by the network the matches are the reprojection; a cell is 8 pixels."""
    for delta in ((0.0, 0.0), (0.5, -0.25)):
        operator = DroidFlow(GRID, narrow(delta=delta), DroidOptions(updates=3))
        views = [operator.encode(render(T)[0]) for T in POSES[:2]]
        there, back = operator.measure([views[0]], [views[1]], *start, fine=False)
        step = 3 * 8 * torch.tensor(delta)
        torch.testing.assert_close(there.pixels, start[0] + step, rtol=0, atol=1e-3)
        torch.testing.assert_close(back.pixels, start[1] + step, rtol=0, atol=1e-3)


def test_weights_are_inverse_variances_and_zero_where_there_is_no_match(start):
    network = narrow(delta=(0.0, 0.0))
    network.update.weight[2].weight.data.zero_()
    network.update.weight[2].bias.data = torch.logit(torch.tensor([0.8, 0.4]))
    operator = DroidFlow(GRID, network, DroidOptions(deviation=0.5))
    views = [operator.encode(render(T)[0]) for T in POSES[:2]]
    forward = start[0] + torch.tensor([40.0, 0.0])
    there, _ = operator.measure([views[0]], [views[1]], forward, start[1])
    inside = GRID.inside(there.pixels, 0.0)
    assert 0.05 < float((~inside).float().mean()) < 0.5
    expected = torch.tensor([0.8, 0.4]) / 0.25
    torch.testing.assert_close(there.weight[inside], expected.expand(int(inside.sum()), 2))
    assert float(there.weight[~inside].max()) == 0
    strict = DroidFlow(GRID, network, DroidOptions(min_confidence=0.65))
    assert float(strict.measure([views[0]], [views[1]], *start)[0].weight.max()) == 0


def test_damping_and_weights_stand_in_the_proportion_of_droid(operator, views):
    """Curvature over damping is that of DROID-SLAM's own units: cells and 0.001 w."""
    T_cw = torch.from_numpy(np.linalg.inv(np.stack(POSES[:2])))
    depth = torch.from_numpy(render(POSES[0])[1][4:-3:8, 4:-3:8].reshape(1, -1).copy())
    d = (1 / depth).float().expand(2, -1)
    edge = torch.tensor([0]), torch.tensor([1])
    T = relative_motion(T_cw, *edge)
    projection = linearise(CAMERA, GRID.rays, T, d[:1])
    there, _ = operator.measure([views[0]], [views[1]], projection.pixels, projection.pixels)
    free = torch.ones(2, dtype=torch.bool)
    problem = BundleProblem(T_cw, d, *edge, ~free, free, pixels=there.pixels, weight=there.weight)
    ours = DenseBundle(GRID).solve(problem, BundleOptions(1, huber=1e9)).information[0]

    w = there.weight[0] * operator.options.deviation**2
    J = projection.depth_jacobian[0] / 8
    curvature = (0.001 * w * J.square()).sum(-1)
    with torch.no_grad():
        damping = operator.network.update.agg(there.memory[0].hidden[None], torch.tensor([0]))
    eta = damping.reshape(-1)
    expected = curvature / (0.2 * eta + 1e-7)
    assert float(expected.median()) > 0
    torch.testing.assert_close(ours / there.damping[0], expected, rtol=1e-3, atol=1e-6)


def test_memory_continues_where_the_edge_was_left(operator, views, start):
    once = DroidFlow(GRID, operator.network, DroidOptions(updates=1))
    first = once.measure([views[0]], [views[1]], *start, fine=False)
    memory = [(first[0].memory[0], first[1].memory[0])]
    moved = first[0].pixels, first[1].pixels
    again = once.measure([views[0]], [views[1]], *moved, fine=False, memory=memory)
    # Two updates in one go start the second from where the first has ended, too.
    both = DroidFlow(GRID, operator.network, DroidOptions(updates=2))
    whole = both.measure([views[0]], [views[1]], *start, fine=False)
    torch.testing.assert_close(again[0].pixels, whole[0].pixels, rtol=0, atol=1e-3)
    torch.testing.assert_close(again[1].weight, whole[1].weight, rtol=1e-4, atol=1e-4)
    forgetful = once.measure([views[0]], [views[1]], *moved, fine=False)
    assert float((forgetful[0].pixels - again[0].pixels).abs().max()) > 0.1
    # The last target counts, not only the hidden state.
    elsewhere = once.measure(
        [views[0]], [views[1]], *(m + 4 for m in moved), fine=False, memory=memory
    )
    stale = once.measure([views[0]], [views[1]], *(m + 4 for m in moved), fine=False)
    assert float((elsewhere[0].pixels - stale[0].pixels).abs().max()) > 0.1


def test_the_start_of_an_edge_is_the_context_of_its_source(operator, views, start):
    """The first update equals the network's own, called with what the layout asks for."""
    once = DroidFlow(GRID, operator.network, DroidOptions(updates=1))
    there, _ = once.measure([views[0]], [views[1]], *start, fine=False)
    with torch.no_grad():
        shown = torch.from_numpy(render(POSES[0])[0][4:, 4:].copy()).permute(2, 0, 1)[None]
        shown = torch.nn.functional.pad(shown.float() / 255, (0, 4, 0, 4), mode="replicate")
        hidden, static = once.network.context(shown)
        position = ((start[0] - 4) / 8).reshape(1, GRID.height, GRID.width, 2)
        flow = position - ((GRID.pixels - 4) / 8).reshape(1, GRID.height, GRID.width, 2)
        motion = torch.cat([flow, 0 * flow], -1).permute(0, 3, 1, 2)
        features = [view.features[None] for view in views[:2]]
        correlation = CorrelationVolume(*features)(position)
        out = once.network.update(hidden, static, correlation, motion)
    expected = position + out.delta.permute(0, 2, 3, 1)
    torch.testing.assert_close(there.pixels, (4 + 8 * expected).flatten(1, 2), rtol=1e-4, atol=1e-3)


def test_batches_do_not_change_the_result(operator, views, start):
    pairs = [views[0], views[0]], [views[1], views[2]]
    doubled = [s.expand(2, -1, -1) for s in start]
    expected = operator.measure(*pairs, *doubled)
    found = DroidFlow(GRID, operator.network, DroidOptions(edges_at_once=1)).measure(
        *pairs, *doubled
    )
    for a, b in zip(expected, found, strict=True):
        torch.testing.assert_close(a.pixels, b.pixels, rtol=1e-4, atol=5e-3)
        torch.testing.assert_close(a.weight, b.weight, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(a.damping, b.damping, rtol=1e-3, atol=1e-3)
    # Both edges leave the first view; of those that come back each has a view of its own.
    assert torch.equal(expected[0].damping[0], expected[0].damping[1])
    assert not torch.equal(expected[1].damping[0], expected[1].damping[1])


def test_half_precision_is_close(operator, start, monkeypatch):
    """As on a GPU, but computed on the CPU."""
    images = [render(T)[0] for T in POSES[:2]]
    full = [operator.encode(image) for image in images]
    expected, _ = operator.measure(full[:1], full[1:], *start)
    monkeypatch.setattr(DroidFlow, "_precision", lambda _: torch.autocast("cpu", torch.float16))
    half = [operator.encode(image) for image in images]
    there, _ = operator.measure(half[:1], half[1:], *start)
    assert half[0].features.dtype == there.memory[0].hidden.dtype == torch.float16
    assert there.pixels.dtype == there.weight.dtype == there.damping.dtype == torch.float32
    difference = (there.pixels - expected.pixels).norm(dim=-1)
    assert 0 < float(difference.median()) < 0.1


def test_the_graph_adjusts_what_the_operator_measures():
    """The whole way: memory, weights and damping through the graph into the adjustment."""
    operator = DroidFlow(GRID, narrow(delta=(0.0, 0.0)))
    store = KeyframeTable.on(GRID).new_set()
    for k, T in enumerate(POSES):
        image, depth = render(T)
        state = store.add(
            k, k / 30, image, operator.encode(image), torch.from_numpy(np.linalg.inv(T))
        )
        state.inverse_depth = torch.from_numpy(1 / depth[4:-3:8, 4:-3:8].reshape(-1)).float()
    graph = FrameGraph(store, operator)
    pairs = [(0, 1), (1, 2), (0, 2)]
    graph.measure(pairs)
    before = graph.edges[0, 2].memory.hidden
    graph.measure(pairs)
    assert not torch.equal(graph.edges[0, 2].memory.hidden, before)
    problem, _ = graph.problem(list(graph.edges), [2], [0, 1, 2])
    (damping,) = problem.depth_terms
    assert isinstance(damping, DepthDamping)
    assert float(damping.curvature.min()) > 0
    torch.testing.assert_close(damping.curvature[0], graph.edges[0, 1].damping)
    # The network leaves the true reprojection as it is, so nothing moves.
    truth = store.poses([2])
    assert graph.adjust(list(graph.edges), [2], [0, 1, 2], BundleOptions()) is not None
    torch.testing.assert_close(store.poses([2]), truth, rtol=0, atol=1e-5)


def test_texture_and_size_of_an_image(operator, views):
    assert operator.texture(views[0]) > 0.8
    black = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    assert operator.texture(operator.encode(black)) == 0
    grey = cv2.cvtColor(render(POSES[0])[0], cv2.COLOR_RGB2GRAY)
    np.testing.assert_array_equal(operator.grey(views[0]).numpy(), grey)
    with pytest.raises(InputError, match="does not fit"):
        operator.encode(black[:-8])
