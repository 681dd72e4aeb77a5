"""Depth maps of keyframes for surface fusion: rendered from disks, or as searched."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from geogs.config import MappingConfig
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import averaged_over_planes, normals_from_depth
from geogs.geometry.given_pose import GivenPose, as_pose
from geogs.geometry.jumps import depth_jumps, widened
from geogs.losses.single_view import MIN_ALPHA
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.map_frame import MapFrame
from geogs.short_repr import ShortRepr
from geogs.splat.render import render
from geogs.types import MapSnapshot, RenderedKeyframe
from geogs.world.archive import Archive
from geogs.world.disks import DiskParameters

_RADIUS = 3
"""Radius in pixels of the tangent planes that a depth is averaged over."""
_SLANTED = 0.5
"""Cosine of the angle between normal and ray (60 degrees) below which spread is measured along the
normal, if all pixels around are below it, too: disks of a road that differ by a centimetre in
height are hit 20 cm apart 25 m ahead. At a silhouette the slanted region is narrow."""
_AT_ENDS = 0.6
"""Weight of a depth near the end of a surface, where disks reach over it: too little for one view
to make a surface alone, as it does elsewhere."""
_AROUND = 2
"""Radius of a neighbourhood, in rows and columns."""


class SurfaceMaps(NamedTuple):
    """A surface rendered from one pose."""

    depth: Float[Tensor, "h w"]
    """0 where the map is too transparent."""
    normal: Float[Tensor, "h w 3"]
    """Camera frame, unit and facing the camera; zero where there is no depth."""
    weight: Float[Tensor, "h w"]
    """Confidence of the depth, in [0, 1]; less where disks spread along the ray."""


@dataclass(frozen=True, slots=True, repr=False)
class RenderedView(ShortRepr):
    """A map rendered from one pose, as NumPy arrays."""

    depth: Float[np.ndarray, "h w"]
    """z in map units; 0 where the map is too transparent."""
    normal: Float[np.ndarray, "h w 3"]
    """Camera frame, unit and facing the camera; zero where there is no depth."""
    weight: Float[np.ndarray, "h w"]
    """Confidence of the depth, in [0, 1]; less where disks spread along the ray."""


@dataclass(frozen=True)
class SurfaceRules:
    """Thresholds that make a surface of blended disks."""

    min_alpha: float
    """Opacity above which the map hides what lies behind."""
    max_spread: float
    """Relative difference of mean and median depth up to which a ray meets one surface."""
    plane_reach: float
    """Relative distance up to which a depth is averaged over the planes of the pixels around."""

    @staticmethod
    def of(config: MappingConfig) -> "SurfaceRules":
        """The rules of a run's settings."""
        return SurfaceRules(MIN_ALPHA, config.max_spread, config.plane_reach)


@dataclass(frozen=True, eq=False)
class MapRenderer:
    """Renders a map from any pose, as the run rendered it from its keyframes.

    Disks are in the map's own frame and unit, poses and results in the world's.
    """

    disks: MapSnapshot
    frame: MapFrame
    camera: Camera
    """Camera of the keyframes' depth maps."""
    rules: SurfaceRules

    @torch.no_grad()
    def surface(
        self,
        T_cw: Float[Tensor, "4 4"],
        camera: Camera | None = None,
        mask: Bool[Tensor, "h w"] | None = None,
    ) -> SurfaceMaps:
        """Render the surface inside a mask; ``camera`` defaults to that of the depth maps."""
        disks = DiskParameters.of(self.disks)
        pose = self.frame.pose(T_cw)
        maps = rendered_surface(disks, camera or self.camera, pose, self.rules, mask)
        return maps._replace(depth=maps.depth * self.frame.unit)

    def render(self, T_cw: GivenPose, camera: Camera | None = None) -> RenderedView:
        """Render the surface from any pose, world to camera, as NumPy arrays.

        ``camera`` defaults to that of the keyframes' depth maps. Raises InputError if the
        pose is no 4x4 matrix of finite numbers.
        """
        maps = self.surface(as_pose(T_cw), camera)
        return RenderedView(*(values.cpu().numpy() for values in maps))


