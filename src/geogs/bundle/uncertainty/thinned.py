"""A subset of an adjustment's cells, which represents all in the estimation of uncertainty.

Linearised on the CPU, some edges at a time, whatever the device of the matches.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import FlowTerm, SourceFlow, linearised_sources
from geogs.bundle.hyper_edge import DepthEquations
from geogs.bundle.lens import LensBlock
from geogs.bundle.lens_flow import LensFlow
from geogs.bundle.problem import BundleProblem, StreamedProblem, source_chunks
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState, DepthTerm
from geogs.world.grid import SampleGrid

AnyProblem = BundleProblem | StreamedProblem


class ThinnedProblem:
    """A problem with a subset of the cells, which represents all of them; on the CPU."""

    def __init__(self, grid: SampleGrid, problem: AnyProblem, cells: int) -> None:
        step = -(-grid.size // cells)
        self._problem = problem
        self._cells = slice(None, None, step)
        self.camera, self.rays = grid.camera, grid.rays[self._cells].cpu()
        self.pixels = grid.pixels[self._cells].cpu()
        self.lens = LensBlock(grid.camera, self.pixels)
        self.count = len(self.rays)
        self.fraction = self.count / grid.size
        self.inverse_depth = problem.inverse_depth[:, self._cells].cpu()

    def sources(self, options: BundleOptions, flow: FlowTerm | None = None) -> Iterator[SourceFlow]:
        """Yield all linearised sources, in order; by default of the known lens."""
        flow = flow or LensFlow(self.lens)
        for part in self.parts(options):
            state = replace(part.start, block=self.lens)
            yield from linearised_sources(flow, part, state, options)

    def depth_moves(
        self, source: SourceFlow, pull: Float[Tensor, "c k"], moves: Float[Tensor, "m k"]
    ) -> Float[Tensor, "c k"]:
        """Return relative changes of a source's inverse depths by errors of matches of size one.

        They are ``C^-1 (pull - E^T moves)`` over the inverse depths, with the gradients ``pull`` on
        the depths and the ``moves`` of all poses. Zero for fixed depths, or without a match.
        """
        depth = source.edges.depth
        rows = source.edges.rows(len(moves) // 6)
        left = pull - source.edges.chained_coupling().mT @ moves[rows].to(pull)
        scale = depth.curvature * self.inverse_depth[source.frame].clamp(min=1e-12)
        known = (depth.information > 0) & self._problem.free_depth[source.frame].cpu()
        return torch.where(known[:, None], left / scale[:, None], 0.0)

    def parts(self, options: BundleOptions) -> Iterator[BundleProblem]:
        """Yield problems of some edges at a time, with the depth terms."""
        p = self._problem
        cells = self._cells
        terms = tuple(_ThinnedTerm(term, p.start, cells) for term in p.depth_terms)
        for chunk in source_chunks(p.source.cpu(), options.chunk):
            part = p.part(chunk)
            yield BundleProblem(
                p.T_cw.cpu(),
                self.inverse_depth,
                part.source.cpu(),
                part.target.cpu(),
                p.free_pose.cpu(),
                p.free_depth.cpu(),
                terms,
                pixels=part.pixels[:, cells].cpu(),
                weight=part.weight[:, cells].cpu(),
            )


@dataclass(frozen=True)
class _ThinnedTerm:
    """A depth term on a subset of the cells."""

    term: DepthTerm
    state: BundleState
    """State with all cells."""
    cells: slice
    information: None = None

    def of_frame(self, frame: int, state: BundleState) -> DepthEquations:
        return self.term.of_frame(frame, self.state).on_cells(self.cells)

    def cost(self, state: BundleState) -> float:
        return self.term.cost(self.state)
