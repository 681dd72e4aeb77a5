"""Dense monocular SLAM with a map of geometry-only Gaussian disks."""

__version__ = "0.1.0"
