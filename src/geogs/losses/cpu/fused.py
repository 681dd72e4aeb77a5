"""The mapper's losses on a CPU: value and gradient in one pass, compiled and split over threads.

In float32; tested against the plain definitions in ``tests/oracles``. The gradient is computed with
the value, so the backward pass only scales it. Results do not depend on the number of threads.
"""

import functools
import math

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from geogs.config import LossConfig
from geogs.geometry.lie import se3_inverse
from geogs.losses.cpu import multi_view_kernels as multi
from geogs.losses.cpu.single_view_kernels import single_view_rows
from geogs.losses.kernel_settings import MIN_COVERAGE, photo_settings, record, single_view_settings
from geogs.losses.multi_view import PhotoView, compared_planes
from geogs.losses.single_view import ViewConstants, visible
from geogs.threads import over_rows

# Constants of Wang et al. 2004.
_C1, _C2, _SIGMA, _REACH = 0.01**2, 0.03**2, 1.5, 5
_LINE = np.exp(-(np.arange(-_REACH, _REACH + 1) ** 2) / (2 * _SIGMA**2))
_LINE = (_LINE / _LINE.sum()).astype(np.float64)


def _blurred(image: np.ndarray) -> np.ndarray:
    """Gaussian window sums with zeros beyond the border; the filter is its own adjoint."""
    return cv2.sepFilter2D(image, -1, _LINE, _LINE, borderType=cv2.BORDER_CONSTANT)


def ssim_gradient(
    reference: Float32[np.ndarray, "h w"],
    warped: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"],
    config: LossConfig,
) -> tuple[float, Float32[np.ndarray, "h w"]]:
    """Weighted L_ssim over all pixels and its gradient in the warped image, computed in float64.

    Windows are normalised over the mask, and a pixel of it counts where its window is covered
    enough: paper Eq. ssim.
    """
    m = (mask > 0).astype(np.float64)
    a, b = reference * m, warped * m
    coverage = _blurred(m)
    covered = np.maximum(coverage, 1e-6)
    mean_a, mean_b = _blurred(a) / covered, _blurred(b) / covered
    variance_a = _blurred(a * a) / covered - mean_a**2
    variance_b = _blurred(b * b) / covered - mean_b**2
    covariance = _blurred(a * b) / covered - mean_a * mean_b
    above, below = 2 * mean_a * mean_b + _C1, mean_a**2 + mean_b**2 + _C1
    upper = 2 * covariance + _C2
    lower = variance_a + variance_b + _C2
    luminance = above / below
    structure = upper / lower
    used = m * (coverage >= np.float64(np.float32(MIN_COVERAGE)))
    weight = config.ssim_weight / mask.size
    loss = weight * float((used * (1 - luminance * structure)).sum())

    # Derivatives by the three window sums that contain the warped image.
    out = -weight * used / covered
    d_luminance = 2 * (mean_a - luminance * mean_b) / below
    d_variance = -structure / lower
    d_covariance = 2 / lower
    in_mean = out * (
        structure * d_luminance - luminance * (2 * mean_b * d_variance + mean_a * d_covariance)
    )
    in_square = out * luminance * d_variance
    in_product = out * luminance * d_covariance
    gradient = _blurred(in_mean) + 2 * b * _blurred(in_square) + a * _blurred(in_product)
    return loss, (gradient * m).astype(np.float32)


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


class _SingleView(torch.autograd.Function):
    @staticmethod
    def forward(ctx, depth, normal, alpha, spread, view, config, unit):  # type: ignore[no-untyped-def]
        height, width = depth.shape
        scale = 1.0
        if config.smoothness_weight > 0:
            shown = visible(depth, alpha) & (view.prior_depth >= 0)
            known = depth[shown]
            scale = 1 / float(known.median()) if len(known) else 0.0
        settings = record(single_view_settings(config, view.camera, unit))
        maps = [_array(m) for m in (depth, normal, alpha, spread)]
        constants = [view.edge, view.image_gradient, view.prior_depth, view.confidence]
        constants = [_array(m) for m in constants]
        prior_normal = np.empty((0, 0, 3), np.float32)
        if view.prior_normal is not None:
            prior_normal = _array(view.prior_normal)
        loss = np.zeros(height, np.float32)
        gradients = [np.zeros_like(m) for m in maps]

        def rows(first: int, last: int) -> None:
            scratch = np.zeros((3, max(last - first + 4, 5), width), np.float32)
            arguments = *maps, *constants, prior_normal, settings, np.float32(scale), scratch, loss
            single_view_rows(first, last, *arguments, *gradients)

        over_rows(rows, height)
        ctx.gradients = [torch.from_numpy(g) for g in gradients]
        return depth.new_tensor(loss.sum(dtype=np.float64))

    @staticmethod
    @once_differentiable
    def backward(ctx, g):  # type: ignore[no-untyped-def]
        return (*(g * each for each in ctx.gradients), None, None, None)


