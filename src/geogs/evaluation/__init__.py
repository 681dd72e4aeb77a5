"""Errors of a result against the truth: trajectory and surface, tables and pictures."""
