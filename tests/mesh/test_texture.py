"""A mesh gets an image from its views, levelled, and looks like views that were not used."""

import json
import struct

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.writers.exports.mesh_writers import write_textured_glb
from geogs.mesh.texture.atlas import pack, scale_that_fits
from geogs.mesh.texture.face_views import face_neighbours, find_candidates
from geogs.mesh.texture.textured import seam_corrections, texture_mesh, view_gains
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from textured_view import psnr, render_textured

CAMERA = Camera(90.0, 90.0, 63.5, 47.5, 128, 96)
DISTANCE = 2.0


def wall(cells: int = 24, half: float = 1.3) -> Mesh:
    """A wavy wall at z = 2 that faces the origin."""
    line = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(line, line)
    z = DISTANCE + 0.05 * np.sin(3 * x) * np.cos(2 * y)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    i = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = (s.ravel() for s in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    faces = [np.stack([a, c, b], 1), np.stack([b, c, d], 1)]
    return Mesh.from_triangles(vertices, np.concatenate(faces))


def paint(points: np.ndarray) -> np.ndarray:
    """A smooth colour, 0 to 1, of every place on the wall."""
    x, y = points[..., 0], points[..., 1]
    red, green = 0.5 + 0.3 * np.sin(5 * x), 0.5 + 0.3 * np.cos(4 * y)
    return np.stack([red, green, 0.4 + 0.2 * np.sin(3 * (x + y))], -1)


def view(mesh: Mesh, x: float, y: float = 0.0, gain: float = 1.0) -> DepthMapView:
    """The wall from beside the origin, exactly."""
    from geogs.evaluation.surfaces.raster import render_mesh

    T_cw = np.eye(4)
    T_cw[:2, 3] = -x, -y
    depth, face = render_mesh(mesh.vertices, mesh.faces, CAMERA, T_cw)
    depth = np.where(face >= 0, depth, 0)
    points = depth[..., None] * CAMERA.rays(torch.float64).numpy() + (x, y, 0)
    image = (255 * gain * paint(points)).clip(0, 255) * (face >= 0)[..., None]
    depth = torch.from_numpy(depth).float()
    return DepthMapView(
        depth, (depth > 0).float(), CAMERA, torch.from_numpy(T_cw), image.astype(np.uint8)
    )


@pytest.fixture(scope="module")
def textured():
    mesh = wall()
    gains = (1.0, 1.25, 0.8, 1.1)
    places = ((-0.5, -0.3), (0.5, -0.3), (-0.5, 0.3), (0.5, 0.3))
    views = [view(mesh, *place, gain) for place, gain in zip(places, gains, strict=True)]
    return mesh, views, texture_mesh(mesh, views, 0.02)


def test_a_view_that_was_not_used_looks_like_the_mesh_though_exposures_differ(textured):
    mesh, _, made = textured
    truth = view(mesh, 0.1, 0.05, (1.0 * 1.25 * 0.8 * 1.1) ** 0.25)
    drawn, hit = render_textured(
        made.vertices, made.faces, made.uv, made.texture, CAMERA, truth.T_cw.numpy()
    )
    assert hit.mean() > 0.9
    assert psnr(drawn, truth.image, hit) > 32
    assert made.seen > 0.95


def test_without_levelling_it_would_not(textured):
    """The oracle: each face in the colours of the view that shows it largest, as they are."""
    mesh, views, _ = textured
    truth = view(mesh, 0.1, 0.05, 1.0)
    candidates = find_candidates(mesh, views, 0.02)
    best = candidates.score.argmax(1)
    colour = candidates.colour[np.arange(len(best)), best]
    from geogs.evaluation.surfaces.raster import render_mesh

    _, face = render_mesh(mesh.vertices, mesh.faces, CAMERA, truth.T_cw.numpy())
    hit = face >= 0
    drawn = np.zeros_like(truth.image)
    drawn[hit] = colour[face[hit]].astype(np.uint8)
    assert psnr(drawn, truth.image, hit) < 25


def test_gains_are_the_ratios_of_exposures(textured):
    mesh, views, _ = textured
    gains = view_gains(find_candidates(mesh, views, 0.02), len(views))
    exposures = np.array([1.0, 1.25, 0.8, 1.1])
    levelled = exposures[:, None] * gains
    assert levelled.max() / levelled.min() < 1.06


def test_seam_corrections_against_dense_least_squares():
    vertex = np.array([0, 1, 2, 2, 3, 1])
    edges = np.array([[0, 1], [1, 2], [3, 4], [4, 5], [3, 5]])
    random = np.random.default_rng(0)
    colour = random.uniform(0, 255, (6, 3)).astype(np.float32)
    found = seam_corrections(vertex, edges, colour)
    rows, right = [], []
    for i, j in ((1, 5), (2, 3)):  # the same vertex in two patches
        rows.append(np.eye(6)[i] - np.eye(6)[j])
        right.append(colour[j] - colour[i])
    for i, j in edges:
        rows.append(np.sqrt(0.1) * (np.eye(6)[i] - np.eye(6)[j]))
        right.append(np.zeros(3))
    rows += list(1e-2 * np.eye(6))
    right += [np.zeros(3)] * 6
    expected = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    # One colour for all of them is hardly fixed by anything.
    np.testing.assert_allclose(found - found.mean(0), expected - expected.mean(0), atol=0.05)


def test_what_stands_before_the_wall_is_not_painted_on_it():
    mesh = wall()
    views = [view(mesh, 0.2 * k) for k in range(-2, 3)]
    blocked = views[2]
    blocked.depth[:, 50:80] = 0.7
    blocked.image[:, 50:80] = (255, 0, 0)
    made = texture_mesh(mesh, views, 0.02)
    used = made.texture.reshape(-1, 3).astype(int)
    assert made.seen > 0.7  # the rest is beyond all images
    red = (used[:, 0] > 240) & (used[:, 1] < 20)
    assert red.mean() < 0.05  # only beside patches, where nothing is drawn from
    drawn, hit = render_textured(
        made.vertices, made.faces, made.uv, made.texture, CAMERA, np.eye(4)
    )
    hit[:10] = hit[-10:] = hit[:, :10] = hit[:, -10:] = False  # no view shows all of these faces
    assert psnr(drawn, view(mesh, 0.0).image, hit) > 30


def test_neighbours_share_an_edge():
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]])
    assert face_neighbours(faces).tolist() == [[0, 1]]


