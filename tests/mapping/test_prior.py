"""A prior's normals on their way into the losses of mapping."""

import logging

import numpy as np
import pytest
import torch

from geogs.config import LossConfig, PriorConfig
from geogs.depth.depth_view import DenseDepth, KeyframeDepth
from geogs.geometry.camera import Camera
from geogs.losses.cpu.fused import fused_single_view
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.view_arrays import MapCameras
from geogs.priors.monocular_prior import PriorMaps
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.keyframes.segment_map import KeyframePriors
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe, KeyframeTable
from keyframe_samples import Sample, segment_of, views_of
from oracles.single_view_reference import single_view_loss

WORKING = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
CAMERAS = MapCameras(WORKING, WORKING.with_long_edge(48), WORKING)
OFF = LossConfig(normal_weight=0.0)


def keyframe(normal: torch.Tensor | None) -> Keyframe:
    image = np.random.default_rng(0).integers(0, 255, (72, 96, 3), np.uint8)
    (made,) = segment_of([Sample(0, image, torch.eye(4, dtype=torch.float64))], WORKING)
    if normal is not None:
        made.prior_normal = normal
    return made


def normals() -> torch.Tensor:
    """Left half faces the camera, right half is turned by 60 degrees; the first rows are unknown.

    In half precision, as the tracker keeps them.
    """
    normal = torch.zeros(72, 96, 3)
    normal[:, :48] = torch.tensor([0.0, 0.0, -1.0])
    normal[:, 48:] = torch.tensor([0.0, -(0.75**0.5), -0.5])
    normal[:8] = 0
    return normal.half()


def view(normal: torch.Tensor | None, loss: LossConfig) -> MapView:
    pool = views_of(keyframe(normal).table, CAMERAS, loss)
    made = pool.add(0)
    depth = KeyframeDepth(np.full((36, 48), 2.0, np.float32), np.full((36, 48), 0.5, np.float32))
    for _ in range(2):  # a depth that is replaced keeps what does not depend on it
        made.set_depth(DenseDepth.of(depth))
    return made


def test_normals_reach_the_losses_at_their_size():
    prior = view(normals(), LossConfig()).constants.prior_normal
    assert prior is not None
    assert prior.shape == (36, 48, 3)
    assert float(prior[:4].abs().max()) == 0
    torch.testing.assert_close(prior[5:, :24], torch.tensor([0.0, 0.0, -1.0]).expand(31, 24, 3))
    turned = torch.tensor([0.0, -(0.75**0.5), -0.5]).expand(31, 23, 3)
    torch.testing.assert_close(prior[5:, 25:], turned, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("normal", "loss"), [(None, LossConfig()), (normals(), OFF)])
def test_without_normals_or_weight_there_is_no_term(normal: torch.Tensor | None, loss: LossConfig):
    assert view(normal, loss).constants.prior_normal is None


def test_the_term_is_the_paper_s():
    """Against |N - N_f|_1 by hand, on both paths: a map that faces the camera everywhere."""
    maps = torch.full((36, 48), 2.0), torch.tensor([0.0, 0.0, -1.0]).expand(36, 48, 3)
    maps = (*maps, torch.full((36, 48), 0.99), torch.zeros(36, 48))
    known = view(normals(), LossConfig()).constants
    prior = known.prior_normal
    error = (maps[1] - prior).abs().sum(-1) * (prior.square().sum(-1) > 0)
    expected = LossConfig().normal_weight * float(error.mean())
    assert expected > 0.02
    for loss in (single_view_loss, fused_single_view):
        with_term = loss(*maps, known, LossConfig(), 1.0)
        without = loss(*maps, known, OFF, 1.0)
        assert float(with_term - without) == pytest.approx(expected, rel=1e-3)


def test_normals_that_face_away_are_dropped_with_a_warning(caplog):
    class Backwards:
        def predict(self, image):
            normal = -normals().float()
            normal[:, :10] *= -1
            return PriorMaps(normal=normal)

    grid = SampleGrid(WORKING)
    store = KeyframeTable.on(grid).new_set()
    operator = ClassicalFlow(grid)
    priors = KeyframePriors(FrameGraph(store, operator), Backwards(), PriorConfig())
    image = keyframe(None).image
    for n in range(2):
        state = store.add(n, 0.1 * n, image, operator.encode(image), torch.eye(4).double())
        with caplog.at_level(logging.WARNING, "geogs"):
            priors.ask(state)
    assert state.prior is None
    assert state.prior_normal.dtype == torch.float16
    assert float(state.prior_normal[:, 10:48].abs().max()) == 0
    torch.testing.assert_close(state.prior_normal[20, 5].tolist(), [0.0, 0.0, -1.0])
    assert [r.message for r in caplog.records] == [
        "Most prior normals face away from the camera; check their normal_axes."
    ]