def rendered_surface(
    disks: DiskParameters,
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
    rules: SurfaceRules,
    mask: Bool[Tensor, "h w"] | None,
) -> SurfaceMaps:
    """Render disks from a pose inside a mask, with the weight of each depth for fusion."""
    output = render(disks, camera, T_cw)
    depth = output.shown_depth(rules.min_alpha)
    if mask is not None:
        depth = torch.where(mask, depth, 0.0)
    length = output.normal.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    normal = torch.where(depth[..., None] > 0, output.normal / length, 0.0)
    # The mean is smoother; but where the ray meets several surfaces it lies on none of them,
    # while the median is on one.
    spread = (output.median_depth - depth).abs()
    facing = _facing(normal, camera)
    single = spread < rules.max_spread * depth
    slanted = ~widened(facing > _SLANTED, _AROUND)
    single |= slanted & (spread * facing < 2 * rules.max_spread * depth)
    depth = torch.where(single | (depth <= 0), depth, output.median_depth)
    jumps = depth_jumps(depth)
    ends = widened(jumps.near | jumps.far | (depth <= 0), _AROUND)
    weight = torch.where(single, 1.0, 0.5) * torch.where(ends, _AT_ENDS, 1.0) * (depth > 0)
    depth = averaged_over_planes(depth, normal, camera, _RADIUS, rules.plane_reach)
    return SurfaceMaps(depth, normal, weight)


def _facing(normal: Float[Tensor, "h w 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """The cosine of the angle between normal and ray."""
    rays = camera.rays(normal.dtype, normal.device)
    return (normal * rays).sum(-1).abs() / rays.norm(dim=-1)


def shown_depth(maps: SurfaceMaps) -> DenseDepth:
    """A rendered surface as the dense depth of a keyframe."""
    known = maps.depth > 0
    shown = maps.depth[known]
    typical = shown.median() if len(shown) else maps.depth.new_ones(())
    depth = torch.where(known, maps.depth, typical)
    return DenseDepth(depth, maps.weight, typical.cpu(), normal=maps.normal)


def rendered_keyframe(
    view: MapView, disks: DiskParameters, rules: SurfaceRules
) -> RenderedKeyframe:
    """Disks seen from a view inside its mask."""
    camera = view.arrays.cameras.render
    return _keyframe(view, rendered_surface(disks, camera, view.T_cw, rules, view.mask))


def searched_keyframe(view: MapView) -> RenderedKeyframe:
    """A view's own dense depth where its confidence, which is the weight, is not zero."""
    weight = view.dense.confidence
    depth = torch.where(weight > 0, view.dense.depth, 0.0)
    normal, _ = normals_from_depth(depth, view.arrays.cameras.render)
    return _keyframe(view, SurfaceMaps(depth, normal, weight))


def _keyframe(view: MapView, maps: SurfaceMaps) -> RenderedKeyframe:
    frame = view.keyframe
    camera = view.arrays.cameras.render
    return RenderedKeyframe(
        view.id, camera, view.T_cw, *maps, frame.image, frame.timestamp, view.mask
    )


def stored_render(
    render: RenderedKeyframe, image: Callable[[], UInt8[np.ndarray, "h w 3"]], archive: Archive
) -> Callable[[], RenderedKeyframe]:
    """Put a rendering into an archive; returns what reads it into memory, with its ``image``.

    Normals are stored in half precision.

    Raises:
        OutputError: the disk is full, or cannot be written.
    """
    maps = (render.depth, render.normal.half(), render.weight)
    stored = [archive.put(values.cpu().numpy()) for values in maps]
    device = render.depth.device
    keyframe = partial(RenderedKeyframe, render.keyframe_id, render.camera, render.T_cw)
    keyframe = partial(keyframe, timestamp=render.timestamp, mask=render.mask)

    def load() -> RenderedKeyframe:
        loaded = (torch.from_numpy(values.load()).to(device).float() for values in stored)
        return keyframe(*loaded, image=image())

    return load
