"""Our flow network and its operator: geometry of the cells, likelihood, plumbing."""

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.flow.classical_flow_cuda import CudaClassicalFlow
from geogs.tracking.flow.lookup import Edges, level_tables
from geogs.tracking.flow.network_parts import cell_pixels
from geogs.tracking.flow.own import OwnFlow, OwnFlowOptions
from geogs.tracking.flow.own_network import (
    FlowEstimate,
    FlowNetwork,
    FlowResidual,
    LaplaceMixture,
    NetworkOptions,
    load_flow_network,
)
from geogs.world.grid import SampleGrid
from geogs_train.course import write_weights
from geogs_train.flow.flow_validation import FlowScores, SceneScores

SMALL = NetworkOptions(stem=8, middle=16, deep=16, hidden=16, context=16, motion=16)
CAMERA = Camera(fx=80.0, fy=80.0, cx=51.5, cy=38.5, width=103, height=77)


@pytest.fixture
def network() -> FlowNetwork:
    torch.manual_seed(5)
    return FlowNetwork(SMALL).eval()


@pytest.fixture
def operator(network, tmp_path) -> OwnFlow:
    path = tmp_path / "w.safetensors"
    write_weights(network, path, 3, scores=SceneScores(FlowScores(*[0.5] * 10), {}))
    grid = SampleGrid(CAMERA)
    return OwnFlow(grid, path, ClassicalFlow(grid))


def images(count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 255, (77, 103, 3), np.uint8) for _ in range(count)]


def test_the_network_is_no_larger_than_two_million():
    assert sum(p.numel() for p in FlowNetwork().parameters()) <= 2_000_000


@pytest.mark.parametrize("size", [(77, 103), (80, 104), (71, 96), (290, 512)])
def test_features_lie_on_the_sample_grid(network, size):
    height, width = size
    grid = SampleGrid(Camera(fx=80.0, fy=80.0, cx=9.0, cy=9.0, width=width, height=height))
    with torch.no_grad():
        features = network.encode(torch.rand(1, 3, height, width))
    assert features.source.shape[1] == grid.size
    assert features.hidden.shape[-2:] == (grid.height, grid.width)
    torch.testing.assert_close(cell_pixels(grid.height, grid.width, grid.pixels), grid.pixels)


@pytest.mark.parametrize("shift", [0, 1])
def test_a_halving_block_is_centred_where_it_says(shift):
    block = FlowResidual(1, 1, shift)
    block.norm_first, block.norm_second = torch.nn.Identity(), torch.nn.Identity()
    for p in block.parameters():  # nothing may be cut off
        p.data.abs_()
    x = torch.rand(1, 1, 12, 16, requires_grad=True)
    block(x)[0, 0, 3, 4].backward()
    rows, columns = torch.nonzero(x.grad[0, 0], as_tuple=True)
    middle = (2 * 3 + 1 - shift, 2 * 4 + 1 - shift)
    # Two convolutions of three, the second after halving: three to each side.
    assert (rows.min() + rows.max()) / 2 == middle[0]
    assert (columns.min() + columns.max()) / 2 == middle[1]


def test_descriptors_of_the_pyramid_are_where_their_levels_say(network):
    """A bright spot moves the strongest response of each level to its own place."""
    quiet = torch.full((1, 3, 128, 128), 0.5)
    spot = quiet.clone()
    x, y = 66, 74
    spot[..., y - 2 : y + 3, x - 2 : x + 3] = 1.0
    for module in network.encoder.modules():
        if isinstance(module, FlowResidual):
            module.norm_first, module.norm_second = torch.nn.Identity(), torch.nn.Identity()
    network.encoder.stem[1] = torch.nn.Identity()
    with torch.no_grad():
        pyramids = [network.encode(i).pyramid for i in (quiet, spot)]
    change = (pyramids[1].descriptors - pyramids[0].descriptors).abs().sum(-1)[0]
    levels = pyramids[0].levels
    for (offset, w, h), level in zip(level_tables(levels)[0], levels, strict=True):
        field = change[offset : offset + w * h].reshape(h, w)
        v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        at = [float((field * c).sum() / field.sum()) for c in (u, v)]
        pixel = [(c - level.shift) / level.scale for c in at]
        assert pixel == pytest.approx([x, y], abs=max(4, 0.5 / level.scale))


def test_the_likelihood_is_that_of_two_laplace_distributions():
    mixture = LaplaceMixture(
        torch.tensor([[[0.4]]]), torch.tensor([[[-1.0, 0.2]]]), torch.tensor([[[1.0, 2.0]]])
    )
    error = torch.tensor([[[0.3, -5.0]]])
    p = 1 / (1 + np.exp(-0.4))
    expected = 0.0
    for e, b, c in ((0.3, np.exp(-1.0), np.e), (5.0, np.exp(0.2), np.exp(2.0))):
        density = p / (2 * b) * np.exp(-e / b) + (1 - p) / (2 * c) * np.exp(-e / c)
        expected -= np.log(density) / 2
    found = mixture.negative_log_likelihood(error)
    assert float(found) == pytest.approx(expected, abs=1e-5)
    variance = [2 * (p * np.exp(-2.0) + (1 - p) * np.exp(2.0)),
                2 * (p * np.exp(0.4) + (1 - p) * np.exp(4.0))]  # fmt: skip
    assert mixture.variance()[0, 0].tolist() == pytest.approx(variance, rel=1e-5)


