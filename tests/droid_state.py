"""A state in the layout of DROID-SLAM's file."""

import torch

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
