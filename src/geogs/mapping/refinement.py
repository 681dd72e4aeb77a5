"""Depth beyond the sweep's planes: slanted patches at the working resolution, and local planes."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from geogs.config import DepthConfig
from geogs.geometry.camera import Camera
from geogs.mapping import refinement_kernels as kernels
from geogs.mapping.depth_view import DepthView


@dataclass(slots=True)
class SlantedDepth:
    """Inverse depth and its slopes per pixel of the render size."""

    inverse_depth: Float32[np.ndarray, "h w"]
    slope_x: Float32[np.ndarray, "h w"]
    """Change of inverse depth per pixel to the right."""
    slope_y: Float32[np.ndarray, "h w"]
    """Change of inverse depth per pixel down."""
    likeness: Float32[np.ndarray, "h w"]
    """Mean NCC with the neighbours that match."""
    precision: Float32[np.ndarray, "h w"]
    """Curvature of the sum of 1 - NCC by inverse depth."""
    support: Float32[np.ndarray, "h w"]
    """Sum of weights of the last plane fit."""


def refine_depth(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    render: Camera,
    working: Camera,
    inverse_depth: Float32[np.ndarray, "h w"],
    confidence: Float32[np.ndarray, "h w"],
    config: DepthConfig,
) -> SlantedDepth:
    """Alternate photometric Gauss-Newton steps per pixel with bilateral plane fits."""
    guide = _colour_guide(reference, render)
    patches, offsets = _reference_patches(reference, render, working)
    centre = patches[len(patches) // 2]
    weights = 1.0 / (1.0 + np.float32(config.support_contrast) * (patches - centre) ** 2)
    images = np.stack([v.fine for v in neighbours]) - np.float32(0.5)
    k, k_inverse = working.matrix().numpy(), np.linalg.inv(render.matrix().numpy())
    relative = [v.T_cw @ np.linalg.inv(reference.T_cw) for v in neighbours]
    a = np.stack([k @ m[:3, :3] @ k_inverse for m in relative])
    b = np.stack([k @ m[:3, 3] for m in relative])
    state = SlantedDepth(inverse_depth.copy(), *(np.zeros_like(inverse_depth) for _ in range(5)))
    sure = (confidence + np.float32(0.02)).astype(np.float32)
    _fit(state, sure, guide, 2, 1, 0.05, 0.0, config)
    _fit(state, sure, guide, config.fit_radius, 1, 0.03, 0.0, config)
    state.inverse_depth = inverse_depth.copy()
    floor = np.float32(config.variance_floor * 0.5)
    step = np.empty_like(inverse_depth)
    for i in range(config.refine_steps):
        kernels.photometric_step(
            patches, offsets, weights, images, a, b, state.inverse_depth, state.slope_x,
            state.slope_y, floor, step, state.likeness, state.precision,
        )
        limit = np.float32(config.step_limit) * state.inverse_depth
        data = state.inverse_depth + np.clip(step, -limit, limit)
        noise = (1.0 - state.likeness + 0.02) / (25.0 * state.precision + 1e-9)
        variance = noise / data**2
        sure = 1.0 / (1.0 + variance / np.float32(config.fit_deviation) ** 2)
        state.inverse_depth = data
        _fit(state, sure + np.float32(1e-3), guide, config.fit_radius, 1, config.fit_tolerance, config.fit_stiffness, config)
        fitted = state.inverse_depth
        if i + 1 < config.refine_steps or True:
            own = 1.0 / variance
            prior = np.float32(1.0 / config.plane_deviation**2)
            state.inverse_depth = ((own * data + prior * fitted) / (own + prior)).astype(np.float32)
    return state


def _fit(state, sure, guide, radius, stride, tolerance, stiffness, config):
    rho, sx, sy = (np.empty_like(state.inverse_depth) for _ in range(3))
    kernels.fit_planes(
        state.inverse_depth, state.slope_x, state.slope_y, sure, guide, radius, stride,
        np.float32(config.guide_contrast), np.float32(tolerance), np.float32(stiffness), rho, sx,
        sy, state.support,
    )
    state.inverse_depth, state.slope_x, state.slope_y = rho, sx, sy


def _colour_guide(reference: DepthView, render: Camera) -> Float32[np.ndarray, "3 h w"]:
    """The colour image at the render size in [0, 1], channels first."""
    size = (render.width, render.height)
    small = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small.transpose(2, 0, 1).astype(np.float32) / np.float32(255))


def _reference_patches(
    reference: DepthView, render: Camera, working: Camera
) -> tuple[Float32[np.ndarray, "s h w"], Float32[np.ndarray, "s 2"]]:
    """The fine reference image around every render pixel, and the offsets in render pixels."""
    reach = np.arange(-2, 3, dtype=np.float32)
    offsets = np.stack(np.meshgrid(reach, reach), -1).reshape(-1, 2)
    zoom_x, zoom_y = working.fx / render.fx, working.fy / render.fy
    columns = np.arange(render.width, dtype=np.float32)
    rows = np.arange(render.height, dtype=np.float32)
    patches = np.empty((len(offsets), render.height, render.width), np.float32)
    for patch, (ox, oy) in zip(patches, offsets, strict=True):
        x = (columns + ox - render.cx) * zoom_x + working.cx
        y = (rows + oy - render.cy) * zoom_y + working.cy
        x, y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        patch[:] = cv2.remap(
            reference.fine, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return patches - np.float32(0.5), offsets
