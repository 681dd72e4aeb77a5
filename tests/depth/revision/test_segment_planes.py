"""A bare wall around a corner, a ball, and the sky: what lies on planes, and what stays."""

import cv2
import numpy as np
import pytest
import torch

from geogs.depth.depth_view import DenseDepth, KeyframeDepth
from geogs.depth.revision import segment_plane_kernels as kernels
from geogs.depth.revision.segment_plane_kernels import PlaneRules
from geogs.depth.revision.segment_planes import (
    CONFIDENCE,
    MIN_AREA,
    MOST_PLANES,
    bare_segments,
    on_planes,
    planar_depth,
)
from geogs.geometry.camera import Camera

CAMERA = Camera(fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)
V, U = np.mgrid[:120.0, :160.0]


def textured(seed: int = 0) -> np.ndarray:
    """An image of which no part is bare."""
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(0, 255, (60, 80, 3), np.uint8), (160, 120))


def wall(a: float = 0.0008, b: float = 0.0004, c: float = 0.3) -> np.ndarray:
    """Inverse depth of a plane."""
    return a * U + b * V + c


def bowed(inverse: np.ndarray, inside: np.ndarray) -> KeyframeDepth:
    """A search that knows a plane but inside, where it is off by up to 30 % and unsure."""
    off = 0.3 * np.sin(np.pi * U / 160) * np.sin(np.pi * V / 120)
    found = np.where(inside, inverse * (1 + off), inverse)
    confidence = np.where(inside, 0.2, 0.9)
    return KeyframeDepth((1 / found).astype(np.float32), confidence.astype(np.float32))


def box(left: int, right: int, top: int = 20, low: int = 100) -> np.ndarray:
    return (left <= U) & (right > U) & (top <= V) & (low > V)


def image_with(bare: np.ndarray) -> np.ndarray:
    image = textured()
    image[bare] = (180, 170, 160)
    return image


def test_bare_parts_are_found_at_any_size():
    bare = box(30, 130)
    for factor in (1, 4):
        size = (160 * factor, 120 * factor)
        image = cv2.resize(image_with(bare), size, interpolation=cv2.INTER_NEAREST)
        labels = bare_segments(image)
        assert max(labels.shape) == min(320, 160 * factor)
        found = cv2.resize(labels, (160, 120), interpolation=cv2.INTER_NEAREST)
        assert set(np.unique(found)) == {0, 1}
        assert (found[24:96, 34:126] == 1).all()
        assert not found[~bare].any()
    small = box(70, 77, 50, 57)
    assert small.sum() < MIN_AREA * small.size
    assert not bare_segments(image_with(small)).any()


def planes_of(found: KeyframeDepth, image: np.ndarray, sky: np.ndarray | None = None):
    """Depth on planes, and where it is taken."""
    planar = on_planes(found, bare_segments(image), sky, 0)
    depth, taken = found.depth.copy(), np.zeros(found.depth.shape, bool)
    depth.ravel()[planar.pixels] = planar.depth
    taken.ravel()[planar.pixels] = True
    return depth, taken


def test_a_bare_wall_is_flat():
    inverse, bare = wall(), box(30, 130)
    found = bowed(inverse, box(36, 124, 26, 94))
    depth, taken = planes_of(found, image_with(bare))
    assert np.abs(found.depth * inverse - 1).max() > 0.2
    assert (taken == box(36, 124, 26, 94)).mean() > 0.99
    assert np.abs(depth * inverse - 1)[taken].max() < 0.002
    again, _ = planes_of(found, image_with(bare))
    assert (again == depth).all()


def test_a_depth_of_another_size_than_the_segments_has_the_same_planes():
    """As on a GPU, whose depths are larger."""
    inverse, bare = wall(), box(30, 130)
    found = bowed(inverse, box(36, 124, 26, 94))
    large = [
        cv2.resize(m, (480, 360), interpolation=cv2.INTER_NEAREST)
        for m in (found.depth, found.confidence)
    ]
    depth, taken = planes_of(KeyframeDepth(*large), image_with(bare))
    v, u = (np.mgrid[:360.0, :480.0] + 0.5) / 3 - 0.5
    off = np.abs(depth * (0.0008 * u + 0.0004 * v + 0.3) - 1)
    assert taken.mean() == pytest.approx(box(36, 124, 26, 94).mean(), rel=0.02)
    assert off[taken].max() < 0.004


def test_a_corner_is_of_two_planes():
    inverse = np.where(U < 80, wall(0.003), wall(-0.003, c=0.3 + 0.006 * 80))
    bare = box(20, 140)
    found = bowed(inverse, box(28, 132, 28, 92))
    depth, taken = planes_of(found, image_with(bare))
    assert (np.abs(depth * inverse - 1)[taken] < 0.01).mean() > 0.9
    assert taken[box(28, 132, 28, 92)].mean() > 0.9


