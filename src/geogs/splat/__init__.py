"""The map of Gaussian disks and its differentiable renderer."""
