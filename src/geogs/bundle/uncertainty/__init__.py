"""Uncertainty of poses and depths at a solution, and of errors common to all matches."""
