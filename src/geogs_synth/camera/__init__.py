"""Cameras and their flaws."""
