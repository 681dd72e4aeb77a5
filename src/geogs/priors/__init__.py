"""Depth and normals that a network guesses from one image, and what their numbers mean."""
