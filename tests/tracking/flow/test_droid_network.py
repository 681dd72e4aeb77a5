"""DROID-SLAM's network against the layout of its public weights and against its equations."""

import pytest
import torch
from torch.nn import functional as F

from droid_state import LAYERS, public_state
from geogs.errors import InputError
from geogs.tracking.flow.droid_network import DroidNetwork, load_droid, motion_features
from geogs.tracking.flow.lookup import CorrelationVolume
from geogs.tracking.flow.network_parts import cell_positions


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
    network = DroidNetwork(4)
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


def test_correlation_finds_itself_and_a_shift(network):
    """The largest of the 49 values of level 0: channel 24 in place, 7 * 4 + 3 one cell right."""
    with torch.no_grad():
        first = network.features(textured())
    second = first.roll(1, dims=3)
    at = cell_positions(*first.shape[2:], first)[None]
    for other, channel in ((first, 24), (second, 31)):
        found = CorrelationVolume(first, other)(at)
        assert found.shape == (1, 196, 12, 16)
        best = found[0, :49, :, :-1].argmax(0)
        assert float((best == channel).float().mean()) > 0.85
        # One sixteenth of the product, nothing else.
        expected = (first[0, :, 5, 6] * other[0, :, 5, 7]).sum() / 16
        torch.testing.assert_close(found[0, 31, 5, 6], expected)


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
    assert len(out) == 2
    for n, edges in enumerate(([1, 3], [0, 2, 4])):
        mean = F.relu(agg.conv1(hidden[edges])).mean(0, keepdim=True)
        joined = F.relu(agg.conv2(mean))
        eta = 0.01 * F.softplus(agg.eta[0](joined))[0, 0]
        torch.testing.assert_close(out[n], eta, rtol=1e-4, atol=1e-6)
    alone = agg(hidden[[1, 3]], torch.tensor([0, 0]))
    torch.testing.assert_close(alone[0], out[0])


def test_motion_is_flow_and_last_error_cut_off():
    position = cell_positions(3, 4, torch.empty(0))[None] + torch.tensor([5.0, -100.0])
    target = position + torch.tensor([-0.25, 70.0])
    motion = motion_features(position, target)
    torch.testing.assert_close(
        motion[0, :, 1, 2], torch.tensor([5.0, -64.0, -0.25, 64.0]), rtol=0, atol=1e-5
    )
