"""The test at depth edges against a slow one, and on a square before a bare wall."""

import numpy as np

from depth_scene import FATTENED, FOREGROUND, fattened, inside
from geogs.depth import edges
from geogs.depth.edges import resolve_edges
from geogs.depth.plane_sweep import SweepResult
from geogs.depth.refinement import SlantedDepth

H, W = 60, 80


def one_pass(refined, confidence, guide, sweep):
    """The definition, a pixel at a time, in double precision."""
    rho, gx, gy = (
        m.astype(float) for m in (refined.inverse_depth, refined.slope_x, refined.slope_y)
    )
    out = [m.copy() for m in (rho, gx, gy, confidence.astype(float))]
    reach = edges.reach_of(rho.shape)
    v, u = np.mgrid[: rho.shape[0], : rho.shape[1]]
    for y, x in np.ndindex(rho.shape):
        near = (abs(v - y) <= reach) & (abs(u - x) <= reach)
        value = (rho - gx * (u - x) - gy * (v - y))[near]
        contrast = ((guide[:, near] - guide[:, y, x, None]).astype(float) ** 2).sum(0)
        weight = confidence[near] / (1 + edges.CONTRAST * contrast) ** 2
        ratio = value / rho[y, x] - 1
        own = weight[abs(ratio) < edges.MIN_GAP].sum()
        cost = lambda r, y=y, x=x: np.interp(r, sweep.planes, sweep.costs[y, x])  # noqa: E731
        best = 0.0
        for side in (-1, 1):
            other = (side * ratio >= edges.MIN_GAP) & (value > 0)
            if weight[other].sum() < 0.3:
                continue
            mode = np.average(value[other], weights=weight[other])
            for _ in range(edges.MEAN_SHIFTS):
                say = weight[other] / (1 + ((value[other] / mode - 1) / edges.WIDTH) ** 2)
                mode = np.average(value[other], weights=say)
            score = np.log((say.sum() + 0.1) / (own + 0.1))
            score += edges.COST_TRUST * (cost(rho[y, x]) - cost(mode))
            if say.sum() >= 0.3 and score > best:
                best = score
                slopes = [np.average(g[near][other], weights=say) for g in (gx, gy)]
                sure = np.average(confidence[near][other], weights=say)
                for m, value_ in zip(
                    out, (mode, *slopes, edges.MOVED_CONFIDENCE * sure), strict=True
                ):
                    m[y, x] = value_
    return out


def test_a_pass_is_that_of_the_definition(monkeypatch):
    monkeypatch.setattr(edges, "PASSES", 1)
    given = fattened(28, 36)
    expected = one_pass(*given)
    got, confidence = resolve_edges(*given)
    maps = (got.inverse_depth, got.slope_x, got.slope_y, confidence)
    assert (expected[0] != given[0].inverse_depth).mean() > 0.02
    for mine, theirs in zip(maps, expected, strict=True):
        # A score of about 0 may fall on either side.
        assert (np.abs(mine - theirs) < 1e-4).mean() > 0.995
    np.testing.assert_array_equal(got.support, given[0].support)


def test_a_fattened_square_shrinks_to_its_colour():
    given = fattened(H, W)
    before = np.abs(given[0].inverse_depth / FOREGROUND - 1) < 0.05
    resolved, confidence = resolve_edges(*given)
    after = np.abs(resolved.inverse_depth / FOREGROUND - 1) < 0.05
    square, halo = inside(H, W), inside(H, W, FATTENED) & ~inside(H, W)
    assert before[halo].mean() > 0.99
    assert after[halo].mean() < 0.05
    assert after[square].mean() > 0.99
    wall = 0.4 + 2e-4 * np.broadcast_to(np.arange(W), (H, W))
    assert np.median(np.abs(resolved.inverse_depth[halo] / wall[halo] - 1)) < 2e-3
    assert np.all(confidence[halo & ~after] <= 0.95 * edges.MOVED_CONFIDENCE)
    untouched = resolved.inverse_depth == given[0].inverse_depth
    np.testing.assert_array_equal(confidence[untouched], given[1][untouched])


def test_matching_speaks_against_colour():
    refined, confidence, guide, sweep = fattened(H, W)
    halo = inside(H, W, FATTENED) & ~inside(H, W)
    costs = sweep.costs.copy()
    seen_near = np.minimum(np.abs(sweep.planes - FOREGROUND) / 0.02, 1).astype(np.float32)
    costs[halo] = seen_near
    sure = SweepResult(sweep.inverse_depth, sweep.cost, sweep.margin, sweep.planes, costs)
    resolved, _ = resolve_edges(refined, confidence, guide, sure)
    stays = np.abs(resolved.inverse_depth / FOREGROUND - 1) < 0.05
    assert stays[halo].mean() > 0.95


def test_a_plane_at_any_slant_is_left_alone():
    y, x = np.mgrid[:H, :W].astype(np.float32)
    rho = 0.3 + 4e-3 * x + 1e-3 * y
    slopes = np.full_like(rho, 4e-3), np.full_like(rho, 1e-3)
    refined = SlantedDepth(rho, *slopes, np.full_like(rho, 5.0))
    planes = np.linspace(0.2, 0.8, 31, dtype=np.float32)
    costs = np.random.default_rng(2).random((H, W, 31)).astype(np.float32)
    guide = np.random.default_rng(3).random((3, H, W)).astype(np.float32)
    sweep = SweepResult(rho, 0 * rho, 0 * rho, planes, costs)
    resolved, confidence = resolve_edges(refined, np.full_like(rho, 0.8), guide, sweep)
    np.testing.assert_array_equal(resolved.inverse_depth, rho)
    assert confidence.min() == np.float32(0.8)