def test_upsampling_is_a_convex_combination_of_near_cells(network):
    features = network.encode(torch.rand(1, 3, 77, 103))
    edges = Edges(torch.zeros(1, dtype=torch.int32), torch.zeros(1, dtype=torch.int32))
    cells = cell_pixels(*features.hidden.shape[-2:], features.source)
    with torch.no_grad():
        *_, last = network.iterate(features, edges, cells[None] + 5.0, 2)
        flow = last.pixels - cells
        dense = network.upsample(last, 77, 103)
    assert dense.shape == (1, 77, 103, 2)
    gh, gw = features.hidden.shape[-2:]
    field = flow.reshape(gh, gw, 2)
    for r, c in ((0, 0), (4, 7), (gh - 1, gw - 1)):
        near = field[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].reshape(-1, 2)
        block = dense[0, 8 * r : 8 * r + 8, 8 * c : 8 * c + 8].reshape(-1, 2)
        assert (block >= near.min(0).values - 1e-4).all()
        assert (block <= near.max(0).values + 1e-4).all()


def test_pairs_measured_together_equal_pairs_measured_alone(operator):
    a, b, c = (operator.encode(i) for i in images(3))
    start = operator.grid.pixels + 2.0
    together = operator.measure([a, b], [b, c], start.expand(2, -1, -1), start.expand(2, -1, -1))
    alone = operator.measure([b], [c], start[None], start[None])
    for both, single in zip(together, alone, strict=True):
        torch.testing.assert_close(both.pixels[1], single.pixels[0], atol=0.1, rtol=0)
    swapped = operator.measure([c], [b], start[None], start[None])
    torch.testing.assert_close(swapped[0].pixels[0], alone[1].pixels[0], atol=0.1, rtol=0)


def test_grey_levels_are_the_classical_operators(operator):
    image = images(1)[0]
    grey = operator.classical.grey(operator.classical.encode(image))
    torch.testing.assert_close(operator.grey(operator.encode(image)), grey, rtol=0, atol=0)


def test_cells_that_leave_the_image_have_no_weight(operator):
    operator.options = OwnFlowOptions(min_probability=0.0, max_deviation=1e6)
    a, b = (operator.encode(i) for i in images(2))
    far = (operator.grid.pixels + 300.0)[None]
    near = operator.grid.pixels[None]
    there, back = operator.measure([a], [b], far, near)
    assert float(there.weight.max()) == 0
    assert float((back.weight > 0).float().mean()) > 0.8


def test_weights_of_something_else_are_refused_in_one_sentence(tmp_path):
    with pytest.raises(InputError, match="no weights"):
        load_flow_network(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"0" * 64)
    with pytest.raises(InputError, match="does not hold weights"):
        load_flow_network(tmp_path / "bad.safetensors")


def test_cells_that_jump_from_a_warm_start_have_no_weight(operator):
    operator.options = OwnFlowOptions(min_probability=0.0, max_deviation=1e6, polish=False)
    cells = operator.grid.pixels
    inner = operator.grid.inside(cells, margin=20.0)
    jumped = cells.clone()
    far = torch.nonzero(inner)[:3, 0]
    jumped[far] += 8.0
    zero = torch.zeros(1, len(cells), 2)
    mixture = LaplaceMixture(zero[..., :1], zero, zero + 1)
    estimate = FlowEstimate(jumped[None] + 2.0, mixture, torch.zeros(1, 1, 1, 1))
    warm = operator._weight(estimate, cells[None])[0, :, 0] > 0
    assert not warm[far].any()
    assert warm[inner].sum() == inner.sum() - 3  # a shift of all is no jump
    assert (operator._weight(estimate, None)[0, far, 0] > 0).all()


def test_a_cold_start_counts_where_the_classical_flow_bears_it_out(operator):
    """The network is made to believe itself everywhere; noise and other noise have no match."""
    operator.options = OwnFlowOptions(
        min_probability=0.0, max_deviation=1e6, max_correction=1e6, cold_iterations=1
    )
    one, other = (operator.encode(image) for image in images(2))
    here = operator.grid.pixels[None]

    def matched(first, second, *start) -> float:
        match, _ = operator.measure([first], [second], *start)
        return float((match.weight[0, :, 0] > 0).float().mean())

    assert matched(one, other, here, here) > 0.7  # begun where one is, it is believed as it is
    assert matched(one, other) < 0.5
    assert matched(one, one) > 0.7


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_what_is_recorded_on_a_gpu_says_what_is_not(network, tmp_path, caplog):
    path = tmp_path / "w.safetensors"
    write_weights(network, path, 3, scores=SceneScores(FlowScores(*[0.5] * 10), {}))
    grid = SampleGrid(CAMERA, "cuda")
    options = OwnFlowOptions(min_probability=0.0, max_deviation=1e6)
    operator = OwnFlow(grid, path, CudaClassicalFlow(grid), options)
    a, b, c = (operator.encode(i) for i in images(3))
    with torch.inference_mode():
        again = operator._features(torch.from_numpy(images(3)[2]).cuda())
    for one, other in zip(c.features, again, strict=True):
        torch.testing.assert_close(one.float(), other.float(), rtol=0.02, atol=0.05)
    assert not torch.equal(a.features[0], c.features[0])  # it was not overwritten
    near = (operator.grid.pixels + 1.5)[None]
    starts = near.expand(2, -1, -1).contiguous()
    together = operator.measure([a, b], [b, c], starts, starts)
    for n, (one, other) in enumerate(((a, b), (b, c))):
        alone = operator.measure([one], [other], near, near)
        for both, single in zip(together, alone, strict=True):
            torch.testing.assert_close(both.pixels[n], single.pixels[0], atol=0.1, rtol=0)
            assert float((single.weight > 0).float().mean()) > 0.5
    assert not caplog.text  # nothing is slower than it could be
