"""Terms of depths on the GPU: those that have a place in the kernels, and all others."""

from collections.abc import Iterable
from dataclasses import dataclass

from torch import Tensor

from geogs.bundle.depth_terms import MEASURED_HUBER, DepthDamping, MeasuredDepths
from geogs.bundle.terms import BundleState, DepthTerm


@dataclass(frozen=True)
class KernelDepthTerms:
    """What the kernel ``sum_sources`` takes beside the matches, and what is added after it."""

    damping: DepthDamping | None
    measured: MeasuredDepths | None
    others: tuple[DepthTerm, ...]
    """Depths alone: the kernels' couplings are those of matches."""

    @staticmethod
    def of(terms: Iterable[DepthTerm]) -> "KernelDepthTerms":
        """The first of each kind that the kernel knows goes there."""
        damping = measured = None
        others = []
        for term in terms:
            if isinstance(term, DepthDamping) and damping is None:
                damping = term
            elif isinstance(term, MeasuredDepths) and measured is None:
                measured = term
            else:
                others.append(term)
        return KernelDepthTerms(damping, measured, tuple(others))

    def of_rows(self, rows: Tensor) -> "KernelDepthTerms":
        """What the kernel takes, for some of the frames alone."""
        damping, measured = self.damping, self.measured
        if damping is not None:
            damping = DepthDamping(damping.curvature[rows])
        if measured is not None:
            measured = MeasuredDepths(measured.inverse_depth[rows], measured.information[rows])
        return KernelDepthTerms(damping, measured, self.others)

    @property
    def arguments(self) -> tuple[Tensor | None, Tensor | None, Tensor | None, float]:
        """What ``sum_sources`` takes."""
        damping = None if self.damping is None else self.damping.curvature.contiguous()
        if self.measured is None:
            return damping, None, None, MEASURED_HUBER
        measured = self.measured.inverse_depth.contiguous()
        return damping, measured, self.measured.information.contiguous(), MEASURED_HUBER

    def add_others(
        self,
        frames: Iterable[int],
        state: BundleState,
        information: Tensor,
        inverse_curvature: Tensor,
        gradient: Tensor,
    ) -> None:
        """Add what else is said of the depths of some frames to the kernel's output for them."""
        rows = [x.view(-1, information.shape[-1]) for x in (inverse_curvature, gradient)]
        for term in self.others:
            for row, frame in enumerate(frames):
                edges = term.of_frame(frame, state)
                if edges.depth is None or len(edges.gradient):
                    kind = type(term).__name__
                    raise TypeError(
                        f"{kind} joins more than depths, which the GPU has no kernel for."
                    )
                information[row] += edges.depth.information
                rows[0][row] = 1 / (1 / rows[0][row] + edges.depth.curvature)
                rows[1][row] += edges.depth.gradient
