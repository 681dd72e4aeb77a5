"""The classical search on the GPU that holds the map."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from geogs.depth import evidence, grid_completion
from geogs.depth.cuda.images import KeyframeImages, image_pixels, packed
from geogs.depth.cuda.plane_sweep import MAX_NEIGHBOURS, PlaneSlots, sweep
from geogs.depth.cuda.refinement import (
    PixelPositions,
    TrackerMaps,
    choose_start,
    judge,
    refine,
    resolve_edges,
)
from geogs.depth.cuda.revision import check, farther_surface, photo_costs, vote
from geogs.depth.depth_engine import DepthTask, Progress, silent
from geogs.depth.depth_view import (
    DenseDepth,
    DepthView,
    PosedDepth,
    dense_depths,
    homographies,
    relative_poses,
)
from geogs.depth.evidence import prior_weight, relative_precision
from geogs.depth.grid_completion import complete_grid, edge_weights, known_cells
from geogs.depth.plane_sweep import sweep_planes
from geogs.depth.sweep_neighbors import depth_range
from geogs.geometry.camera import Camera
from geogs.gpu.kernels import kernels_for
from geogs.gpu.transfer import upload
from geogs.threads import worker_count
from geogs.world.lru import LruCache

# Keyframes whose grids are completed at once.
_BATCH = 32
SOURCE = Path(__file__).with_name("completion.cu")
_PANEL = 8


@dataclass(frozen=True, eq=False)
class SearchPlan:
    """Input of a keyframe's search that the CPU computes."""

    grids: Float32[np.ndarray, "3 gh gw"]
    """The tracker's inverse depth, its information, and the weights of smoothness."""
    typical: float
    """Median known inverse depth; 0 where none is known."""
    near: float
    far: float
    planes: Float32[np.ndarray, "p"]
    """Inverse depths to sweep; none without neighbours."""


class CudaDepthEngine:
    """The kernels of this package, keyframe by keyframe; small parts run in threads on the CPU.

    The host does not wait for the GPU. Images of the ``resident`` keyframes used last stay there.
    """

    def __init__(
        self, device: torch.device, render: Camera, working: Camera, resident: int, planes: int
    ) -> None:
        self.device = device
        self.render = render
        self.working = working
        self.planes = planes
        self._positions = PixelPositions.of(render, working, device)
        self._images: LruCache[int, KeyframeImages] = LruCache(
            resident, lambda id, _: self._edges.pop(id, None)
        )
        self._pixels: dict[int, Future[Float32[np.ndarray, "n"]]] = {}
        self._edges: dict[int, Future[Float32[np.ndarray, "gh gw"]]] = {}
        self._threads = ThreadPoolExecutor(worker_count())

    def observe(self, view: DepthView) -> None:
        """As in the protocol: threads prepare its images."""
        shape = view.inverse_depth.shape
        self._pixels[view.id] = self._threads.submit(image_pixels, view)
        self._edges[view.id] = self._threads.submit(edge_weights, view.image, shape)

    def estimate(self, tasks: Sequence[DepthTask], progress: Progress = silent) -> list[DenseDepth]:
        """As in the protocol; at most 16 neighbours are used."""
        tasks = [DepthTask(t.view, t.neighbours[:MAX_NEIGHBOURS], t.limits) for t in tasks]
        for view in (view for task in tasks for view in (task.view, *task.neighbours)):
            if view.id not in self._edges:
                self.observe(view)
        plans = list(self._threads.map(self._plan, tasks))
        maps: list[tuple[Tensor, Tensor]] = []
        for start in range(0, len(plans), _BATCH):
            batch = slice(start, start + _BATCH)
            evidence = self._complete(plans[batch])
            for i, grids in enumerate(evidence, start):
                maps.append(self._search(tasks[i], plans[i], grids))
                progress(len(maps) / len(tasks))
        return dense_depths(maps)

    def check(
        self, depths: Sequence[PosedDepth], others: Sequence[Sequence[PosedDepth]]
    ) -> list[DenseDepth]:
        """As in the protocol; the median stays that of the estimate."""
        checked = []
        for own, rest in zip(depths, others, strict=True):
            result = own.depth
            if rest:
                depth, confidence = check(own, rest, self.render)
                result = replace(result, depth=depth, confidence=confidence)
            checked.append(result)
        return checked

    def keep(self, points: Float[Tensor, "n 3"], depths: Sequence[PosedDepth]) -> Bool[Tensor, "n"]:
        """As in the protocol."""
        points = points.detach().float().contiguous()
        if not depths:
            return torch.isfinite(points).all(1)
        return vote(points, depths, self.render)

    def photo_costs(
        self,
        view: DepthView,
        others: Sequence[DepthView],
        depths: Float[Tensor, "2 h w"],
        same: Bool[Tensor, "h w"],
        mask: Bool[Tensor, "h w"] | None = None,
    ) -> Float[Tensor, "2 h w"]:
        """As in the protocol; at most 16 others are used."""
        others = others[:MAX_NEIGHBOURS]
        images = [self._images_of(v) for v in others]
        own = self._images_of(view)
        poses = relative_poses(view, others)
        return photo_costs(own, images, poses, depths, same, self.render, mask)

    def farther_surface(self, depth: Float[Tensor, "h w"], reach: int) -> Float[Tensor, "h w"]:
        """As in the protocol."""
        return farther_surface(depth, reach)

    def _images_of(self, view: DepthView) -> KeyframeImages:
        """The images on the GPU, uploaded at their first use."""

        def bring() -> KeyframeImages:
            prepared = self._pixels.pop(view.id, None)
            pixels = None if prepared is None else prepared.result()
            return KeyframeImages.of(view, self.device, pixels)

        return self._images.get(view.id, bring)

    def _plan(self, task: DepthTask) -> SearchPlan:
        reference, neighbours, limits = task
        grid = reference.inverse_depth
        information = reference.information
        known = known_cells(grid, information)
        typical = float(np.median(grid[known])) if known.any() else 0.0
        grids = np.stack([grid, information, self._edges[reference.id].result()])
        grids = grids.astype(np.float32)
        if not neighbours:
            return SearchPlan(grids, typical, 0.0, 0.0, np.empty(0, np.float32))
        near, far = limits or depth_range(reference, neighbours, self.working)
        planes = sweep_planes(reference, neighbours, self.render, near, far, self.planes)
        return SearchPlan(grids, typical, near, far, planes)

    def _complete(self, plans: list[SearchPlan]) -> Float32[Tensor, "k 3 gh gw"]:
        """The tracker's completed inverse depth, its prior weight and its relative precision."""
        grids = np.stack([p.grids for p in plans])
        typical = [p.typical for p in plans]
        if min(typical) > 0 and can_complete(grids.shape[2:], self.device):
            return complete(upload(grids, self.device), typical)
        completed = [complete_grid(g[0], g[1], g[2]) for g in grids]
        evidence = [(c.inverse_depth, prior_weight(c), relative_precision(c)) for c in completed]
        return upload(np.array(evidence, np.float32), self.device)

    def _search(
        self, task: DepthTask, plan: SearchPlan, grids: Float32[Tensor, "3 gh gw"]
    ) -> tuple[Tensor, Tensor]:
        """Depth and confidence of one keyframe."""
        reference, neighbours, _ = task
        device = self.device
        own = self._images_of(reference)
        tracker = TrackerMaps.of(grids, self._positions)
        if not neighbours:
            return 1.0 / tracker.inverse_depth, 0.5 * tracker.prior_weight
        others = [self._images_of(v) for v in neighbours]
        across = packed(*homographies(reference, neighbours, self.render, self.render))
        finely = packed(*homographies(reference, neighbours, self.render, self.working))
        grey = torch.stack([o.grey for o in others])
        planes = PlaneSlots.of(plan.planes, device)
        prior = (tracker.inverse_depth, tracker.prior_weight)
        swept = sweep(own, grey, upload(across, device), planes, *prior)
        fine = torch.stack([o.fine for o in others])
        start = choose_start(tracker, swept)
        refined = refine(own, fine, upload(finely, device), self._positions, *start, tracker)
        confidence = judge(refined, swept.margin, tracker, plan.near, plan.far)
        refined, confidence = resolve_edges(refined, confidence, own.colours, swept)
        return 1.0 / refined.inverse_depth, confidence


