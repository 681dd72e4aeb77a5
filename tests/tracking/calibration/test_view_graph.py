"""The focal length by the epipolar geometry of many pairs, and motions that do not tell it."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geogs.config import TrackingConfig
from geogs.geometry.camera import Camera
from geogs.tracking.calibration.self_calibration import UNRELIABLE
from geogs.tracking.calibration.view_gatherer import ViewGatherer, distant_flows
from geogs.tracking.calibration.view_graph import LEAST_DEVIATION, view_graph_estimate
from geogs.tracking.flow.operator_choice import build_operator
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA, frames, pose

GUESS = Camera(180.0, 198.0, 103.5, 77.5, 208, 156)
FOCAL = 0.8 * np.array([180.0, 198.0])
CENTRE = np.array([GUESS.cx, GUESS.cy])
PAIRS = 24


def flows(
    rng: np.random.Generator, turn: float, way: np.ndarray, is_plane: bool = False
) -> list[tuple[int, FlowMatch]]:
    """Pairs of one grid: rotations of ``turn`` radians or so about any axis, translations of
    ``way`` or so; noise of 0.2 pixels, and a tenth of the matches wherever they like."""
    p = SampleGrid(GUESS).pixels.double().numpy()
    rays = np.c_[(p - CENTRE) / FOCAL, np.ones(len(p))]
    found = []
    for n in range(PAIRS):
        z = 3 / (rays @ [0.3, 0.2, 1.0]) if is_plane else rng.uniform(2, 5, len(p))
        R = Rotation.from_rotvec(rng.normal(size=3) * turn).as_matrix()
        X = z[:, None] * rays @ R.T + way * rng.uniform(0.5, 1.5)
        q = FOCAL * X[:, :2] / X[:, 2:] + CENTRE + rng.normal(size=p.shape) * 0.2
        astray = rng.random(len(p)) < 0.1
        q[astray] += rng.normal(size=p.shape)[astray] * 15
        seen = ((q > 0) & (q < [207, 155])).all(1)
        weight = np.repeat(seen[:, None], 2, 1)[None] * 10.0
        pixels = torch.from_numpy(q[None]).float()
        found.append((n // 2, FlowMatch(pixels, torch.from_numpy(weight).float())))
    return found


@pytest.mark.parametrize("way", [(0.3, 0.1, 0.0), (0.1, 0.0, 0.4), (-0.2, 0.2, -0.2)])
def test_finds_the_focal_length_of_a_camera_that_moves_and_turns(way):
    found = view_graph_estimate(GUESS, flows(np.random.default_rng(0), 0.1, np.array(way)))
    assert found is not None
    error = abs(found.camera.fx / FOCAL[0] - 1)
    print(f"{found.camera.fx:.2f} +- {100 * found.deviation:.2f} %, error {100 * error:.2f} %")
    assert error < 0.01
    assert LEAST_DEVIATION <= found.deviation < 0.03
    assert found.deviations[1] < 0.03
    assert found.camera.fy == pytest.approx(1.1 * found.camera.fx)
    assert (found.camera.cx, found.keyframes) == (GUESS.cx, PAIRS // 2)


def test_a_plane_and_a_camera_that_only_turns_tell_nothing():
    rng = np.random.default_rng(2)
    assert view_graph_estimate(GUESS, flows(rng, 0.1, np.array([0.3, 0.1, 0.1]), True)) is None
    assert view_graph_estimate(GUESS, flows(rng, 0.1, np.zeros(3))) is None


@pytest.mark.parametrize("way", [(0.0, 0.0, 0.4), (0.3, 0.0, 0.0)])
def test_a_camera_that_never_turns_leaves_it_unsure(way):
    found = view_graph_estimate(GUESS, flows(np.random.default_rng(3), 0.0, np.array(way)))
    assert found is None or found.deviation > UNRELIABLE


def test_few_pairs_are_not_believed():
    some = flows(np.random.default_rng(4), 0.1, np.array([0.3, 0.1, 0.0]))
    assert view_graph_estimate(GUESS, some[:8]) is None


@pytest.mark.system
def test_finds_the_focal_length_of_a_rendered_room():
    path = [
        pose(-0.5 + 0.04 * k, 0.1 * np.sin(0.5 * k), 0.3 * np.sin(0.2 * k), 0.35 * np.sin(0.3 * k))
        for k in range(0, 22, 2)
    ]
    guess = CAMERA.with_focal(1.5 * CAMERA.fx)
    grid = SampleGrid(guess)
    operator = build_operator(TrackingConfig(operator="classical"), grid)
    gatherer = ViewGatherer((f.image for f in frames(path)), grid, operator)
    gatherer.gather([], len(path), lambda: None)
    asked: list[None] = []
    matches = distant_flows(grid, operator, gatherer.views, lambda: asked.append(None))
    assert len(asked) == len({n for n, _ in matches}) == len(gatherer.views) - 1
    found = view_graph_estimate(guess, matches)
    assert found is not None
    error = abs(found.camera.fx / CAMERA.fx - 1)
    print(f"{found.camera.fx:.2f} +- {100 * found.deviation:.2f} %, error {100 * error:.2f} %")
    assert error < 0.02
    assert found.deviation < UNRELIABLE
