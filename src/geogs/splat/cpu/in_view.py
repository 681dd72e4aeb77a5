"""Conservative frustum test of disks against some cameras."""

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera

# Margin around the image, for the low-pass filter of the renderer.
_BORDER_PIXELS = 8.0


def disks_in_view(
    position: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    T_cw: Float[Tensor, "v 4 4"],
    camera: Camera,
) -> Bool[Tensor, "n"]:
    """Whether balls (centre, radius) reach into at least one camera's view frustum, or nearly so.

    True for balls whose numbers are not finite. For tensors on the CPU.
    """
    centres = np.ascontiguousarray(position.detach().numpy(), np.float32)
    radii = np.ascontiguousarray(radius.detach().numpy(), np.float32)
    left = (camera.cx + _BORDER_PIXELS) / camera.fx
    right = (camera.width - 1 - camera.cx + _BORDER_PIXELS) / camera.fx
    top = (camera.cy + _BORDER_PIXELS) / camera.fy
    bottom = (camera.height - 1 - camera.cy + _BORDER_PIXELS) / camera.fy
    slopes = np.array([left, right, top, bottom], np.float32)
    poses = np.ascontiguousarray(T_cw.detach().numpy()[:, :3], np.float32)
    return torch.from_numpy(_in_view(centres, radii, poses, slopes))


@numba.njit(cache=True, nogil=True)
def _in_view(centres, radii, poses, slopes):
    seen = np.zeros(len(centres), np.bool_)
    lengths = np.sqrt(1 + slopes * slopes)
    for i in range(len(centres)):
        x = centres[i, 0]
        y = centres[i, 1]
        z = centres[i, 2]
        r = radii[i]
        for k in range(len(poses)):
            T = poses[k]
            c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if c < -r:
                continue
            a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            if -a - slopes[0] * c > r * lengths[0] or a - slopes[1] * c > r * lengths[1]:
                continue
            b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            if -b - slopes[2] * c > r * lengths[2] or b - slopes[3] * c > r * lengths[3]:
                continue
            seen[i] = True
            break
    return seen
