"""Scores of a result's folder against the truth of its scene."""
