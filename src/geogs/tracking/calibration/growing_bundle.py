"""Keyframes with poses, inverse depths and flow, adjusted together with the lens."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import torch
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.bundle.lens import LensBlock
from geogs.bundle.problem import BundleProblem
from geogs.bundle.projection import relative_motion
from geogs.bundle.row_motions import RowMotions, fitted_twists
from geogs.bundle.shared import OPTIONS, SharedResult, solve_shared, usual_residual
from geogs.geometry.camera import Camera
from geogs.geometry.lie import scaled
from geogs.tracking.calibration.focal_candidates import Start
from geogs.tracking.calibration.unknowns import OpenRows, Unknowns
from geogs.tracking.calibration.view_gatherer import View
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.matching.pnp import pnp
from geogs.world.grid import SampleGrid

OFFSETS = (1, 3, 6)
"""Offsets to the preceding keyframes that each is matched with."""
_STALE = 0.3
"""Median motion of the reprojection, in pixels, after which a pair is matched again."""
_TOGETHER = 16
"""Pairs matched at a time."""
PATIENT, LEAST_DECREASE = replace(OPTIONS, iterations=60), 1e-6
"""Options for many small steps: for a rotating camera focal length, distortion and depths lie in a
flat valley, along which each step gains little; an early stop would be near the start."""


_SQUEEZE, _MOST_SQUEEZE = 0.03, 0.75
"""Least and largest change of log fy / fx that is looked for."""
_ASIDE, _RISE = 0.1, 1.1
"""Change of log fy / fx from the best by which the cost has to rise, and by which factor."""
_SAME_ASPECT = 0.004
"""Change of log fy / fx that needs no further adjustment once the pixels are no squares."""
_FALL, _BETTER = 0.97, 0.7
"""Largest cost, relative to that with square pixels, with a changed aspect for others to be tried,
and with the best; chosen on synthetic clips (docs/notebook/calibration.md)."""


@dataclass
class _Edge:
    pixels: Tensor
    weight: Tensor
    reprojection: Tensor
    fine: bool


class GrowingBundle:
    """Views located so far, and the edges between them; mutable. Poses are on the CPU."""

    def __init__(
        self,
        grid: SampleGrid,
        operator: FlowOperator,
        views: list[View],
        start: Start,
        unknowns: Unknowns,
        rows: OpenRows | None = None,
    ) -> None:
        """Start from views that a candidate has located, with the depth of the first one; ``rows``
        for a rolling shutter."""
        self.grid = grid
        """Grid of the guess; of its camera only the size is used."""
        self._operator = operator
        self._unknowns = unknowns
        self._rows = rows
        self.lens = start.lens
        self.readout = unknowns.readout or 0.0
        """Present readout, seconds."""
        self._views = views[: len(start.T_cw)]
        known = start.information.to(grid.device)
        first = grid_fields(grid).fill(start.inverse_depth.to(grid.device), known)
        fields = grid_fields(self._pinhole)
        each = [(first, known), *(fields.transfer(T, first, known) for T in start.T_cw[1:])]
        self._T = list(start.T_cw)
        self._depth, self._information = map(list, zip(*each, strict=True))
        self._edges: dict[tuple[int, int], _Edge] = {}
        self.result: SharedResult | None = None
        self._is_squeezed = False
        self.residual = math.inf
        """Median residual of the matches, in their own deviations, as last adjusted."""

    def __len__(self) -> int:
        return len(self._views)

    @property
    def _pinhole(self) -> SampleGrid:
        """Grid of the present focal length."""
        return SampleGrid(self.lens.pinhole, self.grid.device)

    def place(self, view: View) -> bool:
        """Append the next view by PnP on the last one's depth; False if that fails."""
        assert view.step is not None
        step = view.step.match.on_cpu()
        good = step.sure()[0] & (self._information[-1].cpu() > 0)
        T = pnp(SampleGrid(self.lens.pinhole), self._depth[-1].cpu(), step.pixels[0], good)
        if T is None:
            return False
        self._views.append(view)
        self._T.append(T @ self._T[-1])
        fields = grid_fields(self._pinhole)
        depth, information = fields.transfer(T, self._depth[-1], self._information[-1])
        self._depth.append(depth)
        self._information.append(information)
        return True

    def measure(self, fine: bool, tick: Callable[[], None]) -> None:
        """Match every pair that is new, was matched less finely, or whose reprojection moved."""
        n = len(self)
        pairs = [(j - k, j) for j in range(n) for k in OFFSETS if j >= k]
        both = pairs + [(j, i) for i, j in pairs]
        where = dict(zip(both, self._reprojections(both), strict=True))
        stale = [p for p in pairs if any(self._moved(e, where, fine) for e in (p, p[::-1]))]
        for at in range(0, len(stale), _TOGETHER):
            tick()
            chunk = stale[at : at + _TOGETHER]
            first, second = ([self._views[p[k]].encoded for p in chunk] for k in (0, 1))
            forward = torch.stack([where[p] for p in chunk])
            backward = torch.stack([where[p[::-1]] for p in chunk])
            there, back = self._operator.measure(first, second, forward, backward, fine=fine)
            for match, edges in ((there, chunk), (back, [p[::-1] for p in chunk])):
                for k, edge in enumerate(edges):
                    self._edges[edge] = _Edge(match.pixels[k], match.weight[k], where[edge], fine)

    def _moved(
        self, edge: tuple[int, int], where: dict[tuple[int, int], Tensor], fine: bool
    ) -> bool:
        known = self._edges.get(edge)
        if known is None or (fine and not known.fine):
            return True
        used = known.weight[:, 0] > 0
        moved = (where[edge] - known.reprojection).norm(dim=-1)[used]
        return not len(moved) or float(moved.median()) > _STALE

    def _reprojections(self, directed: list[tuple[int, int]]) -> Tensor:
        source, target = (torch.tensor([e[k] for e in directed]) for k in (0, 1))
        depth = torch.stack([self._depth[i] for i, _ in directed])
        block = LensBlock(self.lens, self.grid.pixels)
        return block.project(torch.stack(self._T), source, target, depth).pixels

    def problem(self) -> BundleProblem:
        """Return the problem of all edges, on the CPU; every pose but the first is free."""
        directed = sorted(self._edges)
        edges = [self._edges[e] for e in directed]
        free = torch.arange(len(self)) > 0
        return BundleProblem(
            torch.stack(self._T),
            torch.stack(self._depth).cpu(),
            torch.tensor([i for i, _ in directed]),
            torch.tensor([j for _, j in directed]),
            free,
            torch.ones_like(free),
            pixels=torch.stack([e.pixels for e in edges]).cpu(),
            weight=torch.stack([e.weight for e in edges]).cpu(),
        )

    def adjust(self) -> bool:
        """Solve for all unknowns and update the state; False if that fails."""
        problem = self._whole_problem()
        result = self._solved(problem, self.lens)
        if not result.finite:
            return False
        self.result = result
        self.lens = result.block.lens
        self.readout = result.block.readout
        self.residual = usual_residual(problem, result)
        self._T = list(result.T_cw)
        information = result.information.to(self.grid.device)
        self._information = list(information)
        depth = result.inverse_depth.to(self.grid.device)
        self._depth = list(grid_fields(self.grid).fill(depth, information))
        self._normalise()
        return True

    def find_aspect(self) -> bool:
        """Change the aspect of the lens where that explains the matches much better; return whether
        it did. The pixels of a video may be no squares, and its file need not say so."""
        assert self.result is not None
        problem = self._whole_problem()
        if self._rows is not None and problem.by_rows is None:
            return False  # rows of a turning camera would be taken for another aspect

        @cache
        def cost(log_aspect: float) -> float:
            result = self._solved(problem, self._squeezed(log_aspect))
            return result.cost if result.finite else math.inf

        least, fall = (_SAME_ASPECT, 1.0) if self._is_squeezed else (_SQUEEZE, _FALL)
        if min(cost(-least), cost(least)) >= fall * self.result.cost:
            return False
        bounds = (-_MOST_SQUEEZE, _MOST_SQUEEZE)
        found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-3})
        best = float(found.x)
        # A camera that turns about one axis leaves the aspect open: there is no clear minimum.
        is_clear = min(cost(best - _ASIDE), cost(best + _ASIDE)) > _RISE * found.fun
        is_better = self._is_squeezed or found.fun < _BETTER * self.result.cost
        total = math.log(self.lens.fy / self.lens.fx) + best
        if not (is_clear and is_better and least <= abs(best) and abs(total) < _MOST_SQUEEZE):
            return False
        self.lens = self._squeezed(best)
        self._is_squeezed = True
        return True

    def _squeezed(self, log_aspect: float) -> Camera:
        """Return the lens with fy / fx times ``exp(log_aspect)``."""
        return replace(self.lens, fy=self.lens.fy * math.exp(log_aspect))

    def _whole_problem(self) -> BundleProblem:
        problem = self.problem()
        return replace(problem, by_rows=self._by_rows(problem))

    def _solved(self, problem: BundleProblem, lens: Camera) -> SharedResult:
        unknowns = self._unknowns
        rolls = None if problem.by_rows is None else unknowns.readout is None
        pixels = self.grid.pixels.cpu()
        block = LensBlock(lens, pixels, unknowns.focal, unknowns.radial, self.readout, rolls)
        return solve_shared(problem, block, PATIENT, LEAST_DECREASE)

    def _by_rows(self, problem: BundleProblem) -> Float[Tensor, "e p 2"] | None:
        """Return the shift of all matches per second of readout, by the motions of views in the
        images next to them; None for a global shutter, or where none of these is near enough."""
        if self._rows is None:
            return None
        measured = [self._rows.motions.of(view.frame) for view in self._views]
        velocity, known = map(torch.stack, zip(*measured, strict=True))
        rays = SampleGrid(self.lens).rays
        depth = problem.inverse_depth
        known = known.cpu() & (torch.stack(self._information).cpu() > 0)
        if not known.any():
            return None
        twist = fitted_twists(self.lens, rays, depth, velocity.cpu(), known)
        T_ji = relative_motion(problem.T_cw, problem.source, problem.target)
        motions = RowMotions(twist, self._rows.times)
        return motions.slopes(self.lens, rays, T_ji, depth, problem.source, problem.target)

    def _normalise(self) -> None:
        """Scale to a median depth of 1, so that limits and thresholds always mean the same."""
        known = torch.cat([d[i > 0] for d, i in zip(self._depth, self._information, strict=True)])
        if not len(known):
            return
        scale = float(known.median())
        self._depth = [d / scale for d in self._depth]
        self._information = [i * scale**2 for i in self._information]
        self._T = [scaled(T, scale) for T in self._T]
