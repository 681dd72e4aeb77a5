"""A found lens and its pinhole: images of a room, points there and back, two lenses in turn."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geogs.bundle.uncertainty.lens_error import lens_shapes
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.geometry.camera import Camera
from geogs.types import FoundLens, FrameLens
from geogs_synth.camera.radial_camera import RadialCamera
from lit_rooms import lit_room

CAMERA = Camera(fx=110.0, fy=110.0, cx=79.5, cy=59.5, width=160, height=120)
LENS = FoundLens(0.1, -0.2, 0.001, 0.002)
PLACES = [(60, 80), (20, 30), (100, 130), (60, 12)]
"""Row and column."""


def seen(row: float, column: float, lens: FoundLens) -> tuple[float, float]:
    """Column and row where the lens shows what the pinhole does, one by one."""
    x, y = (column - 79.5) / 110, (row - 59.5) / 110
    square = x * x + y * y
    growth = 1 + lens.k1 * square + lens.k2 * square**2
    focal = 110 * lens.focal
    return 79.5 + focal * (lens.right + x * growth), 59.5 + focal * (lens.down + y * growth)


def test_a_room_through_the_lens_becomes_that_of_the_pinhole():
    room = lit_room(0)
    T_wc = np.eye(4)
    T_wc[:3, :3] = [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]
    T_wc[:3, 3] = 2, 2, 1.4
    wanted, strong = room.render(CAMERA, T_wc).image, FoundLens(0.15, 0.1, 0.001, 0.001)
    bent = room.render(RadialCamera(CAMERA, strong.k1, strong.k2), T_wc).image
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
    assert farthest(StraightView(CAMERA, CAMERA, strong).image(bent)) < 0.25


@pytest.mark.parametrize(
    ("focal", "right", "down"), [(1.0, 0.0, 0.0), (0.95, 0.0, 0.0), (0.97, 0.03, -0.02)]
)
def test_what_a_pixel_shows_is_taken_where_the_lens_shows_it(focal, right, down):
    lens = replace(LENS, focal=focal, right=right, down=down)
    view = StraightView(CAMERA, CAMERA, lens)
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    straight = view.image(np.stack([u, v, 0.5 * (u + v)], -1).astype(np.uint8))
    nearest = view.nearest(np.stack([u, v], -1))
    for row, column in PLACES:
        wanted = seen(row, column, lens)
        np.testing.assert_allclose(straight[row, column, :2], wanted, atol=1.0)
        np.testing.assert_allclose(nearest[row, column], wanted, atol=0.51)
        (bent,) = view.bent(torch.tensor([[float(column), float(row)]])).numpy()
        np.testing.assert_allclose(bent, wanted, atol=1e-4)


@pytest.mark.parametrize(("focal", "right"), [(1.0, 0.0), (0.95, 0.0), (0.95, 0.04)])
def test_points_come_back_from_the_lens(focal, right):
    view = StraightView(CAMERA, CAMERA, replace(LENS, focal=focal, right=right, down=-0.02))
    pixels = torch.tensor([[c, r] for r, c in PLACES], dtype=torch.float64)[None]
    np.testing.assert_allclose(view.straight(view.bent(pixels)), pixels, atol=1e-3)


def test_where_a_polynomial_turns_back_nothing_is_shown():
    view = StraightView(CAMERA, CAMERA, FoundLens(0.0, -0.6, 0.001, 0.001))  # farthest at r = 0.76
    shown = view.straight(torch.tensor([[159.0, 59.5], [100.0, 59.5]], dtype=torch.float64))
    assert shown.isfinite().all(-1).tolist() == [False, True]


def test_black_stays_black():
    image = np.full((120, 160, 3), 200, np.uint8)
    image[:, :40] = 0
    straight = StraightView(CAMERA, CAMERA, LENS).image(image)
    for row in (10, 60, 110):
        black = [round(seen(row, column, LENS)[0]) < 40 for column in range(160)]
        assert (straight[row].max(-1) == 0).tolist() == black


def test_what_the_lens_did_not_see_is_known():
    wide = FoundLens(0.1, 0.1, 0.001, 0.001)  # shows the rim farther out than the pinhole has it
    is_seen = StraightView(CAMERA, CAMERA, wide).is_seen
    for row in (0, 30, 60, 119):
        for column in (0, 3, 80, 150, 159):
            u, v = seen(row, column, wide)
            assert is_seen[row, column] == (-0.5 <= u <= 159.5 and -0.5 <= v <= 119.5)
    assert 0.7 < is_seen.mean() < 0.99
    assert StraightView(CAMERA, CAMERA, FoundLens(-0.1, 0.0, 0.001, 0.001)).is_seen.all()


def test_the_lens_is_that_of_the_matches():
    """To first order: a pinhole's pixel less the one that is seen, as the adjustment has it."""
    lens = FoundLens(1e-3, -2e-3, 0.001, 0.001, right=2e-3, down=-1e-3)
    column, row = np.meshgrid(np.arange(160.0), np.arange(120.0))
    pixels = torch.from_numpy(np.stack([column, row], -1))
    shapes = lens_shapes(CAMERA, pixels)
    wanted = lens.k1 * shapes[1] + lens.k2 * shapes[2]
    wanted = wanted + lens.right * shapes[3] + lens.down * shapes[4]
    bent = StraightView(CAMERA, CAMERA, lens).bent(pixels)
    np.testing.assert_allclose(pixels - bent, wanted, atol=1e-4)


def test_what_a_frame_has_of_its_own_is_taken_off():
    views = FrameViews(StraightView(CAMERA, CAMERA, LENS), {7: FrameLens(0.02, 0.03, -0.02)})

    def shown(view: StraightView) -> np.ndarray:
        """Waves, as a lens shows them to which the pinhole's pixels bend."""
        pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), -1)
        x, y = np.nan_to_num(view.straight(torch.from_numpy(pixels))).transpose(2, 0, 1)
        wave = 127 + 60 * np.sin(x / 9) + 60 * np.cos(y / 7)
        return np.repeat(wave[..., None], 3, 2).round().astype(np.uint8)

    own, common = shown(views.of(7)), shown(views.view)
    inside = np.s_[12:-12, 12:-12]

    def farthest(image: np.ndarray) -> int:
        return int(np.abs(image.astype(int) - common)[inside].max())

    assert farthest(views.alike(7, own)) <= 3
    assert farthest(own) > 50
    assert views.alike(8, own) is own
