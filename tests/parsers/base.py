"""What is said of a parser: a small good example, how it is damaged, and who reads it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from hypothesis import strategies as st

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from io_samples import gradient_image
from posed_layouts import Room

Damage = Callable[[bytes], st.SearchStrategy[bytes]]


@dataclass(frozen=True)
class Parser:
    """What reads a kind of file."""

    write: Callable[[Path], object]
    """Puts a good example into an empty folder."""
    files: tuple[str, ...]
    """Those of the example that are damaged, by their names in the folder."""
    damage: Damage
    read: Callable[[Path], object]
    """Reads the example in a folder."""


def tiny_room() -> Room:
    """Three images of a camera that moves to the right."""
    camera = Camera(50.0, 51.0, 31.0, 24.0, 64, 48)
    tangents = [[-0.1 * i, 0.0, 0.0, 0.0, 0.02 * i, 0.0] for i in range(3)]
    T_cw = se3_exp(torch.tensor(tangents, dtype=torch.float64)).numpy()
    points = np.array([[0.0, 0.1, 2.0], [0.1, 0.0, 3.0]])
    return Room(camera, [gradient_image(i) for i in range(3)], T_cw, points, [[0, 1], [1, 2]])


def written(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)
