"""Parts in worlds of their own, links of which some are false, and what hangs together."""

import numpy as np
import torch

from geogs.geometry.lie import se3_exp, sim3_exp, sim3_inverse, sim3_log, sim3_scale
from geogs.world.loops import ImageFeatures, RelativePoses
from geogs_fleet.join.gauge import claim, common_gauge
from geogs_fleet.join.links import Link
from geogs_fleet.join.part import PartViews
from geogs_fleet.join.part_graph import Placement, placed

N = 10
FEATURES = ImageFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))


def poses(seed: int) -> torch.Tensor:
    """World to camera of a short walk."""
    random = torch.Generator().manual_seed(seed)
    steps = 0.1 * torch.randn(N, 6, generator=random, dtype=torch.float64)
    return torch.stack([se3_exp(step) for step in steps.cumsum(0)])


def part(seed: int, S: torch.Tensor, drift: float = 0.0) -> PartViews:
    """The walk in another world, to which ``S`` takes; its lengths drift along the way."""
    T, depth = poses(seed), float(2 * sim3_scale(S)) * torch.ones(N).double()
    centre = -(T[:, :3, :3].mT @ T[:, :3, 3:])[..., 0]
    moved = centre @ S[:3, :3].T + S[:3, 3]
    for k in range(1, N):
        moved[k:] += (drift * k / N) * (moved[k] - moved[k - 1])
    R = T[:, :3, :3] @ (S[:3, :3] / sim3_scale(S)).T
    own = torch.eye(4, dtype=torch.float64).repeat(N, 1, 1)
    own[:, :3, :3], own[:, :3, 3] = R, -(R @ moved[..., None])[..., 0]
    inverse = (1 / depth)[:, None].expand(N, 6).float().numpy()
    return PartViews(own.numpy(), np.arange(N) / 2.0, inverse, 0 * inverse, (FEATURES,) * N)


def link(a: int, i: int, b: int, j: int, worlds: list[torch.Tensor], wrong: float = 0.0) -> Link:
    """What two keyframes say of each other: the truth, or something else."""
    scale = sim3_scale(worlds[b]) / sim3_scale(worlds[a])
    T = poses(b)[j] @ torch.linalg.inv(poses(a)[i])
    S = T.clone()
    S[:3, :3] *= scale
    S[:3, 3] *= sim3_scale(worlds[b])
    noise = torch.randn(7, generator=torch.Generator().manual_seed(100 * i + j)).double()
    S = sim3_exp((wrong or 1e-6) * noise) @ S
    both = torch.tensor([0, 1])
    relative = RelativePoses(
        both, both.flip(0), torch.stack([S, sim3_inverse(S)]),
        torch.full((2, 7), 1e6, dtype=torch.float64), torch.ones(2, dtype=torch.bool),
    )  # fmt: skip
    return Link((a, i), (b, j), S, 0.5, relative)


def worlds_of(*seeds: int) -> list[torch.Tensor]:
    some = [sim3_exp(0.4 * torch.randn(7, generator=torch.Generator().manual_seed(s)).double())
            for s in seeds]  # fmt: skip
    return [torch.eye(4, dtype=torch.float64), *some]


def test_a_claim_takes_points_of_one_world_to_the_other():
    worlds = worlds_of(1)
    parts = [part(n, S) for n, S in enumerate(worlds)]
    assert torch.allclose(claim(parts, link(0, 2, 1, 5, worlds)), worlds[1], atol=1e-5)


