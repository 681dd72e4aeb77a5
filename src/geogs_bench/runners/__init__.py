"""Runners of a benchmark's tasks: geogs, parts of it, and the baseline with colour."""