def test_what_is_sure_and_what_is_no_plane_stay():
    ball = 0.3 + 0.2 * np.sqrt(np.clip(1 - ((U - 80) / 60) ** 2 - ((V - 60) / 45) ** 2, 0, 1))
    image = image_with(box(30, 130))
    sure = KeyframeDepth((1 / ball).astype(np.float32), np.full(ball.shape, 0.8, np.float32))
    assert not planes_of(sure, image)[1].any()
    unsure = bowed(ball, box(60, 100, 40, 80))
    assert not planes_of(unsure, image)[1].any()


def test_a_plane_is_not_gone_on_with_far_from_where_it_is_known():
    inverse, bare = wall(), box(30, 130)
    known = box(30, 44, 40, 54)  # a corner of the wall alone
    noise = np.random.default_rng(0).normal(0, 0.005, inverse.shape)
    found = bowed(inverse * (1 + noise), ~known)
    _, taken = planes_of(found, image_with(bare))
    assert not taken[:, 90:].any()


def test_what_lies_beyond_a_faint_edge_is_on_none_of_the_planes():
    """A bare part goes on from a wall to a slope above it, of which only the far rim is known."""
    wall_below, slope = wall(), wall(0.0, -0.004, 0.55)
    above = V < 60
    inverse = np.where(above, slope, wall_below)
    found = bowed(inverse, box(36, 124, 26, 60))
    _, taken = planes_of(found, image_with(box(30, 130)))
    assert not taken[box(36, 124, 26, 60)].any()
    _, taken = planes_of(bowed(wall_below, box(36, 124, 26, 60)), image_with(box(30, 130)))
    assert taken[box(36, 124, 26, 60)].mean() > 0.9


def test_the_sky_is_no_plane():
    inverse, bare = wall(), box(30, 130)
    found = bowed(inverse, box(36, 124, 26, 94))
    assert not planes_of(found, image_with(bare), box(30, 130, 20, 60))[1].any()
    assert planes_of(found, image_with(bare), box(30, 50, 20, 30))[1].any()


@pytest.mark.parametrize("slopes", [(0.0008, 0.0004), (0.0, 0.0), (-0.0015, 0.0005)])
def test_normals_are_those_of_the_plane(slopes):
    inverse, bare = wall(*slopes, c=0.4), box(30, 130)
    found = bowed(inverse, box(36, 124, 26, 94))
    depth, confidence = (torch.from_numpy(x) for x in (found.depth, found.confidence))
    dense = DenseDepth(depth, confidence, depth.median(), normal=torch.zeros(120, 160, 3))
    planar = planar_depth(bare_segments(image_with(bare)), dense, CAMERA, 0)
    taken = planar.depth != depth
    assert (planar.confidence[taken] == CONFIDENCE).all()
    assert (planar.confidence[~taken] == confidence[~taken]).all()
    points = CAMERA.back_project(torch.from_numpy(1 / inverse))
    across, down = points[60, 81] - points[60, 80], points[61, 80] - points[60, 80]
    normal = torch.linalg.cross(across, down)
    normal = -normal / normal.norm() * normal[2].sign()
    assert torch.allclose(planar.normal[60, 80].double(), normal, atol=1e-3)
    assert not planar.normal[0, 0].any()


RULES = PlaneRules(2)


def slow_planes(x, y, value, weight, rng):
    """Each plane by samples drawn with NumPy, all tried at once, and least squares."""
    places, left, planes = np.stack([x, y, np.ones_like(x)], -1), np.arange(len(x)), []
    for _ in range(MOST_PLANES):
        at, v, w = places[left], value[left], weight[left]
        drawn = rng.choice(len(left), (64, 3), p=w / w.sum())
        drawn = drawn[np.abs(np.linalg.det(at[drawn])) > 1e-9]
        tried = np.linalg.solve(at[drawn], v[drawn][..., None])[..., 0]
        ons = np.abs(tried @ at.T - v) < RULES.tolerance * v
        on = ons[np.argmax((ons * w).sum(1))]
        for _ in range(RULES.refits):
            root = np.sqrt(w[on])
            plane = np.linalg.lstsq(at[on] * root[:, None], v[on] * root, rcond=None)[0]
            fitted, on = on, np.abs(at @ plane - v) < RULES.tolerance * v
        if w[on].sum() < RULES.min_explained * weight.sum():
            break
        information = (at[fitted] * w[fitted, None]).T @ at[fitted]
        deviation = RULES.tolerance / 2 * v[on].mean()
        planes.append(
            (plane, RULES.correlated * deviation**2 * np.linalg.inv(information), left[on])
        )
        left = left[~on]
    return planes


