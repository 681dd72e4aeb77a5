"""The weights files that the system can use: which there are, where they are had, what is allowed.

What is said of public files is what their own pages say. Checksums stand here only where the
publisher gives one.
"""

from dataclasses import dataclass
from typing import Literal

Purpose = Literal["own", "raft", "droid", "depth", "prior"]
"""A flow operator, the depth network, or a monocular prior."""

PACKAGED = "comes with geogs"


@dataclass(frozen=True)
class KnownWeights:
    """A weights file that is known by name."""

    name: str
    """File name under which it is looked for."""
    purpose: Purpose
    """What uses it."""
    what: str
    """What it is, in a few words."""
    origin: str
    """Where it is had."""
    licence: str
    sha256: str = ""
    """Checksum that its publisher gives, or the first digits of it; empty if there is none."""


_RAFT = "https://github.com/princeton-vl/RAFT (download_models.sh, in models.zip)"
_RAFT_LICENCE = "BSD-3-Clause repository; whether that covers the weights is not said"
_TORCHVISION = "https://download.pytorch.org/models/"
_TORCHVISION_LICENCE = "BSD-3-Clause library; terms of the training data may apply"
_HUB = "https://huggingface.co/"

CATALOGUE = (
    KnownWeights(
        "flow.safetensors",
        "own",
        "flow for static scenes, trained by geogs",
        PACKAGED,
        "Apache-2.0",
    ),
    KnownWeights(
        "raft-things.pth", "raft", "large, FlyingChairs and FlyingThings", _RAFT, _RAFT_LICENCE
    ),
    KnownWeights(
        "raft-sintel.pth", "raft", "large, then Sintel, KITTI and HD1K", _RAFT, _RAFT_LICENCE
    ),
    KnownWeights(
        "raft_large_C_T_V2-1bb1363a.pth",
        "raft",
        "large, FlyingChairs and FlyingThings, by torchvision",
        _TORCHVISION + "raft_large_C_T_V2-1bb1363a.pth",
        _TORCHVISION_LICENCE,
        sha256="1bb1363a",
    ),
    KnownWeights(
        "raft_large_C_T_SKHT_V2-ff5fadd5.pth",
        "raft",
        "large, then Sintel, KITTI and HD1K, by torchvision",
        _TORCHVISION + "raft_large_C_T_SKHT_V2-ff5fadd5.pth",
        _TORCHVISION_LICENCE,
        sha256="ff5fadd5",
    ),
    KnownWeights(
        "raft-small.pth", "raft", "small, FlyingChairs and FlyingThings", _RAFT, _RAFT_LICENCE
    ),
    KnownWeights(
        "raft_small_C_T_V2-01064c6d.pth",
        "raft",
        "small, FlyingChairs and FlyingThings, by torchvision",
        _TORCHVISION + "raft_small_C_T_V2-01064c6d.pth",
        _TORCHVISION_LICENCE,
        sha256="01064c6d",
    ),
    KnownWeights(
        "droid.pth",
        "droid",
        "DROID-SLAM, TartanAir",
        "https://github.com/princeton-vl/DROID-SLAM (README, droid.pth)",
        "BSD-3-Clause",
    ),
    KnownWeights(
        "depth.safetensors",
        "depth",
        "multi-view depth of still scenes, trained by geogs",
        PACKAGED,
        "Apache-2.0",
    ),
    KnownWeights(
        "depth-anything-v2-small.onnx",
        "prior",
        "Depth Anything V2 small: inverse depth",
        _HUB + "onnx-community/depth-anything-v2-small (onnx/model.onnx)",
        "Apache-2.0",
    ),
    KnownWeights(
        "metric3d-vit-small.onnx",
        "prior",
        "Metric3D v2 small: depth and normals",
        _HUB + "onnx-community/metric3d-vit-small (onnx/model.onnx)",
        "CC0-1.0 by that page; BSD-2-Clause repository of the authors",
    ),
    KnownWeights(
        "omnidata_normal_dpt_hybrid.pth",
        "prior",
        "Omnidata DPT-hybrid: normals; a PyTorch checkpoint",
        _HUB + "sashasax/omnidata_normal_dpt_hybrid_384",
        "CC-BY-NC-4.0",
    ),
)
"""In the order in which an operator takes what it finds."""


def known_as(name: str) -> KnownWeights | None:
    """What is known of a file of this name."""
    return next((known for known in CATALOGUE if known.name == name), None)
