"""The choice of views: against a slow reference, and of images of which one knows the best."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from geogs.depth.sweep_neighbors import BEST_PARALLAX_DEG, MAX_PARALLAX_DEG, MIN_PARALLAX_DEG
from geogs.geometry.camera import Camera
from geogs.mapping.coverage import (
    Sightings,
    coverage_order,
    relative_sharpness,
    scene_points,
    sightings,
)

CAMERA = Camera(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)


def looking(centre: np.ndarray, yaw: float) -> np.ndarray:
    """World to camera from a place, turned about the vertical axis (y, down)."""
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:3, :3] = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    T[:3, 3] = -T[:3, :3] @ centre
    return T


def walk(count: int, turn: float = 2 * np.pi, radius: float = 0.5) -> np.ndarray:
    """Cameras on a circle that look outwards."""
    angles = np.linspace(0, turn, count, endpoint=False)
    return np.stack(
        [looking(radius * np.array([np.sin(a), 0, np.cos(a)]), float(a)) for a in angles]
    )


def seen_by(T_cw: np.ndarray, depth: float = 2.0) -> Sightings:
    typical = np.full(len(T_cw), depth)
    points = scene_points(T_cw, CAMERA, typical, np.random.default_rng(0))
    return sightings(T_cw, CAMERA, typical, points)


def slow_order(seen: Sightings, sharpness: np.ndarray, copy: float = 0.02) -> list[int]:
    """The definition, all of it anew for every choice."""
    rays: list[dict[int, np.ndarray]] = [{} for _ in range(seen.views)]
    for point, view, ray in zip(seen.point, seen.view, seen.ray, strict=True):
        rays[view][int(point)] = ray
    chosen: list[int] = []
    while True:
        best, most = None, -1.0
        for view in range(seen.views):
            if view in chosen:
                continue
            news, gain = [], 0.0
            for point, ray in rays[view].items():
                others = [rays[c][point] for c in chosen if point in rays[c]]
                if not others:
                    news.append(1.0)
                    gain += 0.5
                    continue
                cosine = max(float(np.clip(ray @ o, -1, 1)) for o in others)
                angle = np.degrees(np.arccos(cosine))
                new = min(angle / BEST_PARALLAX_DEG, 1.0)
                if angle > MAX_PARALLAX_DEG:
                    new = 1.0 if angle > 75.0 else 0.5
                news.append(new)
                gain += new / len(others)
            if news and np.mean(news) <= copy:
                continue
            if gain * sharpness[view] > most * (1 + 1e-6):
                best, most = view, gain * sharpness[view]
        if best is None:
            return chosen
        chosen.append(best)


def test_the_order_is_that_of_the_definition():
    rng = np.random.default_rng(3)
    T_cw = np.stack([looking(rng.uniform(-1, 1, 3), rng.uniform(-3, 3)) for _ in range(16)])
    seen, sharpness = seen_by(T_cw), rng.uniform(0.5, 1.0, 16)
    order = list(coverage_order(seen, sharpness))
    assert order == slow_order(seen, sharpness)
    assert len(order) == 16


@pytest.mark.parametrize("copy", [0.1, 0.3])
def test_those_are_copies_that_see_nothing_from_elsewhere(copy):
    seen = seen_by(walk(40, turn=1.0))
    order = list(coverage_order(seen, np.ones(40), copy))
    assert order == slow_order(seen, np.ones(40), copy)
    assert {0.1: 12, 0.3: 3}[copy] < len(order) < {0.1: 30, 0.3: 15}[copy]


def test_every_beginning_covers_what_as_many_evenly_spread_ones_do():
    T_cw = walk(100)
    seen = seen_by(T_cw)

    def measurable(views: list[int]) -> float:
        """Part of the points that two of the views see from apart enough, but not too much."""
        begin = np.searchsorted(seen.point, np.arange(seen.point.max() + 2))
        found = []
        for rows in map(slice, begin[:-1], begin[1:]):
            rays = seen.ray[rows][np.isin(seen.view[rows], views)].astype(np.float64)
            angles = np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)))
            apart = (angles > MIN_PARALLAX_DEG) & (angles < MAX_PARALLAX_DEG)
            found.append(apart.any())
        return float(np.mean(found))

    order = list(islice(coverage_order(seen, np.ones(100)), 20))
    for count, least in ((6, 0.4), (10, 0.7), (20, 0.97)):
        even = np.linspace(0, 99, count).astype(int).tolist()
        shares = measurable(order[:count]), measurable(even)
        print(f"{count} views: {shares[0]:.3f}, evenly spread {shares[1]:.3f}")
        assert shares[0] > least
        assert shares[0] > shares[1] - 0.03


def test_copies_are_left_out_and_all_others_stay():
    T_cw = walk(40)
    rested = np.concatenate([T_cw, np.repeat(T_cw[7:8], 30, axis=0)])
    order = list(coverage_order(seen_by(rested), np.ones(70)))
    kept = {i if i < 40 else 7 for i in order}
    assert len(order) == 40
    assert kept == set(range(40))


def test_a_camera_that_only_turns_adds_what_it_sees_anew():
    T_cw = np.stack([looking(np.zeros(3), 0.5 * i) for i in range(12)])
    order = list(coverage_order(seen_by(T_cw), np.ones(12)))
    assert len(order) > 6


def test_of_near_images_the_sharp_one_is_taken():
    T_cw = walk(120)
    detail = np.full(120, 1000)
    blurred = np.arange(120) % 3 != 1
    detail[blurred & (np.arange(120) % 2 == 0)] = 500
    sharpness = relative_sharpness(T_cw, 2.0, detail.tolist())
    assert sharpness[detail == 1000].min() == 1.0
    order = list(islice(coverage_order(seen_by(T_cw), sharpness), 30))
    assert np.mean(detail[order] == 500) < 0.1 < 0.3 < np.mean(detail == 500)
    assert relative_sharpness(T_cw[:3], 2.0, [1, 2, 3]).tolist() == [1, 1, 1]


def test_a_place_with_less_detail_is_not_taken_for_blurred():
    T_cw = walk(90)
    detail = np.where(np.arange(90) < 45, 1000, 300)
    sharpness = relative_sharpness(T_cw, 2.0, detail.tolist())
    assert np.mean(sharpness == 1.0) > 0.9


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_unit_of_the_world_does_not_matter(scale):
    T_cw = walk(30)
    T_cw[:, :3, 3] *= scale
    typical = np.full(30, 2.0 * scale)
    points = scene_points(T_cw, CAMERA, typical, np.random.default_rng(0))
    assert 100 < len(points) <= 360
    order = list(coverage_order(sightings(T_cw, CAMERA, typical, points), np.ones(30)))
    assert len(order) == 30


def test_images_that_see_nothing_come_last():
    T_cw = walk(10)
    seen = seen_by(T_cw)
    blind = replace(seen, views=12)
    order = list(coverage_order(blind, np.ones(12)))
    assert sorted(order[-2:]) == [10, 11]
