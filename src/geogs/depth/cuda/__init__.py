"""Keyframe depth on a GPU."""
