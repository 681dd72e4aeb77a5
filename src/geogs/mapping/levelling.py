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
    mine, theirs, usable = [], [], []
    for other in others:
        grey, seen, good = _common_pixels(view, other)
        mine.append(grey)
        theirs.append(seen)
        usable.append(good)
    if not mine:
        return same_light(view.dense.depth.device)
    return relative_light(torch.cat(mine), torch.cat(theirs), torch.cat(usable))


def _common_pixels(
    view: MapView, other: MapView
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """Grey values of a view's pixels, those of the same points in another, and which are both."""
    depth, photo, seen = view.dense, view.photo, other.photo
    rays = view.pool.cameras.render.rays(device=depth.depth.device)[::_STRIDE, ::_STRIDE]
    z = depth.depth[::_STRIDE, ::_STRIDE]
    points = (rays * z[..., None]).reshape(-1, 3)
    sure = (depth.confidence[::_STRIDE, ::_STRIDE] > _SURE).reshape(-1)
    T = (other.T_cw @ se3_inverse(view.T_cw)).to(points)
    mine, mine_in = _sampled(photo.grey, photo.camera, points)
    theirs, theirs_in = _sampled(seen.grey, seen.camera, points @ T[:3, :3].mT + T[:3, 3])
    gain, offset = other.light.unbind()
    exposed = _is_exposed(mine) & _is_exposed((theirs - offset) / gain)
    return mine, theirs, sure & mine_in & theirs_in & exposed


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
