"""Cuts through rooms of known plans: walls, corners, gaps, noise, furniture."""

import numpy as np
import pytest

from geogs.mesh.drawing.cut import Cut, cut_mesh, heights
from geogs.mesh.drawing.walls import find_walls
from geogs.mesh.triangle_mesh import Mesh

PLANS = {
    "rectangle": [(0, 0), (5, 0), (5, 3.5), (0, 3.5)],
    "L": [(0, 0), (6, 0), (6, 2.5), (2.5, 2.5), (2.5, 5), (0, 5)],
    "askew": [(0, 0), (4, 1), (5, 4), (1, 4.5)],
    "niche": [(0, 0), (5, 0), (5, 4), (3, 4), (3, 3.2), (2, 3.2), (2, 4), (0, 4)],
}


def walled(
    plan: list[tuple[float, float]], noise: float, doors: bool = False, step: float = 0.08
) -> Mesh:
    """Walls 2.4 m high around a plan, which face inwards, and its floor; each wall is a grid."""
    random = np.random.default_rng(0)
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    corners = np.array(plan, float)
    for start, end in zip(corners, np.roll(corners, -1, 0), strict=True):
        length = np.linalg.norm(end - start)
        n = max(int(length / step), 1)
        m = int(2.4 / step)
        s, z = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 2.4, m + 1), indexing="ij")
        normal = np.array([-(end - start)[1], (end - start)[0]]) / length
        xy = (
            start
            + s[..., None] * (end - start)
            + random.normal(0, noise, s.shape)[..., None] * (normal)
        )
        index = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1) + sum(map(len, vertices))
        quads = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
        a, b, c, d = (q[: n // 3] if doors and length > 4.5 else q for q in quads)
        a2, b2, c2, d2 = (q[n // 3 + 10 :] if doors and length > 4.5 else q[:0] for q in quads)
        for e, f, g, h in ((a, b, c, d), (a2, b2, c2, d2)):
            faces += [
                np.stack([e, g, f], -1).reshape(-1, 3),
                np.stack([e, h, g], -1).reshape(-1, 3),
            ]
        vertices.append(np.concatenate([xy, z[..., None]], -1).reshape(-1, 3))
    low = corners.min(0)
    high = corners.max(0)
    floor = np.array([[*low, 0], [high[0], low[1], 0], [*high, 0], [low[0], high[1], 0]])
    faces.append(np.array([[0, 1, 2], [0, 2, 3]]) + sum(map(len, vertices)))
    vertices.append(floor)
    return Mesh.from_triangles(np.concatenate(vertices), np.concatenate(faces))


@pytest.mark.parametrize("noise", [0.0, 0.006, 0.012])
@pytest.mark.parametrize("name", PLANS)
def test_walls_have_the_lengths_and_corners_of_the_plan(name, noise):
    plan = np.array(PLANS[name], float)
    cut = cut_mesh(walled(PLANS[name], noise), 2, 1.2)
    walls = find_walls(cut)
    true = np.sort(np.linalg.norm(np.roll(plan, -1, 0) - plan, axis=1))
    np.testing.assert_allclose(np.sort(walls.lengths), true, atol=0.03 + noise)
    corners = walls.ends.reshape(-1, 1, 2)
    assert np.linalg.norm(corners - plan, axis=2).min(1).max() < 0.03 + 2 * noise
    assert walls.others.lengths.sum() < 0.04 * true.sum()
    middle = walls.ends.mean(1)
    inside = middle + 0.05 * walls.inward
    assert all(_is_inside(point, plan) for point in inside)


def _is_inside(point: np.ndarray, plan: np.ndarray) -> bool:
    """Whether a point lies inside a polygon, by the crossings of a ray to the right."""
    crossings = 0
    for a, b in zip(plan, np.roll(plan, -1, 0), strict=True):
        if (a[1] > point[1]) != (b[1] > point[1]):
            x = a[0] + (point[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
            crossings += x > point[0]
    return crossings % 2 == 1


def test_a_door_divides_its_wall():
    walls = find_walls(cut_mesh(walled(PLANS["rectangle"], 0.004, doors=True), 2, 1.2))
    assert len(walls.ends) == 6
    doors = [w for w in walls.lengths if w < 3.4]
    assert len(doors) == 4
    np.testing.assert_allclose(walls.lengths.sum(), 17 - 2 * 10 * 5 / 62, atol=0.1)


@pytest.mark.parametrize("turn", [0, 17, 45, 200])
def test_walls_turn_with_the_plan_and_round_things_are_none(turn):
    angle = np.radians(turn)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cut = cut_mesh(walled(PLANS["rectangle"], 0.005), 2, 1.2)
    around = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(around), np.sin(around)], 1)
    ends = 0.25 * np.stack([circle[:-1], circle[1:]], 1) + [2.5, 1.5]
    all_ends = np.concatenate([cut.ends, ends]) @ R.T
    inward = np.concatenate([cut.inward, (circle[:-1] + circle[1:]) / 2]) @ R.T
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    walls = find_walls(Cut(all_ends, inward))
    np.testing.assert_allclose(np.sort(walls.lengths), [3.5, 3.5, 5, 5], atol=0.04)
    assert walls.others.lengths.sum() > 1.3


def test_a_cut_of_a_box_is_its_outline_wherever_it_is():
    mesh = walled(PLANS["rectangle"], 0.0)
    for at in (0.0799, 0.08, 1.2, 2.0):  # at the height of vertices, too
        cut = cut_mesh(mesh, 2, at)
        assert cut.lengths.sum() == pytest.approx(17, abs=1e-6)
        assert np.abs(np.abs(cut.inward).max(1) - 1).max() < 1e-6
    assert not len(cut_mesh(mesh, 2, 5.0).ends)
    side = cut_mesh(mesh, 1, 1.7)  # both walls and the floor
    assert side.lengths.sum() == pytest.approx(2 * 2.4 + 5, abs=1e-6)


def test_the_floor_is_below_tables_and_above_outliers():
    mesh = walled(PLANS["rectangle"], 0.003)
    table = np.array([[1, 1, 0.75], [2.5, 1, 0.75], [2.5, 2, 0.75], [1, 2, 0.75]])
    ghost = np.array([[1, 1, -2], [1.1, 1, -2], [1, 1.1, -2]])
    vertices = np.concatenate([mesh.vertices, table, ghost])
    n = len(mesh.vertices)
    more = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]]) + n
    found = heights(Mesh.from_triangles(vertices, np.concatenate([mesh.faces, more])))
    np.testing.assert_allclose(found, [0.0, 2.4], atol=0.03)


def test_no_lines_have_no_walls():
    assert not len(find_walls(Cut(np.zeros((0, 2, 2)), np.zeros((0, 2)))).ends)
