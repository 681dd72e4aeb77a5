"""States of the RAFT networks in the layout of their authors."""

import json
from pathlib import Path

from torch import Tensor

from fixtures.make_raft_oracle import filled
from geogs.tracking.flow.raft_layout import Layout, names_in, network_from

ORACLE = json.loads((Path(__file__).parent / "fixtures" / "raft_oracle.json").read_text())


def published(size: str) -> dict[str, Tensor]:
    """Filled tensors as torchvision's file would hold them."""
    return filled(ORACLE[size]["shapes"])


def original(size: str) -> dict[str, Tensor]:
    """The same tensors as the original repository's file would hold them."""
    state = network_from(published(size), "published").state_dict()
    return {
        stored: tensor
        for name, tensor in state.items()
        for stored in names_in(Layout.ORIGINAL, name)
    }
