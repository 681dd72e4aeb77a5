"""Monocular priors in the tracker: predicted for every keyframe, then adjusted with its depth."""

import logging
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.config import PriorConfig
from geogs.priors.alignment import align_inverse_depth
from geogs.priors.monocular_prior import MonocularPrior
from geogs.tracking.depth_prior import DEVIATION, FlowEvidence, adjust_depth, flow_evidence
from geogs.tracking.graph.frame_graph import HUBER, FrameGraph
from geogs.world.cell_depths import KeyframePrior
from geogs.world.grid import OFFSET, STRIDE, SampleGrid
from geogs.world.keyframes import Keyframe

CAUTION = 4.0
"""Factor on a prior's deviation for mapping, which assumes that a tracker's deviations are
overestimated (``DEVIATION_SCALE``, ``TRACKER_SCALE`` of depth/)."""

_log = logging.getLogger(__name__)


class KeyframePriors:
    """Adds priors to keyframes and adjusts depth with them where matches determine little.

    Does nothing without a prior.
    """

    def __init__(
        self, graph: FrameGraph, prior: MonocularPrior | None, config: PriorConfig
    ) -> None:
        self.graph = graph
        self.prior = prior
        self.config = config
        self._warned = False

    def ask(self, keyframe: Keyframe) -> None:
        """Predict the prior of a new keyframe; no depth where it was measured by a sensor."""
        if self.prior is None:
            return
        maps, grid = self.prior.predict(keyframe.image), self.graph.keyframes.grid
        if maps.normal is not None:
            keyframe.prior_normal = self._facing(maps.normal.cpu())
        if maps.depth is not None and keyframe.measured is None:
            values = on_cells(grid, maps.depth.to(grid.device))
            zero = torch.zeros_like(values)
            one = values.new_ones(self.config.scale_rows * self.config.scale_columns)
            keyframe.prior = KeyframePrior(maps.kind, values, zero, one, zero)

    def _facing(self, normal: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """Return normals that face the camera; zero in place of others."""
        away = (normal * self.graph.keyframes.grid.camera.rays()).sum(-1, keepdim=True) >= 0
        known = normal.square().sum(-1, keepdim=True) > 0
        if not self._warned and int((away & known).sum()) > 0.5 * int(known.sum()):
            self._warned = True
            _log.warning("Most prior normals face away from the camera; check their normal_axes.")
        return torch.where(away, 0.0, normal)

    def adjust(self, ids: Sequence[int]) -> None:
        """Adjust depth and scale of the keyframes that have a prior jointly, poses fixed."""
        store, deep = self.graph.keyframes, set(ids)
        edges = [e for e in self.graph.edges if e[0] in deep and store[e[0]].prior is not None]
        if not edges:
            return
        problem, frames = self.graph.problem(edges, [], {i for i, _ in edges})
        flow = flow_evidence(store.grid, problem, HUBER)
        rows, keyframes, priors = [], [], []
        for n, id in enumerate(frames):
            keyframe, prior = store[id], store[id].prior
            if id in deep and prior is not None:
                self._align(prior, keyframe.inverse_depth, flow.curvature[n])
                if prior.is_aligned:
                    rows.append(n)
                    keyframes.append(keyframe)
                    priors.append(prior)
        if not rows:
            return
        adjusted = adjust_depth(
            store.grid,
            FlowEvidence(flow.curvature[rows], flow.gradient[rows]),
            torch.stack([k.inverse_depth for k in keyframes]),
            torch.stack([p.inverse_depth for p in priors]),
            torch.stack([p.scale for p in priors]),
            self.config,
        )
        for n, (keyframe, prior) in enumerate(zip(keyframes, priors, strict=True)):
            keyframe.inverse_depth = adjusted.inverse_depth[n]
            prior.scale = adjusted.scale[n]
            prior.information = adjusted.information[n] / CAUTION**2

    def _align(
        self,
        prior: KeyframePrior,
        inverse_depth: Float[Tensor, "p"],
        curvature: Float[Tensor, "p"],
    ) -> None:
        """Align a prior to the tracker's unit: once, or again at every call if it has a shift.

        The adjusted scales replace a second alignment of scale.
        """
        if prior.is_aligned and not prior.kind.has_shift:
            return
        relative = curvature * inverse_depth.square()
        weight = relative / (relative + DEVIATION**-2)
        aligned = align_inverse_depth(prior.values, prior.kind, inverse_depth, weight)
        if aligned is not None:
            prior.inverse_depth = aligned
            prior.scale, prior.is_aligned = torch.ones_like(prior.scale), True


def on_cells(grid: SampleGrid, values: Float[Tensor, "h w"]) -> Float[Tensor, "p"]:
    """Sample an image-sized map at the pixels of the cells."""
    rows = values[OFFSET : OFFSET + STRIDE * grid.height : STRIDE]
    return rows[:, OFFSET : OFFSET + STRIDE * grid.width : STRIDE].reshape(-1).float()
