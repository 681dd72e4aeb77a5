"""The page of a result in a real browser: it draws, turns, and complains of nothing."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from box_room import box, circle
from browser import open_tab
from geogs.application.results.result_page import ShownView, shown_model
from geogs.evaluation.held_camera import level_axes
from geogs.evaluation.model_view.shown_model import Colouring, Legend, Lengths, TextureModel
from geogs.evaluation.model_view.start_view import start_view
from geogs.evaluation.pages.run_page import lengths, write_run_page
from geogs.geometry.camera import Camera
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import MapSnapshot, Trajectory

CAMERA = Camera(80.0, 80.0, 63.5, 47.5, 128, 96)
RED, GREEN = [200, 30, 30], [30, 170, 40]


def box_page(folder, with_truth: bool = False, with_texture: bool = False):
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
    model = shown_model(trajectory, views, CAMERA, mesh, disks, Lengths(1.0, "Metres."), more)
    if with_texture:  # its upper half red, its lower half, which the floor has, blue
        sheet = np.zeros((64, 64, 3), np.uint8)
        sheet[:32, :, 0] = sheet[32:, :, 2] = 220
        jpeg = cv2.imencode(".jpg", sheet[..., ::-1])[1].tobytes()
        is_floor = (model.surface.vertices[:, 2] < -1.1) & (model.surface.normals[:, 2] > 0.9)
        uv = np.stack([np.full(len(is_floor), 0.5), np.where(is_floor, 0.8, 0.2)], 1)
        textured = replace(model.surface, texture=TextureModel(uv, jpeg), colourings=())
        model = replace(model, surface=textured)
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
    axes = np.eye(3)
    eye, target = start_view(points, axes, circle())
    assert np.allclose(target, 0, atol=0.8)
    assert (eye - target) @ axes[2] > 0.4 * np.linalg.norm(eye - target)
    assert np.linalg.norm(eye - target) < 10


def test_objects_are_seen_from_the_side_of_the_cameras():
    inwards = circle()
    inwards[:, 2, 3] = 0
    inwards[:, :3, [0, 2]] *= -1  # half a turn about the image's vertical axis
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3))
    axes = level_axes(inwards)
    eye, target = start_view(points, axes, inwards)
    assert np.allclose(target, 0, atol=0.15)
    side = (eye - target) / np.linalg.norm(eye - target)
    assert side @ inwards[0, :3, 3] > 0.4  # of half a metre
    assert 0.1 < side @ axes[2] < 0.5  # a little from above


def test_a_page_says_what_its_lengths_are():
    metric = {"scale": "metric (a depth sensor)", "metric_scale": {"deviation": 0.01}}
    assert lengths(metric).metres == 1
    assert lengths(metric).note == "Metres by a depth sensor, to about 2 %."
    assert lengths({"scale": "of the poses (millimetres)"}).metres == 0.001
    for unknown in ("of the poses (arbitrary)", "arbitrary (monocular)", 7, None):
        assert lengths({"scale": unknown}).metres is None
    assert "do not tell metres" in lengths({}).note
    assert (
        lengths({**metric, "metric_scale": {"deviation": "x"}}).note == "Metres by a depth sensor."
    )


def drawn(tab) -> np.ndarray:
    """The model as it is now; waits until it is no longer drawn."""
    tab.page.wait_for_function(
        "() => new Promise((done) => setTimeout(() => requestAnimationFrame(() => "
        "done(!document.getElementById('model').stage.steps.size)), 300))"
    )
    return tab.picture()[:, :600]  # beside the image of the keyframe


def azimuth(tab) -> float:
    """Direction of the view around the vertical, degrees."""
    return np.degrees(tab.page.evaluate("() => model.stage.orbit.getAzimuthalAngle()"))


def look(tab, name: str) -> None:
    tab.page.click(f"[data-part=looks] button:text-is('{name}')")


@pytest.mark.system
def test_page_draws_turns_and_says_nothing(tmp_path):
    page = box_page(tmp_path, with_truth=True)
    assert page.stat().st_size < 1.2e6
    with open_tab(page.as_uri()) as tab:
        tab.page.wait_for_selector("#model[data-state=drawn]", timeout=600_000)
        tab.page.wait_for_selector(".beside img[src]", timeout=600_000)
        assert "Reliable & sound." in tab.page.inner_text("p.verdict")
        assert "Metres." in tab.page.inner_text("p.note >> nth=1")
        first = drawn(tab)
        # One looks from above through walls that face away: the floor and the far walls are there.
        assert share(first, RED) > 0.03
        assert share(first, GREEN) > 0.05
        rows = [np.nonzero((first[..., c] > first[..., d] + 60).any(1))[0].mean()
                for c, d in ((0, 1), (1, 0))]  # fmt: skip
        assert rows[0] > rows[1]  # the floor is below

        look(tab, "Error")
        assert share(drawn(tab), [0, 0, 1]) > 0.1
        assert "10 cm" in tab.page.inner_text(".legend")
        look(tab, "Disks")
        assert share(drawn(tab), [0, 0, 1]) < 0.05  # nothing else hides them, nor do they hide it
        look(tab, "Error")
        assert share(drawn(tab), [0, 0, 1]) > 0.1

        before = azimuth(tab)
        box_of = tab.page.locator("canvas").bounding_box()
        x, y = box_of["x"] + box_of["width"] / 3, box_of["y"] + box_of["height"] / 2
        tab.page.mouse.move(x, y)
        tab.page.mouse.down()
        tab.page.mouse.move(x + 250, y, steps=5)
        tab.page.mouse.up()
        turned = (before - azimuth(tab) + 180) % 360 - 180
        assert abs(turned) == pytest.approx(60, abs=3)
        assert (np.abs(drawn(tab) - first).max(-1) > 25).mean() > 0.05
        assert tab.complaints == []
        assert all(r.startswith(("file:", "blob:", "data:")) for r in tab.requests)


@pytest.mark.system
def test_page_plays_the_path_and_measures(tmp_path):
    page = box_page(tmp_path)
    with open_tab(page.as_uri()) as tab:
        tab.page.wait_for_selector(".beside img[src]", timeout=600_000)
        tab.page.eval_on_selector("[data-part=place]", "(s) => { s.value = 3; s.oninput(); }")
        assert tab.page.inner_text("[data-part=keyframe]").startswith("keyframe 4 of 10")
        outside = drawn(tab)
        tab.page.click("[data-part=ride]")
        inside = drawn(tab)
        assert (np.abs(inside - outside).max(-1) > 25).mean() > 0.2
        position = tab.page.evaluate("() => model.stage.camera.position.toArray()")
        assert np.linalg.norm(position) == pytest.approx(0.5, abs=0.11)  # of the circle
        tab.page.click("[data-part=ride]")
        drawn(tab)
        # Two points of the floor: where rays through pixels meet it, by hand.
        tab.page.click("text=Measure")
        assert "Metres." in tab.page.inner_text("[data-part=hint]")
        ends = [[-1.0, -1.2, -0.5], [1.5, -1.2, 0.5]]
        to_pixel = "(p) => model.stage.pixel(model.stage.camera.position.clone().fromArray(p))"
        canvas = tab.page.locator("canvas").bounding_box()
        for end in ends:
            u, v = tab.page.evaluate(to_pixel, end)
            tab.page.mouse.click(canvas["x"] + u, canvas["y"] + v)
        said, unit = tab.page.inner_text("[data-part=length]").split()
        assert unit == "m"
        assert float(said) == pytest.approx(np.linalg.norm(np.subtract(*ends)), rel=0.02)
        tab.page.click("[data-part=play]")
        tab.page.wait_for_function(
            "() => Number(document.querySelector('[data-part=place]').value) > 3.5"
        )
        assert tab.complaints == []


@pytest.mark.system
def test_the_page_shows_the_texture_the_right_way_up(tmp_path):
    with open_tab(box_page(tmp_path, with_texture=True).as_uri()) as tab:
        tab.page.wait_for_selector("#model[data-state=drawn]", timeout=600_000)
        first = drawn(tab)
        assert share(first, [0, 0, 1]) > 0.03
        assert share(first, RED) > 0.05
        tab.page.get_by_role("button", name="Shape").click()
        plain = drawn(tab)
        assert share(plain, RED) < 0.02
        assert share(plain, [0, 0, 1]) < 0.02
        assert tab.complaints == []
