"""Losses of the map: per-pixel torch functions, and the same fused for the mapper on a CPU."""

from geogs.losses.fused import fused_multi_view, fused_single_view
from geogs.losses.multi_view import PhotoView, multi_view_loss
from geogs.losses.single_view import ViewConstants, single_view_loss

__all__ = [
    "PhotoView",
    "ViewConstants",
    "fused_multi_view",
    "fused_single_view",
    "multi_view_loss",
    "single_view_loss",
]
