"""The scale by tags: rendered exactly, blurred and noisy, in a map of another unit."""

import cv2
import numpy as np
import pytest

from geogs.application.scale.measurable_scene import MeasurableScene, SeenKeyframe
from geogs.application.scale.tags import TagDetector, TagSize, scale_by_tags, triangulated
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.types import Trajectory

CAMERA = Camera(fx=360.0, fy=360.0, cx=255.5, cy=191.5, width=512, height=384)
SIDE = 0.16
FAMILY = "DICT_5X5_50"
TEXELS = 20
"""To the bit."""
UNIT = 0.37
"""Map units to the metre."""


def wall(ids: tuple[int, ...] = (3, 7)) -> tuple[np.ndarray, float]:
    """Tags side by side on a light wall, and how long a texel is in metres."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY))
    tags = [cv2.aruco.generateImageMarker(dictionary, id, 7 * TEXELS) for id in ids]
    image = np.full((20 * TEXELS, 34 * TEXELS), 200, np.uint8)
    for n, tag in enumerate(tags):
        image[6 * TEXELS : 13 * TEXELS, (6 + 14 * n) * TEXELS :][: 7 * TEXELS, : 7 * TEXELS] = tag
    return image, SIDE / (7 * TEXELS)


def view(T_cw: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """The wall in the plane z = 0 as a camera sees it, four samples to the pixel's side."""
    image, texel = wall()
    fine = CAMERA.resized(4 * CAMERA.width, 4 * CAMERA.height)
    height, width = image.shape
    to_world = np.array(
        [[texel, 0, -width / 2 * texel], [0, texel, -height / 2 * texel], [0, 0, 1]]
    )
    to_world[:2, 2] += texel / 2
    H = fine.matrix().numpy() @ np.c_[T_cw[:3, :2], T_cw[:3, 3]] @ to_world
    seen = cv2.warpPerspective(image, H, (fine.width, fine.height), borderValue=120)
    seen = cv2.resize(seen, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    noisy = cv2.GaussianBlur(seen, (0, 0), 0.6) + noise * rng.standard_normal(seen.shape)
    return np.repeat(noisy.clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def towards(centre: np.ndarray) -> np.ndarray:
    """World to camera of one that looks at the middle of the wall."""
    z = -centre / np.linalg.norm(centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ centre
    return T


def scene(count: int, noise: float = 0.0, seed: int = 0, spread: float = 0.5) -> MeasurableScene:
    rng = np.random.default_rng(seed)
    keyframes = []
    for k in range(count):
        swing = spread * (2 * k / max(count - 1, 1) - 1)
        T = towards(np.array([swing, 0.3 * rng.uniform(-1, 1) * spread, -0.9]))
        image = view(T, noise, rng)
        T = T.copy()
        T[:3, 3] *= UNIT
        keyframes.append(SeenKeyframe(T, image))
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)), np.zeros(0, bool))
    return MeasurableScene(
        CAMERA, CAMERA, keyframes, empty, lambda T: np.zeros((CAMERA.height, CAMERA.width))
    )


@pytest.mark.parametrize(("noise", "bound"), [(0.0, 0.002), (5.0, 0.003)])
def test_a_tag_tells_the_scale(noise, bound):
    found = scale_by_tags(scene(6, noise), TagSize(FAMILY, SIDE))
    assert found.factor * UNIT == pytest.approx(1, abs=bound)
    assert 0.003 <= found.deviation < 0.01
    assert found.origin == "2 tags of 0.16 m in 12 sightings"


def test_a_view_that_lies_is_left_out():
    good = scene(7)
    wrong = good.keyframes[3].T_cw.copy()
    wrong[0, 3] += 0.05
    keyframes = [*good.keyframes[:3], SeenKeyframe(wrong, good.keyframes[3].image)]
    lying = MeasurableScene(
        CAMERA, CAMERA, [*keyframes, *good.keyframes[4:]], good.trajectory, good.surface
    )
    found = scale_by_tags(lying, TagSize(FAMILY, SIDE))
    assert found.factor * UNIT == pytest.approx(1, abs=0.003)


def test_what_tells_no_scale_says_why():
    with pytest.raises(InputError, match="in too few places"):
        scale_by_tags(scene(3, spread=0.002), TagSize(FAMILY, SIDE))
    with pytest.raises(InputError, match="no tag of DICT_4X4_50 was found"):
        scale_by_tags(scene(1), TagSize("DICT_4X4_50", SIDE))
    with pytest.raises(InputError, match="knows no tags called DICT_9"):
        TagDetector("DICT_9")


def test_corners_are_found_to_a_tenth_of_a_pixel():
    T = towards(np.array([0.3, -0.1, -0.9]))
    found = TagDetector(FAMILY)(view(T, 0.0, np.random.default_rng(0)))
    assert sorted(found) == [3, 7]
    _, texel = wall()
    for n, id in enumerate((3, 7)):
        left, top = (6 + 14 * n) * TEXELS, 6 * TEXELS
        corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * 7 * TEXELS + [left, top]
        world = (corner - [17 * TEXELS, 10 * TEXELS]) * texel
        seen = np.c_[world, np.zeros(4)] @ T[:3, :3].T + T[:3, 3]
        pixels = seen[:, :2] / seen[:, 2:] * 360 + [255.5, 191.5]
        assert np.abs(found[id] - pixels).max() < 0.1


def test_triangulating_exact_pixels_gives_the_point():
    point = np.array([0.1, -0.2, 0.3])
    rays = []
    for x in (-0.5, 0.0, 0.4):
        T = towards(np.array([x, 0.1, -1.0]))
        seen = T[:3, :3] @ point + T[:3, 3]
        rays.append((T, seen[:2] / seen[2] * 360 + [255.5, 191.5]))
    np.testing.assert_allclose(triangulated(CAMERA, rays), point, atol=1e-9)
    assert triangulated(CAMERA, rays[:1]) is None
    assert triangulated(CAMERA, [rays[0], rays[0]]) is None
