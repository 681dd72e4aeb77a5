"""The two published layouts of RAFT's checkpoints.

The network's own names are those of the original repository. Against them

- the original's files have a ``module.`` before every name (they were saved from several GPUs), and
  hold the normalisation of a projected shortcut twice: ``downsample.1`` is called ``norm3``, too;
- torchvision's files name the parts otherwise: ``TORCHVISION`` below.
"""

import re
from collections.abc import Mapping
from enum import Enum

from torch import Tensor

from geogs.errors import InputError
from geogs.tracking.flow.raft_network import LARGE, SMALL, RaftNetwork, RaftShape

TORCHVISION = (
    (r"^fnet\.", "feature_encoder."),
    (r"^cnet\.", "context_encoder."),
    (r"^(\w+_encoder)\.conv1\.", r"\1.convnormrelu.0."),
    (r"^(\w+_encoder)\.norm1\.", r"\1.convnormrelu.1."),
    (r"^(\w+_encoder)\.conv2\.", r"\1.conv."),
    (r"\.(layer\d\.\d)\.conv(\d)\.", r".\1.convnormrelu\2.0."),
    (r"\.(layer\d\.\d)\.norm(\d)\.", r".\1.convnormrelu\2.1."),
    (r"^update_block\.encoder\.convc(\d)\.", r"update_block.motion_encoder.convcorr\1.0."),
    (r"^update_block\.encoder\.convf(\d)\.", r"update_block.motion_encoder.convflow\1.0."),
    (r"^update_block\.encoder\.conv\.", "update_block.motion_encoder.conv.0."),
    (r"^update_block\.gru\.conv([zrq])\.", r"update_block.recurrent_block.convgru1.conv\1."),
    (r"^update_block\.gru\.conv([zrq])(\d)\.", r"update_block.recurrent_block.convgru\2.conv\1."),
    (r"^update_block\.mask\.0\.", "mask_predictor.convrelu.0."),
    (r"^update_block\.mask\.2\.", "mask_predictor.conv."),
)
"""Patterns, applied in order, that turn a name of the network into torchvision's."""
REPEATED = (r"\.downsample\.1\.", ".norm3.")
"""The second name that the original's files have for the same tensor."""


class Layout(Enum):
    """Who named the tensors."""

    ORIGINAL = "original"
    TORCHVISION = "torchvision"


def names_in(layout: Layout, name: str) -> list[str]:
    """Under which names a file of a layout holds a tensor of the network."""
    if layout is Layout.TORCHVISION:
        for pattern, replacement in TORCHVISION:
            name = re.sub(pattern, replacement, name)
        return [name]
    return [f"module.{n}" for n in dict.fromkeys([name, re.sub(*REPEATED, name)])]


def network_from(tensors: Mapping[str, Tensor], source: str) -> RaftNetwork:
    """The network, large or small, with the tensors of a checkpoint of either layout.

    Every tensor of the file must belong to the network and every tensor of the network must be in
    the file. ``source`` names the file in the sentence of the InputError that is raised otherwise.
    """
    layout, shape = _recognise(tensors, source)
    if layout is Layout.ORIGINAL:
        # Saved from one GPU, they lack the prefix.
        tensors = {f"module.{name.removeprefix('module.')}": t for name, t in tensors.items()}
    network = RaftNetwork(shape)
    state, found, wanted = network.state_dict(), {}, set()
    for name, place in state.items():
        names = names_in(layout, name)
        wanted.update(names)
        for stored in names:
            if stored in tensors and tensors[stored].shape != place.shape:
                raise InputError(
                    f"{source} does not fit RAFT: {stored} has shape "
                    f"{tuple(tensors[stored].shape)}, not {tuple(place.shape)}."
                )
        found[name] = tensors.get(names[0])
    missing, unknown = wanted - set(tensors), set(tensors) - wanted
    if missing or unknown:
        raise InputError(f"{source} does not fit RAFT: {_difference(missing, unknown)}.")
    network.load_state_dict(found)
    return network.eval().requires_grad_(False)


def _recognise(tensors: Mapping[str, Tensor], source: str) -> tuple[Layout, RaftShape]:
    names = {name.removeprefix("module.") for name in tensors}
    if "fnet.conv1.weight" in names:
        is_large = any(n.startswith("update_block.gru.convz1") for n in names)
        return Layout.ORIGINAL, LARGE if is_large else SMALL
    if "feature_encoder.convnormrelu.0.weight" in names:
        is_large = any(n.startswith("update_block.recurrent_block.convgru2") for n in names)
        return Layout.TORCHVISION, LARGE if is_large else SMALL
    raise InputError(
        f"{source} holds no RAFT network; take a checkpoint of the original repository or of "
        "torchvision (geogs weights list)."
    )


def _difference(missing: set[str], unknown: set[str]) -> str:
    parts = [
        f"{len(names)} {'tensor is' if len(names) == 1 else 'tensors are'} {what} "
        f"(such as {min(names)})"
        for what, names in (("missing", missing), ("unknown", unknown))
        if names
    ]
    return " and ".join(parts)
