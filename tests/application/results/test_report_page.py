"""The page of a result in a real browser: it draws, turns, and complains of nothing."""

import numpy as np
import pytest
import torch

from box_room import box, circle
from browser import open_tab
from geogs.application.results.result_page import ShownView, first_view, shown_model
from geogs.evaluation.model_view.shown_model import Colouring, Legend
from geogs.evaluation.pages.run_page import write_run_page
from geogs.geometry.camera import Camera
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import MapSnapshot, Trajectory

CAMERA = Camera(80.0, 80.0, 63.5, 47.5, 128, 96)
RED, GREEN = [200, 30, 30], [30, 170, 40]


def box_page(folder, with_truth: bool = False):
    """A page of a box with a red floor and green walls, seen from within by a circle of cameras."""
    vertices, faces = box((3.0, 2.0, 1.2))
    mesh = Mesh.from_triangles(vertices, faces)
    # Each face of its own, so that the floor alone is red.
    mesh = Mesh.from_triangles(vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)))
    inward = (mesh.normals * -mesh.vertices).sum(1).mean() > 0
    if not inward:
        mesh = Mesh.from_triangles(mesh.vertices, mesh.faces[:, ::-1])
    floor = np.repeat(mesh.vertices.reshape(-1, 3, 3)[..., 2].max(1) < -1, 3)
    colours = np.where(floor[:, None], RED, GREEN).astype(np.uint8)
    mesh = Mesh(mesh.vertices, mesh.faces, mesh.normals, colours)
    path = circle()
    trajectory = Trajectory(np.arange(len(path)) / 30, path, np.ones(len(path), bool))
    image = np.full((96, 128, 3), (30, 60, 220), np.uint8)
    views = [ShownView(i / 30, T, lambda: image) for i, T in enumerate(path[::6])]
    disks = MapSnapshot(
        torch.from_numpy(mesh.vertices), torch.tensor([[1.0, 0, 0, 0]]).expand(len(colours), 4),
        torch.full((len(colours), 2), 0.3), torch.ones(len(colours)),
    )  # fmt: skip
    legend = Legend("Distance to the truth", ("0", "10 cm"), ("#ffffcc", "#800026"))
    blue = np.full_like(colours, (20, 40, 230))
    more = (lambda mesh: [Colouring("Error", blue, legend)]) if with_truth else (lambda mesh: ())
    model = shown_model(trajectory, views, CAMERA, mesh, disks, more)
    verdict = {"sentence": "Reliable & sound.", "is_reliable": True}
    write_run_page(folder, {"source": "box", "frames": 60, "verdict": verdict}, model)
    return folder / "index.html"


def share(picture: np.ndarray, colour: list[int]) -> float:
    """Part of a picture that has about the hue of a colour."""
    strong = int(np.argmax(colour))
    others = [c for c in range(3) if c != strong]
    return float((picture[..., strong] > picture[..., others].max(-1) + 60).mean())


def test_rooms_are_seen_from_above_and_wholly():
    points = np.random.default_rng(0).uniform([-3, -2, -1.2], [3, 2, 1.2], (5000, 3))
    axes, eye, target = first_view(points, circle())
    assert np.allclose(target, 0, atol=0.1)
    assert (eye - target) @ axes[2] > 0.4 * np.linalg.norm(eye - target)
    towards = (points - eye) @ (target - eye) / np.linalg.norm(target - eye)
    angle = np.degrees(np.arccos(towards / np.linalg.norm(points - eye, axis=1)))
    assert np.quantile(angle, 0.99) < 30  # of half a diagonal
    assert np.linalg.norm(eye - target) < 10


def test_objects_are_seen_from_the_side_of_the_cameras():
    inwards = circle()
    inwards[:, 2, 3] = 0
    inwards[:, :3, [0, 2]] *= -1  # half a turn about the image's vertical axis
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3))
    axes, eye, target = first_view(points, inwards)
    assert np.allclose(target, 0, atol=0.02)
    side = (eye - target) / np.linalg.norm(eye - target)
    assert side @ inwards[0, :3, 3] > 0.4  # of half a metre
    assert 0.1 < side @ axes[2] < 0.5  # a little from above


@pytest.mark.system
def test_page_draws_turns_and_says_nothing(tmp_path):
    page = box_page(tmp_path, with_truth=True)
    assert page.stat().st_size < 1.2e6
    with open_tab(page.as_uri()) as tab:
        tab.page.wait_for_selector("#model[data-state=drawn]", timeout=600_000)
        tab.page.wait_for_selector(".strip button")
        assert "Reliable & sound." in tab.page.inner_text("p.verdict")
        first = tab.picture()
        # One looks from above through walls that face away: the floor and the far walls are there.
        assert share(first, RED) > 0.03
        assert share(first, GREEN) > 0.05
        rows = [np.nonzero((first[..., c] > first[..., d] + 60).any(1))[0].mean()
                for c, d in ((0, 1), (1, 0))]  # fmt: skip
        assert rows[0] > rows[1]  # the floor is below

        box_of = tab.page.locator("canvas").bounding_box()
        x, y = box_of["x"] + box_of["width"] / 2, box_of["y"] + box_of["height"] / 2
        tab.page.mouse.move(x, y)
        tab.page.mouse.down()
        tab.page.mouse.move(x + 200, y, steps=4)
        tab.page.mouse.up()
        tab.page.wait_for_timeout(700)
        turned = tab.picture()
        assert (np.abs(turned - first).max(-1) > 25).mean() > 0.05

        tab.page.click("[data-part=looks] button:text-is('Error')")
        tab.page.wait_for_timeout(200)
        assert share(tab.picture(), [0, 0, 1]) > 0.1
        assert "10 cm" in tab.page.inner_text(".legend")
        cell = tab.page.locator(".strip button").nth(3)
        cell.click()
        assert tab.page.inner_text(".name").startswith("keyframe 4 of 10")
        tab.page.click("[data-part=layers] button:text-is('Mesh')")
        tab.page.click("[data-part=layers] button:text-is('Disks')")
        tab.page.click("[data-part=layers] button:text-is('Images')")
        tab.page.wait_for_timeout(400)
        assert share(tab.picture(), [0, 0, 1]) > 0.002  # the images of the keyframes, blue
        assert tab.complaints == []
        assert all(r.startswith(("file:", "blob:", "data:")) for r in tab.requests)
