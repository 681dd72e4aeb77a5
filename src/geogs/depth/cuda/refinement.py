"""The refinement of ``refinement.py`` and the confidence on a GPU."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from geogs.depth import refinement as cpu
from geogs.depth.confidence import WEIGHTS
from geogs.depth.cuda.images import KeyframeImages
from geogs.depth.cuda.plane_sweep import SweptDepth
from geogs.depth.plane_sweep import VARIANCE_FLOOR
from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload
from geogs.world.grid import OFFSET, STRIDE

SOURCE = Path(__file__).with_name("refinement.cu")


@dataclass(frozen=True, eq=False)
class PixelPositions:
    """Positions of render pixels on the tracker's grid, and of patch samples in the fine image."""

    grid_columns: Float32[Tensor, "w"]
    grid_rows: Float32[Tensor, "h"]
    fine_columns: Float32[Tensor, "5 w"]
    fine_rows: Float32[Tensor, "5 h"]

    @staticmethod
    def of(render: Camera, working: Camera, device: torch.device) -> "PixelPositions":
        """Positions for two sizes of a camera."""
        reach = np.arange(-cpu.PATCH_REACH, cpu.PATCH_REACH + 1, dtype=np.float32)[:, None]
        u = (np.arange(render.width) - render.cx + reach) * (working.fx / render.fx) + working.cx
        v = (np.arange(render.height) - render.cy + reach) * (working.fy / render.fy) + working.cy
        columns, rows = ((x[cpu.PATCH_REACH] - OFFSET) / STRIDE for x in (u, v))
        positions = (columns, rows, u, v)
        return PixelPositions(*(upload(x.astype(np.float32), device) for x in positions))


