"""The light of a view: what makes its grey values those of the views before it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.losses.light import relative_light, same_light
from geogs.losses.multi_view import bilinear
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
    mine, inside = _sampled(view.photo.grey, view.photo.camera, points)
    usable, T_wv = sure & inside & _is_exposed(mine), se3_inverse(view.T_cw)
    theirs, common = [], []
    for other in others:
        T = (other.T_cw @ T_wv).to(points)
        seen, inside = _sampled(
            other.photo.grey, other.photo.camera, points @ T[:3, :3].mT + T[:3, 3]
        )
        gain, offset = other.light.unbind()
        theirs.append(seen)
        common.append(usable & inside & _is_exposed((seen - offset) / gain))
    return relative_light(mine.repeat(len(others)), torch.cat(theirs), torch.cat(common))


def _sparse_points(view: MapView) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Points of every fourth pixel of a view in its camera, and which are sure."""
    depth = view.dense
    rays = view.pool.cameras.render.rays(device=depth.depth.device)[::_STRIDE, ::_STRIDE]
    points = rays * depth.depth[::_STRIDE, ::_STRIDE, None]
    sure = depth.confidence[::_STRIDE, ::_STRIDE] > _SURE
    return points.reshape(-1, 3), sure.reshape(-1)


def _sampled(
    grey: Float[Tensor, "h w"], camera: Camera, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
    ahead = points[:, 2] > 1e-6
    pixels, _ = camera.project(torch.where(ahead[:, None], points, torch.ones_like(points)))
    edge = pixels.new_tensor([camera.width - 1, camera.height - 1])
    inside = ahead & (pixels >= 0).all(-1) & (pixels <= edge).all(-1)
    return bilinear(grey, torch.where(inside[:, None], pixels, torch.zeros_like(pixels))), inside


def _is_exposed(grey: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
    return (grey > _DARK) & (grey < _BRIGHT)
