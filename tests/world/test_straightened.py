"""Images that a found lens bent, straightened: against what a pinhole sees of the same room."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geogs.bundle.uncertainty.lens_error import lens_shapes
from geogs.geometry.camera import Camera
from geogs.geometry.distortion import lens_maps
from geogs.types import FoundLens
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from geogs_synth.camera.radial_camera import RadialCamera
from lit_rooms import lit_room

CAMERA = Camera(fx=110.0, fy=110.0, cx=79.5, cy=59.5, width=160, height=120)
LENS = FoundLens(0.1, -0.2, 0.001, 0.002)


def one_keyframe(image: np.ndarray, encode=None) -> KeyframeSet:
    keyframes = KeyframeTable.on(SampleGrid(CAMERA), encode).new_set()
    keyframes.add(0, 0.0, image, None, torch.eye(4, dtype=torch.float64))
    return keyframes


def test_a_room_through_the_lens_becomes_that_of_the_pinhole():
    room = lit_room(0)
    T_wc = np.eye(4)
    T_wc[:3, :3] = [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]
    T_wc[:3, 3] = 2, 2, 1.4
    wanted, strong = room.render(CAMERA, T_wc).image, FoundLens(0.15, 0.1, 0.001, 0.001)
    bent = room.render(RadialCamera(CAMERA, strong.k1, strong.k2), T_wc).image
    keyframes = one_keyframe(bent)
    keyframes.straighten(strong)
    window = cv2.createHanningWindow((48, 40), cv2.CV_32F)

    def grey(image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(image.astype(np.float32).mean(-1), (0, 0), 1.0)

    def farthest(image: np.ndarray) -> float:
        """Most pixels by which a part of the image lies off that of the pinhole."""
        return max(
            float(np.hypot(*cv2.phaseCorrelate(grey(wanted)[part], grey(image)[part], window)[0]))
            for part in (np.s_[y : y + 40, x : x + 48] for y in (8, 40, 72) for x in (8, 56, 104))
        )

    assert farthest(bent) > 1.5
    assert farthest(keyframes[0].image) < 0.25
    assert keyframes.table.lens == strong


def test_what_a_pixel_shows_is_taken_where_the_lens_shows_it():
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    image = np.stack([u, v, 0.5 * (u + v)], -1).astype(np.uint8)
    keyframes = one_keyframe(image)
    keyframes[0].sensor_depth = (1 + u / 160).astype(np.float32)
    keyframes.straighten(LENS)
    straight, depth = keyframes[0].image, keyframes[0].sensor_depth
    for row, column in [(60, 80), (20, 30), (100, 130), (60, 12)]:
        x, y = (column - 79.5) / 110, (row - 59.5) / 110
        factor = 1 + 0.1 * (x * x + y * y) - 0.2 * (x * x + y * y) ** 2
        seen = np.array([79.5 + 110 * x * factor, 59.5 + 110 * y * factor])
        np.testing.assert_allclose(straight[row, column, :2], seen, atol=1.0)
        assert depth[row, column] == pytest.approx(1 + round(seen[0]) / 160, rel=1e-3)


def test_depths_go_with_the_image_and_those_of_the_adjustment_stay():
    keyframes = one_keyframe(np.zeros((120, 160, 3), np.uint8))
    keyframe, grid = keyframes[0], keyframes.grid
    keyframe.inverse_depth = 0.5 + grid.pixels[:, 0] / 160
    keyframe.information = torch.full_like(keyframe.inverse_depth, 100.0)
    before = keyframe.inverse_depth.clone()
    keyframes.straighten(LENS)
    assert torch.equal(keyframe.inverse_depth, before)
    field = keyframe.depth_field()[0].reshape(-1)
    x, y = (grid.rays[:, k].numpy() for k in (0, 1))
    square = x * x + y * y
    seen = 79.5 + 110 * x * (1 + 0.1 * square - 0.2 * square**2)
    low, high = float(grid.pixels[:, 0].min()), float(grid.pixels[:, 0].max())
    np.testing.assert_allclose(field, 0.5 + seen.clip(low, high) / 160, atol=1e-4)


def test_a_focal_length_that_was_found_is_taken_off_images_and_depths():
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    image = np.stack([u, v, 0.5 * (u + v)], -1).astype(np.uint8)
    keyframes = one_keyframe(image)
    keyframe, before = keyframes[0], keyframes.grid
    keyframe.inverse_depth = 0.5 + before.pixels[:, 0] / 160
    keyframe.information = torch.full_like(keyframe.inverse_depth, 100.0)
    keyframes.straighten(replace(LENS, focal=0.95))
    assert (keyframes.camera, keyframes.grid.camera.fx) == (CAMERA, pytest.approx(0.95 * 110))
    straight = keyframe.image
    for row, column in [(60, 80), (20, 30), (100, 130), (60, 12)]:
        x, y = (column - 79.5) / 110, (row - 59.5) / 110
        factor = 0.95 * (1 + 0.1 * (x * x + y * y) - 0.2 * (x * x + y * y) ** 2)
        seen = np.array([79.5 + 110 * x * factor, 59.5 + 110 * y * factor])
        np.testing.assert_allclose(straight[row, column, :2], seen, atol=1.0)
    x, y = (before.rays[:, k].numpy() for k in (0, 1))
    square = x * x + y * y
    seen = 79.5 + 110 * x * 0.95 * (1 + 0.1 * square - 0.2 * square**2)
    low, high = float(before.pixels[:, 0].min()), float(before.pixels[:, 0].max())
    field = keyframe.depth_field()[0].reshape(-1)
    np.testing.assert_allclose(field, 0.5 + seen.clip(low, high) / 160, atol=1e-4)
    again = KeyframeTable(lens=keyframes.table.lens).attached(SampleGrid(CAMERA))
    assert again.grid.camera == keyframes.grid.camera


def test_black_stays_black_and_features_are_made_anew():
    image = np.full((120, 160, 3), 200, np.uint8)
    image[:, :40] = 0
    keyframes = one_keyframe(image, encode=lambda image: float(image.mean()))
    straightened = keyframes[0]
    keyframes.table.arrays.recent("encoded").put(0, -1.0)
    keyframes.straighten(LENS)
    assert straightened.encoded == float(straightened.image.mean())
    u, _ = lens_maps(CAMERA, CAMERA, (LENS.k1, LENS.k2, 0.0, 0.0), "polynomial")
    assert np.array_equal(straightened.image.max(-1) == 0, np.rint(u) < 40)


def test_the_lens_is_that_of_the_matches():
    """To first order: a pinhole's pixel less the one that is seen, as the adjustment has it."""
    k1, k2 = 1e-3, -2e-3
    u, v = lens_maps(CAMERA, CAMERA, (k1, k2, 0.0, 0.0), "polynomial")
    column, row = np.meshgrid(np.arange(160.0), np.arange(120.0))
    pixels = torch.from_numpy(np.stack([column, row], -1))
    shapes = lens_shapes(CAMERA, pixels)
    wanted = (k1 * shapes[1] + k2 * shapes[2]).numpy()
    np.testing.assert_allclose(pixels.numpy() - np.stack([u, v], -1), wanted, atol=1e-4)
