"""Depth beyond the sweep's planes: slanted patches at the working resolution, and local planes."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt64

from geogs.depth import refinement_kernels as kernels
from geogs.depth.depth_view import DepthView, homographies
from geogs.depth.evidence import TrackerEvidence
from geogs.depth.plane_sweep import VARIANCE_FLOOR
from geogs.depth.sampling_kernels import pixel_pairs
from geogs.geometry.camera import Camera
from geogs.threads import over_rows

PATCH_REACH = 2
"""Patches of 5 x 5 samples, one render pixel apart."""
PATCH_CONTRAST = 500.0
"""Rate c of a patch sample's weight 1 / (1 + c d^2) by its grey difference d."""
REFINE_STEPS = (2, 2, 1)
"""Stride over the samples of a patch in each photometric step; a fit of local planes follows each.
Every second sample, like one colour of a chessboard, is enough except in the last step."""
STEP_LIMIT = 0.03
"""Largest step, relative to inverse depth: beyond it patches are no longer alike."""
PHOTO_DEVIATION = 0.07
"""Deviation of a photometric optimum times the root of its curvature, as measured."""
FIT_RADIUS = 4
"""Radius in pixels of the fit of a local plane."""
FIT_DEVIATION = 0.01
"""Relative deviation at which a pixel counts half in it."""
FIT_TOLERANCE = 0.01
"""Relative distance from the plane at which a pixel counts half in it."""
FIT_STIFFNESS = 0.5
"""Weight of the previous slopes in it, in confident pixels at distance 1."""
GUIDE_CONTRAST = 200.0
"""Rate c of a pixel's weight in it, 1 / (1 + c |dI|^2), by its colour difference."""
PLANE_DEVIATION = 0.003
"""Typical relative distance of a surface from local planes."""
FLOOR_DEVIATION = 0.002
"""Least relative deviation for any number of matches (pose, calibration, resampling)."""
FULL_SUPPORT = 5.0
"""Support from which a local plane counts fully."""


@dataclass(slots=True)
class SlantedDepth:
    """Inverse depth and its slopes per pixel of the render size."""

    inverse_depth: Float32[np.ndarray, "h w"]
    slope_x: Float32[np.ndarray, "h w"]
    """Change of inverse depth per pixel to the right."""
    slope_y: Float32[np.ndarray, "h w"]
    """Change of inverse depth per pixel down."""
    support: Float32[np.ndarray, "h w"]
    """Sum of weights of the last plane fit: confident pixels of like colour on the same plane."""


@dataclass(frozen=True, slots=True)
class _Patches:
    """Reference patches, their weights and the neighbours, for the photometric steps."""

    samples: Float32[np.ndarray, "s h w"]
    offsets: Float32[np.ndarray, "s 2"]
    weights: Float32[np.ndarray, "s h w"]
    pairs: UInt64[np.ndarray, "n fh fw"]
    """``pixel_pairs`` of the neighbours' images."""
    a: np.ndarray
    b: np.ndarray

    def every(self, step: int) -> "_Patches":
        """The patches with every ``step``-th sample."""
        samples = self.samples[::step].copy()
        offsets = self.offsets[::step].copy()
        weights = self.weights[::step].copy()
        return _Patches(samples, offsets, weights, self.pairs, self.a, self.b)


def refine_depth(
    reference: DepthView,
    neighbours: Sequence[DepthView],
    render: Camera,
    working: Camera,
    rho: Float32[np.ndarray, "h w"],
    confidence: Float32[np.ndarray, "h w"],
    tracker: TrackerEvidence,
    guide: Float32[np.ndarray, "3 h w"],
) -> SlantedDepth:
    """Alternate photometric Gauss-Newton steps per pixel with bilateral plane fits.

    They begin at the inverse depth ``rho``; ``confidence`` (0 to 1) weights the pixels in the first
    planes; ``guide`` is the image of :func:`colour_guide`. After each step inverse depth is the
    precision-weighted mean of the photometric optimum, the tracker's value (robust) and the local
    plane's.
    """
    patches = _gather_patches(reference, neighbours, render, working)
    compared = {step: patches.every(step) for step in set(REFINE_STEPS)}
    state = SlantedDepth(rho, *(np.zeros_like(rho) for _ in range(3)))
    for radius, tolerance in ((2, 0.05), (FIT_RADIUS, 0.03)):
        _fit_planes(state, confidence, guide, radius, tolerance, 0.0)
    state.inverse_depth = rho.copy()
    for step in REFINE_STEPS:
        photo_precision = _photometric_step(state, compared[step])
        rho = state.inverse_depth
        misfit = (tracker.inverse_depth / rho - 1.0) ** 2 * tracker.precision
        tracker_precision = tracker.precision / (1.0 + misfit / 4.0)
        precision = photo_precision + tracker_precision
        data = (photo_precision * rho + tracker_precision * tracker.inverse_depth) / precision
        state.inverse_depth = data
        confidence = 1.0 / (1.0 + 1.0 / (precision * np.float32(FIT_DEVIATION**2)))
        confidence += np.float32(1e-3)
        _fit_planes(state, confidence, guide, FIT_RADIUS, FIT_TOLERANCE, FIT_STIFFNESS)
        plane = np.minimum(state.support / np.float32(FULL_SUPPORT), np.float32(1.0))
        plane *= np.float32(1.0 / PLANE_DEVIATION**2)
        state.inverse_depth = (precision * data + plane * state.inverse_depth) / (precision + plane)
    return state


