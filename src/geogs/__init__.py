"""Dense monocular SLAM with a map of geometry-only Gaussian disks."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from geogs.config import Config
    from geogs.geometry.camera import Camera
    from geogs.io.writers.native import load_map
    from geogs.slam import Slam
    from geogs.splat.map import GaussianMap

__all__ = ["Camera", "Config", "GaussianMap", "Slam", "__version__", "load_map"]

__version__ = "0.1.0"

_HOMES = {
    "Camera": "geogs.geometry.camera",
    "Config": "geogs.config",
    "GaussianMap": "geogs.splat.map",
    "Slam": "geogs.slam",
    "load_map": "geogs.io.writers.native",
}


def __getattr__(name: str) -> Any:
    """Import the public names when they are first used, so that the command line starts at once."""
    if name not in _HOMES:
        raise AttributeError(f"module geogs has no attribute {name}")
    return getattr(import_module(_HOMES[name]), name)
