"""What a page unpacks is what was packed: undone here number by number, as the page does it."""

import zlib

import numpy as np
import pytest

from box_room import box, circle
from geogs.evaluation.held_camera import level_axes
from geogs.evaluation.model_view.model_section import STEPS, model_section, pack, webgl_axes
from geogs.evaluation.model_view.shown_model import (
    Colouring,
    DiskModel,
    ImageExtent,
    KeyframeModel,
    PathModel,
    ShownModel,
    SurfaceModel,
)
from geogs.evaluation.model_view.start_view import StartView


def unpacked(content: bytes, place: list[int]) -> np.ndarray:
    """The array at a place, one number after the other."""
    offset, rows, columns, size = place
    result = np.zeros((rows, columns), np.int64)
    for column in range(columns):
        start, value = offset + column * rows * size, 0
        for row in range(rows):
            zigzag = sum(content[start + byte * rows + row] << (8 * byte) for byte in range(size))
            value = (value + (zigzag // 2 if zigzag % 2 == 0 else -(zigzag + 1) // 2)) % 256**size
            result[row, column] = value
    return result


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture
def model() -> ShownModel:
    vertices, faces = box((3.0, 2.0, 1.2))
    colours = np.arange(len(vertices) * 3, dtype=np.uint8).reshape(-1, 3)
    T_wc = circle()[:4]
    random = np.random.default_rng(0)
    quaternion = random.normal(size=(20, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    disks = DiskModel(
        random.normal(size=(20, 3)).astype(np.float32),
        quaternion.astype(np.float32),
        np.exp(random.uniform(-6, -2, (20, 2))).astype(np.float32),
    )
    return ShownModel(
        level_axes(circle()), StartView(np.array([4.0, 5, 6]), np.zeros(3)), ImageExtent(0.8, 0.6),
        SurfaceModel(
            vertices.astype(np.float32), faces, unit(vertices), [Colouring("Colour", colours)]
        ),
        [PathModel("Path", T_wc[:, :3, 3], ["tracked", "lost", "orientation only", "tracked"])],
        [KeyframeModel("<one>", T, b"jpeg%d" % i if i else None) for i, T in enumerate(T_wc)],
        disks,
    )  # fmt: skip


def test_surface_and_colours_come_out_as_they_went_in(model):
    scene, arrays, _ = pack(model)
    content, packed = zlib.decompress(arrays), scene["surface"]
    low, step = (np.array(part) for part in packed["box"])
    vertices = low + unpacked(content, packed["vertices"]) * step
    faces = unpacked(content, packed["faces"])
    faces[:, 1:] += faces[:, :1]
    colours = unpacked(content, packed["colourings"][0]["colours"])
    R = webgl_axes(model.axes)
    expected = model.surface.vertices @ R.T
    extent = np.ptp(expected, axis=0)
    corners = {tuple(c) for c in model.surface.colourings[0].colours.tolist()}
    assert {tuple(c) for c in colours.tolist()} == corners
    nearest = np.linalg.norm(vertices[:, None] - expected, axis=-1)
    assert (nearest.min(1) <= np.linalg.norm(extent) / STEPS).all()
    same = model.surface.colourings[0].colours[nearest.argmin(1)]
    assert (same == colours).all()
    normals = (unpacked(content, packed["normals"]).astype(float) - 128) / 127
    there = model.surface.normals[nearest.argmin(1)] @ R.T
    np.testing.assert_allclose(normals, there, atol=0.51 / 127)

    def turned(triangles: np.ndarray, points: np.ndarray) -> set[tuple]:
        """Each triangle as its corners, from the least on, in their turn."""
        rounded = [[tuple(points[i].round(2) + 0.0) for i in t] for t in triangles]
        return {tuple(min(t[k:] + t[:k] for k in range(3))) for t in rounded}

    assert turned(faces, vertices) == turned(model.surface.faces, expected)


def test_axes_are_those_of_webgl(model):
    R = webgl_axes(model.axes)
    assert np.linalg.det(R) == pytest.approx(1)
    assert np.allclose(R @ model.axes[2], [0, 1, 0])  # up is y
    assert np.allclose(R @ model.axes[1], [0, 0, -1])  # forward is away
    scene, _, images = pack(model)
    assert np.allclose(scene["start"]["eye"], R @ [4, 5, 6])
    T = np.array(scene["keyframes"][2]["T_wc"]).reshape(3, 4)
    assert np.allclose(T, R @ model.keyframes[2].T_wc[:3], atol=1e-6)
    offset, length = scene["keyframes"][2]["image"]
    assert images[offset : offset + length] == b"jpeg2"
    assert "image" not in scene["keyframes"][0]


def test_path_keeps_every_bit_and_every_state(model):
    scene, arrays, _ = pack(model)
    content, path = zlib.decompress(arrays), scene["paths"][0]
    points = unpacked(content, path["points"]).astype(np.uint32).view(np.float32)
    R = webgl_axes(model.axes)
    assert (points == (model.paths[0].points @ R.T).astype(np.float32)).all()
    assert unpacked(content, path["states"]).ravel().tolist() == [0, 2, 1, 0]


def test_disks_keep_normal_and_size(model):
    from scipy.spatial.transform import Rotation

    scene, arrays, _ = pack(model)
    content, packed = zlib.decompress(arrays), scene["disks"]
    low, step = (np.array(part) for part in packed["box"])
    position = low + unpacked(content, packed["position"]) * step
    R = webgl_axes(model.axes)
    own = np.linalg.norm(position[:, None] - model.disks.position @ R.T, axis=-1).argmin(1)
    assert sorted(own) == list(range(20))
    quaternion = (unpacked(content, packed["quaternion"]) - 128) / 127
    there = Rotation.from_quat(np.roll(quaternion, -1, 1)).as_matrix()[..., 2]
    before = Rotation.from_quat(np.roll(model.disks.quaternion, -1, 1)).as_matrix()[own, :, 2]
    assert ((there * (before @ R.T)).sum(1) > np.cos(np.radians(1.5))).all()
    first, last = packed["logs"]
    scale = np.exp(first + unpacked(content, packed["scale"]) / 255 * (last - first))
    assert np.allclose(scale, model.disks.scale[own], rtol=0.01)


def test_html_is_safe_and_needs_nothing_else(model):
    text = model_section(model)[0]
    assert "<one>" not in text  # names of strangers do not become markup
    assert "The MIT License" in text
    for outside in ('src="http', "@import", "fetch(", 'href="http'):
        assert outside not in text.replace(text[text.index("three.js r") :], "")
