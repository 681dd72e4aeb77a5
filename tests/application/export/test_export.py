"""Exports are read by the programs that they are for, and by ourselves."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import geogs
from geogs.application.export.export import export
from geogs.application.result_settings import ExportSettings, RemeshSettings
from geogs.application.results.revise import remesh
from geogs.application.results.saved_result import SavedResult
from geogs.cli.main import main
from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.io.ply_reader import read_ply
from geogs.io.sources.sniff import open_posed_source
from geogs.io.writers.exports.mesh_writers import linear
from geogs.io.writers.ply_writer import SH_DEGREE_0
from saved_results import BLOCK, CAMERA, IDS, MASKED, ORIGIN, UNIT, WALL, make_result

NAMES = [f"{id:06d}.jpg" for id in IDS]
POINTS = 1500


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> SavedResult:
    folder = make_result(tmp_path_factory.mktemp("result"))
    remesh(RemeshSettings(folder, MeshConfig(voxel=0.15, min_component_faces=10), device="cpu"))
    return geogs.load_result(folder)


def exported(result: SavedResult, to: str, **more: object) -> Path:
    more = {"as_tracked": True, "textured": False, **more}
    return export(ExportSettings(result.folder, to, device="cpu", **more))


def on_planes(points: np.ndarray) -> np.ndarray:
    """Distance of world points to the wall or the block's front, map units."""
    z = (points[:, 2] - ORIGIN[2]) / UNIT
    return np.minimum(np.abs(z - WALL), np.abs(z - BLOCK))


@pytest.mark.parametrize("text", [False, True])
def test_colmap_reads_cameras_images_points_and_tracks(result, tmp_path, text):
    pycolmap = pytest.importorskip("pycolmap")
    folder = exported(result, "colmap", output=tmp_path, text=text, points=POINTS)
    assert (folder / "sparse/0/cameras.txt").is_file() == text
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    (camera,) = model.cameras.values()
    expected = [CAMERA.fx, CAMERA.fy, CAMERA.cx + 0.5, CAMERA.cy + 0.5]
    np.testing.assert_allclose(camera.params, expected)
    assert camera.model.name == "PINHOLE"
    places = {image.name: image for image in model.images.values()}
    assert sorted(places) == NAMES
    for name, T_cw in zip(NAMES, result.views.T_cw, strict=True):
        T = places[name].cam_from_world
        T = T() if callable(T) else T
        np.testing.assert_allclose(T.matrix(), T_cw[:3], atol=1e-9)
    assert len(model.points3D) > 0.5 * POINTS
    for point in list(model.points3D.values())[::20]:
        assert point.track.length() >= 2
        for seen in point.track.elements:
            image = model.images[seen.image_id]
            own = image.points2D[seen.point2D_idx]
            assert model.points3D[own.point3D_id].xyz.tolist() == point.xyz.tolist()
            np.testing.assert_allclose(image.project_point(point.xyz), own.xy, atol=1e-3)
    xyz = np.array([point.xyz for point in model.points3D.values()])
    assert np.median(on_planes(xyz)) < 0.01


@pytest.mark.parametrize("to", ["colmap", "nerfstudio"])
def test_image_sets_are_read_again_with_the_same_cameras_poses_and_masks(result, tmp_path, to):
    source = open_posed_source(exported(result, to, output=tmp_path, points=POINTS))
    assert source.kind == to
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(source.camera, name) == pytest.approx(getattr(CAMERA, name), abs=1e-9)
    np.testing.assert_allclose(source.T_cw, result.views.T_cw, atol=1e-9)
    images = list(source)
    assert [Path(image.label).name for image in images] == NAMES
    for image, keyframe in zip(images, result.keyframes, strict=True):
        np.testing.assert_array_equal(image.image, keyframe.image)
    assert [image.mask is not None for image in images] == [i == MASKED for i in range(5)]
    mask = images[MASKED].mask
    assert mask[:, :40].all()
    assert not mask[:, 40:].any()


