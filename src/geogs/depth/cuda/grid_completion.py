"""The completion of ``grid_completion.py`` and the evidence drawn from it on a GPU."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from geogs.depth import evidence, grid_completion
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload

SOURCE = Path(__file__).with_name("completion.cu")
_PANEL = 8


def _window(minors: int) -> int:
    """Rows of the band matrix worked on at a time, for lines of ``minors`` cells."""
    return -(-2 * minors // _PANEL) * _PANEL + _PANEL


def _shared_bytes(minors: int) -> int:
    window = _window(minors)
    return 8 * (window**2 + window * (_PANEL + 2) + _PANEL * (_PANEL + 1))


def can_complete(shape: tuple[int, ...], device: torch.device) -> bool:
    """Whether the band of a grid of this shape fits into the shared memory of the GPU."""
    if _window(min(shape)) > 192:
        return False
    if device.type != "cuda":
        return True
    properties = torch.cuda.get_device_properties(device)
    limit: int = getattr(properties, "shared_memory_per_block_optin", 48 * 1024)
    return _shared_bytes(min(shape)) <= limit


def complete(
    grids: Float32[Tensor, "k 3 gh gw"], typical: Sequence[float]
) -> Float32[Tensor, "k 3 gh gw"]:
    """Completed inverse depth, ``prior_weight`` and ``relative_precision`` of some keyframes.

    ``grids`` hold the tracker's inverse depth, its information and the weights of smoothness;
    ``typical`` is the median of each keyframe's known inverse depths.
    """
    count, _, gh, gw = grids.shape
    by_columns = gh <= gw
    minors, majors = (gh, gw) if by_columns else (gw, gh)
    strides = (gw, 1) if by_columns else (1, gw)
    window, padded = _window(minors), -(-gh * gw // _PANEL) * _PANEL
    scratch = grids.new_empty(count * padded * (12 + window), dtype=torch.float64)
    out = torch.empty_like(grids)
    settings = upload(np.array(CompletionSettings(), np.float32), grids.device)
    kernels_for(SOURCE, grids.device)["complete_grids"](
        count, 32 * _PANEL, grids, upload(np.array(typical, np.float32), grids.device),
        settings, minors, majors, *strides, padded, window - _PANEL, scratch, out,
        shared=_shared_bytes(minors),
    )  # fmt: skip
    return out


class CompletionSettings(NamedTuple):
    """The struct of this name in ``completion.cu``."""

    sigma_scale: float = grid_completion.DEVIATION_SCALE
    bending: float = grid_completion.BENDING
    membrane: float = grid_completion.MEMBRANE
    sure_deviation: float = evidence.CONFIDENT_DEVIATION
    tracker_scale: float = evidence.TRACKER_SCALE
    unknown_deviation: float = evidence.UNKNOWN_DEVIATION
    best_deviation: float = evidence.BEST_DEVIATION
    kink: float = evidence.KINK
