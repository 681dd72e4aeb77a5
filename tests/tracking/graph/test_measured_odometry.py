"""Poses of another tracker beside the images: metres without harm, out-voted where wrong."""

import numpy as np
import pytest
import torch

from geogs.config import Config, OdometryConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.geometry.umeyama import umeyama
from geogs.loop.global_bundle import global_bundle
from geogs.tracking.graph.measured_odometry import Odometry
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import MeasuredPose
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from measured_poses import drifting, with_poses
from tracking_runs import CONFIG, error_cm
from tracking_scenes import CAMERA, frames, pose, sideways

SMALL = Camera(fx=40.0, fy=40.0, cx=23.5, cy=17.5, width=48, height=36)


def segment(path: list[np.ndarray], poses: list[MeasuredPose | None], unit: float) -> KeyframeSet:
    """Keyframes of a path in a unit of so many metres, with what another tracker says."""
    keyframes = KeyframeTable.on(SampleGrid(SMALL)).new_set()
    image = np.zeros((36, 48, 3), np.uint8)
    for n, (T_wc, told) in enumerate(zip(path, poses, strict=True)):
        T_cw = torch.from_numpy(np.linalg.inv(T_wc))
        T_cw[:3, 3] /= unit
        keyframes.add(n, n / 30, image, None, T_cw).pose = told
    return keyframes


def test_motions_are_those_between_neighbours_in_the_unit_of_the_map():
    path = sideways(12, 0.08)
    keyframes = segment(path, drifting(path, drift=0.0, turn_deg=0.0), 2.0)
    keyframes[5].pose = None
    keyframes[9].pose = MeasuredPose(keyframes[9].pose.T_cw, world=1)
    odometry = Odometry(keyframes, OdometryConfig())
    assert odometry.between(keyframes.ids) is None
    odometry.update_scale()
    assert odometry.found.scale == pytest.approx(2.0, rel=1e-9)
    motions = odometry.between(keyframes.ids)
    pairs = list(zip(motions.source.tolist(), motions.target.tolist(), strict=True))
    assert pairs == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 6), (6, 7), (7, 8), (10, 11)]
    T = keyframes.poses(keyframes.ids)
    assert float(motions.residual(T).abs().max()) < 1e-9
    told = odometry.since(keyframes[3], keyframes[4].pose)
    torch.testing.assert_close(told, T[4] @ se3_inverse(T[3]))
    assert odometry.since(keyframes[5], keyframes[4].pose) is None


def test_few_motions_are_not_believed():
    path = sideways(5, 0.08)
    odometry = Odometry(segment(path, drifting(path), 2.0), OdometryConfig())
    odometry.update_scale()
    assert odometry.found.scale is None
    assert not odometry.agreement().used


def tracked(path: list[np.ndarray], poses: list[MeasuredPose] | None) -> Tracker:
    images = frames(path)
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG))
    for frame in images if poses is None else with_poses(images, poses):
        tracker.track(frame)
    tracker.finish()
    global_bundle(tracker)
    return tracker


def errors(tracker: Tracker, path: list[np.ndarray]) -> tuple[float, float | None]:
    """ATE in centimetres after a similarity, and the error of the scale that was found."""
    found, truth = tracker.trajectory().T_wc[:, :3, 3], np.stack(path)[:, :3, 3]
    scale = float(umeyama(torch.from_numpy(found), torch.from_numpy(truth))[0])
    metres = tracker.map.odometry.found.scale
    return error_cm(found, truth), None if metres is None else metres / scale - 1


@pytest.mark.system
def test_poses_bring_metres_and_wrong_ones_are_out_voted():
    path = sideways(22)
    alone, unknown = errors(tracked(path, None), path)
    assert unknown is None
    tracker = tracked(path, drifting(path, 0, wrong=0.2))
    ate, scale = errors(tracker, path)
    assert ate < 1.1 * alone + 0.005
    assert abs(scale) < 0.01
    assert tracker.map.odometry.agreement().fitting > 0.5


@pytest.mark.long
@pytest.mark.system
def test_poses_of_another_motion_change_nothing():
    path = sideways(40)
    alone, _ = errors(tracked(path, None), path)
    other = [pose(0.05 * np.cos(0.4 * k), 0.02 * k, 0.06 * k, 0.09 * k) for k in range(40)]
    tracker = tracked(path, drifting(other))
    agreement = tracker.map.odometry.agreement()
    assert not agreement.used
    assert agreement.fitting < 0.2
    assert errors(tracker, path)[0] == pytest.approx(alone, abs=1e-9)
