"""Training the map on a CPU, view by view."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.config import MappingConfig
from geogs.losses.cpu.fused import fused_multi_view, fused_single_view
from geogs.losses.multi_view import enlarge_depth
from geogs.losses.single_view import MIN_ALPHA
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.training.map_trainer import GRADIENT_LIMIT, LR_SCALE, Batch, learning_rates
from geogs.mapping.training.pose_refine import refine_poses
from geogs.mapping.view_arrays import MapCameras
from geogs.splat.cpu.in_view import disks_in_view
from geogs.splat.optimizer import MapOptimizer
from geogs.splat.render import RenderOutput, render
from geogs.threads import thread_map
from geogs.world.disks import DiskParameters, GaussianMap

# Largest fraction of the map that is trained as an excerpt.
_LARGE_EXCERPT = 0.7
COARSE_PART = 0.5
"""First fraction of a training over all keyframes, at half the resolution: it corrects coarse
errors in half of the time."""
LEAST_COARSE = 100
"""Least long edge of a rendering at half the resolution."""
# Standard deviations at which a disk of any opacity has faded below what the renderer shows.
REACH = 3.4


def view_loss(
    view: MapView,
    partners: list[MapView],
    output: RenderOutput,
    config: MappingConfig,
    unit: float,
    coarse: bool = False,
) -> Float[Tensor, ""]:
    """L_geo of one rendered view: single-view terms, and L_mv averaged over its partners.

    Partners without a rendering yet are matched without occlusion test. The view may be rendered
    ``coarse``, at half the resolution.
    """
    known = view.constants.halved if coarse else view.constants
    loss = fused_single_view(
        output.depth, output.normal, output.alpha, output.distortion, known, config.loss, unit
    )
    if partners:
        depth = output.shown_depth(MIN_ALPHA)
        if view.mask is not None:
            depth = torch.where(known.prior_depth >= 0, depth, 0.0)
        for other in partners:
            loss = loss + fused_multi_view(
                depth, view.photo, other.photo, other.rendered_depth, config.loss
            ) / max(len(partners), config.photo.per_step)
    return loss


@dataclass(frozen=True)
class _Pass:
    """A view's contribution to a step."""

    gradients: list[Tensor]
    """Gradients of the disks' parameters."""
    loss: float
    depth: Float[Tensor, "h w"]
    """The rendered depth, within the view's mask."""
    visible: Bool[Tensor, "n"]