def test_rectangles_do_not_overlap_and_shrink_where_they_must():
    random = np.random.default_rng(1)
    sizes = random.integers(3, 60, (80, 2))
    places, (width, height) = pack(sizes, 4096)
    drawn = np.zeros((height, width), int)
    for (x, y), (w, h) in zip(places, sizes, strict=True):
        drawn[y : y + h, x : x + w] += 1
    assert drawn.max() == 1
    assert sizes.prod(1).sum() > 0.6 * width * height
    scaled, _, (width, height) = scale_that_fits(sizes, 128, fixed=1)
    assert max(width, height) <= 128
    assert (scaled[-1] == sizes[-1]).all()
    assert (scaled[:-1] <= sizes[:-1]).all()


def test_trimesh_reads_places_texture_and_axes(textured, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    _, _, made = textured
    path = tmp_path / "mesh.glb"
    write_textured_glb(path, made.vertices, made.faces, made.normals, made.uv, made.texture)
    read = trimesh.load(path, force="mesh", process=False)
    np.testing.assert_allclose(read.vertices, made.vertices * (1, -1, -1), atol=1e-6)
    np.testing.assert_array_equal(read.faces, made.faces)
    picture = np.asarray(read.visual.material.baseColorTexture.convert("RGB")).astype(float)
    assert picture.shape == made.texture.shape
    assert np.abs(picture - made.texture).mean() < 3
    # trimesh has v upwards; the first row of the file's image is v = 0.
    height, width = made.texture.shape[:2]
    uv = (made.uv + 0.5) / (width, height)
    np.testing.assert_allclose(read.visual.uv, np.stack([uv[:, 0], 1 - uv[:, 1]], -1), atol=1e-6)
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    assert all(v["byteOffset"] % 4 == 0 for v in document["bufferViews"])


def test_a_mesh_that_no_image_shows_is_refused():
    mesh = wall(4)
    with pytest.raises(InputError, match="No image shows"):
        texture_mesh(mesh, [view(mesh, 50.0)], 0.02)
