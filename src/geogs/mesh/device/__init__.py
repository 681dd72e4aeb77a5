"""The steps from a volume to its mesh in batched torch, for the GPU that holds the volume."""