def planes_of_image(value: np.ndarray, weight: np.ndarray, known: np.ndarray, seed: int = 0):
    """Planes of an image that is one segment; the places, values and weights of the pixels used."""
    shape = value.shape
    depth, weight = (1 / value).astype(np.float32), weight.astype(np.float32)
    box, draws = np.array([0, 0, *shape]), np.random.default_rng(seed).random((MOST_PLANES, 64, 3))
    parts, marked = np.zeros((2, *shape), np.int32)
    planes, covariances, tried, some, of = kernels.planes_of_segment(
        np.ones(shape, np.int32), np.int64(1), box, ~known, known, depth, weight, draws, RULES,
        parts, marked,
    )  # fmt: skip
    v, u = np.unravel_index(some, shape)
    x, y = (u + 0.5) / shape[1] - 0.5, (v + 0.5) / shape[0] - 0.5
    known_depth, known_weight = (m.ravel()[some].astype(np.float64) for m in (depth, weight))
    return planes, covariances, tried, of, (x, y, 1 / known_depth, known_weight)


def test_planes_are_those_of_the_slow_fit():
    """A corner with noise and outliers, weighted unevenly."""
    random = np.random.default_rng(5)
    y, x = (np.mgrid[:25.0, :28.0] + 0.5) / np.array([25, 28])[:, None, None] - 0.5
    value = np.where(x < 0.05, 0.4 + 0.3 * x + 0.05 * y, 0.45 - 0.5 * x)
    value *= 1 + 0.005 * random.standard_normal(value.shape)
    value.ravel()[::31] *= random.uniform(0.5, 2, value.ravel()[::31].shape)
    weight = random.uniform(0.7, 1, value.shape)
    planes, covariances, tried, of, given = planes_of_image(value, weight, value > 0, 6)
    assert len(of) == value.size
    expected = slow_planes(*given, np.random.default_rng(6))
    assert (len(planes), tried) == (2, 2)
    assert len(expected) == 2
    for k, (plane, covariance, on) in enumerate(expected):
        assert planes[k] == pytest.approx(plane, rel=1e-6)
        assert covariances[k] == pytest.approx(covariance, rel=1e-4, abs=1e-9)
        assert np.array_equal(np.flatnonzero(of == k + 1), on)


@pytest.mark.parametrize("seed", range(3))
def test_rims_and_parts_are_those_of_opencv(seed):
    random = np.random.default_rng(seed)
    labels = (cv2.blur(random.random((60, 80)), (9, 9)) > 0.5).astype(np.int32)
    sure, depth = random.random((60, 80)) > 0.4, np.ones((60, 80), np.float32)
    unsure = ~sure & (cv2.blur(random.random((60, 80)), (5, 5)) > 0.48)
    boxes, counts = np.empty((1, 4), np.int64), np.empty((1, 3), np.int64)
    kernels.segment_boxes(labels, unsure, sure, boxes, counts)
    segment = labels == 1
    assert counts[0].tolist() == [segment.sum(), (segment & unsure).sum(), (segment & sure).sum()]
    rim = np.ones((5, 5), np.uint8)
    near = cv2.dilate(segment.astype(np.uint8), rim) > 0
    known = kernels.rim_pixels(labels, 1, boxes[0], 2, sure)
    assert np.array_equal(known, np.flatnonzero(near & sure))
    depth[:, 40:] = 2  # of which the plane is none
    planes, rules = np.array([[0.0, 0.0, 1.0]]), RULES._replace(min_pixels=12)
    parts, marked = np.zeros((2, 60, 80), np.int32)
    kernels.mark_supported(labels, 1, boxes[0], unsure, sure, depth, planes, rules, parts, marked)
    count, numbers = cv2.connectedComponents((segment & unsure).astype(np.uint8))
    expected = np.zeros((60, 80), bool)
    for number in range(1, count):
        part = numbers == number
        around = (cv2.dilate(part.astype(np.uint8), rim) > 0) & sure
        least = RULES.min_on_plane * max(1, around.sum())
        if part.sum() >= 12 and (around & (depth == 1)).sum() >= least:
            expected |= part
    assert expected.any()
    assert np.array_equal(marked > 0, expected)


def test_no_plane_of_too_little():
    inverse, confidence = wall(), np.full(U.shape, 0.9)
    few = np.zeros(U.shape, bool)
    few[60, 60:95] = True
    assert not len(planes_of_image(inverse, confidence, few)[0])
    (plane,), (covariance,), _, of, given = planes_of_image(inverse, confidence, inverse > 0)
    assert (of == 1).all()
    places = np.stack([*given[:2], np.ones(len(of))], -1)
    assert places @ plane == pytest.approx(given[2], rel=1e-6)
    variance = np.einsum("ni,ij,nj->n", places, covariance, places)
    assert float((np.sqrt(variance) / given[2]).max()) < 0.02
