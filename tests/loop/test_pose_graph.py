"""The Sim(3) pose graph: derivatives, a drifting corridor closed by loops, and false loops."""

import math
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch

from geogs.bundle.projection import linearise, relative_motion
from geogs.geometry.camera import Camera
from geogs.geometry.lie import (
    retract,
    se3_exp,
    se3_inverse,
    sim3_adjoint,
    sim3_exp,
    sim3_inverse,
    sim3_left_jacobian,
    sim3_log,
    sim3_scale,
    sim3_small_adjoint,
)
from geogs.geometry.umeyama import umeyama
from geogs.loop import matched_edges, pose_graph
from geogs.loop.closure import (
    AGREEMENT,
    ClosingQuestion,
    LoopClosure,
    close_loops,
    consistent_loops,
    cycle_errors,
)
from geogs.loop.constraints import joined, relative_poses
from geogs.loop.matched_edges import GraphState, MatchedEdges
from geogs.loop.pose_graph import (
    PoseGraph,
    PoseGraphResult,
    pose_correction,
    relative_errors,
    relative_jacobians,
    solve,
)
from geogs.mapping.map_update import anchor_transforms
from geogs.world.grid import SampleGrid
from geogs.world.loops import RelativePoses
from oracles.pose_graph_reference import gauss_newton_step, match_residuals, relative_residuals

F64 = torch.float64
KEYFRAMES = 200
ODOMETRY = torch.tensor([0.002] * 3 + [0.0003] * 3 + [0.0008], dtype=F64)
"""Standard deviation of a step; the corridor's steps are about 0.3 long."""
LOOP = torch.tensor([0.01] * 3 + [0.002] * 3 + [0.004], dtype=F64)


