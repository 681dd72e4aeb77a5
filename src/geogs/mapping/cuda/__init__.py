"""Keyframe depths on a GPU."""
