"""The machine: what a run computes on, whether it works, which weights are there."""
