"""A room for tests of training: keyframes with their true depth, and a map a little off."""

import numpy as np
import torch

from geogs.config import Config
from geogs.depth.depth_view import DenseDepth
from geogs.geometry.lie import se3_inverse
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.training.map_trainer import Batch
from geogs.mapping.view_arrays import MapCameras
from geogs.world.disks import DiskParameters, GaussianMap
from geogs_synth.sequence.location import centred_camera
from handheld_walk import handheld_trajectory
from keyframe_samples import Sample, segment_of, views_of
from lit_rooms import lit_room

WORKING = centred_camera(96, 72)
CAMERAS = MapCameras(WORKING, WORKING.with_long_edge(40), WORKING.with_long_edge(80))
CONFIG = Config().mapping
UNIT = 2.0


def rendered_keyframes() -> list[tuple[Sample, np.ndarray]]:
    """Four keyframes of a room with their true depth at render size."""
    caster = lit_room(3)
    poses = handheld_trajectory(caster.scene, 64)
    out = []
    for index in range(0, 32, 8):
        view = caster.render(WORKING, poses[index])
        grid = torch.from_numpy(1 / view.depth[4:-3:8, 4:-3:8]).float()
        T_cw = se3_inverse(torch.from_numpy(poses[index]))
        keyframe = Sample(index, view.image, T_cw, grid, torch.ones_like(grid))
        out.append((keyframe, caster.render(CAMERAS.render, poses[index]).depth))
    return out


def make_views(rendered, device: torch.device, config=CONFIG) -> list[MapView]:
    segment = segment_of([keyframe for keyframe, _ in rendered], WORKING, device)
    views, pool = [], views_of(segment.table, CAMERAS, config.loss)
    for keyframe, (_, depth) in zip(segment, rendered, strict=True):
        view = pool.add(keyframe.id)
        dense = torch.from_numpy(depth).float().to(device)
        confidence = torch.full_like(dense, 0.8)
        view.set_depth(DenseDepth(dense, confidence, dense.median().cpu()))
        view.row.partners = [i for i in range(len(rendered)) if i != view.id][:2]
        views.append(view)
    return views


def make_map(rendered, device: torch.device) -> GaussianMap:
    """Disks a little off the first keyframe's surface."""
    keyframe, depth = rendered[0]
    g = torch.Generator().manual_seed(0)
    rays = CAMERAS.render.rays()[::2, ::2].reshape(-1, 3)
    z = torch.from_numpy(depth[::2, ::2]).float().reshape(-1, 1)
    T_wc = se3_inverse(keyframe.T_cw).float()
    points = (rays * z * (1 + 0.02 * torch.randn(z.shape, generator=g))) @ T_wc[:3, :3].T
    n = len(points)
    disks = DiskParameters(
        points + T_wc[:3, 3],
        torch.randn(n, 4, generator=g),
        torch.full((n, 2), -2.6) + 0.2 * torch.randn(n, 2, generator=g),
        torch.randn(n, generator=g),
    )
    map = GaussianMap.empty(device)
    map.append(disks, 0)
    return map


def make_batches(views: list[MapView]) -> list[Batch]:
    """Steps of one and of two views; with two partners, one or none."""
    return [
        [(views[0], [views[1], views[2]]), (views[1], [views[0]])],
        [(views[2], [])],
        [(views[3], [views[0], views[1]]), (views[0], [views[3], views[2]])],
    ]
