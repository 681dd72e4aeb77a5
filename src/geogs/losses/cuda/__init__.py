"""The mapping losses of a window of views on a GPU."""

from geogs.losses.cuda.view_table import ViewTable
from geogs.losses.cuda.window_losses import WindowLosses

__all__ = ["ViewTable", "WindowLosses"]
