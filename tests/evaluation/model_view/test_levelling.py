"""Rooms that lie askew stand upright again, and are seen from where they are open."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from box_room import box, circle
from geogs.evaluation.model_view.levelling import Facets, level
from geogs.evaluation.model_view.room import DEEP, find_room
from geogs.evaluation.model_view.start_view import ASPECT, FIELD, start_view

HALF = np.array([3.0, 2.0, 1.2])


def room(
    turn: Rotation, sides: str = "EWNSFC", noise: float = 4.0, clutter: float = 0.5, seed: int = 0
) -> Facets:
    """A room of small facets, z up before it is turned; sides are east, west, north, south, floor
    and ceiling; normals are off by some degrees, and clutter faces anywhere."""
    random = np.random.default_rng(seed)
    parts = []
    for name, (axis, sign) in {"E": (0, 1), "W": (0, -1), "N": (1, 1), "S": (1, -1),
                               "C": (2, 1), "F": (2, -1)}.items():  # fmt: skip
        if name not in sides:
            continue
        across = [a for a in range(3) if a != axis]
        count = int(250 * 4 * HALF[across].prod())
        centre = random.uniform(-HALF, HALF, (count, 3))
        centre[:, axis] = sign * HALF[axis]
        normal = np.zeros((count, 3))
        normal[:, axis] = -sign
        parts.append((centre, normal + random.normal(0, np.radians(noise), (count, 3))))
    count = int(clutter * sum(len(c) for c, _ in parts))
    parts.append((random.uniform(-HALF, HALF, (count, 3)), random.normal(size=(count, 3))))
    centres, normals = (np.concatenate(some) for some in zip(*parts, strict=True))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    areas = random.uniform(0.5, 1.5, len(centres)) / 250
    return Facets(turn.apply(centres), turn.apply(normals), areas)


def turned(poses: np.ndarray, turn: Rotation, pitch: float = 0.0) -> np.ndarray:
    """Cameras of a world that is turned, which look down by ``pitch`` degrees."""
    T = np.eye(4)
    T[:3, :3] = turn.as_matrix()
    down = np.eye(4)
    down[:3, :3] = Rotation.from_euler("x", -pitch, degrees=True).as_matrix()
    return T @ poses @ down


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


ASKEW = Rotation.from_euler("xyz", [70, -40, 20], degrees=True)


@pytest.mark.parametrize(
    ("sides", "pitch", "ahead"),
    [("EWNSFC", 0, 60), ("EWNSF", 25, 60), ("NEF", 40, 10), ("F", 30, 10), ("NF", 30, 10)],
)
def test_rooms_stand_upright_however_the_camera_was_held(sides, pitch, ahead):
    poses = turned(circle()[:ahead], ASKEW, pitch)
    found = level(room(ASKEW, sides), poses)
    assert found.share > 0.4
    assert degrees(found.axes[2], ASKEW.apply([0, 0, 1])) < 0.5
    assert np.allclose(found.axes @ found.axes.T, np.eye(3))
    assert np.linalg.det(found.axes) == pytest.approx(1)
    if len(sides) > 2:  # right runs along a wall
        assert np.abs(ASKEW.inv().apply(found.axes[0])[:2]).max() > np.cos(np.radians(1))
    np.testing.assert_allclose(found.y_down[[0, 2, 1]], found.axes * [[1], [1], [-1]])


def test_a_wall_alone_is_vertical_and_leaves_the_rest_to_the_camera():
    poses = turned(circle()[14:17], ASKEW, 10.0)  # towards the north
    found = level(room(ASKEW, "N"), poses)
    up = ASKEW.inv().apply(found.axes[2])
    assert abs(np.degrees(np.arcsin(up[1]))) < 0.5
    assert abs(np.degrees(np.arcsin(up[0]))) < 6


def test_what_has_no_planes_stands_as_the_camera_was_held():
    random = np.random.default_rng(0)
    normals = random.normal(size=(5000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = Facets(normals, normals, np.ones(5000))
    for surface in (ball, None, Facets(normals[:0], normals[:0], np.zeros(0))):
        found = level(surface, circle())
        assert found.share is None
        assert np.allclose(found.axes[2], [0, 0, 1])


def test_walls_and_ceilings_are_found_where_nothing_is_beyond():
    straight, axes = Rotation.identity(), np.eye(3)
    closed = find_room(room(straight, clutter=0.2), axes, circle())
    assert np.allclose(closed.high, HALF - 2 * HALF * DEEP, atol=0.05)
    assert np.allclose(closed.low[:2], -closed.high[:2], atol=0.05)
    assert closed.low[2] == -np.inf
    assert -1.2 < closed.ground < -0.9
    open_room = find_room(room(straight, "NEF", clutter=0.2), axes, circle())
    assert np.isfinite(open_room.high).tolist() == [True, True, False]
    assert np.isinf(open_room.low).all()
    table, tower = room(straight, "FC", clutter=0.2), room(straight, "F", clutter=0.2)
    higher = Facets(*(np.concatenate(pair) for pair in zip(table, tower, strict=True)))
    higher.centres[len(table.areas) :, 2] += 5
    assert find_room(higher, axes, circle()).high[2] == np.inf
    outwards = Facets(table.centres, -table.normals, table.areas)
    assert find_room(outwards, axes, circle()).high[2] == np.inf


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1)])
def test_nothing_is_hidden_from_where_the_camera_was(axis, sign):
    """Cameras that come near to a wall move its bound; one that they passed is none."""
    straight = Rotation.identity()
    surface = room(straight, clutter=0.2)
    near = circle()
    near[-1, axis, 3] = sign * (HALF[axis] - 0.05)
    found = find_room(surface, np.eye(3), near)
    bound = (found.high if sign > 0 else -found.low)[axis]
    assert HALF[axis] > bound >= HALF[axis] - 0.05
    near[-1, axis, 3] = sign * (HALF[axis] + 0.3)
    passed = find_room(surface, np.eye(3), near)
    assert (passed.high if sign > 0 else -passed.low)[axis] == np.inf
    others = np.abs(np.concatenate([passed.high, passed.low[:2]]))
    assert np.isfinite(others).sum() == 4


def test_an_open_room_is_seen_from_where_it_is_open():
    """Of a room whose south and west were not seen, the inner sides of the others face one."""
    surface = room(Rotation.identity(), "NEF", clutter=0.1)
    view = start_view(surface.centres, np.eye(3), circle(), surface)
    away = view.eye - view.target
    assert away[0] < 0
    assert away[1] < 0
    assert np.degrees(np.arcsin(away[2] / np.linalg.norm(away))) == pytest.approx(40, abs=0.1)


@pytest.mark.parametrize("half", [(3, 2, 1.2), (30, 1, 1), (0.01, 0.01, 0.01), (1, 1, 4)])
def test_all_of_it_fills_the_picture(half):
    points = box(half)[0] + [5, 6, 7]
    points = np.repeat(points, 100, 0)
    cameras = circle()
    cameras[:, :3, 3] = points.mean(0)
    eye, target = start_view(points, np.eye(3), cameras)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    seen = (points - eye) @ np.stack([right, np.cross(right, forward), forward], 1)
    place = seen[:, :2] / seen[:, 2:] / np.tan(np.radians(FIELD / 2)) / [ASPECT, 1]
    assert np.abs(place).max() < 1
    assert np.ptp(place, axis=0).max() > 1.75  # of 2
    assert np.abs(place.max(0) + place.min(0)).max() < 0.2  # in the middle
