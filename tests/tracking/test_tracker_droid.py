"""The tracker on DROID-SLAM's operator, with a network that knows the true flow."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geogs.bundle.projection import project
from geogs.config import Config, TrackingConfig
from geogs.loop.global_bundle import global_bundle
from geogs.tracking.flow.droid import DroidFlow
from geogs.tracking.flow.droid_network import DroidNetwork, EdgeOutput, on_cells
from geogs.tracking.flow.network_parts import cell_positions
from geogs.tracking.tracker import lone_tracker
from geogs.world.grid import SampleGrid
from tracking_runs import error_cm
from tracking_scenes import CAMERA, frames, render, sideways

pytestmark = pytest.mark.system

GRID = SampleGrid(CAMERA)
CONFIG = TrackingConfig(init_keyframes=5, window=4)
ROWS, COLUMNS = GRID.height, GRID.width


class KnowingUpdate:
    """Goes most of the way from where it looks to the true position."""

    def __init__(self, path: list[np.ndarray]) -> None:
        self.T_cw = torch.from_numpy(np.linalg.inv(np.stack(path)))
        depth = np.stack([render(T)[1][4:-3:8, 4:-3:8].reshape(-1) for T in path])
        self.inverse_depth = torch.from_numpy(1 / depth).float()

    def __call__(self, hidden, static, correlation, motion) -> EdgeOutput:
        source = static[:, 0, 0, 0]
        # The product of both frames' numbers, wherever some cell still looks into the image.
        target = 16 * correlation.flatten(1).amax(1) / source
        at = cell_positions(ROWS, COLUMNS, motion) + motion[:, :2].permute(0, 2, 3, 1)
        pairs = zip(source.tolist(), target.tolist(), strict=True)
        truth = torch.stack([self.truth(round(a) - 1, round(b) - 1) for a, b in pairs])
        delta = 0.8 * (truth - at).permute(0, 3, 1, 2)
        return EdgeOutput(hidden, delta, torch.full_like(delta, 0.9))

    def truth(self, a: int, b: int) -> torch.Tensor:
        """Position in frame b of the cells of frame a, in cells."""
        T = (self.T_cw[b] @ torch.linalg.inv(self.T_cw[a]))[None]
        pixels = project(CAMERA, GRID.rays, T, self.inverse_depth[a][None]).pixels
        return ((pixels - 4) / 8).reshape(ROWS, COLUMNS, 2)

    def agg(self, hidden, source) -> torch.Tensor:
        found = source.unique()
        return torch.full((len(found), ROWS, COLUMNS), 1e-6)


class KnowingNetwork:
    """Frames are told apart by their images; features are the number of the frame plus one."""

    def __init__(self, path: list[np.ndarray]) -> None:
        self.update = KnowingUpdate(path)
        images = [torch.from_numpy(render(T)[0]).permute(2, 0, 1)[None] / 255 for T in path]
        self.number = {on_cells(x).numpy().tobytes(): k + 1.0 for k, x in enumerate(images)}

    def features(self, shown: torch.Tensor) -> torch.Tensor:
        return torch.full((1, 1, ROWS, COLUMNS), self.number[shown.numpy().tobytes()])

    def context(self, shown: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        number = self.features(shown)
        return 0 * number, number


@pytest.fixture(scope="module")
def tracked() -> SimpleNamespace:
    path = sideways(30, step=0.04)
    operator = DroidFlow(GRID, DroidNetwork(2))
    operator.network = KnowingNetwork(path)
    tracker = lone_tracker(CAMERA, Config(tracking=CONFIG), operator=operator)
    for frame in frames(path):
        tracker.track(frame)
    tracker.finish()
    return SimpleNamespace(tracker=tracker, path=path, edges=dict(tracker.map.graph.edges))


def test_the_tracker_follows_a_network_that_is_right(tracked):
    """All between network and tracker: cells, directions, starts, confidence, damping."""
    trajectory = tracked.tracker.trajectory()
    assert trajectory.tracked.all()
    truth = np.stack(tracked.path)[:, :3, 3]
    assert error_cm(trajectory.T_wc[:, :3, 3], truth) < 0.05
    global_bundle(tracked.tracker)
    assert error_cm(tracked.tracker.trajectory().T_wc[:, :3, 3], truth) < 0.05


def test_memory_does_not_pile_up(tracked):
    """Only edges of the window that is still adjusted keep their hidden states."""
    kept = [e for e, v in tracked.edges.items() if v.memory is not None]
    moving = set(tracked.tracker.segment.ids[-CONFIG.window :])
    assert len(tracked.tracker.segment.ids) > 8
    assert 10 < len(kept) < 0.7 * len(tracked.edges)
    assert all(moving & set(e) for e in kept)
