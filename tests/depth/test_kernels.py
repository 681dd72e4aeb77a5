"""The compiled loops of the depth estimation against slow, obvious versions."""

from itertools import product

import cv2
import numpy as np
import pytest

from depth_scene import RENDER, WORKING, make_scene
from geogs.depth import plane_sweep_kernels as sweep
from geogs.depth import refinement_kernels as refinement
from geogs.depth import reprojection_kernels as reprojection
from geogs.depth.plane_sweep import VARIANCE_FLOOR, matching_costs

F = np.float32


def _random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape).astype(F)


def _paths_reference(cost, image, small, large, edge, directions):
    """Hirschmueller's recursion, one path at a time."""
    h, w, planes = cost.shape
    total = np.zeros(cost.shape)
    for dy, dx in directions:
        path = np.zeros(cost.shape)
        ys = range(h) if dy >= 0 else range(h - 1, -1, -1)
        xs = range(w) if dx >= 0 else range(w - 1, -1, -1)
        for y in ys:
            for x in xs:
                py, px = y - dy, x - dx
                path[y, x] = cost[y, x]
                if not (0 <= py < h and 0 <= px < w):
                    continue
                before = path[py, px]
                contrast = abs(float(image[y, x]) - float(image[py, px]))
                jump = before.min() + max(1.5 * small, large / (1 + edge * contrast))
                for k in range(planes):
                    choices = [before[k], jump]
                    choices += [before[k - 1] + small] if k > 0 else []
                    choices += [before[k + 1] + small] if k < planes - 1 else []
                    path[y, x, k] += min(choices) - before.min()
        total += path
    return total


def test_path_aggregation_equals_the_recursion():
    cost, image = _random(9, 11, 7), _random(9, 11, seed=1)
    total = np.zeros_like(cost)
    for forward in (True, False):
        sweep.aggregate_paths(cost, image, F(0.1), F(0.8), F(5), forward, total)
    directions = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
    expected = _paths_reference(cost, image, 0.1, 0.8, 5.0, directions)
    assert np.abs(total - expected).max() < 1e-4


def test_one_scan_follows_half_of_the_directions():
    cost, image = _random(6, 8, 5), _random(6, 8, seed=1)
    total = np.zeros_like(cost)
    sweep.aggregate_paths(cost, image, F(0.1), F(0.8), F(5), True, total)
    directions = [(0, 1), (1, -1), (1, 0), (1, 1)]
    expected = _paths_reference(cost, image, 0.1, 0.8, 5.0, directions)
    assert np.abs(total - expected).max() < 1e-4


def test_support_average_equals_the_weighted_mean():
    volume, guide = _random(7, 8, 5), _random(7, 8, 3, seed=2)
    out = np.empty_like(volume)
    sweep.average_support(0, len(volume), volume, guide, 2, F(3.0), out)
    for y, x in [(0, 0), (3, 4), (6, 7)]:
        rows, columns = slice(max(y - 2, 0), y + 3), slice(max(x - 2, 0), x + 3)
        difference = ((guide[rows, columns] - guide[y, x]) ** 2).sum(-1)
        weight = 1.0 / (1.0 + 3.0 * difference) ** 2
        mean = (weight[..., None] * volume[rows, columns]).sum((0, 1)) / weight.sum()
        assert np.abs(out[y, x] - mean).max() < 1e-5


@pytest.mark.parametrize("window", [3, 5])
def test_matching_cost_equals_warped_ncc(window):
    scene = make_scene()
    planes = np.array([0.3, 0.37, 0.45], F)
    reference, neighbour = scene.views[:2]
    costs = matching_costs(reference, [neighbour], RENDER, planes, window)
    k = RENDER.matrix().numpy()
    relative = neighbour.T_cw @ np.linalg.inv(reference.T_cw)
    radius = window // 2
    for p, rho in enumerate(planes):
        homography = relative[:3, :3] + rho * np.outer(relative[:3, 3], [0, 0, 1])
        warp = k @ homography @ np.linalg.inv(k)
        for y, x in [(20, 40), (36, 50), (50, 30)]:
            window_yx = np.mgrid[y - radius : y + radius + 1, x - radius : x + radius + 1]
            pixels = np.stack([window_yx[1], window_yx[0], np.ones_like(window_yx[0])], -1) @ warp.T
            u, v = (pixels[..., i] / pixels[..., 2] for i in range(2))
            b = cv2.remap(neighbour.grey, u.astype(F), v.astype(F), cv2.INTER_LINEAR)
            a = reference.grey[y - radius : y + radius + 1, x - radius : x + radius + 1]
            cross = (a * b).mean() - a.mean() * b.mean()
            variances = (a.var() + VARIANCE_FLOOR) * (b.var() + VARIANCE_FLOOR)
            # OpenCV interpolates with weights rounded to 1/32.
            assert abs(costs[y, x, p] - (1 - cross / np.sqrt(variances))) < 0.03