def test_nerfstudio_finds_depth_of_the_size_of_the_image_in_its_unit(result, tmp_path):
    folder = exported(result, "nerfstudio", output=tmp_path, points=POINTS)
    document = json.loads((folder / "transforms.json").read_text())
    assert document["depth_unit_scale_factor"] == 1e-3
    frame = document["frames"][0]
    depth = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    assert depth.shape == (60, 80)
    assert depth.dtype == np.uint16
    T_wc = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])  # to OpenCV axes
    v, u = np.nonzero(depth)
    z = depth[v, u] * document["depth_unit_scale_factor"]
    rays = [
        (u + 0.5 - document["cx"]) / document["fl_x"],
        (v + 0.5 - document["cy"]) / document["fl_y"],
    ]
    points = (np.stack([*rays, np.ones(len(u))], -1) * z[:, None]) @ T_wc[:3, :3].T + T_wc[:3, 3]
    assert np.quantile(on_planes(points), 0.8) < 0.02
    assert "mask_path" in document["frames"][MASKED]
    assert len(read_ply(folder / document["ply_file_path"])["vertex"].columns["x"]) > 500


def test_depth_and_normals_say_their_scale(result, tmp_path):
    for to in ("depth", "normals"):
        exported(result, to, output=tmp_path / to)
    said = json.loads((tmp_path / "depth" / "description.json").read_text())
    exact = np.load(tmp_path / "depth" / "000002.npz")["depth"]
    png = cv2.imread(str(tmp_path / "depth" / "000002.png"), cv2.IMREAD_UNCHANGED)
    unit = said["values"]["png_unit"]
    assert 65535 * unit >= exact.max() > 6553 * unit
    assert np.abs(png * unit - exact).max() <= unit * 0.5 + 1e-6 * exact.max()
    np.testing.assert_allclose(said["T_cw"]["000002"], result.views.T_cw[1])
    normal = np.load(tmp_path / "normals" / "000002.npz")["normal"]
    rgb = cv2.imread(str(tmp_path / "normals" / "000002.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    known = np.linalg.norm(normal, axis=-1) > 0.5
    np.testing.assert_allclose((2 * rgb / 65535 - 1)[known], normal[known], atol=2e-5)
    assert (rgb[~known] == 0).all()
    assert known.mean() > 0.9


def test_trajectories_are_read_by_evo(result, tmp_path):
    evo = pytest.importorskip("evo.tools.file_interface")
    expected = np.linalg.inv(result.views.T_cw)
    kitti = evo.read_kitti_poses_file(str(exported(result, "kitti", output=tmp_path)))
    euroc = evo.read_euroc_csv_trajectory(str(exported(result, "euroc", output=tmp_path)))
    tum = evo.read_tum_trajectory_file(str(exported(result, "tum", output=tmp_path)))
    for read in (kitti, euroc, tum):
        np.testing.assert_allclose(read.poses_se3, expected, atol=1e-9)
    np.testing.assert_allclose(euroc.timestamps, np.array(IDS) / 30, atol=1e-9)
    np.testing.assert_allclose(tum.timestamps, np.array(IDS) / 30)
    assert len((tmp_path / "times.txt").read_text().split()) == 5


def test_meshes_are_read_by_trimesh_with_y_up(result, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    shown, turned = result.mesh.creased(), result.mesh.vertices * [1, -1, -1]
    glb = trimesh.load(exported(result, "glb", output=tmp_path / "m.glb"), process=False)
    (surface,) = glb.geometry.values()
    np.testing.assert_allclose(surface.vertices, shown.vertices * [1, -1, -1], rtol=1e-6)
    np.testing.assert_allclose(surface.vertex_normals, shown.normals * [1, -1, -1], atol=1e-5)
    np.testing.assert_array_equal(surface.faces, shown.faces)
    colours = surface.visual.vertex_attributes["color"][:, :3] / 65535
    np.testing.assert_allclose(colours, linear(shown.colours), atol=1e-5)
    obj = trimesh.load(exported(result, "obj", output=tmp_path), process=False)
    np.testing.assert_allclose(obj.vertices, turned, rtol=1e-5)
    np.testing.assert_array_equal(obj.visual.vertex_colors[:, :3], result.mesh.colours)
    across = (np.cross(*np.diff(obj.vertices[obj.faces], axis=1).transpose(1, 0, 2))).sum(0)
    assert across[2] > 0.9 * np.linalg.norm(across)  # towards the viewer, who looks along -z


def test_a_textured_mesh_lies_beside_the_plain_one(result, tmp_path):
    plain = exported(result, "glb", output=tmp_path)
    before = plain.read_bytes()
    textured = exported(result, "glb", output=tmp_path, textured=True, texture_size=64)
    assert (plain.name, textured.name) == ("mesh.glb", "mesh_textured.glb")
    assert plain.read_bytes() == before
    assert b"image/jpeg" in textured.read_bytes()
    assert b"image/jpeg" not in before


def test_colours_are_made_linear_as_the_standard_says():
    levels = np.array([[0, 10, 11], [128, 188, 255]], np.uint8)
    expected = [[0, 0.0030353, 0.0033465], [0.2158605, 0.5028865, 1]]
    np.testing.assert_allclose(linear(levels), expected, atol=1e-6)


def test_clouds_are_read_by_laspy_and_as_ply(result, tmp_path):
    laspy = pytest.importorskip("laspy")
    vertex = read_ply(exported(result, "cloud", output=tmp_path))["vertex"].columns
    points = np.stack([vertex[axis] for axis in "xyz"], -1)
    assert len(points) > 500
    assert np.quantile(on_planes(points), 0.8) < 0.02
    las = laspy.read(exported(result, "cloud", output=tmp_path / "c.las"))
    np.testing.assert_allclose(np.stack([las.x, las.y, las.z], -1), points, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(las.red) // 257, vertex["red"])


def test_splats_have_the_names_of_both_kinds(result, tmp_path):
    exported(result, "splats", output=tmp_path, sh_degree=1)
    full, flat = (read_ply(tmp_path / f"splats_{k}dgs.ply")["vertex"].columns for k in "32")
    rest = [f"f_rest_{i}" for i in range(9)]
    head = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    turn = ["rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(full) == [*head, "scale_0", "scale_1", "scale_2", *turn]
    assert list(flat) == [*head, "scale_0", "scale_1", *turn]
    np.testing.assert_allclose(np.exp(flat["scale_1"]), result.disks.scale[:, 1], rtol=1e-5)
    assert not any(full[name].any() for name in rest)


def test_gsplat_start_values_are_those_of_the_disks(result, tmp_path):
    start = np.load(exported(result, "gsplat", output=tmp_path))
    n = len(result.disks)
    shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,)}
    assert {k: v.shape for k, v in start.items()} == {**shapes, "sh0": (n, 1, 3)}
    np.testing.assert_allclose(np.exp(start["scales"][:, :2]), result.disks.scale, rtol=1e-5)
    opacity = 1 / (1 + np.exp(-start["opacities"]))
    np.testing.assert_allclose(opacity, result.disks.opacity, rtol=1e-5)
    colour = start["sh0"][:, 0] * SH_DEGREE_0 + 0.5
    assert 0 <= colour.min() < colour.max() <= 1


def test_the_command_says_what_it_wrote_and_what_is_missing(tmp_path, capsys):
    folder = make_result(tmp_path, with_images=False)
    assert main(["export", str(folder), "--to", "tum", "--device", "cpu"]) == 0
    assert "export/tum/trajectory.txt" in capsys.readouterr().out
    assert (folder / "export" / "tum" / "trajectory.txt").is_file()
    assert main(["export", str(folder), "--to", "tum", "-o", str(tmp_path / "a.glb")]) == 2
    assert "should end in .txt or .tum" in capsys.readouterr().err
    assert main(["export", str(folder), "--to", "glb"]) == 2
    assert "geogs mesh" in capsys.readouterr().err
    assert main(["export", str(folder), "--to", "dwg"]) == 2
    for to in ("colmap", "nerfstudio", "cloud", "splats"):
        with pytest.raises(InputError, match="without keyframe images"):
            export(ExportSettings(folder, to, device="cpu"))