def _window(minors: int) -> int:
    """Rows of the band matrix worked on at a time, for lines of ``minors`` cells."""
    return -(-2 * minors // _PANEL) * _PANEL + _PANEL


def _shared_bytes(minors: int) -> int:
    window = _window(minors)
    return 8 * (window**2 + window * (_PANEL + 2) + _PANEL * (_PANEL + 1))


def can_complete(shape: tuple[int, ...], device: torch.device) -> bool:
    """Whether the band of a grid of this shape fits into the shared memory of the GPU."""
    if _window(min(shape)) > 192:
        return False
    if device.type != "cuda":
        return True
    properties = torch.cuda.get_device_properties(device)
    limit: int = getattr(properties, "shared_memory_per_block_optin", 48 * 1024)
    return _shared_bytes(min(shape)) <= limit


def complete(
    grids: Float32[Tensor, "k 3 gh gw"], typical: Sequence[float]
) -> Float32[Tensor, "k 3 gh gw"]:
    """Completed inverse depth, ``prior_weight`` and ``relative_precision`` of some keyframes.

    ``grids`` hold the tracker's inverse depth, its information and the weights of smoothness;
    ``typical`` is the median of each keyframe's known inverse depths.
    """
    count, _, gh, gw = grids.shape
    by_columns = gh <= gw
    minors, majors = (gh, gw) if by_columns else (gw, gh)
    strides = (gw, 1) if by_columns else (1, gw)
    window = _window(minors)
    padded = -(-gh * gw // _PANEL) * _PANEL
    scratch = grids.new_empty(count * padded * (12 + window), dtype=torch.float64)
    out = torch.empty_like(grids)
    settings = upload(np.array(CompletionSettings(), np.float32), grids.device)
    kernels_for(SOURCE, grids.device)["complete_grids"](
        count, 32 * _PANEL, grids, upload(np.array(typical, np.float32), grids.device),
        settings, minors, majors, *strides, padded, window - _PANEL, scratch, out,
        shared=_shared_bytes(minors),
    )  # fmt: skip
    return out


class CompletionSettings(NamedTuple):
    """The struct of this name in ``completion.cu``."""

    sigma_scale: float = grid_completion.DEVIATION_SCALE
    bending: float = grid_completion.BENDING
    membrane: float = grid_completion.MEMBRANE
    sure_deviation: float = evidence.CONFIDENT_DEVIATION
    tracker_scale: float = evidence.TRACKER_SCALE
    unknown_deviation: float = evidence.UNKNOWN_DEVIATION
    best_deviation: float = evidence.BEST_DEVIATION
    kink: float = evidence.KINK
