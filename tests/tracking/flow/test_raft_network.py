"""RAFT's network against torchvision's, and the checkpoint layouts that it takes."""

import pytest
import torch
from torch import Tensor

from fixtures.make_raft_oracle import ITERATIONS, SAMPLED, image_pair
from geogs.errors import InputError
from geogs.tracking.flow.correlation import CorrelationVolume, LocalCorrelation
from geogs.tracking.flow.raft_layout import Layout, names_in, network_from
from geogs.tracking.flow.raft_network import LARGE, SMALL, RaftNetwork
from raft_oracle import ORACLE, original, published

SHAPES = {"large": LARGE, "small": SMALL}
SIZES = list(SHAPES)


def flow_of(network: RaftNetwork, lookup=CorrelationVolume) -> Tensor:
    shape = network.shape
    with torch.no_grad():
        first, second = (network.encode(image) for image in image_pair())
        correlation = lookup(first.features, second.features, shape.levels, shape.radius)
        return network.estimate(first, correlation, None, ITERATIONS).pixels


@pytest.mark.parametrize("size", SIZES)
def test_flow_is_torchvisions(size):
    found = flow_of(network_from(published(size), "published"))[SAMPLED].flatten()
    wanted = torch.tensor(ORACLE[size]["flow"])
    assert float(wanted.std()) > 1.0  # the oracle says something
    torch.testing.assert_close(found, wanted, atol=1e-4, rtol=0)


PARTS = (
    "feature_encoder.layer2.0.downsample.0.weight",
    "feature_encoder.layer3.1.convnormrelu2.0.weight",
    "context_encoder.layer2.0.downsample.0.weight",
    "context_encoder.conv.bias",
    "update_block.motion_encoder.convcorr1.0.weight",
    "update_block.motion_encoder.convflow2.0.weight",
    "update_block.recurrent_block.convgru1.convr.weight",
    "update_block.flow_head.conv1.bias",
)
PARTS_OF_LARGE = (
    "context_encoder.layer3.0.downsample.1.running_var",
    "update_block.recurrent_block.convgru2.convq.weight",
    "mask_predictor.conv.weight",
)


@pytest.mark.parametrize(
    ("size", "name"),
    [(s, n) for s in SIZES for n in PARTS] + [("large", n) for n in PARTS_OF_LARGE],
)
def test_equality_with_torchvision_tests_every_part(size, name):
    """The flow changes with the weights by far more than the difference that is allowed."""
    tensors = published(size)
    tensors[name] = 1.5 * tensors[name].roll(1)
    found = flow_of(network_from(tensors, "changed"))[SAMPLED].flatten()
    assert float((found - torch.tensor(ORACLE[size]["flow"])).abs().max()) > 1e-2


@pytest.mark.parametrize("size", SIZES)
def test_without_the_volume_the_flow_is_the_same(size):
    network = network_from(published(size), "published")
    torch.testing.assert_close(
        flow_of(network, LocalCorrelation), flow_of(network), atol=1e-4, rtol=0
    )


@pytest.mark.parametrize(("size", "parameters"), [("large", 5_257_536), ("small", 990_162)])
def test_number_of_parameters(size, parameters):
    assert sum(p.numel() for p in RaftNetwork(SHAPES[size]).parameters()) == parameters
    assert ORACLE[size]["parameters"] == parameters


@pytest.mark.parametrize("size", SIZES)
def test_torchvisions_names_and_shapes(size):
    state = RaftNetwork(SHAPES[size]).state_dict()
    found = {names_in(Layout.TORCHVISION, n)[0]: list(t.shape) for n, t in state.items()}
    assert found == ORACLE[size]["shapes"]


BATCH_NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")


def names_of_the_original(size: str) -> set[str]:
    """Written out after the modules of the original repository, apart from our network."""

    def convolution(name: str) -> set[str]:
        return {f"{name}.weight", f"{name}.bias"}

    def normalisation(name: str) -> set[str]:
        return {f"{name}.{part}" for part in BATCH_NORM}

    names: set[str] = set()
    convolutions = 2 if size == "large" else 3
    for encoder in ("fnet", "cnet"):
        has_norm = encoder == "cnet" and size == "large"
        for name in ("conv1", "conv2"):
            names |= convolution(f"{encoder}.{name}")
        if has_norm:
            names |= normalisation(f"{encoder}.norm1")
        for layer in (1, 2, 3):
            for block in (0, 1):
                path = f"{encoder}.layer{layer}.{block}"
                for k in range(1, convolutions + 1):
                    names |= convolution(f"{path}.conv{k}")
                    if has_norm:
                        names |= normalisation(f"{path}.norm{k}")
                if layer > 1 and block == 0:
                    names |= convolution(f"{path}.downsample.0")
                    if has_norm:
                        names |= normalisation(f"{path}.downsample.1")
                        names |= normalisation(f"{path}.norm{convolutions + 1}")
    motion = ["convc1", "convc2", "convf1", "convf2", "conv"]
    gates = [f"conv{g}{k}" for g in "zrq" for k in (1, 2)]
    if size == "small":
        motion.remove("convc2")
        gates = [f"conv{g}" for g in "zrq"]
    parts = [f"encoder.{n}" for n in motion] + [f"gru.{n}" for n in gates]
    parts += ["flow_head.conv1", "flow_head.conv2"]
    if size == "large":
        parts += ["mask.0", "mask.2"]
    for part in parts:
        names |= convolution(f"update_block.{part}")
    return {f"module.{name}" for name in names}


@pytest.mark.parametrize(("size", "count"), [("large", 179), ("small", 106)])
def test_the_originals_names(size, count):
    state = RaftNetwork(SHAPES[size]).state_dict()
    found = [stored for name in state for stored in names_in(Layout.ORIGINAL, name)]
    assert len(found) == len(set(found)) == count
    assert set(found) == names_of_the_original(size)


@pytest.mark.parametrize("prefix", ["module.", ""])
@pytest.mark.parametrize("size", SIZES)
def test_the_originals_file_gives_the_same_network(size, prefix):
    tensors = {prefix + n.removeprefix("module."): t for n, t in original(size).items()}
    wanted = network_from(published(size), "published").state_dict()
    found = network_from(tensors, "original").state_dict()
    assert found.keys() == wanted.keys()
    assert all(torch.equal(found[name], wanted[name]) for name in wanted)


def test_a_missing_tensor_is_told():
    tensors = published("small")
    del tensors["update_block.flow_head.conv2.bias"]
    with pytest.raises(InputError, match=r"1 tensor is missing \(such as update_block.flow_head"):
        network_from(tensors, "weights.pth")


def test_an_unknown_tensor_is_told():
    tensors = {**original("large"), "module.extra.weight": torch.zeros(1)}
    with pytest.raises(InputError, match=r"1 tensor is unknown \(such as module.extra.weight\)"):
        network_from(tensors, "weights.pth")


def test_a_wrong_shape_is_told():
    tensors = {**published("small"), "feature_encoder.conv.bias": torch.zeros(3)}
    with pytest.raises(InputError, match=r"feature_encoder.conv.bias has shape \(3,\), not \(128"):
        network_from(tensors, "weights.pth")


def test_another_network_is_told():
    with pytest.raises(InputError, match=r"weights.pth holds no RAFT network"):
        network_from({"layer.weight": torch.zeros(2)}, "weights.pth")
