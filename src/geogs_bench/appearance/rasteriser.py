"""The trainer's interface to a rasteriser of coloured disks."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs_bench.appearance.appearance_disks import AppearanceDisks

MIN_ALPHA = 1 / 255
"""Least opacity with which a disk hits a pixel."""
PIXEL_SHARPNESS = 2.0
"""Inverse variance in 1/pixel^2 of the Gaussian around a centre below which no disk shrinks."""


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
