"""Points beside a surface in whose place views see what lies far behind."""

import numpy as np
import torch

from geogs.depth.carve import (
    VOTE_CONFIDENCE,
    VOTE_FREE_VIEWS,
    VOTE_SUPPORT,
    VOTE_VIOLATION,
    look_up,
)
from geogs.depth.depth_view import DenseDepth, KeyframeDepth, PosedDepth
from geogs.depth.silhouettes import past_silhouettes
from geogs.geometry.camera import Camera

CAMERA = Camera(30.0, 30.0, 19.5, 14.5, 40, 30)


def posed(depth: np.ndarray, confidence: np.ndarray, shift: float = 0.0) -> PosedDepth:
    T_cw = np.eye(4)
    T_cw[0, 3] = shift
    maps = KeyframeDepth(depth.astype(np.float32), confidence.astype(np.float32))
    return PosedDepth(T_cw, DenseDepth.of(maps))


def one_by_one(centres: torch.Tensor, points: torch.Tensor, views: list[PosedDepth]) -> np.ndarray:
    free = np.zeros(points.shape[:2], bool)
    for n, centre in enumerate(centres):
        for m, point in enumerate(points[n]):
            both = torch.stack([centre, point]).numpy()
            says, surface = 0, 0
            for view in views:
                ratio, sure = look_up(both, view.T_cw, view.depth.arrays(), CAMERA)
                if sure[1] <= VOTE_CONFIDENCE:
                    continue
                on_surface = abs(ratio[0] - 1) < VOTE_VIOLATION
                says += int(on_surface and ratio[1] < 1 - VOTE_VIOLATION)
                surface += int(abs(ratio[1] - 1) < VOTE_SUPPORT)
            free[n, m] = says >= VOTE_FREE_VIEWS and says > surface
    return free


def test_votes_are_those_of_the_slow_way() -> None:
    random = np.random.default_rng(0)
    views = []
    for n in range(5):
        depth = np.where(random.random((30, 40)) < 0.5, 2.0, 2.5) * random.normal(1, 0.02, (30, 40))
        views.append(posed(depth, random.random((30, 40)) + 0.2, 0.1 * n))
    centres = torch.from_numpy(random.normal([0, 0, 2], [0.8, 0.6, 0.08], (300, 3))).float()
    points = centres[:, None] + torch.from_numpy(random.normal(0, 0.1, (300, 4, 3))).float()
    found = past_silhouettes(centres, points, views, CAMERA).numpy()
    assert np.array_equal(found, one_by_one(centres, points, views))
    assert 0.02 < found.mean() < 0.5


def a_step(near_at: int) -> np.ndarray:
    """A thing at 2 before a wall at 3, from a column on."""
    return np.where(np.arange(40) >= near_at, 2.0, 3.0)[None].repeat(30, 0)


def test_only_what_lies_past_the_silhouette_of_the_own_surface_is_free() -> None:
    sure = np.ones((30, 40))
    views = [posed(a_step(20), sure)] * 3
    on_thing, beside = torch.tensor([0.2, 0.0, 2.0]), torch.tensor([-0.3, 0.0, 2.0])
    in_between = torch.tensor([-0.5, 0.0, 2.5])  # on neither surface
    centres = torch.stack([on_thing, in_between])
    points = torch.stack([beside, on_thing, beside]).expand(2, 3, 3)
    free = past_silhouettes(centres, points, views, CAMERA)
    assert free.tolist() == [[True, False, True], [False, False, False]]


def test_one_view_alone_or_unsure_ones_say_nothing() -> None:
    sure, unsure = np.ones((30, 40)), np.full((30, 40), 0.4)
    centre, beside = torch.tensor([[0.2, 0.0, 2.0]]), torch.tensor([[[-0.3, 0.0, 2.0]]])
    alone = [posed(a_step(20), sure), *[posed(a_step(20), unsure)] * 4]
    assert not past_silhouettes(centre, beside, alone, CAMERA).any()
    outvoted = [*[posed(a_step(20), sure)] * 2, *[posed(a_step(5), sure)] * 2]
    assert not past_silhouettes(centre, beside, outvoted, CAMERA).any()
