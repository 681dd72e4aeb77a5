"""Maps from known poses whose disks start at sparse points instead of searched depths."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from depth_scene import WORKING, make_scene, trace
from geogs.application.posed_views import PosedViews
from geogs.application.structure_from_motion import photos
from geogs.config import InputConfig, ReconstructConfig, reconstruct_preset
from geogs.io.sources.sniff import open_posed_source
from geogs.reconstruction import Reconstruction
from geogs.stopwatch import unwatched
from geogs_photos import start_points
from posed_scene import depth_errors, vertices

pytestmark = pytest.mark.system


def papers(start: str) -> ReconstructConfig:
    """The preset on small images, with disks that start at points or at depths."""
    config = reconstruct_preset("paper")
    mapping = replace(
        config.mapping, render_long_edge=96, ablation=replace(config.mapping.ablation, start=start)
    )
    search = replace(config.search, least_steps=100, steps_per_view=1, repeat=False)
    return replace(config, mapping=mapping, search=search)


def true_points(count: int) -> np.ndarray:
    """Points of the ball and the wall that views see, with noise of 0.2 % of their depth."""
    random, found = np.random.default_rng(0), []
    rays = WORKING.rays().double().numpy()
    for view in make_scene().views:
        depth = trace(WORKING, np.linalg.inv(view.T_cw))[0]
        v, u = (random.integers(0, size, count) for size in depth.shape)
        z = depth[v, u] * random.normal(1, 0.002, count)
        found.append((rays[v, u] * z[:, None] - view.T_cw[:3, 3]) @ view.T_cw[:3, :3])
    return np.concatenate(found)


def made_from(points: np.ndarray, start: str) -> Reconstruction:
    scene = Reconstruction(WORKING, papers(start))
    for view in make_scene().views:
        scene.add(view.image, view.T_cw)
    scene.finish(points)
    return scene


def test_disks_start_at_the_points_and_are_no_more_than_these():
    points = true_points(200)
    scene, other = made_from(points, "points"), made_from(points, "depths")
    disks = scene.snapshot()
    assert 0.8 * len(points) < len(disks) <= len(points)
    off = cKDTree(points).query(disks.position.numpy())[0]
    assert np.median(off) < 0.02 < np.median(cKDTree(points).query(other.snapshot().position)[0])
    errors = depth_errors(scene)
    assert np.median(errors) < 0.01
    assert len(errors) > 0.8 * len(depth_errors(other))


def test_without_points_of_its_own_a_scene_gets_those_of_its_features(room, monkeypatch):
    group = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    registered = group["entry-points"][photos.GROUP]
    assert registered["find_start_points"] == "geogs_photos.start_points:find_start_points"
    monkeypatch.setattr(photos, "_registered", lambda name: getattr(start_points, name))
    source = open_posed_source(room, InputConfig(stride=6))
    assert source.points is None
    scene = Reconstruction(source.camera, papers("points"))
    points = PosedViews(scene, source, unwatched).first_look()
    assert len(points) > 150
    off = cKDTree(vertices(room / "points_seen_1cm.ply")).query(points)[0]
    assert np.median(off) < 0.02
