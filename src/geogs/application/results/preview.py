"""Preview surface from the depths of tracking, before the map is made."""

from dataclasses import replace
from pathlib import Path

import torch

from geogs.depth.tracker_depth import enlarged_depth
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.writers.replacement import replaced
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.on_demand import OnDemand
from geogs.slam import Slam
from geogs.threads import on_one_torch_thread
from geogs.world.keyframes import Keyframe

NAME = "preview.ply"
_EDGE = 128
"""Longer side of the depth maps in pixels: a cell of the tracker has eight pixels."""
_TRIANGLES = 60_000
_MAX_VIEWS = 60
"""Largest number of fused keyframes, evenly spread."""
_TWO_VIEWS = 1.5
"""Least weight of a voxel: one such coarse depth alone makes no surface."""


def write_preview(output: Path, slam: Slam) -> bool:
    """Write ``preview.ply``: the surface of the depths of tracking.

    It is deleted when the final result is written. Returns whether there is one.

    Raises:
        OutputError: the file cannot be written.
    """
    mesh = preview(slam)
    if mesh is None:
        return False
    with replaced(output, "part") as new:
        mesh.save(new / NAME)
    return True


@on_one_torch_thread
def preview(slam: Slam) -> Mesh | None:
    """The surface of the depths of tracking, one per 64 pixels; none without any."""
    keyframes = slam.segments.main.segment.keyframes
    stride = -(-max(len(keyframes), 1) // _MAX_VIEWS)
    camera = slam.camera
    shrink = min(_EDGE / max(camera.width, camera.height), 1.0)
    small = camera.resized(round(shrink * camera.width), round(shrink * camera.height))
    views = OnDemand(list(keyframes)[::stride], lambda k: _view(k, camera, small))
    rough = replace(slam.config.mesh, voxel=None, triangle_budget=_TRIANGLES, min_weight=_TWO_VIEWS)
    try:
        return extract_mesh(views, rough)
    except InputError:  # too little surface is known; the full map may have more
        return None


def _view(keyframe: Keyframe, working: Camera, small: Camera) -> DepthMapView:
    found = enlarged_depth(*keyframe.depth_field(), working, small)
    depth, weight = (torch.from_numpy(m) for m in (found.depth, found.confidence))
    return DepthMapView(depth, weight, small, keyframe.T_cw, keyframe.image)
