"""Dense monocular SLAM with a map of geometry-only Gaussian disks."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from geogs.guard.kernel_folder import find_kernel_folder
from geogs.version import __version__

if TYPE_CHECKING:
    from geogs import application
    from geogs.application.reconstruct import reconstruct
    from geogs.application.results.saved_result import load_result
    from geogs.application.run_in_python import run
    from geogs.application.slam_in_python import load_slam, save_slam, slam_mesh, track
    from geogs.config import Config, ReconstructConfig
    from geogs.geometry.camera import Camera
    from geogs.io.sources.sniff import open_posed_source, open_source
    from geogs.io.writers.map_file import load_map
    from geogs.pose_estimate import PoseEstimate
    from geogs.slam import Slam
    from geogs.splat.render import render, render_vjp
    from geogs.types import Frame
    from geogs.world.disks import GaussianMap

__all__ = [
    "Camera",
    "Config",
    "Frame",
    "GaussianMap",
    "PoseEstimate",
    "ReconstructConfig",
    "Slam",
    "__version__",
    "application",
    "load_map",
    "load_result",
    "load_slam",
    "open_posed_source",
    "open_source",
    "reconstruct",
    "render",
    "render_vjp",
    "run",
    "save_slam",
    "slam_mesh",
    "track",
]

_HOMES = {
    "Camera": "geogs.geometry.camera",
    "Config": "geogs.config",
    "Frame": "geogs.types",
    "GaussianMap": "geogs.world.disks",
    "PoseEstimate": "geogs.pose_estimate",
    "ReconstructConfig": "geogs.config",
    "Slam": "geogs.slam",
    "load_map": "geogs.io.writers.map_file",
    "load_result": "geogs.application.results.saved_result",
    "load_slam": "geogs.application.slam_in_python",
    "open_posed_source": "geogs.io.sources.sniff",
    "open_source": "geogs.io.sources.sniff",
    "reconstruct": "geogs.application.reconstruct",
    "render": "geogs.splat.render",
    "render_vjp": "geogs.splat.render",
    "run": "geogs.application.run_in_python",
    "save_slam": "geogs.application.slam_in_python",
    "slam_mesh": "geogs.application.slam_in_python",
    "track": "geogs.application.slam_in_python",
}

find_kernel_folder()


def __getattr__(name: str) -> Any:
    """Import public names when they are first used, so that the command line starts quickly."""
    if name == "application":
        return import_module("geogs.application")
    if name not in _HOMES:
        raise AttributeError(f"module geogs has no attribute {name}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
