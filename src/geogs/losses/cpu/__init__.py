"""The mapping losses of one view or pair on a CPU."""