def fused_single_view(
    depth: Float[Tensor, "h w"],
    normal: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    distortion_map: Float[Tensor, "h w"],
    view: ViewConstants,
    config: LossConfig,
    unit: float,
) -> Float[Tensor, ""]:
    """Weighted sum of the single-view terms: paper Eq. single_loss, plus opacity and silhouette.

    Each term is summed over the pixels where it counts and divided by the number of all pixels, so
    that a small valid region does not get large gradients. ``unit`` is a length in map units that
    makes the distortion term unitless. Where the view's prior depth is ``OUTSIDE`` only the
    silhouette counts. Differentiable once, in the four maps, which are float32. NaN and pixels
    without depth count nowhere.
    """
    return _SingleView.apply(depth, normal, alpha, distortion_map, view, config, unit)


@functools.lru_cache(maxsize=64)
def _enlargement(source: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """For each of ``size`` pixels its two source pixels (2, size) and the weight of the second."""
    at = ((np.arange(size) + 0.5) * (source / size) - 0.5).clip(0, source - 1)
    left = np.minimum(at.astype(np.int64), source - 1)
    weight = (at - left).astype(np.float32)
    # A pixel without weight is not read, so its missing depth does not matter.
    right = np.where(weight > 1e-3, left + 1, left)
    left = np.where(weight < 1 - 1e-3, left, right)
    return np.stack([left, right]), weight


class _MultiView(torch.autograd.Function):
    @staticmethod
    def forward(ctx, depth, T, reference, target, target_depth, config):  # type: ignore[no-untyped-def]
        grey, texture = _array(reference.grey), _array(reference.texture)
        image = _array(target.grey)
        height, width = grey.shape
        small, T34 = _array(depth), np.ascontiguousarray(T.detach().numpy()[:3], np.float32)
        tables = (*_enlargement(len(small), height), *_enlargement(small.shape[1], width))
        hidden = np.empty((0, 0), np.float32) if target_depth is None else _array(target_depth)
        seen = target.camera if target_depth is None else target.camera.resized(*hidden.shape[::-1])
        cameras = (reference.camera, target.camera, seen)
        lenses = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras], np.float32)
        settings = record(photo_settings(config, target.camera))
        settings["huber"] *= math.sqrt(float(reference.noise))
        half = config.ncc_patch // 2 if config.ncc_weight > 0 else -1
        with_depth, with_pose = ctx.needs_input_grad[:2]

        warped, slope, mask = np.empty((3, height, width), np.float32)
        extra = np.empty((3, height, width) if with_pose else (3, 0, 0), np.float32)
        fields = np.empty((3, height, width) if half >= 0 else (3, 0, 0), np.float32)
        loss = np.zeros(height, np.float32)
        over_rows(
            lambda a, b: multi.warp_rows(
                a, b, small, *tables, grey, texture, image, hidden, lenses, T34, settings,
                warped, slope, mask, extra, loss,
            ),
            height,
        )  # fmt: skip
        if half >= 0:
            over_rows(
                lambda a, b: multi.correlate_rows(
                    a, b, grey, texture, warped, mask, half, settings, fields, loss
                ),
                height,
            )
        total = float(loss.sum(dtype=np.float64))
        # d loss / d warped: [0] from other terms, [1] in total; empty unless needed.
        g_image = np.zeros((2, height, width) if with_pose else (2, 0, 0), np.float32)
        if config.ssim_weight > 0:
            g_image = np.zeros((2, height, width), np.float32)
            value, g_image[0] = ssim_gradient(grey, warped, mask, config)
            total += value

        g_depth, g_T = np.zeros_like(small), np.zeros((4, 4))
        if with_depth or with_pose:
            over_rows(
                lambda a, b: multi.depth_gradient_rows(
                    a, b, *tables, grey, texture, warped, slope, mask, half, settings, fields,
                    g_image, g_depth,
                ),
                len(small),
            )  # fmt: skip
        if with_pose:
            g_rows = np.empty((height, 12))
            over_rows(
                lambda a, b: multi.pose_gradient_rows(a, b, g_image, extra, lenses, T34, g_rows),
                height,
            )
            g_T[:3] = g_rows.sum(0).reshape(3, 4)
        ctx.g_depth = torch.from_numpy(g_depth)
        ctx.g_T = torch.from_numpy(g_T).to(T.dtype)
        return depth.new_tensor(total)

    @staticmethod
    @once_differentiable
    def backward(ctx, g):  # type: ignore[no-untyped-def]
        return g * ctx.g_depth, g * ctx.g_T, None, None, None, None


def fused_multi_view(
    depth: Float[Tensor, "h w"],
    reference: PhotoView,
    target: PhotoView,
    target_depth: Float[Tensor, "dh dw"] | None,
    config: LossConfig,
) -> Float[Tensor, ""]:
    """Photometric difference of two views through a rendered depth: paper Eq. multiview_loss.

    ``depth`` is the reference's at render size, float32, 0 where alpha is low; it is enlarged to
    the photometric size. Without ``target_depth`` (the target's rendered depth, any size, no
    gradient) nothing counts as hidden. Each term is summed over valid pixels and divided by the
    number of all pixels. Differentiable once, in the depth and, where they require it, in
    ``reference.T_cw`` and ``target.T_cw``.
    """
    T = target.T_cw @ se3_inverse(reference.T_cw)
    loss = depth.new_zeros(())
    for k, weights in compared_planes(config):
        one = _MultiView.apply(depth, T, reference.plane(k), target.plane(k), target_depth, weights)
        loss = loss + one
    return loss
