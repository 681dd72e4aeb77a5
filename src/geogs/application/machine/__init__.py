"""The machine: what a run computes on, and whether it works."""
