"""A room of one plane in the layouts of data sets."""

import numpy as np

from posed_layouts import Camera, Room

SIZE = (16, 12)


def flat_room(frames: int = 3) -> Room:
    """Poses and images without anything to see."""
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, 0, 3] = np.arange(frames)
    images = [np.full((SIZE[1], SIZE[0], 3), 40 * i, np.uint8) for i in range(frames)]
    camera = Camera(14.0, 14.0, 7.5, 5.5, *SIZE)
    return Room(camera, images, T, np.zeros((1, 3)), [[0, 1]])
