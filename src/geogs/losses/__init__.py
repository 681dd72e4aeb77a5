"""Losses of the map: per-pixel torch functions, and the same fused for the mapper on a CPU."""
