"""The pictures, and the page of a run."""

import numpy as np
import pytest
from PIL import Image

from box_room import CAMERA, box, circle
from geogs.evaluation.held_camera import level_axes, look_at_one_place
from geogs.evaluation.pages import plots
from geogs.evaluation.pages.run_page import write_run_page
from geogs.evaluation.pages.shading import Viewpoint, look, viewpoints
from geogs.evaluation.surfaces.reconstruction_errors import ReconstructionScores
from geogs.evaluation.surfaces.surface import Surface
from geogs.evaluation.surfaces.surface_errors import SurfaceComparison


def test_level_axes_stand_upright():
    axes = level_axes(circle())
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1)
    assert np.allclose(axes[2], [0, 0, 1])
    assert np.allclose(level_axes(np.eye(4)[None])[2], [0, -1, 0])  # one pose: still a frame


def test_shading_is_the_cosine_and_the_ceiling_is_cut():
    half = (3.0, 2.0, 1.2)
    vertices, faces = box(half)
    view = Viewpoint("x", CAMERA, np.linalg.inv(circle()[0]))
    picture = look(vertices, faces, view).paint()
    middle = picture[47:49, 63:65].astype(float)
    assert np.abs(middle - 190).max() <= 1  # a wall seen at right angles, at full brightness
    assert picture.max() <= 190  # no background: the box is closed
    ray = np.array([(20 - 63.5) / 80, 0, 1])
    expected = 190 * (0.25 + 0.75 / np.linalg.norm(ray))
    assert abs(float(picture[47:49, 20].mean()) - expected) < 1.5
    red = np.tile(np.array([[200, 10, 20]], np.uint8), (8, 1))
    painted = look(vertices, faces, view).paint(red)[48, 64].astype(int)
    assert np.abs(painted - [200, 10, 20]).max() <= 1
    above = viewpoints(vertices, circle(), CAMERA)[-1]
    assert above.name == "from above"
    size = above.camera
    centre = look(vertices, faces, above).paint()[size.height // 2, size.width // 2]
    depth_of_floor = np.abs(centre.astype(int) - 190).max()
    assert depth_of_floor <= 1
    assert (look(vertices, faces, above).paint()[0] == 255).all()


def test_what_is_round_is_smooth():
    """A coarse tube, whose facets are steps where they share no vertices."""
    turn = 2 * np.pi * np.arange(16) / 16
    ring = np.stack([np.sin(turn), 0 * turn, 4 - np.cos(turn)], 1)
    vertices = np.concatenate([ring - [0, 3, 0], ring - [0, -3, 0]])
    k, n = np.arange(16), (np.arange(16) + 1) % 16
    faces = np.concatenate([np.stack([k, n, k + 16], 1), np.stack([n, n + 16, k + 16], 1)])
    view = Viewpoint("x", CAMERA, np.eye(4))
    apart = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    smooth, flat = (
        np.abs(np.diff(look(*mesh, view).paint()[48, 44:84, 0].astype(int))).max()
        for mesh in ((vertices, faces), apart)
    )
    assert smooth < 22
    assert flat > 30


def test_objects_are_seen_from_three_cameras_and_rooms_from_above():
    inwards = circle()
    inwards[:, 2, 3] = 0
    inwards[:, :3, [0, 2]] *= -1  # half a turn about the image's vertical axis
    vertices = box((0.1, 0.1, 0.1))[0]
    assert np.allclose(np.linalg.det(inwards[:, :3, :3]), 1)
    assert look_at_one_place(inwards)
    views = viewpoints(vertices, inwards, CAMERA)
    assert [view.name for view in views] == ["first frame", "middle frame", "another side"]
    turn = views[2].T_cw[2, :3] @ np.stack([view.T_cw[2, :3] for view in views[:2]], -1)
    assert np.abs(turn).max() < 0.1  # at right angles to the first two, which are opposite
    assert not look_at_one_place(circle())
    forward = np.tile(np.eye(4), (20, 1, 1))
    forward[:, 2, 3] = np.linspace(0, 5, 20)
    assert not look_at_one_place(forward)


def test_page_of_a_run_holds_its_numbers_and_pictures(tmp_path):
    Image.new("RGB", (20, 10), "red").save(tmp_path / "keyframes.png")
    (tmp_path / "trajectory.png").write_bytes(b"cut off")
    summary = {
        "source": "room", "frames": 1234, "skipped_images": 0, "device": "cpu",
        "lost_spans": [[1.0, 2.5]], "seconds": {"tracking": 1.25, "total": 3.0},
        "frames_per_second": {"until_stream_end": 4.5}, "peak_memory_bytes": 2**30,
        "interrupted": False,
    }  # fmt: skip
    write_run_page(tmp_path, summary)
    page = (tmp_path / "index.html").read_text()
    for text in (
        "1 234",
        "1.0 to 2.5",
        "4.50 until stream end",
        "1024 MiB",
        "<td>tracking</td>",
        '<h2>Rendered keyframes</h2>\n<figure><img src="data:image/webp;base64,',
        "<dt>frames</dt><dd>1 234</dd>",
        "<dd>3 s</dd>",
    ):
        assert text in page
    for text in ("skipped", "stopped early", "Trajectory", ".png"):
        assert text not in page


def compared_at(points, distance, reach=np.inf) -> SurfaceComparison:
    """Distances in metres, of which 9 cm are shown as the worst."""
    scores = ReconstructionScores(*[0.0] * 8, 4.5, 0, 0, 0.0)
    mesh = Surface(points, np.zeros((0, 3), int))
    return SurfaceComparison(scores, mesh, None, points, distance, reach)


def test_uncompared_vertices_stay_grey():
    samples = np.array([[0.0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]])
    vertices = np.array([[0.0, 0, 0.05], [5.0, 0, 0]])
    colours = plots.error_colours(vertices, compared_at(samples, np.full(3, 0.09), 1.0))
    assert colours[1].tolist() == [190, 190, 190]
    assert colours[0][1] < 30


def test_error_colours_go_from_pale_to_red():
    samples = np.array([[0.0, 0, 0], [10, 0, 0]])
    distance = np.array([0, 0, 0, 0.09, 0.09, 0.09])
    colours = plots.error_colours(samples, compared_at(samples.repeat(3, 0), distance))
    assert colours[0].sum() > 600
    assert colours[1][0] > 100
    assert colours[1][1] < 30
