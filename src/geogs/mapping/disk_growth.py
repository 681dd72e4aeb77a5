"""Growth of the map: disks added where depths show more than the map, dropped in free space."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.config import DiskConfig, MappingConfig
from geogs.geometry.depth_maps import fitted_normals
from geogs.geometry.neighbors import nearest_neighbors
from geogs.mapping.keyframe_depths import KeyframeDepths
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.view_arrays import confident_jumps
from geogs.splat.init import NEIGHBOURS, initialise_disks, random_disks
from geogs.splat.render import RenderOutput, render
from geogs.world.disks import DiskParameters, GaussianMap
from geogs.world.map import MapTable

# Nearest keyframes that vote on a keyframe's disks.
_VOTERS = 96
INSERT_ALPHA = 0.4
"""A pixel gets a disk where the map's alpha is below this: most of the light passes ..."""
INSERT_BEHIND = 0.05
"""... or where the map lies this fraction of the depth behind a confident depth."""
PRUNE_OPACITY = 0.05
"""Disks below this opacity are removed."""


def candidate_pixels(
    height: int, width: int, stride: int, generator: torch.Generator
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Rows and columns of one pixel in every stride x stride cell, jittered within the cell."""
    v, u = torch.meshgrid(
        torch.arange(stride // 2, height, stride),
        torch.arange(stride // 2, width, stride),
        indexing="ij",
    )
    reach = (stride - 1) // 2
    jitter = torch.randint(-reach, reach + 1, (2, *v.shape), generator=generator)
    v = (v + jitter[0]).clamp(0, height - 1)
    u = (u + jitter[1]).clamp(0, width - 1)
    return v.flatten(), u.flatten()


def spread_candidates(
    needed: Bool[Tensor, "h w"],
    at_edge: Bool[Tensor, "h w"],
    stride: int,
    edge_stride: int,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Rows and columns of some needed pixels, and the spacing of each.

    It is ``stride``, at depth edges ``edge_stride`` if that is less: a disk is about as large as
    its spacing, and a large one would overhang the edge.
    """
    found = []
    height, width = needed.shape
    for step, there in ((stride, needed & ~at_edge), (min(stride, edge_stride), needed & at_edge)):
        v, u = (x.to(needed.device) for x in candidate_pixels(height, width, step, generator))
        chosen = there[v, u]
        v, u = v[chosen], u[chosen]
        found.append((v, u, torch.full_like(v, step)))
    v, u, spacing = (torch.cat(parts) for parts in zip(*found, strict=True))
    return v, u, spacing


def unexplained(
    render: RenderOutput, depth: Float[Tensor, "h w"], confidence: Float[Tensor, "h w"]
) -> Bool[Tensor, "h w"]:
    """Pixels with a depth where the map is transparent or behind a confident depth.

    Where the map is in front of the depth, a disk would be hidden, and made again from every
    keyframe; wrong disks in front are carved instead.
    """
    empty = render.alpha < INSERT_ALPHA
    behind = render.depth - depth > INSERT_BEHIND * depth
    return (depth > 0) & (empty | (behind & (confidence > 0.5)))


def worth_keeping(disks: GaussianMap) -> Bool[Tensor, "n"]:
    """Disks that are finite and not transparent."""
    position, quaternion, log_scale, logit = disks.parameters
    numbers = torch.cat([position, quaternion, log_scale, logit[:, None]], 1)
    return numbers.isfinite().all(1) & (disks.opacity > PRUNE_OPACITY)


class DiskGrowth:
    """Adds disks to a map, and drops them, by the depths of its keyframes."""

    def __init__(self, table: MapTable, depths: KeyframeDepths, config: MappingConfig) -> None:
        self.table = table
        self.depths = depths
        self.config = config

    def voters(self, view: MapView) -> list[MapView]:
        """The mapped keyframes that vote on the surface of a view."""
        return self.depths.views.near(view, self.table.mapped, _VOTERS)

    def carve(self, views: Sequence[MapView]) -> None:
        """Drop disks that some keyframes see in free space."""
        disks = self.table.disks
        if len(disks) and self.config.disk.carve:
            disks.keep(self.depths.keep(disks.position.detach(), views))

    def prune(self, views: Sequence[MapView]) -> None:
        """Carve, and drop transparent and broken disks."""
        self.table.disks.keep(worth_keeping(self.table.disks))
        self.carve(views)

    @torch.no_grad()
    def start(self, points: Float[Tensor, "n 3"], views: Sequence[MapView]) -> None:
        """Add disks at sparse points of the scene, each assigned to the nearest keyframe."""
        disks = self.table.disks
        centres = torch.stack([view.T_wc[:3, 3] for view in views]).to(points)
        nearest = nearest_neighbors(points, centres, 1)[1][:, 0]
        # Sparse points have no spacing that could bound a scale.
        config = replace(self.config.disk, bound_spacing=False)
        new = self._initialised(points, centres[nearest], points[:, 0], config, None)
        ids = torch.tensor([view.id for view in views]).to(nearest.device)
        disks.append(new, ids[nearest])

    @torch.no_grad()
    def insert(self, view: MapView, min_confidence: float) -> None:
        """Add disks where the map does not explain a view's depth, on local planes."""
        config = self.config.disk
        disks = self.table.disks
        camera = self.depths.views.arrays.cameras.render
        depth = view.dense.depth
        confidence = view.dense.confidence
        output = render(disks, camera, view.T_cw)
        needed = unexplained(output, depth, confidence) & (confidence >= min_confidence)
        at_edge = confident_jumps(view.dense).around(config.stride)
        random = self.table.random.of_torch
        v, u, spacing = spread_candidates(
            needed, at_edge, config.stride, config.edge_stride, random
        )
        z = depth[v, u]
        T_wc = view.T_wc.float().to(depth.device)
        rays = camera.rays(device=depth.device)[v, u]
        points = (rays * z[:, None]) @ T_wc[:3, :3].T + T_wc[:3, 3]
        if config.carve:
            others = [other for other in self.voters(view) if other.id != view.id]
            kept = self.depths.keep(points, others)
            v, u, points, z, spacing = (x[kept] for x in (v, u, points, z, spacing))
        if len(points) + len(disks) < NEIGHBOURS or len(points) == 0:
            return
        footprint = spacing * z / camera.fx
        seen = None
        if config.fit_normals:
            normals = fitted_normals(depth, confidence, camera, (v, u), config.stride)
            seen = normals @ T_wc[:3, :3].T
        new = self._initialised(points, T_wc[:3, 3], footprint, config, seen)
        disks.append(new, view.id)

    def _initialised(
        self,
        points: Float[Tensor, "n 3"],
        camera_centre: Float[Tensor, "*c 3"],
        footprint: Float[Tensor, "n"],
        config: DiskConfig,
        seen: Float[Tensor, "n 3"] | None,
    ) -> DiskParameters:
        """New disks at points, initialised by the method of the settings."""
        existing = self.table.disks.position.detach()
        if self.config.ablation.initialisation == "random":
            return random_disks(points, existing, config.opacity, self.table.random.of_torch)
        return initialise_disks(points, camera_centre, footprint, existing, config, seen)
