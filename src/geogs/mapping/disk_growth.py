"""Growth of the map: disks added where depths show more than the map, dropped in free space."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.config import DiskConfig, MappingConfig
from geogs.geometry.fitted_normals import fitted_normals
from geogs.geometry.neighbors import nearest_neighbors
from geogs.mapping.keyframe_depths import KeyframeDepths
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.view_arrays import confident_jumps
from geogs.splat.density import spread_candidates, unexplained, worth_keeping
from geogs.splat.init import NEIGHBOURS, initialise_disks, random_disks
from geogs.splat.render import render
from geogs.world.disks import DiskParameters
from geogs.world.map import MapTable

# Nearest keyframes that vote on a keyframe's disks.
_VOTERS = 96


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
        config, disks = self.config.disk, self.table.disks
        camera = self.depths.views.arrays.cameras.render
        depth, confidence = view.dense.depth, view.dense.confidence
        output = render(disks, camera, view.T_cw)
        needed = unexplained(output, depth, confidence) & (confidence >= min_confidence)
        v, u, spacing = spread_candidates(
            needed, confident_jumps(view.dense).around(config.stride), config.stride,
            config.edge_stride, self.table.random.of_torch,
        )  # fmt: skip
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
        footprint, seen = spacing * z / camera.fx, None
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
