"""Terms of depths on the GPU, each of which has a place in the kernels."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from torch import Tensor

from geogs.bundle.depth_terms import MEASURED_HUBER, DepthDamping, MeasuredDepths
from geogs.bundle.terms import DepthTerm


@dataclass(frozen=True)
class KernelDepthTerms:
    """What the kernel ``sum_sources`` takes beside the matches."""

    damping: DepthDamping | None = None
    measured: MeasuredDepths | None = None

    @staticmethod
    def of(terms: Iterable[DepthTerm]) -> "KernelDepthTerms":
        """At most one of each kind; raises TypeError where there is another."""
        found = KernelDepthTerms()
        for term in terms:
            if isinstance(term, DepthDamping) and found.damping is None:
                found = replace(found, damping=term)
            elif isinstance(term, MeasuredDepths) and found.measured is None:
                found = replace(found, measured=term)
            else:
                raise TypeError(f"The GPU has no kernel for another {type(term).__name__}.")
        return found

    def of_rows(self, rows: Tensor) -> "KernelDepthTerms":
        """The same for some of the frames alone."""
        damping, measured = self.damping, self.measured
        if damping is not None:
            damping = DepthDamping(damping.curvature[rows])
        if measured is not None:
            measured = MeasuredDepths(measured.inverse_depth[rows], measured.information[rows])
        return KernelDepthTerms(damping, measured)

    @property
    def arguments(self) -> tuple[Tensor | None, Tensor | None, Tensor | None, float]:
        """What ``sum_sources`` takes."""
        damping = None if self.damping is None else self.damping.curvature.contiguous()
        if self.measured is None:
            return damping, None, None, MEASURED_HUBER
        measured = self.measured.inverse_depth.contiguous()
        return damping, measured, self.measured.information.contiguous(), MEASURED_HUBER
