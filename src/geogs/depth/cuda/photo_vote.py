"""The photometric costs of ``revision/photo_vote.py`` on a GPU."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from geogs.depth.cuda.images import KeyframeImages
from geogs.depth.revision.photo_vote import CONTRAST, DEVIATIONS, LEAST_DEVIATION, RADIUS
from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload

SOURCE = Path(__file__).with_name("photo_vote.cu")


def photo_costs(
    own: KeyframeImages,
    others: Sequence[KeyframeImages],
    poses: Float[np.ndarray, "n 4 4"],
    depths: Float32[Tensor, "2 h w"],
    same: Bool[Tensor, "h w"],
    camera: Camera,
    mask: Bool[Tensor, "h w"] | None = None,
) -> Float32[Tensor, "2 h w"]:
    """As :func:`geogs.depth.revision.photo_vote.photo_costs`; ``poses`` take the frame of the
    depths to those of the others, at most 16."""
    device, n = depths.device, len(others)
    h, w = depths.shape[1:]
    if mask is not None:
        depths = torch.stack([depths[0], torch.where(mask, depths[1], depths[0])])
    kernels = kernels_for(SOURCE, device)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    numbers = np.concatenate([lens, poses[:, :3].ravel()]).astype(np.float32)
    lens, T = upload(numbers, device).split([4, 12 * n])
    differences = depths.new_empty(2, n, h, w)
    tiles = -(-w // 32), -(-h // 4)
    kernels["grey_differences"](
        (*tiles, 2 * n), (32, 4), own.grey, torch.stack([o.grey for o in others]), T, lens,
        depths.contiguous(), n, h, w, differences,
    )  # fmt: skip
    offset, limit = offset_and_limit(differences[0], same)
    costs, means = torch.empty_like(depths), torch.empty_like(depths)
    kernels["pixel_costs"](
        (-(-h * w // 128), 2), (128,), differences, offset, limit, n, h * w, costs
    )
    kernels["average_costs"](tiles, (32, 4), costs, own.colours, RADIUS, -1 / CONTRAST, h, w, means)
    return means if mask is None else torch.where(mask, means, 0.0)


def offset_and_limit(
    differences: Float[Tensor, "n h w"], same: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Median grey difference of each neighbour where both depths are the ``same``, and the
    deviation from it at which differences are cut."""
    known = torch.where(same, differences, torch.nan).flatten(1)
    offset = known.nanmedian(1).values.nan_to_num()
    deviation = (known - offset[:, None]).abs().nanmedian(1).values.nan_to_num()
    return offset, DEVIATIONS * deviation.clamp(min=LEAST_DEVIATION)
