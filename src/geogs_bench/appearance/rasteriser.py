"""Images and depth maps of coloured disks, by the CUDA operators of gsplat (Apache-2.0).

The depth of a pixel is the crossing of its ray with its median disk.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix
from geogs.mesh.triangle_mesh import DepthMapView
from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import AppearanceDisks
from geogs_bench.appearance.training_views import TrainingView

MIN_ALPHA = 1 / 255
"""Least opacity with which a disk hits a pixel."""
PIXEL_SHARPNESS = 2.0
"""Inverse variance in 1/pixel^2 of the Gaussian around a centre below which no disk shrinks."""
_TILE = 16
_MIN_FACING = 0.1
"""Smallest cosine between a ray and a disk's normal for which they are crossed."""
_DEVIATIONS = 3.0
"""Largest distance of a crossing from the centre, in the disk's larger standard deviations ..."""
_PIXELS = math.sqrt(-2 * math.log(MIN_ALPHA) / PIXEL_SHARPNESS)
"""... and, added to it, in pixels: the visible radius of the smallest disk."""


@dataclass(frozen=True)
class Rendering:
    """One view, differentiable in the disks."""

    colour: Float[Tensor, "h w 3"]
    """RGB over the background, not clamped above."""
    alpha: Float[Tensor, "h w"]
    normal: Float[Tensor, "h w 3"] | None
    """Blended normals of the disks, camera frame, facing the camera; none unless requested."""
    depth_normal: Float[Tensor, "h w 3"] | None
    """Normals of the expected depth, camera frame; zero at the border; none unless requested."""
    screen: Float[Tensor, "*b n 2"]
    """Receives in the backward pass the gradient of each disk's image position, per pixel."""
    visible: Bool[Tensor, "n"]
    """Disks that touch the image."""


@dataclass(frozen=True)
class MedianDisks:
    """The disk at which each pixel's ray has half its transmittance."""

    index: Int64[Tensor, "h w"]
    """Row of the disk; -1 where there is none."""
    alpha: Float[Tensor, "h w"]
    """Opacity along the whole ray."""


@runtime_checkable
class Rasteriser(Protocol):
    """Renders coloured disks."""

    def render(
        self,
        disks: AppearanceDisks,
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        sh_degree: int,
        background: Float[Tensor, "3"] | None,
        with_normals: bool,
    ) -> Rendering:
        """Render colours and, if wanted, normals; the background is black if none is given."""
        ...

    def median_disks(
        self, disks: AppearanceDisks, camera: Camera, T_cw: Float[Tensor, "4 4"]
    ) -> MedianDisks:
        """Find the last disk of each pixel in front of which more than half the light passes."""
        ...


def shifted_matrix(camera: Camera, device: torch.device) -> Float[Tensor, "3 3"]:
    """Intrinsics, float32, for renderers that put the centre of the first pixel at (1/2, 1/2)."""
    K = camera.matrix()
    K[:2, 2] += 0.5
    return K.float().to(device)


