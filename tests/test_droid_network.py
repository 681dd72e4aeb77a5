"""DROID-SLAM's network against the layout of its public weights and against its equations."""

import pytest
import torch
from torch.nn import functional as F

from geogs.errors import InputError
from geogs.tracking.flow.correlation import CorrelationVolume, LocalCorrelation
from geogs.tracking.flow.droid_network import (
    CORRELATION_SCALE,
    LEVELS,
    LOOKUP,
    RADIUS,
    DroidNetwork,
    DroidSize,
    GradientClip,
    cell_positions,
    load_droid,
    motion_features,
    upsample_convex,
)

# name, inputs, outputs, edge of the kernel; the shortcuts are 1 x 1.
ENCODER = [
    ("conv1", 3, 32, 7),
    ("layer1.0.conv1", 32, 32, 3),
    ("layer1.0.conv2", 32, 32, 3),
    ("layer1.1.conv1", 32, 32, 3),
    ("layer1.1.conv2", 32, 32, 3),
    ("layer2.0.conv1", 32, 64, 3),
    ("layer2.0.conv2", 64, 64, 3),
    ("layer2.0.downsample.0", 32, 64, 1),
    ("layer2.1.conv1", 64, 64, 3),
    ("layer2.1.conv2", 64, 64, 3),
    ("layer3.0.conv1", 64, 128, 3),
    ("layer3.0.conv2", 128, 128, 3),
    ("layer3.0.downsample.0", 64, 128, 1),
    ("layer3.1.conv1", 128, 128, 3),
    ("layer3.1.conv2", 128, 128, 3),
]
UPDATE = [
    ("corr_encoder.0", 196, 128, 1),
    ("corr_encoder.2", 128, 128, 3),
    ("flow_encoder.0", 4, 128, 7),
    ("flow_encoder.2", 128, 64, 3),
    ("gru.convz", 448, 128, 3),
    ("gru.convr", 448, 128, 3),
    ("gru.convq", 448, 128, 3),
    ("gru.w", 128, 128, 1),
    ("gru.convz_glo", 128, 128, 1),
    ("gru.convr_glo", 128, 128, 1),
    ("gru.convq_glo", 128, 128, 1),
    ("delta.0", 128, 128, 3),
    ("delta.2", 128, 2, 3),
    ("weight.0", 128, 128, 3),
    ("weight.2", 128, 2, 3),
    ("agg.conv1", 128, 128, 3),
    ("agg.conv2", 128, 128, 3),
    ("agg.eta.0", 128, 1, 3),
    ("agg.upmask.0", 128, 576, 1),
]
LAYERS = [
    *((f"fnet.{n}", i, o, k) for n, i, o, k in [*ENCODER, ("conv2", 128, 128, 1)]),
    *((f"cnet.{n}", i, o, k) for n, i, o, k in [*ENCODER, ("conv2", 128, 256, 1)]),
    *((f"update.{n}", i, o, k) for n, i, o, k in UPDATE),
]


