"""Bars, fills and corners that show no scene, and what lies at the border of a scene itself."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from geogs.application.calibrate import warn_of_border, without_overlay
from geogs.config import InputConfig
from geogs.geometry.camera import Camera
from geogs.io.sources.borders import find_border
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.sniff import open_source
from geogs.io.sources.static_overlay import IMAGES, is_turntable
from io_samples import write_video
from moving_wall import HEIGHT, WIDTH, seen
from progress_listener import Listener

LETTERBOX = (40, 40, 0, 0)


def wall(count: int = IMAGES, step: float = 5.0, seed: int = 0) -> list[np.ndarray]:
    """A textured wall in colour that a camera moves along."""
    return [np.repeat(image[..., None], 3, 2) for image in seen(count, step, seed)]


def barred(
    images: list[np.ndarray], sides: tuple[int, int, int, int], colour: tuple[int, int, int]
) -> list[np.ndarray]:
    """Images with bars above, below, left and right."""
    return [
        cv2.copyMakeBorder(image, *sides, cv2.BORDER_CONSTANT, value=colour) for image in images
    ]


def filled(image: np.ndarray, blur: float) -> np.ndarray:
    """A picture between blurred, enlarged copies of itself at its left and right."""
    big = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    out = cv2.GaussianBlur(big, (0, 0), blur)[60:180]
    out[:, 80:240] = image
    return out


@pytest.mark.parametrize(
    ("sides", "colour"),
    [
        (LETTERBOX, (0, 0, 0)),
        ((0, 0, 31, 33), (90, 90, 90)),
        ((12, 0, 0, 0), (255, 255, 255)),
        ((20, 14, 30, 40), (200, 60, 20)),
        ((5, 5, 0, 0), (0, 0, 0)),
    ],
)
def test_bars_are_found_to_the_pixel(sides, colour):
    border = find_border(barred(wall(), sides, colour))
    assert border is not None
    assert border.sides == sides


def test_a_bar_with_a_clock_and_one_with_texture_are_found():
    images = barred(wall(), (40, 30, 0, 0), (30, 30, 30))
    for k, image in enumerate(images):
        cv2.putText(image, f"{k:02d}", (5, 30), 0, 0.8, (255, 255, 255), 2)
        image[-30:] = wall(1, seed=5)[0][:30]
    border = find_border(images)
    assert border is not None
    assert border.sides == pytest.approx((40, 30, 0, 0), abs=1)


@pytest.mark.parametrize("blur", [4.0, 12.0])
def test_a_blurred_fill_is_found_though_it_moves(blur):
    border = find_border([filled(image, blur) for image in wall()])
    assert border is not None
    assert border.sides == pytest.approx((0, 0, 80, 80), abs=1)
    assert border.mask[:, :80].all()
    assert not border.mask[:, 84:236].any()


@pytest.mark.parametrize("rows", [15, 24, 36])
def test_a_fill_like_the_scene_beside_it_is_found(rows):
    images = []
    grain = np.random.default_rng(0).normal(0, 25, (HEIGHT, WIDTH, 1))
    for k, plain in enumerate(wall()):
        image = np.clip(plain + np.roll(grain, 5 * k, axis=1), 0, 255).astype(np.uint8)
        stretched = cv2.resize(image, (WIDTH, HEIGHT + 2 * rows))
        fill = cv2.GaussianBlur(stretched, (0, 0), 8)
        fill[rows : rows + HEIGHT] = image
        images.append(fill)
    border = find_border(images)
    assert border is not None
    assert border.sides == pytest.approx((rows, rows, 0, 0), abs=1)


def test_what_is_outside_of_a_circle_is_found():
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    inside = np.hypot(u - WIDTH / 2, v - HEIGHT / 2) < 70
    border = find_border([image * inside[..., None].astype(np.uint8) for image in wall()])
    assert border is not None
    assert border.mask[~inside].mean() > 0.95
    assert border.mask[inside].mean() < 0.08


@pytest.mark.parametrize("seed", range(3))
def test_a_scene_has_none(seed):
    assert find_border(wall(seed=seed)) is None


def test_a_sky_a_vignette_and_a_window_are_the_scenes_own():
    """A sky's edge is ragged, a window moves, a vignette has no edge."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    far = ((u / WIDTH - 0.5) ** 2 + (v / HEIGHT - 0.5) ** 2) * 2
    skies, windows, dark = wall(), wall(), wall()
    for k in range(IMAGES):
        ragged = 40 + 8 * np.sin((np.arange(WIDTH) + 5 * k) / 9)
        skies[k][v < ragged] = 255
        windows[k][: 40 + k, : 60 + 3 * k] = 255
        dark[k] = (dark[k] * (1 - far)[..., None]).astype(np.uint8)
    for images in (skies, windows, dark):
        assert find_border(images) is None


def test_a_camera_that_rests_and_few_images_tell_nothing():
    assert find_border(barred(wall(step=0.0), LETTERBOX, (0, 0, 0))) is None
    assert find_border(barred(wall(7), LETTERBOX, (0, 0, 0))) is None


def test_bars_of_a_video_with_one_entry_are_masked_and_said(tmp_path):
    images = barred(wall(60, 2.0), LETTERBOX, (0, 0, 0))
    path = write_video(tmp_path / "v.mp4", images, gop=100)
    listener = Listener()
    source = without_overlay(open_source(path, InputConfig(long_edge=100)), listener)
    assert len(listener.said) == 1
    assert "bars of 40 above, 40 below" in listener.said[0].replace("41", "40")
    opened = open_source(path, InputConfig(long_edge=100))
    assert (source.camera.width, opened.camera.height) == (100, 100)
    assert source.camera.height == pytest.approx(100 * HEIGHT / WIDTH, abs=6)
    assert source.mask is not None
    assert source.mask[3:-3].all()


def test_a_turntable_is_no_moving_camera():
    background = wall(1, seed=7)[0][..., 0]
    turning = []
    for image in seen(IMAGES):
        both = background.copy()
        both[35:85, 50:110] = image[35:85, 50:110]
        turning.append(both)
    assert is_turntable(turning)
    assert not is_turntable(seen(IMAGES))
    assert not is_turntable(seen(IMAGES, step=0.0))


def test_images_with_poses_are_warned_of():
    class Posed(PosedSource):
        """Stands for a source with poses."""

        camera = Camera(200.0, 200.0, 79.5, 99.5, WIDTH, HEIGHT + 80)

        def __init__(self, images: list[np.ndarray]) -> None:
            self.images = images

        def __len__(self) -> int:
            return len(self.images)

        def __getitem__(self, index: int) -> SimpleNamespace:
            return SimpleNamespace(image=self.images[index])

    listener = Listener()
    warn_of_border(Posed(wall()), listener)
    assert listener.said == []
    warn_of_border(Posed(barred(wall(), LETTERBOX, (0, 0, 0))), listener)
    assert "40 above, 40 below" in listener.said[0]
