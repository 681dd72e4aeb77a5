"""Coloured disks through the CUDA operators of gsplat (Apache-2.0)."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int32
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs_bench.appearance.appearance_disks import AppearanceDisks
from geogs_bench.appearance.rasteriser import (
    MedianDisks,
    Rendering,
    normals_of_depth,
    shifted_matrix,
)

_TILE = 16


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
        self._matrices: dict[Camera, Tensor] = {}
        self._rays: dict[Camera, Tensor] = {}

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
            depth_normal = normals_of_depth(depth, self._directions(camera, T_cw.device))
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
        alpha, median = result[1][0, ..., 0], result[4][0, ..., 0]
        index = median.round().long() - 1
        return MedianDisks(torch.where(alpha > 0, index, -1), alpha)

    def _project(self, disks: AppearanceDisks, camera: Camera, T_cw: Tensor) -> _Projection:
        # The third scale is not used by the operators, but its column must be there.
        radii, means, depths, transforms, normals = self._gsplat.fully_fused_projection_2dgs(
            disks.means,
            disks.quaternions,
            F.pad(disks.scales, (0, 1), value=1.0),
            T_cw[None],
            self._matrix(camera, T_cw.device)[None],
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
            projection.means.detach(),
            projection.radii,
            projection.depths.detach(),
            _TILE,
            *tiles,
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

    def _matrix(self, camera: Camera, device: torch.device) -> Float[Tensor, "3 3"]:
        """Intrinsics on the device; cached, since sending them waits for the GPU."""
        if camera not in self._matrices:
            self._matrices[camera] = shifted_matrix(camera, device)
        return self._matrices[camera]

    def _directions(self, camera: Camera, device: torch.device) -> Float[Tensor, "h w 3"]:
        """Rays of the pixels on the device, cached."""
        if camera not in self._rays:
            self._rays[camera] = camera.rays(torch.float32, device)
        return self._rays[camera]
