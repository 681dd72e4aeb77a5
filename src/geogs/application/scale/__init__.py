"""Metric scale of a map: by a known distance, tags of known size, or the camera's height."""
