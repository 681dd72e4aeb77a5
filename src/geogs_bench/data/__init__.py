"""Scenes of data sets with their truth, found in a folder or rendered."""
