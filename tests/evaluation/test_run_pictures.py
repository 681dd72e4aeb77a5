"""The pictures of a run: what is drawn where, in which colours."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from box_room import circle
from geogs.evaluation.pages.run_pictures import (
    depth_colours,
    draw_keyframes,
    draw_path,
    normal_colours,
    path_panel,
    tick_step,
)
from geogs.types import Trajectory

BLUE, ORANGE = (0, 114, 178), (213, 94, 0)


def drawn(panel: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Columns and rows of the pixels of a colour, below the title and the names."""
    v, u = np.nonzero((panel == colour).all(-1))
    return np.stack([u, v], -1)[v > 48]


def test_a_path_is_drawn_upright_and_to_one_scale():
    corners = np.array([[0.0, 0], [4, 0], [4, 2], [0, 2], [0, 0]])
    sides = [np.linspace(a, b, 40) for a, b in pairwise(corners)]
    points = np.concatenate(sides)
    lost = np.zeros(len(points), bool)
    lost[40:80] = True  # the right side, upwards
    panel = path_panel(points, lost, "from above", "forward")
    every = np.concatenate([drawn(panel, BLUE), drawn(panel, ORANGE)])
    width, height = np.ptp(every, axis=0)
    assert width == pytest.approx(2 * height, rel=0.06)
    assert width > 0.8 * panel.shape[1] - 60
    marked = drawn(panel, ORANGE)
    assert marked[:, 0].min() > every[:, 0].max() - 8
    assert np.ptp(marked[:, 1]) > 0.9 * height
    rising = path_panel(np.array([[0.0, 0], [1, 1]]), np.zeros(2, bool), "a", "b")
    dots = drawn(rising, BLUE)
    assert dots[dots[:, 0].argmax(), 1] < dots[dots[:, 0].argmin(), 1]  # up is up


@pytest.mark.parametrize(
    ("span", "step"), [(6.0, 1.0), (60.0, 10.0), (0.012, 0.002), (25.0, 5.0), (1e-6, 2e-7)]
)
def test_ticks_are_round(span, step):
    assert tick_step(span) == pytest.approx(step)


def test_depth_goes_from_blue_to_red_and_is_white_where_there_is_none():
    colours = depth_colours(np.array([[1.0, 2.0, 3.0, 0.0, np.nan, 9.0]]), 1.0, 3.0)[0].astype(int)
    assert colours[0][2] > colours[0][1]  # turbo begins with a dark blue
    assert colours[1][1] > 200  # green in the middle
    assert colours[2][0] > 100 > colours[2][2]
    assert colours[3].tolist() == colours[4].tolist() == [255] * 3
    assert colours[5].tolist() == colours[2].tolist()


def test_normals_towards_the_camera_are_blue():
    normals = np.array([[[0.0, 0, -1], [1, 0, 0], [0, -1, 0], [0, 0, 0]]])
    colours = normal_colours(normals)[0].tolist()
    assert colours == [[128, 128, 255], [255, 128, 128], [128, 255, 128], [255] * 3]


def test_pictures_are_written_whatever_is_known(tmp_path):
    depth, normal = np.full((48, 64), 2.0), np.zeros((48, 64, 3))
    depth[:24] = 0
    normal[10:, :, 2] = -1
    image = np.full((96, 128, 3), (90, 20, 10), np.uint8)
    draw_keyframes(tmp_path / "k.png", [image] * 2, [depth, 0 * depth], [normal] * 2)
    picture = np.array(Image.open(tmp_path / "k.png"))
    cell = (picture == (90, 20, 10)).all(-1)
    assert cell.sum() == 2 * 420 * 315
    assert (picture == (128, 128, 255)).all(-1).sum() == pytest.approx(
        2 * 420 * 315 * 38 / 48, rel=0.02
    )
    tracked = np.ones(60, bool)
    tracked[20:25] = False
    draw_path(tmp_path / "p.png", Trajectory(np.arange(60) / 30, circle(), tracked), np.eye(3), "m")
    assert len(drawn(np.array(Image.open(tmp_path / "p.png")), ORANGE)) > 50
    one = Trajectory(np.zeros(1), np.eye(4)[None], np.zeros(1, bool))
    draw_path(tmp_path / "one.png", one, np.eye(3), "map units")
    assert (tmp_path / "one.png").is_file()
