"""Parts of synthetic scenes: ``solids`` for all; ``textured_scene`` for sequences and ``rooms`` for
training add their appearance and the light."""
