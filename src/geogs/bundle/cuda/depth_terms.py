"""Depth terms on the GPU, as kernel arguments."""

from collections.abc import Iterable
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.terms import DepthDamping, DepthTerm, MeasuredDepths


class KernelDepthTerms(NamedTuple):
    """Arguments of the kernel ``sum_sources`` besides matches; contiguous, None if absent."""

    damping: Float[Tensor, "n p"] | None = None
    """Curvature of a :class:`DepthDamping`."""
    measured: Float[Tensor, "n p"] | None = None
    """Inverse depth of :class:`MeasuredDepths`."""
    information: Float[Tensor, "n p"] | None = None
    """Information of :class:`MeasuredDepths`."""

    @staticmethod
    def of(terms: Iterable[DepthTerm]) -> "KernelDepthTerms":
        """Convert terms, at most one of each kind; raises TypeError for any other."""
        found = KernelDepthTerms()
        for term in terms:
            if isinstance(term, DepthDamping) and found.damping is None:
                found = found._replace(damping=term.curvature.contiguous())
            elif isinstance(term, MeasuredDepths) and found.measured is None:
                measured = term.inverse_depth
                information = term.information
                found = found._replace(
                    measured=measured.contiguous(), information=information.contiguous()
                )
            else:
                raise TypeError(f"The GPU has no kernel for another {type(term).__name__}.")
        return found

    def of_rows(self, rows: Tensor) -> "KernelDepthTerms":
        """Return the terms of some of the frames."""
        return KernelDepthTerms(*(x if x is None else x[rows] for x in self))
