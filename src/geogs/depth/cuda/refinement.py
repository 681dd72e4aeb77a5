"""The refinement of ``refinement.py``, the confidence and the sides of edges on a GPU."""

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
from geogs.depth.edges import (
    CONTRAST,
    COST_TRUST,
    MEAN_SHIFTS,
    MIN_GAP,
    MOVED_CONFIDENCE,
    PASSES,
    WIDTH,
    reach_of,
)
from geogs.depth.plane_sweep import VARIANCE_FLOOR
from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload
from geogs.world.grid import OFFSET, STRIDE

SOURCE = Path(__file__).with_name("refinement.cu")
EDGES = Path(__file__).with_name("edges.cu")


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
        columns = positions.grid_columns
        rows = positions.grid_rows
        h, w = len(rows), len(columns)
        out = grids.new_empty(3, h, w)
        blocks = (-(-w // 128), h, 3)
        upsample = kernels_for(SOURCE, grids.device)["upsample_grids"]
        upsample(blocks, 128, grids, columns, rows, *grids.shape[1:], h, w, out)
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
    rho = torch.empty_like(swept.cost)
    confidence = torch.empty_like(swept.cost)
    count = rho.numel()
    known = (tracker.inverse_depth, tracker.prior_weight)
    matched = (swept.inverse_depth, swept.cost, swept.margin)
    choose = kernels_for(SOURCE, rho.device)["choose_start"]
    choose(-(-count // 256), 256, *known, *matched, count, rho, confidence)
    return rho, confidence


def gather_patches(
    fine: Float32[Tensor, "fh fw"], positions: PixelPositions
) -> Float32[Tensor, "25 h w"]:
    """The fine reference image around every render pixel."""
    h, w = len(positions.grid_rows), len(positions.grid_columns)
    samples = fine.new_empty((2 * cpu.PATCH_REACH + 1) ** 2, h, w)
    blocks = (-(-w // 128), h, len(samples))
    places = (positions.fine_columns, positions.fine_rows)
    gather = kernels_for(SOURCE, fine.device)["gather_patches"]
    gather(blocks, 128, fine, *places, *fine.shape, h, w, samples)
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
    fit = (cpu.FIT_RADIUS, cpu.FIT_TOLERANCE, cpu.FIT_STIFFNESS)
    for every in cpu.REFINE_STEPS:
        precision, confidence = photometric_step(
            state, samples, images, homographies, tracker, every
        )
        fit_planes(state, confidence, reference.colours, *fit, precision)
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
    bounded = torch.empty_like(margin)
    confidence = torch.empty_like(margin)
    weights = upload(np.array(WEIGHTS, np.float32), margin.device)
    kernels_for(SOURCE, margin.device)["judge_depth"](
        (-(-w // 32), -(-h // 4)), (32, 4), refined.inverse_depth, margin, refined.support,
        tracker.inverse_depth, tracker.precision, weights, h, w, 0.5 / far, 2.0 / near, bounded,
        confidence,
    )  # fmt: skip
    refined.inverse_depth = bounded
    return confidence


def resolve_edges(
    refined: SlantedMaps,
    confidence: Float32[Tensor, "h w"],
    colours: Float32[Tensor, "3 h w"],
    swept: SweptDepth,
) -> tuple[SlantedMaps, Float32[Tensor, "h w"]]:
    """As ``geogs.depth.edges.resolve_edges``; ``colours`` is the image in [0, 1]."""
    h, w = confidence.shape
    planes = swept.planes
    constants = (CONTRAST, MIN_GAP, WIDTH, COST_TRUST, MOVED_CONFIDENCE)
    settings = upload(np.array(constants, np.float32), confidence.device)
    maps = [refined.inverse_depth, refined.slope_x, refined.slope_y, confidence]
    for _ in range(PASSES):
        out = [torch.empty_like(confidence) for _ in maps]
        kernels_for(EDGES, confidence.device)["resolve_edges"](
            (-(-w // 32), -(-h // 4)), (32, 4), *maps, colours, swept.costs, settings, planes.per,
            planes.count, planes.first, planes.spacing, reach_of((h, w)), MEAN_SHIFTS, h, w, *out,
        )  # fmt: skip
        maps = out
    rho, slope_x, slope_y, confidence = maps
    return SlantedMaps(rho, slope_x, slope_y, refined.support), confidence
