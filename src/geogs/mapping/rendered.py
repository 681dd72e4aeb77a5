"""Depth maps of keyframes for a surface: rendered from disks, or as searched before any disk."""

import torch

from geogs.config import MappingConfig
from geogs.geometry.camera import Camera
from geogs.geometry.depth import normals_from_depth
from geogs.mapping.view import MapView
from geogs.splat.map import DiskParameters
from geogs.splat.render import render
from geogs.types import RenderedKeyframe


def rendered_keyframe(
    view: MapView, disks: DiskParameters, camera: Camera, config: MappingConfig
) -> RenderedKeyframe:
    """Disks seen from a view inside its mask, with the weight of each depth for fusion."""
    output = render(disks, camera, view.T_cw)
    depth = output.shown_depth(config.loss.min_alpha)
    # The mean is smoother; but where the ray meets several surfaces it lies on none of them,
    # while the median is on one.
    single = (output.median_depth - depth).abs() < config.max_spread * depth
    depth = torch.where(single | (depth <= 0), depth, output.median_depth)
    weight = torch.where(single, 1.0, 0.5) * (depth > 0)
    if view.mask is not None:
        depth = torch.where(view.mask, depth, 0.0)
        weight = torch.where(view.mask, weight, 0.0)
    length = output.normal.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return RenderedKeyframe(
        keyframe_id=view.id,
        camera=camera,
        T_cw=view.T_cw,
        depth=depth,
        normal=torch.where(depth[..., None] > 0, output.normal / length, 0.0),
        weight=weight,
        image=view.keyframe.image,
    )


def searched_keyframe(view: MapView, camera: Camera) -> RenderedKeyframe:
    """A view's own dense depth where its confidence, which is the weight, is not zero."""
    weight = view.dense.confidence
    depth = torch.where(weight > 0, view.dense.depth, 0.0)
    normal, _ = normals_from_depth(depth, camera)
    return RenderedKeyframe(view.id, camera, view.T_cw, depth, normal, weight, view.keyframe.image)
