"""Kinds of place in hand-made depth maps, against what was drawn and against slow references."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from geogs.geometry.camera import Camera
from geogs_bench.results.record import Place
from geogs_bench.scoring import depth_scores
from geogs_bench.scoring.depth_scores import (
    BEHIND,
    JUMP,
    LONG,
    NEAR_EDGE,
    THIN,
    fit_planes,
    inverse_depth,
    places_of,
)

CAMERA = Camera(100.0, 90.0, 59.5, 44.5, 120, 90)
SHAPE = (90, 120)
TEXTURE = np.random.default_rng(0).integers(0, 255, (*SHAPE, 3), np.uint8)


def slanted(normal: tuple[float, float, float], distance: float) -> np.ndarray:
    """Depth of a plane n . X = distance."""
    rays = CAMERA.rays(torch.float64).numpy()
    return np.asarray(distance / (rays @ (np.array(normal) / np.linalg.norm(normal))))


def kinds(depth: np.ndarray, image: np.ndarray = TEXTURE) -> dict[Place, np.ndarray]:
    return places_of(depth, image, CAMERA, fit_planes(depth, 7, 0.003))


def wall(depth: float = 3.0) -> np.ndarray:
    return np.full(SHAPE, depth)


def columns(mask: np.ndarray, row: int = 45) -> list[int]:
    return np.flatnonzero(mask[row]).tolist()


def test_a_wall_is_open() -> None:
    found = kinds(wall())
    assert found["open"].all()
    assert found["all"].all()
    for place in ("edge", "thin", "behind thin", "bare", "grazing", "sky"):
        assert not found[place].any(), place


def test_a_step_is_an_edge_five_pixels_wide_on_either_side() -> None:
    depth = wall()
    depth[:, 60:] = 2.0
    found = kinds(depth)
    assert columns(found["edge"]) == list(range(60 - NEAR_EDGE, 60 + NEAR_EDGE))
    assert not found["thin"].any()
    assert not found["behind thin"].any()
    assert (found["open"] == ~found["edge"]).all()


@pytest.mark.parametrize(("jump", "is_edge"), [(0.04, False), (0.06, True)])
def test_the_least_jump_is_a_part_of_the_farther_depth(jump: float, is_edge: bool) -> None:
    depth = wall()
    depth[:, 60:] *= 1 - jump
    assert kinds(depth)["edge"].any() == is_edge


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.9, 0.0, 0.5), (0.2, 0.97, 0.1)])
def test_no_plane_is_an_edge_or_thin_however_slanted(normal: tuple[float, float, float]) -> None:
    depth = slanted(normal, 1.0)
    depth = np.where((depth > 0) & (depth < 50), depth, 0)
    if normal[1] > 0.9:  # neighbours differ by more than a jump
        both = (depth[1:] > 0) & (depth[:-1] > 0)
        assert (depth[1:][both] / depth[:-1][both]).min() < 1 - JUMP
    found = kinds(depth)
    assert not found["edge"].any()
    assert not found["thin"].any()


def test_two_planes_that_meet_are_no_edge() -> None:
    left, right = slanted((0.7, 0.0, 0.7), 2.0), slanted((-0.7, 0.0, 0.7), 2.0)
    assert not kinds(np.maximum(left, right))["edge"].any()  # a corner of a room
    assert not kinds(np.minimum(left, right))["edge"].any()  # a corner of a box


@pytest.mark.parametrize("width", [1, 4, THIN - 1])
def test_a_bar_before_a_wall_is_thin_and_the_wall_around_it_is_behind(width: int) -> None:
    depth = wall()
    depth[:70, 50 : 50 + width] = 2.0
    found = kinds(depth)
    assert columns(found["thin"]) == list(range(50, 50 + width))
    behind = [*range(50 - BEHIND, 50), *range(50 + width, 50 + width + BEHIND)]
    assert columns(found["behind thin"]) == behind
    assert not found["thin"][70:].any()
    assert found["edge"][45, 50 - NEAR_EDGE : 50 + width + NEAR_EDGE].sum() >= 2 * NEAR_EDGE + 1


def test_a_wide_bar_and_a_short_one_are_not_thin() -> None:
    wide, short = wall(), wall()
    wide[:, 50 : 50 + THIN] = 2.0
    short[40:50, 50:54] = 2.0
    for depth in (wide, short):
        found = kinds(depth)
        assert found["edge"].any()
        assert not found["thin"].any()
        assert not found["behind thin"].any()


def test_a_gap_in_a_wall_is_no_thin_thing() -> None:
    depth = wall(2.0)
    depth[:, 50:54] = 3.0
    found = kinds(depth)
    assert found["edge"].any()
    assert not found["thin"].any()


def test_the_sky_is_of_no_other_kind_and_a_roof_before_it_has_an_edge() -> None:
    depth = wall()
    depth[:30] = np.inf
    found = kinds(depth)
    assert (found["sky"] == np.isinf(depth)).all()
    assert not (found["sky"] & found["all"]).any()
    rows = np.flatnonzero(found["edge"][:, 60])
    assert rows.tolist() == list(range(30, 30 + NEAR_EDGE))


def test_what_has_no_depth_is_of_no_kind_and_a_sensors_shadow_hides_no_edge() -> None:
    depth = wall()
    depth[:, 60:] = 2.0
    depth[:, 50:60] = 0.0
    found = kinds(depth)
    assert not any(mask[:, 50:60].any() for mask in found.values())
    assert columns(found["edge"]) == [*range(50 - NEAR_EDGE, 50), *range(60, 60 + NEAR_EDGE)]
    same = wall()
    same[:, 50:60] = 0.0
    assert not kinds(same)["edge"].any()


@pytest.mark.parametrize(("levels", "is_bare"), [(0.5, True), (1.5, False)])
def test_bare_is_where_the_image_hardly_changes_but_for_noise(levels: float, is_bare: bool) -> None:
    image = TEXTURE.astype(float)
    image[:, 40:] = 60 + levels * np.arange(80)[:, None]
    image[:, 40:] += np.random.default_rng(1).normal(0, 1.5, SHAPE)[:, 40:, None]
    found = kinds(wall(), image.round().clip(0, 255).astype(np.uint8))["bare"]
    assert not found[:, :40].any()
    assert found[10:80, 60:110].mean() == pytest.approx(float(is_bare), abs=0.02)


def test_grazing_is_by_the_ray_not_by_the_axis() -> None:
    depth = slanted((0.0, 1.0, 0.0), 1.0)  # a floor one metre below
    depth = np.where((depth > 0) & (depth < 100), depth, 0)
    found = kinds(depth)["grazing"]
    v, u = np.nonzero(depth > 0)
    rays = CAMERA.rays(torch.float64).numpy()[v, u]
    angle = np.degrees(np.arccos(rays[:, 1] / np.linalg.norm(rays, axis=1)))
    inside = (v > depth.nonzero()[0].min() + 4) & (v < 86) & (u > 3) & (u < 116)
    np.testing.assert_array_equal(found[v, u][inside], (angle > depth_scores.GRAZING)[inside])
    assert found.any()


def random_depth(seed: int) -> np.ndarray:
    """Planes, boxes, bars, sky and holes."""
    rng = np.random.default_rng(seed)
    depth = slanted((rng.normal(0, 0.3), rng.normal(0, 0.3), 1.0), 3.0)
    for _ in range(12):
        y, x = rng.integers(0, 80), rng.integers(0, 110)
        h, w = rng.integers(1, 60), rng.integers(1, 30)
        depth[y : y + h, x : x + w] = rng.uniform(0.5, 4.0)
    for x in rng.integers(10, 110, 3):
        depth[20:80, x : x + 5] = 0.4
    depth[:5, 30:70] = np.inf
    depth[rng.random(SHAPE) < 0.02] = 0
    return depth


@pytest.mark.parametrize("seed", range(3))
def test_edges_are_those_of_a_walk_from_pixel_to_pixel(seed: int) -> None:
    inverse = inverse_depth(random_depth(seed))
    expected = np.zeros(SHAPE, bool)
    for transposed in (False, True):
        lines = inverse.T if transposed else inverse
        marks = expected.T if transposed else expected
        for r, line in enumerate(lines):
            known = [k for k in range(len(line)) if not np.isnan(line[k])]
            for k in range(len(known) - 1):
                a, b = known[k], known[k + 1]
                step = line[b] - line[a]
                rests = [abs(step)]
                if k > 0:
                    p = known[k - 1]
                    rests.append(abs(step - (line[a] - line[p]) / (a - p) * (b - a)))
                if k + 2 < len(known):
                    q = known[k + 2]
                    rests.append(abs(step - (line[q] - line[b]) / (q - b) * (b - a)))
                if b - a <= 32 and min(rests) > JUMP * max(line[a], line[b]):
                    marks[r, a] = marks[r, b] = True
    np.testing.assert_array_equal(depth_scores.edges(inverse), expected)
    assert 0.01 < expected.mean() < 0.5


@pytest.mark.parametrize("seed", range(2))
def test_thin_is_what_no_square_covers(seed: int) -> None:
    """Against all squares, pixel by pixel; the farthest pixel of a square is how near it gets."""
    depth = random_depth(seed)
    inverse, half = inverse_depth(depth), THIN // 2
    nearest = np.zeros(SHAPE)
    for v in range(-half, SHAPE[0] + half):
        for u in range(-half, SHAPE[1] + half):
            rows = slice(max(v - half, 0), v + half + 1)
            square = (rows, slice(max(u - half, 0), u + half + 1))
            inside = inverse[square]
            if not np.isnan(inside).all():
                nearest[square] = np.maximum(nearest[square], np.nanmin(inside))
    narrow = ~np.isnan(inverse) & (np.nan_to_num(inverse) * (1 - JUMP) > nearest)
    parts, count = ndimage.label(narrow, np.ones((3, 3)))
    expected = np.zeros(SHAPE, bool)
    for part in range(1, count + 1):
        v, u = np.nonzero(parts == part)
        if max(np.ptp(v), np.ptp(u)) + 1 >= LONG:
            expected |= parts == part
    np.testing.assert_array_equal(depth_scores.thin_things(inverse), expected)
    assert 0.01 < expected.mean() < 0.3


@pytest.mark.parametrize("side", [5, 7])
def test_planes_are_those_of_least_squares_over_each_neighbourhood(side: int) -> None:
    depth = random_depth(5)
    depth += np.random.default_rng(3).normal(0, 0.003, SHAPE) * (depth > 0)
    fits = fit_planes(depth, side, 0.003)
    known, half = (depth > 0) & np.isfinite(depth), side // 2
    rng, checked = np.random.default_rng(4), 0
    normals = fits.normals(CAMERA)
    for v, u in zip(rng.integers(0, 90, 400), rng.integers(0, 120, 400), strict=True):
        rows, cols = (
            np.arange(max(c - half, 0), min(c + half + 1, n)) for c, n in ((v, 90), (u, 120))
        )
        y, x = (grid.ravel() for grid in np.meshgrid(rows, cols, indexing="ij"))
        y, x = y[known[y, x]], x[known[y, x]]
        if not (known[v, u] and len(y) >= 0.8 * side * side):
            assert not fits.is_known[v, u]
            continue
        A = np.stack([np.ones(len(x)), x - u, y - v], 1)
        w = 1 / depth[y, x]
        plane = np.linalg.lstsq(A, w, rcond=None)[0]
        if plane[0] <= 0:
            assert not fits.is_known[v, u]
            continue
        assert fits.is_known[v, u]
        ours = [fits.value[v, u], fits.right[v, u], fits.down[v, u]]
        np.testing.assert_allclose(ours, plane, atol=1e-9)
        rest = np.sqrt(((A @ plane - w) ** 2).mean())
        if abs(rest / plane[0] - 0.003) > 1e-6:
            assert fits.is_good[v, u] == (rest < 0.003 * plane[0])
        # Three points of the plane say what its normal is.
        points = [
            np.array([(u + i - CAMERA.cx) / CAMERA.fx, (v + j - CAMERA.cy) / CAMERA.fy, 1.0])
            / (plane @ [1, i, j])
            for i, j in ((0, 0), (0.1, 0), (0, 0.1))
        ]
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        normal /= np.linalg.norm(normal) * np.sign(normal @ points[0])
        np.testing.assert_allclose(normals[v, u], normal, atol=1e-6)
        checked += 1
    assert checked > 100
