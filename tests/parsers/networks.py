"""Cards of priors, networks and their weights."""

import json
from dataclasses import asdict
from functools import cache
from pathlib import Path

import torch
from safetensors.torch import save_file

import mutations
from geogs.depth.network.depth_calibration import DepthCalibration
from geogs.depth.network.model import DepthNetwork, load_depth_network
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.geometry.camera import Camera
from geogs.networks.tensor_files import read_tensors
from geogs.priors.card import load_card
from geogs.priors.onnx import OnnxPrior
from geogs.tracking.flow.own_network import FlowNetwork, NetworkOptions, load_flow_network
from io_samples import gradient_image
from parsers.base import Parser, written

CARD = (
    "name: test\nsource: nowhere\nlicence: none\nresize: stretch\nheight: 8\nwidth: 8\n"
    "mean: [0.5, 0.5, 0.5]\nstd: [0.2, 0.2, 0.2]\ndepth_kind: metric\ndepth_range: [0.1, 10]\n"
    "normal_axes: +x-y-z\nnormal_scale: 2\n"
)
TENSORS = {"a": torch.arange(6.0), "b": torch.ones(2, 2)}
WEIGHTS = "w.safetensors"


def networks() -> dict[str, Parser]:
    """By what is in the file."""
    return {
        "card": Parser(
            written("card.yaml", CARD), ("card.yaml",), mutations.yaml_text,
            lambda f: load_card(str(f / "card.yaml")),
        ),
        "network": Parser(network, ("n.onnx",), mutations.binary, predict),
        "weights": Parser(
            lambda f: save_file(TENSORS, f / WEIGHTS), (WEIGHTS,), mutations.safetensors,
            lambda f: read_tensors(f / WEIGHTS),
        ),
        "weights-flow": Parser(
            flow, (WEIGHTS,), mutations.safetensors, lambda f: load_flow_network(f / WEIGHTS)
        ),
        "weights-depth": Parser(
            depth, (WEIGHTS,), mutations.safetensors, lambda f: load_depth_network(f / WEIGHTS)
        ),
        "checkpoint-of-torch": Parser(
            lambda f: torch.save(TENSORS, f / "w.pth"), ("w.pth",), mutations.binary,
            lambda f: read_tensors(f / "w.pth"),
        ),
    }  # fmt: skip


@cache
def network_of_onnx() -> bytes:
    import onnx

    one = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 3, 8, 8])
    two = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 3, 8, 8])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["x"], ["y"])], "g", [one], [two])
    opset = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=8)
    return bytes(model.SerializeToString())


def network(folder: Path) -> None:
    """Of ONNX, with its card."""
    (folder / "card.yaml").write_text(CARD.replace("depth_kind: metric\n", ""))
    (folder / "n.onnx").write_bytes(network_of_onnx())


def predict(folder: Path) -> object:
    """What a network says of an image."""
    camera = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
    prior = OnnxPrior(folder / "n.onnx", load_card(str(folder / "card.yaml")), camera)
    return prior.predict(gradient_image(0))


def flow(folder: Path) -> None:
    """Weights of a small flow network."""
    options = NetworkOptions(stem=8, middle=8, deep=16, hidden=16, context=16, motion=16)
    header = {"options": json.dumps(asdict(options))}
    save_file(FlowNetwork(options).state_dict(), folder / WEIGHTS, header)


def depth(folder: Path) -> None:
    """Weights of a small depth network."""
    options = DepthNetworkOptions(
        planes=4, groups=2, matching=4, encoder=(4, 4, 4), context=(4, 4, 4, 4, 4),
        volume=(4, 4, 4, 4), metadata=4, decoder=4,
    )  # fmt: skip
    header = {
        "options": json.dumps(asdict(options)),
        "calibration": json.dumps(asdict(DepthCalibration())),
    }
    save_file(DepthNetwork(options).state_dict(), folder / WEIGHTS, header)
