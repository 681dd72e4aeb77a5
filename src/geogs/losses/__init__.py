"""Losses of the map: value and gradient in one go for the mapper, in ``cpu`` and ``cuda``."""