@dataclass(frozen=True, eq=False)
class TrackerMaps:
    """``TrackerEvidence`` on the device."""

    inverse_depth: Float32[Tensor, "h w"]
    prior_weight: Float32[Tensor, "h w"]
    """Confidence in [0, 1], for the sweep."""
    precision: Float32[Tensor, "h w"]
    """Relative precision, for the refinement."""

    @staticmethod
    def of(grids: Float32[Tensor, "3 gh gw"], positions: PixelPositions) -> "TrackerMaps":
        """Bilinear values of the three grids at the render pixels."""
        h, w = len(positions.grid_rows), len(positions.grid_columns)
        out = grids.new_empty(3, h, w)
        kernels_for(SOURCE, grids.device)["upsample_grids"](
            (-(-w // 128), h, 3), 128, grids, positions.grid_columns, positions.grid_rows,
            *grids.shape[1:], h, w, out,
        )  # fmt: skip
        return TrackerMaps(*out)


@dataclass(eq=False)
class SlantedMaps:
    """``SlantedDepth`` on the device."""

    inverse_depth: Float32[Tensor, "h w"]
    slope_x: Float32[Tensor, "h w"]
    slope_y: Float32[Tensor, "h w"]
    support: Float32[Tensor, "h w"]


def choose_start(tracker: TrackerMaps, swept: SweptDepth) -> tuple[Tensor, Tensor]:
    """As ``evidence.choose_start``."""
    rho, confidence = torch.empty_like(swept.cost), torch.empty_like(swept.cost)
    kernels_for(SOURCE, rho.device)["choose_start"](
        -(-rho.numel() // 256), 256, tracker.inverse_depth, tracker.prior_weight,
        swept.inverse_depth, swept.cost, swept.margin, rho.numel(), rho, confidence,
    )  # fmt: skip
    return rho, confidence


def gather_patches(
    fine: Float32[Tensor, "fh fw"], positions: PixelPositions
) -> Float32[Tensor, "25 h w"]:
    """The fine reference image around every render pixel."""
    h, w = len(positions.grid_rows), len(positions.grid_columns)
    samples = fine.new_empty((2 * cpu.PATCH_REACH + 1) ** 2, h, w)
    kernels_for(SOURCE, fine.device)["gather_patches"](
        (-(-w // 128), h, len(samples)), 128, fine, positions.fine_columns, positions.fine_rows,
        *fine.shape, h, w, samples,
    )  # fmt: skip
    return samples


def photometric_step(
    state: SlantedMaps,
    samples: Float32[Tensor, "25 h w"],
    images: Float32[Tensor, "n fh fw"],
    homographies: Float32[Tensor, "n 12"],
    tracker: TrackerMaps,
    every: int = 1,
) -> tuple[Tensor, Tensor]:
    """Move ``state`` one step, averaged with the tracker; returns precision and plane weight.

    Every ``every``-th sample of a patch is compared.
    """
    h, w = state.inverse_depth.shape
    data, precision, confidence = (torch.empty_like(state.inverse_depth) for _ in range(3))
    kernels_for(SOURCE, samples.device)["photometric_step"](
        (-(-w // 32), h), (32, len(images)), samples, images, homographies, state.inverse_depth,
        state.slope_x, state.slope_y, tracker.inverse_depth, tracker.precision, h, w,
        *images.shape[1:], every, cpu.PATCH_CONTRAST, 0.5 * VARIANCE_FLOOR, cpu.STEP_LIMIT,
        cpu.PHOTO_DEVIATION**2, cpu.FLOOR_DEVIATION**2, cpu.FIT_DEVIATION**2, data, precision,
        confidence,
    )  # fmt: skip
    state.inverse_depth = data
    return precision, confidence


def fit_planes(
    state: SlantedMaps,
    confidence: Float32[Tensor, "h w"],
    colours: Float32[Tensor, "3 h w"],
    radius: int,
    tolerance: float,
    stiffness: float,
    precision: Float32[Tensor, "h w"] | None = None,
) -> None:
    """Replace ``state`` by local planes, averaged with it by ``precision`` if that is given."""
    h, w = confidence.shape
    out = [torch.empty_like(confidence) for _ in range(4)]
    kernels_for(SOURCE, confidence.device)["fit_planes"](
        (-(-w // 32), -(-h // 4)), (32, 4), state.inverse_depth, state.slope_x, state.slope_y,
        confidence, colours, precision, h, w, radius, cpu.GUIDE_CONTRAST, tolerance, stiffness,
        cpu.FULL_SUPPORT, 1.0 / cpu.PLANE_DEVIATION**2, *out,
    )  # fmt: skip
    state.inverse_depth, state.slope_x, state.slope_y, state.support = out


def refine(
    reference: KeyframeImages,
    images: Float32[Tensor, "n fh fw"],
    homographies: Float32[Tensor, "n 12"],
    positions: PixelPositions,
    rho: Float32[Tensor, "h w"],
    confidence: Float32[Tensor, "h w"],
    tracker: TrackerMaps,
) -> SlantedMaps:
    """``refine_depth`` from the inverse depth ``rho`` with the fine images of the neighbours."""
    samples = gather_patches(reference.fine, positions)
    zero = torch.zeros_like(rho)
    state = SlantedMaps(rho, zero, zero, zero)
    for radius, tolerance in ((2, 0.05), (cpu.FIT_RADIUS, 0.03)):
        fit_planes(state, confidence, reference.colours, radius, tolerance, 0.0)
    state.inverse_depth = rho
    for every in cpu.REFINE_STEPS:
        precision, confidence = photometric_step(
            state, samples, images, homographies, tracker, every
        )
        fit_planes(
            state, confidence, reference.colours, cpu.FIT_RADIUS, cpu.FIT_TOLERANCE,
            cpu.FIT_STIFFNESS, precision,
        )  # fmt: skip
    return state


def judge(
    refined: SlantedMaps,
    margin: Float32[Tensor, "h w"],
    tracker: TrackerMaps,
    near: float,
    far: float,
) -> Float32[Tensor, "h w"]:
    """Clamp inverse depth to 0.5 / ``far`` and 2 / ``near``; returns its confidence."""
    h, w = margin.shape
    bounded, confidence = torch.empty_like(margin), torch.empty_like(margin)
    weights = upload(np.array(WEIGHTS, np.float32), margin.device)
    kernels_for(SOURCE, margin.device)["judge_depth"](
        (-(-w // 32), -(-h // 4)), (32, 4), refined.inverse_depth, margin, refined.support,
        tracker.inverse_depth, tracker.precision, weights, h, w, 0.5 / far, 2.0 / near, bounded,
        confidence,
    )  # fmt: skip
    refined.inverse_depth = bounded
    return confidence