def public_state(seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights in the layout of the public file."""
    g = torch.Generator().manual_seed(seed)
    state = {}
    for name, inputs, outputs, k in LAYERS:
        # The file has more outputs than are used here; how many does not matter.
        outputs += name in ("update.delta.2", "update.weight.2")
        scale = (2 / (inputs * k * k)) ** 0.5
        state[f"module.{name}.weight"] = scale * torch.randn(outputs, inputs, k, k, generator=g)
        state[f"module.{name}.bias"] = 0.1 * torch.randn(outputs, generator=g)
    return state


@pytest.fixture(scope="module")
def network() -> DroidNetwork:
    return load_droid(public_state())


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_parameters_are_those_of_the_public_weights():
    network = DroidNetwork()
    expected = {}
    for name, inputs, outputs, k in LAYERS:
        expected[f"{name}.weight"] = (outputs, inputs, k, k)
        expected[f"{name}.bias"] = (outputs,)
    assert {n: tuple(p.shape) for n, p in network.state_dict().items()} == expected
    assert count(network) == 4_002_565
    assert count(network.fnet) == 714_560
    assert count(network.cnet) == 731_072
    assert count(network.update.agg) == 370_625


def test_loading_is_strict_and_drops_unused_outputs(network):
    state = public_state()
    assert torch.equal(network.update.delta[2].weight, state["module.update.delta.2.weight"][:2])
    assert torch.equal(network.fnet.conv1.weight, state["module.fnet.conv1.weight"])
    assert not network.training
    assert not any(p.requires_grad for p in network.parameters())
    with pytest.raises(InputError, match=r"not the weights of DROID-SLAM.*surplus"):
        load_droid({**state, "module.surplus": torch.zeros(1)})
    del state["module.update.gru.w.bias"]
    with pytest.raises(InputError, match=r"update\.gru\.w\.bias"):
        load_droid(state)


def test_encoders_have_an_eighth_of_the_resolution(network):
    image = torch.rand(1, 3, 344, 616, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        assert network.fnet(image).shape == (1, 128, 43, 77)
        hidden, static = network.context(image)
    assert hidden.shape == static.shape == (1, 128, 43, 77)
    assert float(hidden.abs().max()) <= 1
    assert float(static.min()) == 0


def test_a_cell_is_centred_on_its_first_pixel():
    """The receptive field of cell (r, c) is symmetric about pixel (8 r, 8 c)."""
    torch.manual_seed(0)
    network = DroidNetwork(DroidSize(4))
    image = torch.rand(1, 3, 160, 160, requires_grad=True)
    network.cnet(image)[0, :, 10, 11].square().sum().backward()
    rows, columns = (torch.nonzero(image.grad.abs().sum((0, 1, k)))[:, 0] for k in (3, 2))
    assert (int(rows[0]) + int(rows[-1])) / 2 == 80
    assert (int(columns[0]) + int(columns[-1])) / 2 == 88


def textured(seed: int = 6) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 12, 16, generator=g)
    return F.interpolate(coarse, (96, 128), mode="bilinear") * 0.7 + 0.3 * torch.rand(
        1, 3, 96, 128, generator=g
    )


@pytest.mark.parametrize("kind", [CorrelationVolume, LocalCorrelation])
def test_correlation_finds_itself_and_a_shift(network, kind):
    """The largest of the 49 values of level 0: channel 24 in place, 7 * 4 + 3 one cell right."""
    with torch.no_grad():
        first = network.features(textured())
    second = first.roll(1, dims=3)
    at = cell_positions(*first.shape[2:])[None]
    for other, channel in ((first, 24), (second, 31)):
        found = kind(first, other, LEVELS, RADIUS, CORRELATION_SCALE)(at)
        assert found.shape == (1, LOOKUP, 12, 16)
        best = found[0, :49, :, :-1].argmax(0)
        assert float((best == channel).float().mean()) > 0.85
        # One sixteenth of the product, nothing else.
        expected = (first[0, :, 5, 6] * other[0, :, 5, 7]).sum() / 16
        torch.testing.assert_close(found[0, 31, 5, 6], expected)


def test_both_correlations_agree_anywhere():
    g = torch.Generator().manual_seed(7)
    first, second = (torch.randn(2, 16, 9, 13, generator=g) for _ in range(2))
    at = cell_positions(9, 13) + 6 * torch.randn(2, 9, 13, 2, generator=g)
    stored, local = (
        kind(first, second, LEVELS, RADIUS, CORRELATION_SCALE)(at)
        for kind in (CorrelationVolume, LocalCorrelation)
    )
    torch.testing.assert_close(stored, local, rtol=1e-4, atol=1e-4)
    assert float(stored.abs().max()) > 0.3
    assert float(stored[:, 3 * 49 :].abs().max()) > 0.02  # of the coarsest level


def test_gru_follows_its_equations(network):
    gru, g = network.update.gru, torch.Generator().manual_seed(2)
    h, x = torch.randn(2, 128, 5, 6, generator=g).tanh(), torch.randn(2, 320, 5, 6, generator=g)

    def conv(layer, *inputs):
        y = torch.cat(inputs, 1)
        return F.conv2d(y, layer.weight, layer.bias, padding=layer.weight.shape[-1] // 2)

    whole = (torch.sigmoid(conv(gru.w, h)) * h).flatten(2).mean(2)[..., None, None]
    z = torch.sigmoid(conv(gru.convz, h, x) + conv(gru.convz_glo, whole))
    r = torch.sigmoid(conv(gru.convr, h, x) + conv(gru.convr_glo, whole))
    q = torch.tanh(conv(gru.convq, r * h, x) + conv(gru.convq_glo, whole))
    torch.testing.assert_close(gru(h, x), (1 - z) * h + z * q)


def test_update_reads_its_inputs_in_order(network):
    """Hidden state, static context, correlation, motion; outputs in their ranges."""
    g = torch.Generator().manual_seed(3)
    shapes = [(3, c, 6, 7) for c in (128, 128, 196, 4)]
    hidden, static, correlation, motion = (torch.randn(s, generator=g) for s in shapes)
    update = network.update
    out = update(hidden.tanh(), static.relu(), correlation, motion)
    x = [static.relu(), update.corr_encoder(correlation), update.flow_encoder(motion)]
    torch.testing.assert_close(out.hidden, update.gru(hidden.tanh(), torch.cat(x, 1)))
    assert out.delta.shape == out.weight.shape == (3, 2, 6, 7)
    assert 0 < float(out.weight.min()) < float(out.weight.max()) < 1
    assert float(out.delta.abs().max()) > 1


def test_aggregation_groups_edges_by_source(network):
    agg = network.update.agg
    hidden = torch.randn(5, 128, 6, 7, generator=torch.Generator().manual_seed(4))
    out = agg(hidden, torch.tensor([7, 2, 7, 2, 7]))
    assert out.frames.tolist() == [2, 7]
    assert out.upsampling.shape == (2, 576, 6, 7)
    for n, edges in enumerate(([1, 3], [0, 2, 4])):
        mean = F.relu(agg.conv1(hidden[edges])).mean(0, keepdim=True)
        joined = F.relu(agg.conv2(mean))
        eta = 0.01 * F.softplus(agg.eta[0](joined))[0, 0]
        torch.testing.assert_close(out.damping[n], eta, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(out.upsampling[n], agg.upmask(joined)[0], rtol=1e-4, atol=1e-4)
    alone = agg(hidden[[1, 3]], torch.tensor([0, 0]))
    torch.testing.assert_close(alone.damping[0], out.damping[0])


def test_clip_is_the_identity_and_drops_bad_gradients():
    x = torch.tensor([1.0, -2.0, 3.0, 4.0], requires_grad=True)
    y = GradientClip(0.01)(x)
    assert torch.equal(y, x)
    y.backward(torch.tensor([0.005, -0.02, torch.nan, -0.01]))
    torch.testing.assert_close(x.grad, torch.tensor([0.005, 0.0, 0.0, -0.01]))


def test_motion_is_flow_and_last_error_cut_off():
    position = cell_positions(3, 4)[None] + torch.tensor([5.0, -100.0])
    target = position + torch.tensor([-0.25, 70.0])
    motion = motion_features(position, target)
    torch.testing.assert_close(
        motion[0, :, 1, 2], torch.tensor([5.0, -64.0, -0.25, 64.0]), rtol=0, atol=1e-5
    )


def test_upsampling_reads_neighbours_and_pixels_in_order():
    values = torch.arange(20.0).reshape(1, 4, 5)
    logits = torch.full((1, 576, 4, 5), -30.0)
    logits[:, 64 * 4 : 64 * 5] = 0
    flat = upsample_convex(values, logits)
    assert flat.shape == (1, 32, 40)
    torch.testing.assert_close(flat, values.repeat_interleave(8, 1).repeat_interleave(8, 2))
    # Pixel (3, 6) of a cell takes its right-hand neighbour, k = 5.
    logits[:, 64 * 5 + 8 * 3 + 6] = 30
    out = upsample_convex(values, logits)
    assert float(out[0, 8 * 1 + 3, 8 * 2 + 6]) == pytest.approx(float(values[0, 1, 3]))
    changed = (out - flat).abs() > 1e-3
    assert int(changed.sum()) == 4 * 4  # the last column has nobody to its right
    assert not changed[:, :, 32:].any()


def test_upsampling_of_a_constant_is_constant_up_to_the_border():
    logits = torch.randn(2, 576, 3, 4, generator=torch.Generator().manual_seed(5))
    up = upsample_convex(torch.full((2, 3, 4), 0.7), logits)
    torch.testing.assert_close(up, torch.full((2, 24, 32), 0.7))