def test_cost_outside_every_neighbour_is_the_outside_cost():
    scene = make_scene()
    planes = np.array([0.3, 3.0], F)
    costs = matching_costs(scene.views[0], [scene.views[1]], RENDER, planes)
    assert costs[36, 0, 1] == pytest.approx(sweep.OUTSIDE, rel=1e-6)
    assert np.isfinite(costs).all()


def test_matching_cost_is_the_mean_over_the_better_half_of_those_that_see_the_point():
    scene = make_scene()
    reference, *others = scene.views
    planes = np.array([0.5, 1.4, 2.2], F)  # 0.5, 3 and more of the four look past some pixels
    costs = matching_costs(reference, others, RENDER, planes)
    alone = np.stack([matching_costs(reference, [o], RENDER, planes) for o in others])
    k = RENDER.matrix().numpy()
    cameras = [(k @ (v.T_cw @ np.linalg.inv(reference.T_cw))[:3], v) for v in others]
    rays = RENDER.rays().numpy()
    counts = set()
    for p, rho in enumerate(planes):
        for y, x in product(range(0, RENDER.height, 3), range(0, RENDER.width, 3)):
            point = np.append(rays[y, x] / rho, 1.0)
            images = [projection @ point for projection, _ in cameras]
            places = [(q[0] / q[2], q[1] / q[2]) for q in images]
            if any(
                _near_border(u, RENDER.width) or _near_border(v, RENDER.height) for u, v in places
            ):
                continue  # rounding decides
            inside = [0 < u < RENDER.width - 1 and 0 < v < RENDER.height - 1 for u, v in places]
            used = max(2, (sum(inside) + 1) // 2)
            counts.add(sum(inside))
            expected = np.sort(alone[:, y, x, p])[:used].mean()
            assert costs[y, x, p] == pytest.approx(expected, abs=1e-4)
    assert counts == {0, 1, 2, 3, 4}


def _near_border(place, size):
    return min(abs(place), abs(place - (size - 1))) < 0.01


def test_winner_finds_the_vertex_and_its_margin():
    planes = np.arange(9, dtype=F)
    total = np.broadcast_to((planes - F(4.3)) ** 2, (2, 3, 9)).astype(F)
    position, cost, margin = (np.empty((2, 3), F) for _ in range(3))
    sweep.pick_planes(0, len(total), total, total, position, cost, margin)
    assert np.abs(position - 4.3).max() < 1e-5
    assert np.abs(cost - 0.09).max() < 1e-5
    assert np.abs(margin - (2.7**2 - 0.09)).max() < 1e-5


def test_plane_fit_equals_weighted_least_squares():
    h, w, radius = 9, 10, 2
    rho, sure = F(0.5) + F(0.02) * _random(h, w), _random(h, w, seed=1) + F(0.1)
    slope_x, slope_y = F(0.004) * _random(h, w, seed=2), F(0.004) * _random(h, w, seed=3)
    guide = _random(3, h, w, seed=4)
    out = [np.empty((h, w), F) for _ in range(4)]
    given = rho, slope_x, slope_y, sure, guide, radius, F(20), F(0.03), F(0.5)
    for first, last in ((0, 3), (3, len(rho))):
        refinement.fit_planes(first, last, *given, *out)
    for y, x in [(0, 0), (4, 5), (8, 2)]:
        rows, values, weights = [], [], []
        for v in range(max(y - radius, 0), min(y + radius + 1, h)):
            for u in range(max(x - radius, 0), min(x + radius + 1, w)):
                dx, dy = u - x, v - y
                r = rho[v, u] - rho[y, x] - dx * slope_x[y, x] - dy * slope_y[y, x]
                colour = ((guide[:, v, u] - guide[:, y, x]) ** 2).sum()
                far = r / (0.03 * rho[y, x])
                weights.append(sure[v, u] / (1 + 20 * colour) / (1 + far**2))
                rows.append([1.0, dx, dy])
                values.append(r)
        a, b, m = np.array(rows), np.array(values), np.array(weights)
        normal = a.T @ (m[:, None] * a) + np.diag([0, 0.5, 0.5])
        fit = np.linalg.solve(normal, a.T @ (m * b))
        assert abs(out[0][y, x] - rho[y, x] - fit[0]) < 1e-5
        assert abs(out[1][y, x] - slope_x[y, x] - fit[1]) < 1e-5
        assert abs(out[2][y, x] - slope_y[y, x] - fit[2]) < 1e-5
        assert abs(out[3][y, x] - m.sum()) < 1e-4


def test_photometric_step_climbs_the_ncc():
    """The step is the Gauss-Newton step of 1 - NCC: its product with the curvature is the slope."""
    from geogs.depth.refinement import _gather_patches

    scene = make_scene()
    patches = _gather_patches(scene.views[0], scene.views[1:2], RENDER, WORKING)
    zero = np.zeros_like(scene.truth[0])

    def step(rho):
        out = [np.empty_like(zero) for _ in range(2)]
        refinement.photometric_step(
            0, len(rho), patches.samples, patches.offsets, patches.weights, patches.pairs,
            patches.a, patches.b, rho, zero, zero, F(1e-6), *out,
        )  # fmt: skip
        return out

    truth = 1.0 / scene.truth[0]
    flat = np.ones_like(zero, bool)
    flat[:6], flat[-6:], flat[:, :6], flat[:, -12:] = False, False, False, False
    for offset in (0.99, 1.01):
        move, curvature = step(truth * F(offset))
        good = flat & (curvature > 20.0)
        assert good.mean() > 0.35
        remaining = np.abs(truth * F(offset) + move - truth)[good] / truth[good]
        assert np.median(remaining) < 0.004


def test_splatting_keeps_the_nearest_and_fills_two_by_two():
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 1.0], [0.5, 0.5, -1.0], [9.0, 0.0, 1.0]], F)
    confidence = np.array([0.9, 0.8, 0.9, 0.9], F)
    depth, weight = np.zeros((6, 8), F), np.zeros((6, 8), F)
    lens = np.array([4.0, 4.0, 3.4, 2.6], F)
    eye, origin = np.eye(3, dtype=F), np.zeros(3, F)
    reprojection.splat_depth(points, confidence, eye, origin, lens, F(0.5), depth, weight)
    expected = np.zeros((6, 8), F)
    expected[2:4, 3:5] = 1.0
    assert np.array_equal(depth, expected)
    assert np.array_equal(weight, F(0.8) * expected)
    reprojection.splat_depth(points, 0 * confidence, eye, origin, lens, F(0.5), depth, weight)
    assert np.array_equal(depth, expected)


def test_the_best_depth_has_most_votes_and_nothing_in_front():
    depths = np.array([2.0, 2.01, 1.0, 3.0, 0.0], F).reshape(5, 1, 1)
    weights = np.array([0.8, 0.7, 0.9, 0.9, 0.0], F).reshape(5, 1, 1)
    best, score, settings = np.empty((1, 1), F), np.empty((1, 1), F), (F(0.015), F(0.05), F(0.5))
    asked = np.ones((1, 1), bool)
    reprojection.agree_on_depth(depths, weights, asked, *settings, best, score)
    alike = np.exp(-0.5 * (0.01 / 2.01 / 0.015) ** 2)
    assert best[0, 0] in (F(2.0), F(2.01))
    assert abs(score[0, 0] - (0.8 + 0.7 * alike - 0.5 * 0.9)) < 0.01
    nothing = np.zeros_like(depths)
    reprojection.agree_on_depth(nothing, nothing, asked, *settings, best, score)
    assert best[0, 0] == 0
    assert score[0, 0] == 0
    reprojection.agree_on_depth(depths, weights, ~asked, *settings, best, score)
    assert best[0, 0] == 0
    assert score[0, 0] == 0