def _photometric_step(state: SlantedDepth, patches: _Patches) -> Float32[np.ndarray, "h w"]:
    """Move ``state`` one bounded step; returns the relative precision of the optimum.

    The measured deviation of a single optimum is ``PHOTO_DEVIATION`` over the square root of the
    curvature (by relative inverse depth), however similar the patches are.
    """
    rho = state.inverse_depth
    step, curvature = np.empty_like(rho), np.empty_like(rho)
    floor = np.float32(0.5 * VARIANCE_FLOOR)
    over_rows(
        lambda *rows: kernels.photometric_step(
            *rows, patches.samples, patches.offsets, patches.weights, patches.pairs, patches.a,
            patches.b, rho, state.slope_x, state.slope_y, floor, step, curvature,
        ),
        len(rho),
    )  # fmt: skip
    limit = np.float32(STEP_LIMIT) * rho
    state.inverse_depth = rho = rho + np.clip(step, -limit, limit)
    variance = np.float32(PHOTO_DEVIATION**2) / (curvature * rho**2 + np.float32(1e-6))
    return 1.0 / (variance + np.float32(FLOOR_DEVIATION**2))


def _fit_planes(
    state: SlantedDepth,
    confidence: Float32[np.ndarray, "h w"],
    guide: Float32[np.ndarray, "3 h w"],
    radius: int,
    tolerance: float,
    stiffness: float,
) -> None:
    """Replace ``state`` by the local planes."""
    rho, slope_x, slope_y = (np.empty_like(state.inverse_depth) for _ in range(3))
    settings = [np.float32(x) for x in (GUIDE_CONTRAST, tolerance, stiffness)]
    over_rows(
        lambda *rows: kernels.fit_planes(
            *rows, state.inverse_depth, state.slope_x, state.slope_y, confidence, guide, radius,
            *settings, rho, slope_x, slope_y, state.support,
        ),
        len(rho),
    )  # fmt: skip
    positive = rho > np.float32(0.2) * state.inverse_depth
    state.inverse_depth = np.where(positive, rho, state.inverse_depth)
    state.slope_x, state.slope_y = slope_x, slope_y


def colour_guide(reference: DepthView, render: Camera) -> Float32[np.ndarray, "3 h w"]:
    """The colour image at the render size in [0, 1], channels first."""
    size = (render.width, render.height)
    small = cv2.resize(reference.image, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small.transpose(2, 0, 1)).astype(np.float32) / np.float32(255)


def _gather_patches(
    reference: DepthView, neighbours: Sequence[DepthView], render: Camera, working: Camera
) -> _Patches:
    """The fine reference image around every render pixel; similarity to the centre as weight."""
    reach = np.arange(-PATCH_REACH, PATCH_REACH + 1, dtype=np.float32)
    offsets = np.stack(np.meshgrid(reach, reach), -1).reshape(-1, 2)
    columns = np.arange(render.width) - render.cx
    rows = np.arange(render.height) - render.cy
    samples = np.empty((len(offsets), render.height, render.width), np.float32)
    for sample, (ox, oy) in zip(samples, offsets, strict=True):
        x = (columns + ox) * (working.fx / render.fx) + working.cx
        y = (rows + oy) * (working.fy / render.fy) + working.cy
        x, y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        fine = cv2.remap(reference.fine, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        sample[:] = fine - np.float32(0.5)
    contrast = (samples - samples[len(samples) // 2]) ** 2
    weights = 1.0 / (1.0 + np.float32(PATCH_CONTRAST) * contrast)
    a, b = homographies(reference, neighbours, render, working)
    pairs = pixel_pairs(np.stack([v.fine for v in neighbours]) - np.float32(0.5))
    return _Patches(samples, offsets, weights, pairs, a, b)
