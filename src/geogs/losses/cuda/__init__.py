"""The mapping losses of a window of views on a GPU."""
