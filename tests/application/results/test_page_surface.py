"""The surface of the page: its texture shows what the keyframes saw there."""

import cv2
import numpy as np
import pytest

import geogs
from geogs.application.result_settings import RemeshSettings
from geogs.application.results import page_surface as owner
from geogs.application.results.page_surface import page_surface
from geogs.application.results.revise import remesh
from geogs.application.results.saved_result import SavedResult
from geogs.config import MeshConfig
from geogs.mesh.triangle_mesh import Mesh
from saved_results import make_result


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> SavedResult:
    folder = make_result(tmp_path_factory.mktemp("result"))
    remesh(RemeshSettings(folder, MeshConfig(voxel=0.15, min_component_faces=10), device="cpu"))
    return geogs.load_result(folder)


def test_each_vertex_has_the_colour_that_the_keyframe_saw_there(result):
    still = result.renders[0]
    shown, texture = page_surface(result.mesh, [still])
    image = cv2.imdecode(np.frombuffer(texture.jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    T_cw = still.T_cw.numpy()
    local = shown.vertices @ T_cw[:3, :3].T + T_cw[:3, 3]
    camera = result.camera
    u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    inside = (u > 3) & (u < camera.width - 4) & (v > 3) & (v < camera.height - 4)
    whole = np.zeros(len(inside), bool)
    whole[shown.faces[inside[shown.faces].all(1)]] = True  # others have a plain colour
    inside &= whole
    assert inside.sum() > 60
    expected = _sampled(still.image, u, v)[inside]
    width = np.array(image.shape[1::-1])
    found = _sampled(image, *(texture.uv * width - 0.5).T)[inside]
    error = np.abs(found - expected).mean(1)
    # Half of the faces are at the rim of the image or at the block's, and have a plain colour.
    assert (error < 6).mean() > 0.25
    shuffled = np.abs(np.roll(found, 7, axis=0) - expected).mean(1)
    assert (shuffled < 6).mean() < 0.15


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    places = [x.astype(np.float32)[None] for x in (u, v)]
    return cv2.remap(np.ascontiguousarray(image), *places, cv2.INTER_LINEAR)[0].astype(float)


def test_the_triangles_are_those_of_the_mesh(result):
    shown, texture = page_surface(result.mesh, result.renders)
    assert len(texture.uv) == len(shown.vertices) >= len(result.mesh.vertices)
    assert 0 <= texture.uv.min() <= texture.uv.max() <= 1
    np.testing.assert_allclose(
        shown.vertices[shown.faces], result.mesh.vertices[result.mesh.faces], atol=1e-6
    )
    across = np.cross(*np.diff(shown.vertices[shown.faces], axis=1).transpose(1, 0, 2))
    cosine = (across * shown.normals[shown.faces].sum(1)).sum(1)
    assert (cosine > 0).mean() > 0.99


def test_without_images_or_faces_that_they_show_there_is_none(result, monkeypatch):
    bare, none = page_surface(result.mesh, [])
    assert none is None
    assert len(bare.faces) == len(result.mesh.faces)
    behind = Mesh(-result.mesh.vertices - 50, result.mesh.faces, -result.mesh.normals)
    assert page_surface(behind, result.renders)[1] is None
    monkeypatch.setattr(owner, "MAX_FACES", 400)
    monkeypatch.setattr(owner, "MAX_TEXTURED", 300)
    assert 300 < len(page_surface(result.mesh, [])[0].faces) <= 440
    assert len(page_surface(result.mesh, result.renders)[0].faces) <= 330
