"""The paper's losses between two views in plain PyTorch, of any dtype and device.

The target image is seen through the reference's rendered depth.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import LossConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.losses.kernel_settings import MIN_COVERAGE, NCC_MIN_VARIANCE
from geogs.losses.multi_view import (
    MIN_DEPTH_RATIO,
    PhotoView,
    compared_planes,
    enlarge_depth,
    occlusion_tolerance,
)
from oracles.photometric_reference import ncc, robust_l1, ssim


@dataclass(frozen=True, eq=False)
class Warped:
    """A target image brought into the reference view."""

    image: Float[Tensor, "h w *c"]
    """I_r->t; 0 where out of view."""
    pixels: Float[Tensor, "h w 2"]
    """Where each reference pixel falls in the target, p_t."""
    depth: Float[Tensor, "h w"]
    """z in the target's frame, map units."""
    in_view: Bool[Tensor, "h w"]
    """M_view: depth known, in front of the target, inside its image."""


def bilinear(image: Float[Tensor, "h w *c"], pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "..."]:
    """Bilinear samples of an image at pixel coordinates inside it, ``(*b, *c)``.

    Paper Eq. bilinear_interpolation; its slope jumps where it crosses a pixel.
    """
    height, width = image.shape[:2]
    x, y = pixels.unbind(-1)
    left = x.detach().floor().clamp(0, width - 2)
    top = y.detach().floor().clamp(0, height - 2)
    fx, fy = x - left, y - top
    if image.ndim == 3:
        fx, fy = fx[..., None], fy[..., None]
    i, j = left.long(), top.long()
    upper = image[j, i] * (1 - fx) + image[j, i + 1] * fx
    lower = image[j + 1, i] * (1 - fx) + image[j + 1, i + 1] * fx
    return upper * (1 - fy) + lower * fy


def warp(
    target_image: Float[Tensor, "th tw *c"],
    depth: Float[Tensor, "h w"],
    reference_camera: Camera,
    target_camera: Camera,
    reference_T_cw: Float[Tensor, "4 4"],
    target_T_cw: Float[Tensor, "4 4"],
) -> Warped:
    """The target image at the points of the reference's depth: paper Eqs. back_project, bilinear.

    Depth is in map units at the reference image's size (0 where unknown). Differentiable in the
    depth and both poses.
    """
    T = (target_T_cw @ se3_inverse(reference_T_cw)).to(depth.dtype)
    points = reference_camera.back_project(depth) @ T[:3, :3].mT + T[:3, 3]
    front = (depth > 0) & (points[..., 2] > MIN_DEPTH_RATIO * depth)
    points = torch.where(front[..., None], points, torch.ones_like(points))
    pixels, z = target_camera.project(points)
    edge = pixels.new_tensor([target_camera.width - 1, target_camera.height - 1])
    in_view = front & (pixels >= 0).all(-1) & (pixels <= edge).all(-1)
    inside = torch.where(in_view[..., None], pixels, torch.zeros_like(pixels))
    image = bilinear(target_image, inside)
    mask = in_view if image.ndim == 2 else in_view[..., None]
    image = torch.where(mask, image, torch.zeros_like(image))
    return Warped(image, pixels, z, in_view)


