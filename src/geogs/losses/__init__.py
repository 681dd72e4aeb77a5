"""Losses of the map: per-pixel torch functions; fused for the mapper in ``cpu`` and ``cuda``."""

from geogs.losses.multi_view import PhotoView, multi_view_loss
from geogs.losses.single_view import ViewConstants, single_view_loss

__all__ = ["PhotoView", "ViewConstants", "multi_view_loss", "single_view_loss"]
