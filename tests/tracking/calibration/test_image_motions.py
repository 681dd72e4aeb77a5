"""Velocities in the image, against an image that is moved as is known."""

import cv2
import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.tracking.calibration.image_motions import ImageMotions, TimedImage
from geogs.world.grid import SampleGrid

CAMERA = Camera(fx=300.0, fy=300.0, cx=199.5, cy=149.5, width=400, height=300)
GRID = SampleGrid(CAMERA)
INTERVAL = 1 / 30
TEXTURE = cv2.GaussianBlur(
    np.random.default_rng(0).integers(0, 255, (300, 400), dtype=np.uint8), (0, 0), 3
)


def place(seconds: float) -> tuple[float, float]:
    """Pixels right and down of where things are at 0: a shake, and a drift."""
    return 5 * np.sin(30 * seconds) + 20 * seconds, -2 * np.sin(30 * seconds)


def shown(seconds: float) -> TimedImage:
    x, y = place(seconds)
    to = np.array([[1, 0, x], [0, 1, y]], np.float64)
    grey = cv2.warpAffine(TEXTURE, to, (400, 300), flags=cv2.INTER_CUBIC, borderMode=1)
    return TimedImage(seconds, np.repeat(3 * (grey[..., None] - 85), 3, 2))


def seen(images: list[TimedImage], followed: int) -> ImageMotions:
    motions = ImageMotions(GRID)
    for n, image in enumerate(images):
        motions.see(n, image)
        if n == followed:
            motions.follow()
    return motions


def test_the_velocity_is_that_at_the_image_itself():
    """Not that between it and the nearest, of a shake of some six images."""
    images = [shown((n - 3) * INTERVAL) for n in range(7)]
    velocity, known = seen(images, 3).of(3)
    wanted = torch.tensor([170.0, -60.0])
    assert float(known.float().mean()) > 0.7
    off = (velocity[known] - wanted).norm(dim=-1).median()
    x, y = (np.array(place(INTERVAL)) - place(-INTERVAL)) / (2 * INTERVAL)
    by_nearest = torch.tensor([x, y]) - wanted
    assert float(off) < 0.3 * float(by_nearest.norm())


def test_images_at_an_end_and_far_away_say_what_they_can():
    images = [shown(n * INTERVAL) for n in range(3)]
    velocity, known = seen(images, 0).of(0)
    assert float((velocity[known] - torch.tensor([170.0, -60.0])).norm(dim=-1).median()) < 40
    images = [image._replace(timestamp=n) for n, image in enumerate(images)]
    velocity, known = seen(images, 1).of(1)
    assert not known.any()
    assert not velocity.any()