def noise(n: int, deviation: torch.Tensor, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return deviation * torch.randn(n, len(deviation), generator=g, dtype=F64)


def looking(centre: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """World to camera of cameras at places (n, 3) that look along a yaw about the y axis."""
    R = se3_exp(torch.stack([yaw * 0] * 4 + [-yaw, yaw * 0], -1))
    T = R.clone()
    T[:, :3, 3] = -(R[:, :3, :3] @ centre[..., None])[..., 0]
    return T


def corridor() -> torch.Tensor:
    """World to camera along a round corridor that ends in its own first twentieth, waving."""
    turn = torch.linspace(0, 2 * math.pi * 1.05, KEYFRAMES, dtype=F64)
    wave = 0.1 * torch.sin(9.3 * turn)
    centre = torch.stack([12 * torch.sin(turn), wave, 8 * (1 - torch.cos(turn))], -1)
    return looking(centre, torch.atan2(12 * torch.cos(turn), 8 * torch.sin(turn)))


@dataclass(frozen=True, eq=False)
class Drive:
    """A corridor as a drifting tracker saw it."""

    truth: torch.Tensor
    units: torch.Tensor
    """S_i of the truth: world to camera in the keyframe's unit."""
    T_cw: torch.Tensor
    odometry: RelativePoses


@cache
def drive(drift: float = 0.05, noisy: float = 1.0, seed: int = 0) -> Drive:
    truth = corridor()
    unit = torch.exp(math.log(1 + drift) * torch.arange(KEYFRAMES) / (KEYFRAMES - 1)).double()
    S = truth.clone()
    S[:, :3] *= unit[:, None, None]
    i = torch.arange(KEYFRAMES - 1)
    i, j = torch.cat([i, i[:-1]]), torch.cat([i + 1, i[:-1] + 2])
    G = S[j] @ sim3_inverse(S[i])
    G[:, :3, :3] /= sim3_scale(G)[:, None, None]  # a tracker sees no change of scale
    deviation = ODOMETRY.clone()
    xi = noisy * noise(len(G), deviation, seed)
    xi[:, 6] = 0
    G = se3_exp(xi[:, :6]) @ G
    T = [S[0]]
    for k in range(KEYFRAMES - 1):
        T.append(G[k] @ T[-1])
    information = (1 / deviation.square()).expand(len(G), 7).clone()
    return Drive(
        truth,
        S,
        torch.stack(T),
        RelativePoses(i, j, G, information, torch.zeros(len(G), dtype=torch.bool)),
    )


def loops(d: Drive, count: int, noisy: float = 1.0, seed: int = 1) -> RelativePoses:
    """True loops between the last and the first keyframes."""
    n = torch.arange(count)
    i, j = n % 10, KEYFRAMES - 10 + (n * 7) % 10 - (n // 10) % 2
    i, j = torch.where(n % 3 == 1, j, i), torch.where(n % 3 == 1, i, j)  # in either direction
    G = sim3_exp(noisy * noise(count, LOOP, seed)) @ d.units[j] @ sim3_inverse(d.units[i])
    return as_loops(i, j, G)


def as_loops(i: torch.Tensor, j: torch.Tensor, G: torch.Tensor) -> RelativePoses:
    information = (1 / LOOP.square()).expand(len(G), 7).clone()
    return RelativePoses(i, j, G, information, torch.ones(len(G), dtype=torch.bool))


def random_loops(count: int, seed: int = 2) -> RelativePoses:
    """Wrong in every respect: anywhere in the corridor, at any angle."""
    g = torch.Generator().manual_seed(seed)
    i = torch.randint(0, KEYFRAMES // 2, (count,), generator=g)
    j = i + torch.randint(30, KEYFRAMES // 2, (count,), generator=g)
    size = torch.tensor([1.0] * 3 + [0.7] * 3 + [0.05], dtype=F64)
    return as_loops(i, j, sim3_exp(noise(count, size, seed)))


def twin_room(d: Drive, count: int, seed: int = 3) -> RelativePoses:
    """The middle taken for the start, by all in the same way."""
    n = torch.arange(count)
    i, j = n % 8, KEYFRAMES // 2 + (n * 3) % 8
    world = sim3_exp(torch.tensor([0.4, 0.1, -0.3, 0.02, 0.1, 0.01, 0.01], dtype=F64))
    moved = d.T_cw[j] @ se3_inverse(d.T_cw[KEYFRAMES // 2])[None] @ d.T_cw[:1]
    G = sim3_exp(noise(count, LOOP, seed)) @ moved @ world @ se3_inverse(d.T_cw[i])
    return as_loops(i, j, G)


def next_bay(d: Drive, count: int, seed: int = 4) -> RelativePoses:
    """The start seen again, but a bay of a repeating wall further: odometry cannot tell."""
    n = torch.arange(count)
    i, j = n % 10, KEYFRAMES - 10 + (n * 3) % 10
    bay = sim3_exp(torch.tensor([0.25, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0], dtype=F64))
    G = sim3_exp(noise(count, LOOP, seed)) @ d.units[j] @ bay @ sim3_inverse(d.units[i])
    return as_loops(i, j, G)


def first_fixed(n: int) -> torch.Tensor:
    return torch.arange(n) == 0


def close(d: Drive, *extra: RelativePoses) -> tuple[PoseGraphResult, torch.Tensor]:
    """Vote, adjust; the result, and which loops were voted for."""
    relative = joined([d.odometry, *extra])
    keep = consistent_loops(d.T_cw, relative)
    result = solve(PoseGraph(d.T_cw, relative.select(keep), first_fixed(KEYFRAMES)))
    return result, keep[relative.is_loop]


@cache
def twenty_true_loops() -> tuple[PoseGraphResult, torch.Tensor]:
    """What is found without any false loop."""
    return close(drive(), loops(drive(), 20))


def centres(S: torch.Tensor) -> torch.Tensor:
    return sim3_inverse(S)[:, :3, 3]


def ate(d: Drive, S: torch.Tensor) -> float:
    """Root mean square distance to the true places after the best similarity."""
    source, target = centres(S), centres(d.truth)
    s, R, t = umeyama(source, target)
    return float((s * source @ R.mT + t - target).square().sum(1).mean().sqrt())


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.1, 2.0])
def test_left_jacobian_of_sim3(size):
    xi = size * noise(5, torch.ones(7, dtype=F64), 0) / 2
    assert torch.allclose(
        torch.linalg.matrix_exp(sim3_small_adjoint(xi)), sim3_adjoint(sim3_exp(xi)), atol=1e-9
    )
    for x, J in zip(xi, sim3_left_jacobian(xi), strict=True):
        back = sim3_inverse(sim3_exp(x))

        def step(d, x=x, back=back):
            return sim3_log(sim3_exp(x + d) @ back)

        numeric = torch.autograd.functional.jacobian(step, torch.zeros(7, dtype=F64))
        torch.testing.assert_close(J, numeric, rtol=1e-7, atol=1e-8)


def small_graph(seed: int = 0) -> PoseGraph:
    n = 5
    T = se3_exp(noise(n, torch.tensor([1.0] * 3 + [0.3] * 3, dtype=F64), seed))
    i, j = torch.tensor([0, 1, 2, 3, 0]), torch.tensor([1, 2, 3, 4, 3])
    size = torch.tensor([0.3] * 3 + [0.2] * 3 + [0.1], dtype=F64)
    G = sim3_exp(noise(len(i), size, seed + 1)) @ T[j] @ se3_inverse(T[i])
    information = 1 + noise(len(i), torch.ones(7, dtype=F64), seed + 2).abs()
    relative = RelativePoses(i, j, G, information, torch.zeros(len(i), dtype=torch.bool))
    return PoseGraph(T, relative, first_fixed(n))


def test_relative_jacobians_match_autograd_and_finite_differences():
    graph = small_graph()
    S = sim3_exp(noise(5, torch.full((7,), 0.3, dtype=F64), 7)) @ graph.start
    fast = relative_jacobians(graph.relative, relative_errors(S, graph.relative))
    zero = torch.zeros(5, 7, dtype=F64)
    exact = torch.func.jacrev(lambda x: relative_residuals(graph.relative, S, x))(zero)
    for e in range(len(graph.relative)):
        for J, end in zip(fast, (graph.relative.source, graph.relative.target), strict=True):
            k = int(end[e])
            torch.testing.assert_close(J[e], exact[e, :, k], rtol=1e-8, atol=1e-9)
            for c in range(7):
                step = zero.clone()
                step[k, c] = 1e-6
                after, before = (
                    relative_errors(retract(x, S), graph.relative) for x in (step, -step)
                )
                torch.testing.assert_close(
                    J[e, :, c], (after - before)[e] / 2e-6, rtol=1e-6, atol=1e-7
                )


CAMERA = Camera(fx=70.0, fy=72.0, cx=39.0, cy=29.0, width=80, height=60)


def small_matches(T: torch.Tensor, dtype: torch.dtype = F64) -> MatchedEdges:
    """Edges between neighbours in both directions, with a pixel of noise."""
    g = torch.Generator().manual_seed(5)
    grid = SampleGrid(CAMERA)
    rays = grid.rays.to(dtype)
    i, j = torch.tensor([0, 1, 1, 2, 2, 3, 4]), torch.tensor([1, 0, 2, 1, 3, 2, 0])
    d = 0.2 + 0.1 * torch.rand(len(T), grid.size, generator=g, dtype=dtype)
    S = T[j] @ sim3_inverse(T[i])
    y = rays @ S[:, :3, :3].mT.to(dtype) + d[i][..., None] * S[:, None, :3, 3].to(dtype)
    pixels = CAMERA.project(y)[0]
    pixels = pixels + torch.randn(pixels.shape, generator=g, dtype=dtype)
    weight = 0.5 + torch.rand(pixels.shape, generator=g, dtype=dtype)
    return MatchedEdges(CAMERA, rays, d, i, j, pixels, weight)


def near_cameras() -> torch.Tensor:
    return se3_exp(noise(5, torch.tensor([0.3] * 3 + [0.1] * 3, dtype=F64), 11))


def test_reprojection_jacobians_match_autograd_and_finite_differences():
    S = sim3_exp(noise(5, torch.full((7,), 0.1, dtype=F64), 3)) @ near_cameras()
    m = small_matches(S)
    S_ji = S[m.target] @ sim3_inverse(S[m.source])
    d = m.inverse_depth
    p = linearise(CAMERA, m.rays, S_ji, d[m.source])
    # The solver never forms the source's; it chains reduced blocks by the same adjoint.
    J, J_d = p.pose_jacobian.permute(0, 3, 2, 1), p.depth_jacobian
    J_i, J_j = -J @ sim3_adjoint(S_ji)[:, None, :6], torch.nn.functional.pad(J, (0, 1))
    zero = torch.zeros(5, 7, dtype=F64), torch.zeros_like(d)
    by_pose, by_depth = torch.func.jacrev(lambda x, y: -match_residuals(m, S, x, y), (0, 1))(*zero)
    assert J_i[..., 6].abs().max() > 1  # the column that a wrong adjoint sets to zero
    for e, (i, j) in enumerate(zip(m.source.tolist(), m.target.tolist(), strict=True)):
        torch.testing.assert_close(J_i[e], by_pose[e, :, :, i], rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(J_j[e], by_pose[e, :, :, j], rtol=1e-8, atol=1e-8)
        own = torch.stack([by_depth[e, p, :, i, p] for p in range(d.shape[1])])
        torch.testing.assert_close(J_d[e], own, rtol=1e-8, atol=1e-8)
        for k, J in ((i, J_i), (j, J_j)):
            for c in range(7):
                step = zero[0].clone()
                step[k, c] = 1e-6
                two = [match_residuals(m, S, x, zero[1])[e] for x in (-step, step)]
                numeric = (two[0] - two[1]) / 2e-6
                torch.testing.assert_close(J[e, :, :, c], numeric, rtol=1e-5, atol=1e-5)


def test_a_step_matches_the_reference(monkeypatch):
    graph = small_graph()
    T = near_cameras()
    matches = small_matches(T)
    relative = replace(
        graph.relative, G=T[graph.relative.target] @ se3_inverse(T[graph.relative.source])
    )
    relative = replace(
        relative, G=sim3_exp(noise(5, torch.full((7,), 0.01, dtype=F64), 9)) @ relative.G
    )
    graph = replace(graph, start=T, matches=matches, relative=relative)
    monkeypatch.setattr(pose_graph, "STEPS", 1)
    monkeypatch.setattr(pose_graph, "DAMPING", 1e-3)
    monkeypatch.setattr(matched_edges, "FACTOR", 0.01)
    monkeypatch.setattr(matched_edges, "CHUNK", 2)
    fast = solve(graph)
    xi, delta = gauss_newton_step(graph, 1e-3)
    torch.testing.assert_close(fast.S, retract(xi, T), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(
        fast.inverse_depth, matches.inverse_depth + delta, rtol=1e-6, atol=1e-7
    )


def test_exact_recovery_without_noise():
    d = drive(noisy=0.0)
    exact = replace(
        d.odometry, G=d.units[d.odometry.target] @ sim3_inverse(d.units[d.odometry.source])
    )
    start = replace(d, odometry=exact)
    result, kept = close(start, loops(d, 5, noisy=0.0))
    assert kept.all()
    assert ate(d, d.T_cw) > 0.05
    assert ate(d, result.S) < 1e-6
    torch.testing.assert_close(sim3_scale(result.S), sim3_scale(d.units), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("count", "factor"), [(1, 5), (5, 10), (20, 12)])
def test_a_loop_removes_the_drift_of_a_corridor(count, factor):
    d = drive()
    result, kept = twenty_true_loops() if count == 20 else close(d, loops(d, count))
    assert kept.all()
    assert ate(d, d.T_cw) > factor * ate(d, result.S)
    ratio = sim3_scale(result.S) / sim3_scale(d.units)
    assert (ratio / ratio.mean() - 1).abs().max() < 0.012  # of the planted 0.05


FALSE = {
    "random 5 %": lambda d: [random_loops(1)],
    "random 20 %": lambda d: [random_loops(5)],
    "random 50 %": lambda d: [random_loops(20)],
    "twin room": lambda d: [twin_room(d, 15)],
    "next bay": lambda d: [next_bay(d, 12)],
    "twin room, next bay and random": lambda d: [twin_room(d, 8), next_bay(d, 8), random_loops(8)],
}


@pytest.mark.parametrize("name", FALSE)
def test_false_loops_are_outvoted(name):
    d = drive()
    clean, _ = twenty_true_loops()
    result, kept = close(d, loops(d, 20), *FALSE[name](d))
    assert kept[:20].all()
    assert not kept[20:].any()
    assert ate(d, result.S) <= 1.2 * ate(d, clean.S)


def test_odometry_alone_could_not_tell_the_next_bay():
    d = drive()
    relative = joined([d.odometry, loops(d, 20), next_bay(d, 12)])
    pairs, alone = cycle_errors(d.T_cw, relative)
    assert alone.max() < AGREEMENT
    assert pairs[20:, 20:].max() < AGREEMENT  # they support each other
    assert pairs[:20, 20:].min() > AGREEMENT


def test_the_kernel_alone_resists_random_loops():
    d = drive()
    relative = joined([d.odometry, loops(d, 20), random_loops(20)])
    result = solve(PoseGraph(d.T_cw, relative, first_fixed(KEYFRAMES)))
    clean, _ = twenty_true_loops()
    weight = result.loop_weight[relative.is_loop]
    assert weight[:20].min() > 0.3
    assert weight[20:].max() < 0.01
    assert ate(d, result.S) <= 1.2 * ate(d, clean.S)


def test_the_vote_forgives_odometry_that_is_too_sure_of_itself():
    d = drive()
    relative = joined([d.odometry, loops(d, 20), random_loops(10), next_bay(d, 12)])
    sure = torch.where(relative.is_loop[:, None], 1.0, 10.0) * relative.information
    keep = consistent_loops(d.T_cw, replace(relative, information=sure))[relative.is_loop]
    assert keep[:20].all()
    assert not keep[20:].any()


def test_the_result_is_the_same_every_time():
    d = drive()
    before, (again, _) = twenty_true_loops()[0], close(d, loops(d, 20))
    assert torch.equal(before.S, again.S)


def test_the_correction_carries_what_a_camera_sees_to_the_same_place():
    d = drive()
    result, _ = close(d, loops(d, 5))
    ids = [2 * k + 3 for k in range(KEYFRAMES)]
    correction = pose_correction(ids, d.T_cw, result.S)
    _, world = anchor_transforms(correction)
    torch.testing.assert_close(world, sim3_inverse(result.S) @ d.T_cw, rtol=1e-9, atol=1e-9)
    after = torch.stack([correction.after[k] for k in ids])
    torch.testing.assert_close(centres(after), centres(result.S), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(
        torch.linalg.det(after[:, :3, :3]), torch.ones(KEYFRAMES, dtype=F64), rtol=1e-9, atol=1e-9
    )


def test_relative_poses_keep_their_meaning_after_a_correction():
    d = drive()
    result, _ = close(d, loops(d, 5))
    correction = pose_correction(range(KEYFRAMES), d.T_cw, result.S)
    after = torch.stack(list(correction.after.values()))
    before, moved = d.odometry, d.odometry.rescaled(sim3_scale(result.S))
    was, now = relative_errors(result.S, before), relative_errors(after, moved)
    torch.testing.assert_close(
        (before.information * was**2).sum(1), (moved.information * now**2).sum(1)
    )


def matched_scene(scale: float = 1.0) -> tuple[SampleGrid, torch.Tensor, MatchedEdges]:
    """Two cameras before a slanted plane, the second with another unit of length; exact flow."""
    grid = SampleGrid(CAMERA)
    T = se3_exp(torch.tensor([[0.0] * 6, [0.3, -0.1, 0.2, 0.02, -0.05, 0.03]], dtype=F64))
    normal, offset = torch.tensor([0.2, -0.1, 1.0], dtype=F64), 4.0
    rays = grid.rays.double()
    R, t = T[:, :3, :3], T[:, :3, 3]
    # n . X = offset in the world; depth z of a ray r of camera k: n . R^T (z r - t) = offset.
    n = R @ normal
    d = (rays @ n.mT).mT / (offset + (n * t).sum(1))[:, None]
    d[1] /= scale
    i, j = torch.tensor([0, 1]), torch.tensor([1, 0])
    S = T.clone()
    S[1, :3] *= scale
    G = S[j] @ sim3_inverse(S[i])
    y = rays @ G[:, :3, :3].mT + d[i][..., None] * G[:, None, :3, 3]
    pixels = CAMERA.project(y)[0]
    weight = torch.ones_like(pixels)
    return grid, S, MatchedEdges(CAMERA, grid.rays, d.float(), i, j, pixels.float(), weight.float())


def motions(T_cw: torch.Tensor, edges: MatchedEdges) -> torch.Tensor:
    return relative_motion(T_cw, edges.source, edges.target)


def test_relative_poses_of_matched_edges():
    grid, S, edges = matched_scene()
    start = se3_exp(noise(2, torch.tensor([0.05] * 3 + [0.02] * 3, dtype=F64), 0)) @ S
    found = relative_poses(grid, edges, motions(start, edges), is_loop=False)
    assert relative_errors(S, found).abs().max() < 1e-4
    assert (found.information > 0).all()
    torch.testing.assert_close(sim3_scale(found.G), torch.ones(2, dtype=F64))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_matches_on_a_gpu_say_what_they_say_on_the_cpu():
    grid, S, edges = matched_scene()
    g = torch.Generator().manual_seed(0)
    pixels = edges.pixels + torch.randn(edges.pixels.shape, generator=g)
    start = se3_exp(noise(2, torch.tensor([0.05] * 3 + [0.02] * 3, dtype=F64), 0)) @ S
    expected = relative_poses(
        grid, replace(edges, pixels=pixels), motions(start, edges), is_loop=False
    )
    there = SampleGrid(CAMERA, "cuda")
    sent = replace(
        edges, rays=there.rays, inverse_depth=edges.inverse_depth.cuda(), pixels=pixels.cuda(),
        weight=edges.weight.cuda(),
    )  # fmt: skip
    found = relative_poses(there, sent, motions(start, edges), is_loop=False)
    assert found.G.device.type == "cpu"
    torch.testing.assert_close(found.G, expected.G, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.information, expected.information, rtol=1e-3, atol=0)


def test_a_loop_measures_the_ratio_of_units():
    grid, S, edges = matched_scene(1.07)
    start = S.clone()
    start[1, :3, :3] /= 1.07
    found = relative_poses(grid, edges, motions(start, edges), is_loop=True)
    assert relative_errors(S, found).abs().max() < 2e-3
    assert sim3_scale(found.G)[0].item() == pytest.approx(1.07, abs=2e-3)


def test_noisy_matches_tell_less_and_few_tell_nothing():
    grid, S, edges = matched_scene()
    g = torch.Generator().manual_seed(0)
    noisy = edges.pixels + torch.randn(edges.pixels.shape, generator=g)
    sharp, blurred = (
        relative_poses(grid, e, motions(S, e), is_loop=False)
        for e in (edges, replace(edges, pixels=noisy))
    )
    assert (blurred.information < sharp.information).all()
    error = relative_errors(S, blurred)
    assert (blurred.information * error.square()).sum(1).max() < 1.0
    few = torch.zeros_like(edges.weight)
    few[0] = 1.0
    found = relative_poses(grid, replace(edges, weight=few), motions(S, edges), is_loop=False)
    assert found.source.tolist() == [0]


def test_matched_edges_close_a_loop_in_scale(monkeypatch):
    """A keyframe that drifted in place and unit is pulled back by its matches alone."""
    _, S, edges = matched_scene(1.07)
    i, j = torch.tensor([0]), torch.tensor([1])
    T = S.clone()
    T[1, :3, :3] /= 1.07
    T = se3_exp(torch.tensor([[0.0] * 6, [0.05, 0.02, -0.05, 0.01, 0.0, 0.01]], dtype=F64)) @ T
    weak = torch.full((1, 7), 1e-6, dtype=F64)
    relative = RelativePoses(i, j, T[1:] @ se3_inverse(T[:1]), weak, torch.tensor([False]))
    graph = PoseGraph(T, relative, first_fixed(2), edges)
    monkeypatch.setattr(pose_graph, "STEPS", 50)
    result = solve(graph)
    before = GraphState(graph.start, edges.inverse_depth)
    linear = edges.linearise(before)
    assert linear.cost(GraphState(result.S, result.inverse_depth)) < 1e-4 * linear.cost(before)
    # Without a prior on depth the unit of the second follows from the baseline in both directions.
    moved, true = result.S[1], S[1]
    baseline = moved[:3, 3] / true[:3, 3].norm()
    torch.testing.assert_close(
        baseline / baseline.norm(), true[:3, 3] / true[:3, 3].norm(), atol=0.02, rtol=0
    )


def in_view(d: Drive, edges: list[tuple[int, int]], seed: int = 0) -> MatchedEdges:
    """Matches of edges between keyframes that see a cloud of points, with half a pixel of noise."""
    g = torch.Generator().manual_seed(seed)
    grid = SampleGrid(CAMERA)
    depth = 3 + 2 * torch.rand(KEYFRAMES, grid.size, generator=g, dtype=F64)
    i, j = torch.tensor(sorted(edges)).unbind(1)
    G = d.units[j] @ sim3_inverse(d.units[i])
    depth = depth * sim3_scale(d.units)[:, None]
    y = grid.rays.double() @ G[:, :3, :3].mT + G[:, None, :3, 3] / depth[i][..., None]
    pixels = CAMERA.project(y)[0]
    seen = (y[..., 2] > 0.1) & grid.inside(pixels)
    pixels = pixels + 0.5 * torch.randn(pixels.shape, generator=g, dtype=F64)
    weight = (4.0 * seen)[..., None].expand(pixels.shape)
    return MatchedEdges(
        CAMERA, grid.rays, (1 / depth).float(), i, j, pixels.float(), weight.float()
    )


def closure(T_cw: torch.Tensor, relative: RelativePoses, *args, **kwargs) -> LoopClosure | None:
    return close_loops(ClosingQuestion(range(KEYFRAMES), T_cw, relative, *args, **kwargs))


def test_closing_loops_with_matches():
    d = drive()
    relative = joined([d.odometry, loops(d, 8), random_loops(4)])
    true = [(0, 190), (1, 197), (190, 0), (197, 1), (197, 198), (0, 1), (1, 0), (190, 191)]
    false = [(int(relative.source[-1]), int(relative.target[-1]))]
    matches = in_view(d, true + false)
    without = closure(d.T_cw, relative)
    closed = closure(d.T_cw, relative, matches)
    assert without is not None
    assert closed is not None
    assert closed.accepted[:-4].all()
    assert not closed.accepted[-4:].any()
    assert closed.inverse_depth is not None
    after = [torch.stack(list(c.correction.after.values())) for c in (without, closed)]
    assert ate(d, d.T_cw) > 10 * max(ate(d, T) for T in after)
    scale = torch.tensor([*without.correction.scale.values()], dtype=F64)
    again = closure(after[0], relative.select(without.accepted).rescaled(scale))
    assert again is not None
    assert max(abs(math.log(s)) for s in again.correction.scale.values()) < 1e-6
    untouched = torch.ones(KEYFRAMES, dtype=torch.bool)
    untouched[matches.source[matches.source != false[0][0]]] = False
    assert torch.equal(closed.inverse_depth[untouched], matches.inverse_depth[untouched])


def test_no_loop_to_believe_corrects_nothing():
    d = drive()
    assert closure(d.T_cw, d.odometry) is None
    assert closure(d.T_cw, joined([d.odometry, random_loops(3)])) is None


def test_a_metric_map_keeps_its_scales():
    """Odometry that measures metres drifts in place alone; loops that err in scale move none."""
    d = drive(drift=0.0)
    relative = d.odometry
    i, j = torch.tensor([0, 2, 5]), torch.tensor([KEYFRAMES - 8, KEYFRAMES - 6, KEYFRAMES - 3])
    wrong = torch.tensor([0.0] * 6 + [0.02], dtype=F64)
    G = sim3_exp(wrong) @ d.truth[j] @ se3_inverse(d.truth[i])
    both = as_loops(i, j, G)
    parts = ("source", "target", "G", "information", "is_loop")
    together = RelativePoses(*(torch.cat([getattr(r, p) for r in (relative, both)]) for p in parts))
    free = closure(d.T_cw, together)
    held = closure(d.T_cw, together, is_metric=True)
    assert max(abs(s - 1) for s in free.correction.scale.values()) > 1e-3
    assert max(abs(s - 1) for s in held.correction.scale.values()) < 1e-9
    after = torch.stack([held.correction.after[k] for k in range(KEYFRAMES)])
    error = (se3_inverse(after) - se3_inverse(d.truth))[:, :3, 3].norm(dim=1).max()
    before = (se3_inverse(d.T_cw) - se3_inverse(d.truth))[:, :3, 3].norm(dim=1).max()
    assert float(error) < 0.7 * float(before)
