"""A camera that moves along a wall, with a bonnet in its view."""

import cv2
import numpy as np

HEIGHT, WIDTH = 120, 160


def seen(count: int, step: float = 5.0, seed: int = 0) -> list[np.ndarray]:
    """A textured wall that a camera moves along, with noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(20, 235, (HEIGHT // 8 + 2, 80)).astype(np.float32)
    wall = cv2.resize(coarse, (640, HEIGHT + 16), interpolation=cv2.INTER_CUBIC)
    return [
        (wall[:HEIGHT, round(step * k) :][:, :WIDTH] + rng.normal(0, 2, (HEIGHT, WIDTH)))
        .clip(0, 255)
        .astype(np.uint8)
        for k in range(count)
    ]


def with_bonnet(images: list[np.ndarray], seed: int = 9) -> list[np.ndarray]:
    """Its lower quarter is a thing that has texture at its middle and is bare beside it."""
    thing = np.full((HEIGHT, WIDTH), 90, np.uint8)
    thing[96:116, 30:130] = seen(1, seed=seed)[0][96:116, 30:130]
    covered = [image.copy() for image in images]
    for image in covered:
        image[92:] = thing[92:]
    return covered