def occlusion_mask(
    warped: Warped,
    target_depth: Float[Tensor, "dh dw"],
    target_camera: Camera,
    tolerance: float = 0.05,
) -> Bool[Tensor, "h w"]:
    """M = M_view M_occ: paper Eqs. occlusion_mask, valid_mask.

    Visible where the relative difference between the point's depth and the target's rendered depth
    is below ``tolerance``. That depth may have another size than the target image; it is sampled
    bilinearly, and its pixels without depth (0) see nothing.
    """
    height, width = target_depth.shape
    small = target_camera.resized(width, height)
    image = warped.pixels.detach()
    x = (image[..., 0] - target_camera.cx) * (small.fx / target_camera.fx) + small.cx
    y = (image[..., 1] - target_camera.cy) * (small.fy / target_camera.fy) + small.cy
    zero = torch.zeros_like(x)
    x = torch.where(warped.in_view, x.clamp(0, width - 1), zero)
    y = torch.where(warped.in_view, y.clamp(0, height - 1), zero)
    known = (target_depth > 0) & torch.isfinite(target_depth)
    clean = torch.where(known, target_depth, torch.zeros_like(target_depth)).detach().to(x.dtype)
    maps = torch.stack([clean, known.to(x.dtype)], -1)
    seen, coverage = bilinear(maps, torch.stack([x, y], -1)).unbind(-1)
    z = warped.depth.detach()
    return warped.in_view & (coverage > 0.999) & ((z - seen).abs() < tolerance * z)


def multi_view_loss(
    depth: Float[Tensor, "h w"],
    reference: PhotoView,
    target: PhotoView,
    target_depth: Float[Tensor, "dh dw"] | None,
    config: LossConfig,
) -> Float[Tensor, ""]:
    """Photometric difference of two views through a rendered depth: paper Eq. multiview_loss.

    ``depth`` is the reference's at render size, 0 where alpha is low; it is enlarged to the
    photometric size. Without ``target_depth`` (the target's rendered depth, any size, no gradient)
    nothing counts as hidden. Each term is summed over valid pixels and divided by the number of
    all pixels. Differentiable in the depth and in both views' ``T_cw``.
    """
    loss = depth.new_zeros(())
    for k, weights in compared_planes(config):
        loss = loss + _plane_loss(depth, reference.plane(k), target.plane(k), target_depth, weights)
    return loss


def _plane_loss(
    depth: Float[Tensor, "h w"],
    reference: PhotoView,
    target: PhotoView,
    target_depth: Float[Tensor, "dh dw"] | None,
    config: LossConfig,
) -> Float[Tensor, ""]:
    grey = reference.grey.to(depth.dtype)
    big = enlarge_depth(depth, *grey.shape)
    image = target.grey.to(depth.dtype)
    warped = warp(image, big, reference.camera, target.camera, reference.T_cw, target.T_cw)
    mask = warped.in_view
    if target_depth is not None:
        tolerance = occlusion_tolerance(config, target.camera)
        mask = occlusion_mask(warped, target_depth, target.camera, tolerance)
    quadratic = config.l1_huber * math.sqrt(2 * float(reference.noise))
    texture = reference.texture.to(depth.dtype)
    return photometric_loss(grey, warped.image, mask, replace(config, l1_huber=quadratic), texture)


def photometric_loss(
    reference: Float[Tensor, "h w *c"],
    warped: Float[Tensor, "h w *c"],
    mask: Bool[Tensor, "h w"],
    config: LossConfig,
    texture: Float[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """``lambda_1 L_1 + lambda_ssim L_ssim + lambda_ncc L_ncc``, sums over the number of pixels.

    L_1 and L_ncc count ``v / (v + photo_texture)`` where the reference's texture is v;
    ``l1_huber`` is a difference here.
    """
    c, total = config, reference.new_zeros(())
    share = texture / (texture + c.photo_texture) if c.photo_texture > 0 else 1.0
    if c.l1_weight > 0:
        loss, _ = robust_l1(reference, warped, mask, c.l1_huber, c.l1_cut)
        total = total + c.l1_weight * (share * loss).sum()
    if c.ssim_weight > 0:
        loss, _ = ssim(reference, warped, mask, MIN_COVERAGE)
        total = total + c.ssim_weight * loss.sum()
    if c.ncc_weight > 0:
        thresholds = c.ncc_reject, NCC_MIN_VARIANCE, MIN_COVERAGE
        loss, _ = ncc(reference, warped, mask, c.ncc_patch, *thresholds)
        total = total + c.ncc_weight * (share * loss).sum()
    return total / mask.numel()
