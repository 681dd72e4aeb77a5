"""Settings of the losses for kernels: float32 records, read by the names of their fields.

On a GPU they are the structs of these names in ``cuda/view_maps.cuh``.
"""

import math
from typing import NamedTuple

import numpy as np

from geogs.config import LossConfig
from geogs.geometry.camera import Camera
from geogs.losses.multi_view import MIN_DEPTH_RATIO, occlusion_tolerance
from geogs.losses.single_view import MIN_ALPHA, NORMAL_EPSILON, SMOOTHNESS_ETA

# Keeps the correlation finite on flat windows; grey variance, far below the texture threshold.
NCC_VARIANCE_FLOOR = 1e-5
NCC_MIN_VARIANCE = 1e-8
"""Windows of the reference with less grey variance have no texture to correlate."""
MIN_COVERAGE = 0.7
"""Least valid fraction of a window; in others too little is left to compare."""


class SingleViewSettings(NamedTuple):
    """Weights are divided by the number of pixels, the distortion's also by the length unit."""

    fx: float
    fy: float
    cx: float
    cy: float
    depth: float
    normal: float
    consistency: float
    distortion: float
    opacity: float
    smoothness: float
    silhouette: float
    min_alpha: float
    relative: float
    """1 for the relative depth error, 0 for the difference."""
    normal_epsilon: float
    """Added to the square of a normal's length."""
    eta: float
    rewards_edges: float
    """1 with the second smoothness term."""


class PhotoSettings(NamedTuple):
    """Weights are divided by the number of pixels and scaled by a pair's weight."""

    fx: float
    fy: float
    cx: float
    cy: float
    min_depth_ratio: float
    """Least fraction of its depth at which a point may lie in front of the other camera."""
    occlusion: float
    """Relative depth difference from which a pixel is hidden."""
    l1: float
    huber: float
    """Difference up to which L_1 is quadratic, in standard deviations of the reference's noise."""
    cut: float
    ncc: float
    reject: float
    min_variance: float
    texture: float
    min_coverage: float
    variance_floor: float
    ssim: float


def single_view_settings(config: LossConfig, camera: Camera, unit: float) -> SingleViewSettings:
    """Settings for views of a camera; ``unit``, a length of the map, makes distortion unitless."""
    c = config
    pixels = camera.width * camera.height
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    return SingleViewSettings(
        *lens,
        depth=c.depth_weight / pixels,
        normal=c.normal_weight / pixels,
        consistency=c.normal_consistency_weight / pixels,
        distortion=c.distortion_weight / unit / pixels,
        opacity=c.opacity_weight / pixels,
        smoothness=c.smoothness_weight / pixels,
        silhouette=c.silhouette_weight / pixels,
        min_alpha=MIN_ALPHA,
        relative=c.ablation.depth_relative,
        normal_epsilon=NORMAL_EPSILON,
        eta=SMOOTHNESS_ETA,
        rewards_edges=c.ablation.smoothness_rewards_edges,
    )


def photo_settings(config: LossConfig, camera: Camera, weight: float = 1.0) -> PhotoSettings:
    """Settings for pairs of a camera's photometric images, each pair with this ``weight``."""
    c = config
    pixels = camera.width * camera.height
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    return PhotoSettings(
        *lens,
        min_depth_ratio=MIN_DEPTH_RATIO,
        occlusion=occlusion_tolerance(c, camera),
        l1=weight * c.l1_weight / pixels,
        huber=max(math.sqrt(2) * c.l1_huber, 1e-9),
        cut=c.l1_cut,
        ncc=weight * c.ncc_weight / pixels,
        reject=c.ncc_reject,
        min_variance=NCC_MIN_VARIANCE,
        texture=c.photo_texture,
        min_coverage=MIN_COVERAGE,
        variance_floor=NCC_VARIANCE_FLOOR,
        ssim=weight * c.ssim_weight / pixels,
    )


def record(settings: SingleViewSettings | PhotoSettings) -> np.void:
    """The settings as compiled code takes them."""
    kind = np.dtype([(name, np.float32) for name in settings._fields])
    return np.array([tuple(settings)], kind)[0]