class CpuTrainer:
    """Adam on a map, view by view, on a CPU."""

    def __init__(self, disks: GaussianMap, cameras: MapCameras, config: MappingConfig, unit: float):
        self.disks = disks
        self.cameras = cameras
        self.config = config
        self.unit = unit
        self.optimizer = MapOptimizer(disks, learning_rates(config, unit))
        is_large = cameras.render.long_edge // 2 >= LEAST_COARSE
        self.coarse_part = COARSE_PART if is_large else 0.0
        """``COARSE_PART``, or 0 if renderings are too small for that."""

    def train(
        self, batches: Sequence[Batch], factors: Sequence[float] | None = None, coarse: bool = False
    ) -> None:
        """One Adam step per batch on its summed losses; ``factors`` scale all learning rates.

        At half the resolution if ``coarse``, which needs a ``coarse_part``. If the views can only
        see an excerpt of the map, only that is trained, which changes nothing but rounding.
        """
        whole = self.disks
        optimizer = self.optimizer
        seen = self._in_view(batches)
        if not 0 < len(seen) <= _LARGE_EXCERPT * len(whole):
            self._train(batches, factors, coarse)
            return
        part = whole.excerpt(seen)
        try:
            self.disks = part
            self.optimizer = MapOptimizer(part, optimizer.learning_rates)
            self._train(batches, factors, coarse)
        finally:
            self.disks = whole
            self.optimizer = optimizer
            whole.take_back(seen, part)

    def _train(
        self, batches: Sequence[Batch], factors: Sequence[float] | None, coarse: bool
    ) -> None:
        for n, batch in enumerate(batches):
            factor = 1.0 if factors is None else factors[n]
            self.optimizer.learning_rates = learning_rates(self.config, self.unit, factor)
            self.step(batch, coarse)
        self.optimizer.learning_rates = learning_rates(self.config, self.unit)

    def _in_view(self, batches: Sequence[Batch]) -> Int[Tensor, "m"]:
        """Disks that the views can see before or after some steps."""
        views = {view.id: view for batch in batches for view, _ in batch}
        if self.config.photo.fresh:
            views |= {o.id: o for batch in batches for _, others in batch for o in others}
        if not views or not len(self.disks):
            return torch.zeros(0, dtype=torch.int64)
        steps = 1.5 * len(batches)  # Adam's moves are about as long as the learning rate
        growth = np.exp(steps * LR_SCALE)
        way = steps * self.config.lr_position
        radius = REACH * growth * self.disks.scale.amax(1) + way * self.unit
        poses = torch.stack([view.T_cw for view in views.values()])
        camera = self.cameras.render
        return disks_in_view(self.disks.position, radius, poses, camera).nonzero()[:, 0]

    def refine_poses(
        self, active: list[MapView], views: Mapping[int, MapView], config: MappingConfig
    ) -> dict[int, Float[Tensor, "4 4"]]:
        """Poses of the active keyframes that agree better with the map; the earliest stays."""
        return refine_poses(self.disks, active, views, self.cameras, config, self.unit)

    def forget_renders(self, views: Iterable[MapView]) -> None:
        """Discard the rendered depths of views, as the map was moved."""
        for view in views:
            view.rendered_depth = None

    def step(self, batch: Batch, coarse: bool = False) -> float:
        """One Adam step on the summed losses of views with their partners; returns the loss."""
        if len(self.disks) == 0:
            return 0.0
        if self.config.photo.fresh:
            self._show_partners(batch)
        # In parallel, as much of a pass is done by one thread; summed in order.
        passes = thread_map(lambda pair: self._pass(*pair, coarse), batch)
        visible = torch.zeros(len(self.disks), dtype=torch.bool, device=self.disks.device)
        total = 0.0
        for (view, _), done in zip(batch, passes, strict=True):
            view.rendered_depth = done.depth
            visible |= done.visible
            total += done.loss
        sums = [sum(g[1:], g[0]) for g in zip(*(p.gradients for p in passes), strict=True)]
        for parameter, gradient in zip(self.disks.parameters, sums, strict=True):
            parameter.grad = gradient
        self.disks.seen += visible
        self.optimizer.step(visible & _sane_gradients(self.disks.parameters))
        self.optimizer.zero_grad()
        self._bound_scales()
        return total

    @torch.enable_grad()
    def _pass(self, view: MapView, partners: list[MapView], coarse: bool) -> _Pass:
        """Forward and backward pass of one view; changes nothing that other views use."""
        parameters = DiskParameters(*(p.detach().requires_grad_() for p in self.disks.parameters))
        full = self.cameras.render
        camera = view.constants.halved.camera if coarse else full
        output = render(parameters, camera, view.T_cw)
        loss = view_loss(view, partners, output, self.config, self.unit, coarse)
        loss.backward()
        with torch.no_grad():
            shown = output.shown_depth(MIN_ALPHA)
            if coarse:
                shown = enlarge_depth(shown, full.height, full.width)
            depth = _within(view, shown)
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        return _Pass(gradients, float(loss.detach()), depth, output.visible)

    @torch.no_grad()
    def _show_partners(self, batch: Batch) -> None:
        """Render the partners as the map is now, for the occlusion tests of this step."""
        for other in {o.id: o for _, partners in batch for o in partners}.values():
            output = render(self.disks, self.cameras.render, other.T_cw)
            other.rendered_depth = _within(other, output.shown_depth(MIN_ALPHA))

    @torch.no_grad()
    def _bound_scales(self) -> None:
        disk = self.config.disk
        low, high = disk.min_scale * self.unit, disk.max_scale * self.unit
        self.disks.parameters.log_scale.clamp_(float(np.log(low)), float(np.log(high)))


def _within(view: MapView, depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The depth where the view has no mask that excludes it, else 0."""
    return depth if view.mask is None else torch.where(view.mask, depth, 0.0)


def _sane_gradients(parameters: DiskParameters) -> Bool[Tensor, "n"]:
    """Disks whose gradient is finite and of reasonable size; the gradient of others is cleared."""
    sane = torch.ones(len(parameters.position), dtype=torch.bool)
    for p in parameters:
        if p.grad is not None:
            size = p.grad.abs().reshape(len(p), -1).amax(1)
            sane &= size < GRADIENT_LIMIT  # NaN compares false
    return sane
