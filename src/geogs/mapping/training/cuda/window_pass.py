"""One pass over a window of views on a GPU: rendering, losses, gradients."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.config import LossConfig
from geogs.losses.cuda.view_table import ViewTable
from geogs.losses.cuda.window_losses import WindowLosses
from geogs.splat.cuda.rasterize import MapGradients, Maps, Rasterizer, Views
from geogs.splat.render import NEAR
from geogs.world.disks import DiskParameters, GaussianMap


class WindowPass:
    """Buffers and launches for a fixed number of views, partners and disks.

    ``batch`` (views) and ``pairs`` (views, partners) hold slots of the table, -1 for none, on the
    device. Nothing waits for the GPU, so passes can be captured in a CUDA graph.
    """

    def __init__(
        self,
        table: ViewTable,
        config: LossConfig,
        unit: float,
        views: int,
        partners: int,
        pair_weight: float,
        capacity: int,
        for_poses: bool = False,
        fresh: bool = False,
    ) -> None:
        """``fresh`` renders all partners first, for the occlusion tests of this pass."""
        device = table.device
        camera = table.render
        self.table = table
        self.views = views
        self.capacity = capacity
        self._generation = table.generation
        self.rasterizer = Rasterizer(capacity, views, camera, NEAR, device)
        self.losses = WindowLosses(table, config, unit, views, partners, pair_weight, for_poses)
        self.maps = Maps.empty(camera, (views,), capacity, device)
        m = self.maps
        zero = torch.zeros_like
        self._gradients = MapGradients(
            zero(m.depth), zero(m.normal), zero(m.alpha), zero(m.distortion)
        )
        slots = torch.full((views * (1 + partners),), -1, dtype=torch.int32, device=device)
        self.slots: Int[Tensor, "s"] = slots
        """Batch, then pairs, in one piece."""
        self.batch = slots[:views]
        self.pairs = slots[views:].view(views, partners)
        self._partners: tuple[Rasterizer, Maps] | None = None
        if fresh and partners > 0:
            shown = Rasterizer(capacity, views * partners, camera, NEAR, device)
            shown.status = self.rasterizer.status  # neither counts unless both have room
            self._partners = shown, Maps.empty(camera, (views * partners,), capacity, device)
        self.loss: Float[Tensor, "b"] = torch.zeros(views, device=device)
        sizes = ((3,), (4,), (2,), ())
        self.d_disks: DiskParameters | None = None
        self.d_poses: Float[Tensor, "b 4 4"] | None = None
        self.d_motions: Float[Tensor, "b p 12"] | None = None
        """Gradient of the loss by the motion from a view to its partner, rows of 3x4 matrices."""
        if for_poses:
            self.d_poses = torch.zeros(views, 4, 4, dtype=torch.float64, device=device)
            self.d_motions = torch.zeros(views, partners, 12, dtype=torch.float64, device=device)
        else:
            self.d_disks = DiskParameters(
                *(torch.zeros(capacity, *size, device=device) for size in sizes)
            )

    def is_outdated(self, disks: GaussianMap) -> bool:
        """Whether the map or the table has moved in memory since this was made."""
        return self.table.generation != self._generation or disks.capacity != self.capacity

    def reserve(self, entries: int) -> None:
        """Make room in the lists for ``entries`` in all."""
        self.rasterizer.reserve(entries)
        if self._partners is not None:
            self._partners[0].reserve(entries)

    def launch(self, disks: DiskParameters, count: Int[Tensor, "1"]) -> None:
        """Compute maps, losses and gradients of ``batch``; ``disks`` include their spare room."""
        if self._partners is not None:
            shown, maps = self._partners
            others = self.pairs.view(-1)
            seen = Views(self.table.poses, others, count)
            shown.project(disks, seen, maps)
            shown.blend(seen, maps, with_trace=False)
            self.losses.store_rendered(others, maps.depth, maps.alpha)
        views = Views(self.table.poses, self.batch, count)
        m = self.maps
        d = self._gradients
        self.rasterizer.project(disks, views, m)
        self.rasterizer.blend(views, m)
        self.losses.launch(
            self.batch, self.pairs, m.depth, m.normal, m.alpha, m.distortion,
            d.depth, d.normal, d.alpha, d.distortion, self.loss, self.d_motions,
        )  # fmt: skip
        if self.d_disks is not None:
            self.losses.store_rendered(self.batch, m.depth, m.alpha)
        self.rasterizer.backward(disks, views, d, self.d_disks, self.d_poses)
