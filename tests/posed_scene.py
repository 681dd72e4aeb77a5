"""A small scene and the command, for tests of reconstruction from known poses."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from depth_scene import WORKING, make_scene, trace
from geogs.config import ReconstructConfig
from geogs.evaluation.surfaces.surface import read_surface, sample_surface
from geogs.reconstruction import Reconstruction

GEOGS = [sys.executable, "-m", "geogs.cli.main"]
DEFAULT = ReconstructConfig()
SMALL = replace(
    DEFAULT,
    search=replace(DEFAULT.search, least_steps=60, steps_per_view=1),
    mapping=replace(
        DEFAULT.mapping, render_long_edge=96, disk=replace(DEFAULT.mapping.disk, stride=2)
    ),
)

BRIEF = replace(SMALL, search=replace(SMALL.search, least_steps=10, repeat=False))
"""Where a map has to be there, however good it is."""


def geogs(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [*GEOGS, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=1800)


def vertices(path: Path) -> np.ndarray:
    """Vertex positions of a PLY file."""
    return read_surface(path).vertices


def surface_points(path: Path, count: int = 5000) -> np.ndarray:
    """Points spread evenly over a mesh, however large its triangles are."""
    return sample_surface(read_surface(path), count, np.random.default_rng(0))[0]


def ball_and_wall(scale: float = 1.0, far: float = 0.0) -> Reconstruction:
    """The views of the depth tests, without what a tracker knew.

    Lengths times ``scale``, then moved by ``far`` along each axis.
    """
    scene = Reconstruction(WORKING, SMALL)
    for view in make_scene().views:
        T_wc = np.linalg.inv(view.T_cw)
        T_wc[:3, 3] = scale * T_wc[:3, 3] + far
        T_cw = np.linalg.inv(T_wc)
        scene.add(view.image, T_cw)
    return scene


def depth_errors(scene: Reconstruction, scale: float = 1.0) -> np.ndarray:
    """Relative errors of all rendered depths."""
    camera, errors = scene.mapper.cameras.render, []
    for view, render in zip(make_scene().views, scene.renders(), strict=True):
        truth = trace(camera, np.linalg.inv(view.T_cw))[0] * scale
        depth = render.depth.numpy()
        errors.append(np.abs(depth / truth - 1)[depth > 0])
    return np.concatenate(errors)
