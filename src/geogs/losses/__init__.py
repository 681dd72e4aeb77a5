"""Losses of the map: value and gradient in one pass for the mapper, in ``cpu`` and ``cuda``."""
