"""Motion blur, by the camera's own motion and by that of objects."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_synth.camera.camera_batch import CameraBatch

_TAPS = 11
_MOST = 40.0
"""Largest blur, pixels."""


def exposed(
    colour: Float[Tensor, "b v 3 h w"], blur: Float[Tensor, "b v h w 2"]
) -> Float[Tensor, "b v 3 h w"]:
    """Mean linear light along each pixel's motion, which is centred on the pixel."""
    b, v, _, h, w = colour.shape
    way = blur.flatten(0, 1).clamp(-_MOST, _MOST)
    step = torch.stack([way[..., 0] * (2 / w), way[..., 1] * (2 / h)], -1)
    shifts = [(tap / (_TAPS - 1) - 0.5) * step for tap in range(_TAPS)]
    return mean_of_displaced(colour.flatten(0, 1), shifts).unflatten(0, (b, v))


def mean_of_displaced(
    image: Float[Tensor, "n 3 h w"], shifts: Sequence[Float[Tensor, "n #h #w 2"]]
) -> Float[Tensor, "n 3 h w"]:
    """The mean of an image displaced by each of some shifts, in half sizes of the image."""
    h, w = image.shape[-2:]
    x = (torch.arange(w, device=image.device) + 0.5) * (2 / w) - 1
    y = (torch.arange(h, device=image.device)[:, None] + 0.5) * (2 / h) - 1
    grid = torch.stack(torch.broadcast_tensors(x, y), -1)
    total = torch.zeros_like(image)
    for shift in shifts:
        total += torch.nn.functional.grid_sample(
            image, grid + shift, padding_mode="border", align_corners=False
        )
    return total / len(shifts)


def motion_while_open(
    views: CameraBatch,
    depth: Float[Tensor, "b v h w"],
    camera: Float[Tensor, "b v 6"],
    things: Float[Tensor, "b v h w 3"],
) -> Float[Tensor, "b v h w 2"]:
    """Pixels by which each point moves in the image while the shutter is open.

    ``camera`` is the motion of the camera in this time (rotation vector, translation, in its
    frame), ``things`` that of the points, world frame.
    """
    h, w = depth.shape[-2:]
    fx, fy, cx, cy = views.intrinsics[:, :, None, None, None].unbind(1)
    x = (torch.arange(w, device=depth.device) - cx) / fx
    y = (torch.arange(h, device=depth.device)[:, None] - cy) / fy
    ray = torch.stack(torch.broadcast_tensors(x, y, torch.ones_like(depth)), -1)
    point = ray * depth[..., None]
    rotation, way = (p[:, :, None, None].expand_as(point) for p in camera.split(3, -1))
    moved = torch.einsum("bvij,bvhwj->bvhwi", views.T_cw[..., :3, :3], things)
    rate = moved - way - torch.linalg.cross(rotation, point)
    across = (rate[..., :2] - ray[..., :2] * rate[..., 2:]) / depth[..., None].clamp_min(0.05)
    return across * torch.stack([fx, fy], -1)
