"""Term of dense flow on the CPU, by compiled loops over the cells of each source.

Cells are seen through a lens, whose parameters may be shared unknowns; the tracker's lens is known.
"""

from collections.abc import Callable, Iterator
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import BEHIND, SourceFlow, damped_curvature
from geogs.bundle.hyper_edge import DepthEquations, RelativeEdges
from geogs.bundle.lens import UNIT, LensBlock
from geogs.bundle.problem import BundleProblem, sources_within
from geogs.bundle.projection import MIN_Z, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState
from geogs.geometry.lie import se3_adjoint
from geogs.world.grid import SampleGrid

Further = Callable[[BundleProblem], Float[Tensor, "e o p 2"]]
"""Returns derivatives of the cells' positions by further shared unknowns."""


class LensFlow:
    """Dense flow of cells seen through the lens of a state, or a known one."""

    def __init__(self, known: LensBlock | None = None, further: Further | None = None) -> None:
        """If no lens is ``known``, that of the state is an unknown."""
        self._known = known
        self._further = further

    @staticmethod
    def of(grid: SampleGrid) -> "LensFlow":
        """Return the dense flow of the cells of a grid, seen through its camera."""
        return LensFlow(LensBlock(grid.camera, grid.pixels))

    def sources(
        self, problem: BundleProblem, state: BundleState, options: BundleOptions
    ) -> Iterator[SourceFlow]:
        """Yield the sources of all edges, in order; with their diagonal if the lens is unknown."""
        from geogs.bundle.lens_kernels import linearise_source

        T_ji = relative_motion(state.T_cw, problem.source, problem.target)
        block = self._block(state)
        adjoint = se3_adjoint(T_ji)
        edges = _Edges(block, problem, T_ji)
        limits = _limits(options.huber)
        slopes = edges.slopes if self._known is None else edges.slopes[:0]
        further = np.zeros((len(edges.weight), 0, 0, 2), np.float32)
        if self._further is not None:
            further = _float(self._further(problem))
        elif problem.by_rows is not None:
            further = _float(UNIT * problem.by_rows[:, None])
        shared = len(slopes) + further.shape[1]
        for frame, e in sources_within(problem.source):
            size = 6 * (e.stop - e.start) + shared
            H = adjoint.new_zeros(size, size)
            g = adjoint.new_zeros(size)
            depth = state.inverse_depth[frame].contiguous()
            E, C, b = depth.new_zeros(size, len(depth)), *depth.new_zeros(2, len(depth))
            linearise_source(
                edges.motions[e], edges.rays, slopes, *edges.lens, depth.numpy(), edges.pixels[e],
                edges.weight[e], further[e], limits,
                H.numpy(), g.numpy(), E.numpy(), C.numpy(), b.numpy(),
            )  # fmt: skip
            equations = DepthEquations(E, damped_curvature(C, options.depth_damping), b, C)
            poses = torch.cat([problem.target[e], problem.source[e][:1]])
            found = RelativeEdges(poses, H, g, shared, equations, adjoint=adjoint[e])
            yield SourceFlow(frame, found, None if self._known else found.chained()[0].diagonal())

    def cost(self, problem: BundleProblem, state: BundleState, huber: float) -> float:
        from geogs.bundle.lens_kernels import cost_of_source

        T_ji = relative_motion(state.T_cw, problem.source, problem.target)
        block = self._block(state)
        edges = _Edges(block, problem, T_ji)
        behind = np.float32((BEHIND * huber) ** 2)
        limits = _limits(huber)
        return sum(
            cost_of_source(
                edges.motions[e],
                edges.rays,
                *edges.lens,
                _float(state.inverse_depth[frame]),
                edges.pixels[e],
                edges.weight[e],
                limits,
                behind,
            )
            for frame, e in sources_within(problem.source)
        )

    def _block(self, state: BundleState) -> LensBlock:
        return self._known or cast(LensBlock, state.block)


class _Edges:
    """Edges and the lens as kernel arguments."""

    def __init__(
        self, block: LensBlock, problem: BundleProblem, T_ji: Float[Tensor, "e 4 4"]
    ) -> None:
        from geogs.geometry.bend_kernels import lens_arguments

        lens = block.lens
        self.motions = _float(T_ji[:, :3])
        self.rays = _float(block.rays[:, :2].mT)
        self.slopes = _float(block.slopes)
        self.lens = lens_arguments(lens)
        self.pixels = _float(problem.unrolled(block.readout))
        self.weight = _float(problem.weight)


def _float(values: Tensor) -> np.ndarray:
    return values.to(torch.float32).contiguous().numpy()


def _limits(huber: float) -> np.ndarray:
    return np.array([huber, MIN_Z], np.float32)
