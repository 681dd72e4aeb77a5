"""The tracker with monocular priors on a room whose walls have no texture."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch

from degraded_prior import BAD, PATCHY, PLAUSIBLE, DegradedPrior, with_bare_walls
from geogs.config import Config, PriorConfig, TrackingConfig
from geogs.geometry.camera import Camera
from geogs.geometry.umeyama import umeyama
from geogs.loop.global_bundle import global_bundle
from geogs.priors.monocular_prior import DepthKind, PriorMaps
from geogs.tracking.flow.cell_texture import MIN_STRUCTURE, cell_structure
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import Frame, PoseCorrection
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from handheld_walk import handheld_trajectory
from lit_rooms import lit_room

pytestmark = pytest.mark.system

CAMERA = Camera(163.5, 163.5, 95.5, 71.5, 192, 144)
CONFIG = TrackingConfig(init_keyframes=6)
FRAMES = 28


@dataclass(frozen=True)
class Score:
    """Keyframes' RMSE in cm; mean relative depth error of all cells, of those without texture."""

    ate: float
    depth: float
    bare: float


@pytest.fixture(scope="module")
def walk() -> tuple[list[RenderedView], np.ndarray]:
    scene = with_bare_walls(lit_room(0).scene)
    T_wc = handheld_trajectory(scene, FRAMES)
    caster = Raycaster(scene)
    return [caster.render(CAMERA, T) for T in T_wc], T_wc


def track(views: list[RenderedView], prior, config: PriorConfig | None = None) -> Tracker:
    tracker = lone_tracker(
        CAMERA, Config(tracking=CONFIG, prior=config or PriorConfig()), prior=prior
    )
    for n, view in enumerate(views):
        tracker.track(Frame(n, n / 30, view.image))
    tracker.finish()
    return tracker


def score(tracker: Tracker, walk: tuple[list[RenderedView], np.ndarray]) -> Score:
    views, T_wc = walk
    keyframes = [tracker.keyframes[k] for k in tracker.segment.ids]
    x = torch.stack([torch.linalg.inv(k.T_cw)[:3, 3] for k in keyframes])
    y = torch.from_numpy(T_wc[[k.frame_index for k in keyframes], :3, 3])
    scale, R, t = umeyama(x, y)
    ate = 100 * float((scale * x @ R.T + t - y).square().sum(1).mean().sqrt())
    errors, bare = [], []
    for k in keyframes[1:-1]:
        true = views[k.frame_index].depth[4:-3:8, 4:-3:8]
        errors.append(np.abs(float(scale) / k.depth_field()[0] / true - 1).ravel())
        bare.append(
            cell_structure(cv2.cvtColor(k.image, cv2.COLOR_RGB2GRAY)).smaller < MIN_STRUCTURE
        )
    error, where = np.concatenate(errors), np.concatenate(bare)
    assert 0.2 < where.mean() < 0.6
    return Score(ate, float(error.mean()), float(error[where].mean()))


@pytest.fixture(scope="module")
def alone(walk) -> Score:
    return score(track(walk[0], None), walk)


@pytest.fixture(scope="module")
def helped(walk) -> Tracker:
    return track(walk[0], DegradedPrior(walk[0], PLAUSIBLE))


def test_a_good_prior_gives_bare_walls_their_depth(walk, alone: Score, helped: Tracker):
    good = score(helped, walk)
    assert good.bare < 0.8 * alone.bare
    assert good.depth < 0.9 * alone.depth
    assert good.ate < 1.25 * alone.ate  # half a millimetre either way


@pytest.mark.long
def test_a_prior_known_up_to_a_shift_helps_as_well(walk, alone: Score):
    prior = DegradedPrior(walk[0], PLAUSIBLE, DepthKind.AFFINE_INVERSE)
    assert score(track(walk[0], prior), walk).bare < 0.8 * alone.bare


@pytest.mark.long
def test_a_bad_prior_costs_little(walk, alone: Score):
    bad = score(track(walk[0], DegradedPrior(walk[0], BAD)), walk)
    assert bad.ate < 1.2 * alone.ate
    assert bad.bare < 1.2 * alone.bare
    patchy = score(track(walk[0], DegradedPrior(walk[0], PATCHY)), walk)
    assert patchy.ate < 1.2 * alone.ate
    assert patchy.depth < 1.1 * alone.depth


def test_the_prior_adds_little_information_and_only_where_it_is_needed(walk, helped: Tracker):
    views, _ = walk
    told, alone, bare = [], [], []
    for id in helped.segment.ids[1:-1]:
        state, k = helped.keyframes[id], helped.keyframes[id]
        d = state.inverse_depth
        told.append(1 / (d * k.confident_information.clamp(min=1e-9).sqrt()))
        alone.append(1 / (d * state.information.clamp(min=1e-9).sqrt()))
        grey = cv2.cvtColor(views[k.frame_index].image, cv2.COLOR_RGB2GRAY)
        bare.append(torch.from_numpy(cell_structure(grey).smaller < 0.05))
    told, alone, bare = (torch.cat(v) for v in (told, alone, bare))
    assert float(alone[bare].median()) > 0.15
    assert 0.02 < float(told[bare].median()) < 0.3
    sure = alone < 0.01
    assert float((told / alone)[sure].min()) > 0.9


def test_scales_follow_the_unit(walk, helped: Tracker):
    """After a correction that halves lengths, prior and depth still say the same."""
    id = helped.segment.ids[-2]
    state = helped.keyframes[id]
    before = state.inverse_depth.clone(), state.prior.scale.clone(), state.prior.information.clone()
    poses = {id: state.T_cw.clone()}
    helped.keyframes.correct(PoseCorrection(poses, poses, {id: 2.0}))
    torch.testing.assert_close(state.inverse_depth, 2 * before[0])
    torch.testing.assert_close(state.prior.scale, 2 * before[1])
    torch.testing.assert_close(state.prior.information, before[2] / 4)
    helped.keyframes.correct(PoseCorrection(poses, poses, {id: 0.5}))
    torch.testing.assert_close(state.prior.scale, before[1])


def test_global_adjustment_keeps_what_the_prior_gave(walk, alone: Score, helped: Tracker):
    global_bundle(helped)
    assert score(helped, walk).bare < 0.8 * alone.bare


class _Normals:
    """Says nothing of depth."""

    def predict(self, image):
        normal = torch.zeros(*image.shape[:2], 3)
        normal[..., 2] = -1
        return PriorMaps(normal=normal)


@pytest.mark.long
def test_normals_reach_the_keyframes_and_leave_depth_alone(walk):
    views = walk[0][:20]
    without, normals = track(views, None), track(views, _Normals())
    assert len(without.segment.ids) >= 6
    assert without.segment.ids == normals.segment.ids
    for id in without.segment.ids:
        a, b = without.keyframes[id], normals.keyframes[id]
        assert torch.equal(a.inverse_depth, b.inverse_depth)
        assert torch.equal(a.T_cw, b.T_cw)
        assert a.prior_normal is None
        assert b.prior_normal.shape == (144, 192, 3)
