"""The light of a view: what makes its grey values those of the views before it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.gpu.transfer import to_device
from geogs.losses.light import relative_light, same_light
from geogs.mapping.view import MapView

_STRIDE = 4
"""Every fourth pixel of a dense depth, in both directions, is compared."""
_SURE = 0.3
"""Least confidence of its depth."""
_DARK, _BRIGHT = 0.02, 0.98
"""Grey values beyond which a sensor says no more than that."""


def light_of(view: MapView, others: Sequence[MapView]) -> Float[Tensor, "2"]:
    """Gain and offset of a view that has none yet, so that its grey values are those of others.

    The others are levelled already. The dense depth of the view tells where its pixels are in them.
    Gain 1 and offset 0 where there is nothing to compare with.
    """
    if not others:
        return same_light(view.dense.depth.device)
    points, sure = _sparse_points(view)
    (mine,), (inside,) = _sampled(view.photo.grey[None], view.photo.camera, points[None])
    usable = sure & inside & _is_exposed(mine)
    T_cw = torch.stack([other.T_cw for other in others]).cpu()
    T = to_device((T_cw @ se3_inverse(view.T_cw).to(T_cw)).to(points.dtype), points.device)
    greys = torch.stack([other.photo.grey for other in others])
    there = points @ T[:, :3, :3].mT + T[:, None, :3, 3]
    theirs, inside = _sampled(greys, view.photo.camera, there)
    gain, offset = torch.stack([other.light for other in others])[..., None].unbind(1)
    common = usable & inside & _is_exposed((theirs - offset) / gain)
    return relative_light(mine.repeat(len(others)), theirs.flatten(), common.flatten())


def _sparse_points(view: MapView) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Points of every fourth pixel of a view in its camera, and which are sure."""
    depth = view.dense
    rays = view.pool.cameras.render.rays(device=depth.depth.device)[::_STRIDE, ::_STRIDE]
    points = rays * depth.depth[::_STRIDE, ::_STRIDE, None]
    sure = depth.confidence[::_STRIDE, ::_STRIDE] > _SURE
    return points.reshape(-1, 3), sure.reshape(-1)


def _sampled(
    greys: Float[Tensor, "k h w"], camera: Camera, points: Float[Tensor, "k n 3"]
) -> tuple[Float[Tensor, "k n"], Bool[Tensor, "k n"]]:
    """What each image shows of points in its camera, and where it does."""
    ahead = points[..., 2] > 1e-6
    pixels, _ = camera.project(points)
    edges = (camera.width - 1, camera.height - 1)
    place = torch.stack([pixels[..., k] * (2 / edges[k]) - 1 for k in (0, 1)], -1)
    inside = ahead & (place.abs() <= 1).all(-1)
    place = torch.where(inside[..., None], place, 0.0)
    shown = grid_sample(greys[:, None], place[:, None], align_corners=True)
    return shown[:, 0, 0], inside


def _is_exposed(grey: Float[Tensor, "*n"]) -> Bool[Tensor, "*n"]:
    return (grey > _DARK) & (grey < _BRIGHT)
