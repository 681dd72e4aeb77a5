"""Poses given by programs, as NumPy arrays or PyTorch tensors on any device."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.errors import InputError

GivenPose = Float[Tensor, "4 4"] | Float[np.ndarray, "4 4"]
"""World to camera."""


def as_pose(T_cw: GivenPose) -> Float64[Tensor, "4 4"]:
    """Copy a given pose to the CPU. Raises InputError if it is none."""
    try:
        pose = torch.as_tensor(T_cw, dtype=torch.float64, device="cpu").detach()
    except (TypeError, ValueError, RuntimeError):
        pose = torch.zeros(0)
    if pose.shape != (4, 4) or not bool(torch.isfinite(pose).all()):
        raise InputError("A pose is a 4x4 matrix of finite numbers, world to camera.")
    return pose