def test_agreeing_links_tie_parts_and_false_ones_stay_out():
    worlds = worlds_of(1, 2, 3)
    parts = [part(n, S) for n, S in enumerate(worlds)]
    links = [
        link(0, 2, 1, 5, worlds), link(0, 3, 1, 6, worlds), link(0, 4, 1, 1, worlds, 0.8),
        link(1, 2, 2, 5, worlds), link(1, 7, 2, 6, worlds), link(1, 8, 2, 3, worlds),
        link(0, 1, 2, 1, worlds, 0.7),
        link(2, 1, 3, 1, worlds),
    ]  # fmt: skip
    gauge = common_gauge(parts, links)
    assert gauge.parts == [0, 1, 2]  # one link is not enough for the fourth
    for n in gauge.parts:
        assert sim3_log(gauge.world[n] @ sim3_inverse(worlds[n])).abs().max() < 1e-4
    assert [(k.first, k.second) for k in gauge.links] == [
        (k.first, k.second) for n, k in enumerate(links) if n in (0, 1, 3, 4, 5)
    ]


def test_of_several_worlds_the_largest_is_taken_and_a_lone_part_is_one():
    worlds = worlds_of(1, 2, 3, 4)
    parts = [part(n, S) for n, S in enumerate(worlds)]
    links = [link(0, i, 1, i, worlds) for i in (1, 2)]
    links += [link(a, i, a + 1, i, worlds) for a in (2, 3) for i in (1, 2)]
    gauge = common_gauge(parts, links)
    assert gauge.parts == [2, 3, 4]
    assert torch.equal(gauge.world[2], torch.eye(4, dtype=torch.float64))
    assert common_gauge(parts, []).parts == [0]


def test_the_graph_undoes_what_a_part_has_drifted():
    worlds = worlds_of(1)
    parts = [part(0, worlds[0]), part(0, worlds[1], drift=0.03)]
    links = [link_of_same(i, worlds, parts) for i in (0, 3, 6, 9)]
    gauge = common_gauge(parts, links)
    assert gauge.parts == [0, 1]
    found = placed(parts, gauge)
    assert torch.allclose(found[0].T_cw[0], poses(0)[0], atol=1e-9)
    rigid = torch.from_numpy(parts[1].T_cw) @ gauge.world[1]
    rigid[:, :3] /= sim3_scale(rigid)[:, None, None]
    # Both parts are as sure of themselves: they meet half way, at the same places.
    meeting = away(found[0].T_cw, found[1].T_cw)
    assert meeting < 0.6 * away(rigid)
    assert away(found[1].T_cw) < 0.75 * away(rigid)
    assert away(rigid) > 0.005


def link_of_same(i: int, worlds: list[torch.Tensor], parts: list[PartViews]) -> Link:
    """Both parts have the same walk: the keyframes are at one place."""
    scale = sim3_scale(worlds[1])
    S = torch.eye(4, dtype=torch.float64)
    S[:3, :3] *= scale
    made = link(0, i, 1, i, worlds)
    G = torch.stack([S, sim3_inverse(S)])
    relative = RelativePoses(
        made.relative.source, made.relative.target, G, made.relative.information,
        made.relative.is_loop,
    )  # fmt: skip
    return Link((0, i), (1, i), S, 0.5, relative)


def away(T_cw: torch.Tensor, other: torch.Tensor | None = None) -> float:
    """Root mean square distance of cameras from others, or from where they were."""
    two = (T_cw, poses(0) if other is None else other)
    centre, true = (-(T[:, :3, :3].mT @ T[:, :3, 3:])[..., 0] for T in two)
    return float((centre - true).square().sum(1).mean().sqrt())


def test_similarities_take_what_a_camera_sees_to_where_the_moved_camera_sees_it():
    before, after = poses(1), poses(2)
    scale = torch.linspace(0.5, 2, N).double()
    S = Placement(after, scale).similarities(before.numpy())
    for k in range(N):
        seen = torch.tensor([0.3, -0.2, 2.0]).double()
        world = torch.linalg.inv(before[k]) @ torch.cat([seen, torch.ones(1)])
        moved = torch.linalg.inv(after[k]) @ torch.cat([seen / scale[k], torch.ones(1)])
        assert torch.allclose(S[k] @ world, moved, atol=1e-9)
