"""The mapping losses of one view or pair on a CPU."""

from geogs.losses.cpu.fused import fused_multi_view, fused_single_view

__all__ = ["fused_multi_view", "fused_single_view"]
