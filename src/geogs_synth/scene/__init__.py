"""What synthetic scenes are made of: ``solids`` for all; a ``scene`` for sequences, ``rooms`` for
training add what they look like and the light."""
