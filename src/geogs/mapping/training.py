"""One step of training: losses of some views, gradients, Adam."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import MappingConfig
from geogs.losses import fused_multi_view, fused_single_view
from geogs.mapping.view import MapCameras, MapView
from geogs.splat.map import DiskParameters, GaussianMap
from geogs.splat.optimizer import LearningRates, MapOptimizer
from geogs.splat.render import RenderOutput, render

# A disk whose gradient exceeds this has met a numerical accident (a nearly edge-on pixel).
_GRADIENT_LIMIT = 1e3


def learning_rates(config: MappingConfig, unit: float, factor: float = 1.0) -> LearningRates:
    """Adam steps in map units; ``unit`` is the map's typical depth."""
    return LearningRates(
        position=config.lr_position * unit * factor,
        quaternion=config.lr_quaternion * factor,
        log_scale=config.lr_scale * factor,
        opacity_logit=config.lr_opacity * factor,
    )


def view_loss(
    view: MapView,
    partners: list[MapView],
    output: RenderOutput,
    config: MappingConfig,
    unit: float,
) -> Float[Tensor, ""]:
    """L_geo of one rendered view: single-view terms, and L_mv averaged over its partners.

    Partners without a rendering yet are matched without occlusion test.
    """
    loss = fused_single_view(
        output.depth, output.normal, output.alpha, output.distortion,
        view.known, config.loss, unit,
    )  # fmt: skip
    if partners:
        depth = torch.where(output.alpha.detach() > config.loss.min_alpha, output.depth, 0.0)
        for other in partners:
            loss = loss + fused_multi_view(
                depth, view.photo, other.photo, other.rendered_depth, config.loss
            ) / max(len(partners), config.photo.per_step)
    return loss


def draw_partners(
    view: MapView, views: dict[int, MapView], config: MappingConfig, random: np.random.Generator
) -> list[MapView]:
    """Some of a view's partners, at random."""
    ids = [i for i in view.partners if i in views]
    count = min(config.photo.per_step, len(ids))
    return [views[ids[i]] for i in random.choice(len(ids), count, replace=False)] if count else []


class Trainer:
    """Adam on a map, view by view."""

    def __init__(self, disks: GaussianMap, cameras: MapCameras, config: MappingConfig, unit: float):
        self.disks = disks
        self.cameras = cameras
        self.config = config
        self.unit = unit
        self.optimizer = MapOptimizer(disks, learning_rates(config, unit))

    def set_rate(self, factor: float) -> None:
        """Scale all learning rates."""
        self.optimizer.learning_rates = learning_rates(self.config, self.unit, factor)

    def step(self, batch: list[tuple[MapView, list[MapView]]]) -> float:
        """One Adam step on the summed losses of views with their partners; returns the loss."""
        if len(self.disks) == 0:
            return 0.0
        visible = torch.zeros(len(self.disks), dtype=torch.bool, device=self.disks.device)
        total = 0.0
        for view, partners in batch:
            output = render(self.disks, self.cameras.render, view.T_cw)
            loss = view_loss(view, partners, output, self.config, self.unit)
            loss.backward()
            view.rendered_depth = shown_depth(output, self.config.loss.min_alpha)
            visible |= output.visible
            total += float(loss.detach())
        self.disks.mark_seen(visible)
        self.optimizer.step(visible & _sane_gradients(self.disks.parameters))
        self.optimizer.zero_grad()
        self._bound_scales()
        return total

    @torch.no_grad()
    def _bound_scales(self) -> None:
        disk = self.config.disk
        low, high = disk.min_scale * self.unit, disk.max_scale * self.unit
        self.disks.log_scale.clamp_(float(np.log(low)), float(np.log(high)))


@torch.no_grad()
def shown_depth(output: RenderOutput, min_alpha: float) -> Float[Tensor, "h w"]:
    """Rendered depth where the map is opaque enough to hide what lies behind, else 0."""
    return torch.where(output.alpha > min_alpha, output.depth, 0.0)


def _sane_gradients(parameters: DiskParameters) -> Bool[Tensor, "n"]:
    """Disks whose gradient is finite and of reasonable size; the gradient of others is cleared."""
    sane = torch.ones(len(parameters.position), dtype=torch.bool)
    for p in parameters:
        if p.grad is not None:
            size = p.grad.abs().reshape(len(p), -1).amax(1)
            sane &= size < _GRADIENT_LIMIT  # NaN compares false
    return sane