def normals_of_depth(
    depth: Float[Tensor, "h w"], rays: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """Camera-frame normals by central differences, facing the camera, zero at the border."""
    points = depth[..., None] * rays
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    normals = F.normalize(torch.linalg.cross(down, right), dim=-1)
    return F.pad(normals, (0, 0, 1, 1, 1, 1))


@dataclass(frozen=True)
class _Projection:
    """Disks projected to one image, in gsplat's layout; the first axis is the image."""

    radii: Int32[Tensor, "1 n 2"]
    """Half sizes in pixels of the boxes around the disks; 0 for invisible ones."""
    means: Float[Tensor, "1 n 2"]
    depths: Float[Tensor, "1 n"]
    transforms: Float[Tensor, "1 n 3 3"]
    normals: Float[Tensor, "1 n 3"]
    screen: Float[Tensor, "1 n 2"]
    """Zero; receives the gradient that densification uses."""


class GsplatRasteriser:
    """The rasteriser of gsplat's ``rasterization_2dgs``; needs an NVIDIA GPU.

    The operators are called one by one, since the function as a whole inverts the camera's pose
    up to three times an image, and each time the host waits for the GPU.

    Raises:
        InputError: gsplat is not installed.
    """

    def __init__(self, near: float) -> None:
        try:
            import gsplat
        except ImportError as error:
            raise InputError(
                "The appearance baseline needs gsplat; install it with: pip install gsplat"
            ) from error
        self._gsplat = gsplat
        self._near = near

    def render(
        self,
        disks: AppearanceDisks,
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        sh_degree: int,
        background: Float[Tensor, "3"] | None,
        with_normals: bool,
    ) -> Rendering:
        """Render colours and, if wanted, normals: see :class:`~.rasteriser.Rasteriser`."""
        projection = self._project(disks, camera, T_cw)
        visible = (projection.radii > 0).all(-1)
        directions = disks.means + T_cw[:3, 3] @ T_cw[:3, :3]
        colours = self._gsplat.spherical_harmonics(
            sh_degree, directions[None], disks.coefficients[None], masks=visible
        )
        channels = (colours + 0.5).clamp(min=0)
        if with_normals:
            channels = torch.cat([channels, projection.depths[..., None]], -1)
        if background is not None:
            background = F.pad(background, (0, channels.shape[-1] - 3))[None]
        image, alpha, normal, _, _ = self._blend(disks, camera, projection, channels, background)
        depth_normal = None
        if with_normals:
            depth = image[0, ..., 3] / alpha[0, ..., 0].clamp(min=1e-10)
            depth_normal = normals_of_depth(depth, _on_device(camera, T_cw.device)[1])
        return Rendering(
            image[0, ..., :3],
            alpha[0, ..., 0],
            normal[0] if with_normals else None,
            depth_normal,
            projection.screen,
            visible[0],
        )

    @torch.no_grad()
    def median_disks(
        self, disks: AppearanceDisks, camera: Camera, T_cw: Float[Tensor, "4 4"]
    ) -> MedianDisks:
        """The median disk of each pixel: see :class:`~.rasteriser.Rasteriser`.

        gsplat's median is the last channel's value of the median disk, so that channel holds the
        index of each disk, from 1 on. Float32 represents these for up to 2^24 disks.
        """
        if len(disks) >= 2**24:
            raise InputError(f"{len(disks)} disks are too many to tell apart; use fewer points.")
        device = disks.means.device
        numbers = torch.arange(1, len(disks) + 1, device=device, dtype=torch.float32)
        projection = self._project(disks, camera, T_cw)
        result = self._blend(disks, camera, projection, numbers[None, :, None], None)
        alpha = result[1][0, ..., 0]
        median = result[4][0, ..., 0]
        index = median.round().long() - 1
        return MedianDisks(torch.where(alpha > 0, index, -1), alpha)

    def _project(self, disks: AppearanceDisks, camera: Camera, T_cw: Tensor) -> _Projection:
        # The third scale is not used by the operators, but its column must be there.
        radii, means, depths, transforms, normals = self._gsplat.fully_fused_projection_2dgs(
            disks.means,
            disks.quaternions,
            F.pad(disks.scales, (0, 1), value=1.0),
            T_cw[None],
            _on_device(camera, T_cw.device)[0][None],
            camera.width,
            camera.height,
            near_plane=self._near,
        )
        screen = torch.zeros_like(means, requires_grad=torch.is_grad_enabled())
        return _Projection(radii, means, depths, transforms, normals, screen)

    def _blend(
        self,
        disks: AppearanceDisks,
        camera: Camera,
        projection: _Projection,
        channels: Float[Tensor, "1 n c"],
        background: Float[Tensor, "1 c"] | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Image, opacity, normals, distortion and median; (1, h, w, ...) each."""
        tiles = -(-camera.width // _TILE), -(-camera.height // _TILE)
        _, keys, rows = self._gsplat.isect_tiles(
            projection.means.detach(), projection.radii, projection.depths.detach(), _TILE, *tiles
        )
        starts = self._gsplat.isect_offset_encode(keys, 1, *tiles)
        return self._gsplat.rasterize_to_pixels_2dgs(
            projection.means,
            projection.transforms,
            channels,
            disks.opacities[None],
            projection.normals,
            projection.screen,
            camera.width,
            camera.height,
            _TILE,
            starts,
            rows,
            backgrounds=background,
        )


@functools.lru_cache(maxsize=4)
def _on_device(
    camera: Camera, device: torch.device
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "h w 3"]]:
    """Intrinsics and rays of the pixels; cached, since sending them waits for the GPU."""
    return shifted_matrix(camera, device), camera.rays(torch.float32, device)


@torch.no_grad()
def crossing_depth(
    disks: AppearanceDisks,
    median: MedianDisks,
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
    min_alpha: float,
) -> Float[Tensor, "h w"]:
    """z of the ray's crossing with the plane of the median disk; 0 below ``min_alpha``.

    The plane counts also where the pixel sees the disk only because none shrinks below a pixel:
    for disks of a pixel that is most of the image, and the centre's depth would make it a
    staircase. The centre's depth is taken where ray and plane are nearly parallel and where the
    crossing is farther from the centre than the disk can be seen.
    """
    has_depth = (median.index >= 0) & (median.alpha >= min_alpha)
    rows = median.index[has_depth]
    rays = camera.rays(torch.float32, disks.means.device)[has_depth]
    z = _crossing(disks, rows, rays, camera, T_cw)
    depth = torch.zeros(median.index.shape, device=disks.means.device)
    depth[has_depth] = z
    return depth


@torch.no_grad()
def depth_views(
    disks: AppearanceDisks,
    views: Sequence[TrainingView],
    rasteriser: Rasteriser,
    config: AppearanceConfig,
) -> list[DepthMapView]:
    """Depth of every view inside its mask; every pixel with a depth has weight 1."""
    device = disks.means.device
    maps = []
    for view in views:
        T_cw = torch.from_numpy(view.T_cw).float().to(device)
        median = rasteriser.median_disks(disks, view.camera, T_cw)
        depth = crossing_depth(disks, median, view.camera, T_cw, config.min_alpha)
        if view.mask is not None:
            depth = torch.where(torch.from_numpy(view.mask).to(device), depth, 0.0)
        weight = (depth > 0).float()
        T_cw_exact = torch.from_numpy(view.T_cw)
        maps.append(DepthMapView(depth, weight, view.camera, T_cw_exact, view.image))
    return maps


def _crossing(
    disks: AppearanceDisks,
    rows: Tensor,
    rays: Float[Tensor, "m 3"],
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
) -> Float[Tensor, "m"]:
    normal = quaternion_to_matrix(disks.quaternions)[..., 2] @ T_cw[:3, :3].T
    normal = normal[rows]
    centre = (disks.means @ T_cw[:3, :3].T + T_cw[:3, 3])[rows]
    facing = (rays * normal).sum(-1)
    is_seen_flat = facing.abs() > _MIN_FACING * rays.norm(dim=-1)
    z = (centre * normal).sum(-1) / torch.where(is_seen_flat, facing, 1.0)
    distance = (z[:, None] * rays - centre).norm(dim=-1)
    pixel = centre[:, 2] / min(camera.fx, camera.fy)
    reach = _DEVIATIONS * disks.scales.amax(1)[rows] + _PIXELS * pixel
    return torch.where(is_seen_flat & (distance <= reach) & (z > 0), z, centre[:, 2])
