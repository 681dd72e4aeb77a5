"""Textures: drawn from random numbers, and photographs that come with scikit-image."""
