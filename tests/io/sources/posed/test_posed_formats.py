"""Every layout of images with known poses gives the generating cameras, poses and points back."""

import json
import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.true_scene import read_true_scene
from geogs.io.sources.formats.colmap import read_model
from geogs.io.sources.formats.dtu import decompose
from geogs.io.sources.posed.posed_set import SparsePoints, renumbered
from geogs.io.sources.sniff import open_posed_source
from io_samples import write_image
from posed_layouts import (
    nerfstudio_document,
    render_room,
    write_colmap_binary,
    write_colmap_text,
    write_dtu,
    write_nerfstudio,
    write_replica,
    write_room_images,
    write_scannet,
    write_seven_scenes,
    write_tum,
)

NATIVE = InputConfig(long_edge=0)
NAMES = [f"view{i}.png" for i in range(11)]


@pytest.fixture(scope="module")
def room():
    return render_room(11, 3, 96, 72)


def write_colmap_project(room, folder, write_model=write_colmap_text, **camera):
    names = write_room_images(room, folder / "images", "view{}.png")
    write_model(room, folder / "sparse" / "0", names, **camera)
    return folder


def write_colmap_binary_project(room, folder):
    return write_colmap_project(room, folder, write_colmap_binary)


def seen_by(points: SparsePoints, image: int) -> np.ndarray:
    """Positions of the points that an image sees."""
    return points.positions[np.unique(points.seen_point[points.seen_image == image])]


def assert_is_room(source, room, exactly=True):
    """The cameras project as the generating ones, and the images are theirs, in order."""
    assert len(source) == len(room.images)
    camera, true = source.camera, room.camera
    assert (camera.width, camera.height) == (true.width, true.height)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(true, name), abs=1e-6)
    np.testing.assert_allclose(source.T_cw, room.T_cw, atol=1e-9)
    K, true_K = camera.matrix().numpy(), true.matrix().numpy()
    for T, true_T in zip(source.T_cw, room.T_cw, strict=True):
        seen = room.points @ T[:3, :3].T + T[:3, 3]
        true_seen = room.points @ true_T[:3, :3].T + true_T[:3, 3]
        pixels = (seen @ K.T)[:, :2] / seen[:, 2:]
        true_pixels = (true_seen @ true_K.T)[:, :2] / true_seen[:, 2:]
        np.testing.assert_allclose(pixels, true_pixels, atol=1e-6)
    if exactly:
        for view, image in zip(source, room.images, strict=True):
            np.testing.assert_array_equal(view.image, image)


@pytest.mark.parametrize(
    ("kind", "write"),
    [
        ("colmap", write_colmap_project),
        ("colmap", write_colmap_binary_project),
        ("nerfstudio", write_nerfstudio),
        ("dtu", write_dtu),
        ("replica", write_replica),
        ("tum", write_tum),
        ("7scenes", write_seven_scenes),
        ("scannet", write_scannet),
    ],
)
def test_layout_gives_the_generating_cameras(kind, write, room, tmp_path):
    source = open_posed_source(write(room, tmp_path / "scene"), NATIVE)
    assert source.kind == kind
    assert source.name == ("scene" if kind != "7scenes" else f"{tmp_path.name}-scene")
    assert_is_room(source, room)


def test_colmap_text_and_binary_agree(room, tmp_path):
    text = read_model(write_colmap_text(room, tmp_path / "text", NAMES))
    binary = read_model(write_colmap_binary(room, tmp_path / "binary", NAMES))
    assert text.cameras == binary.cameras
    assert text.images == binary.images
    np.testing.assert_array_equal(text.points.positions, binary.points.positions)
    np.testing.assert_array_equal(text.points.seen_point, binary.points.seen_point)
    np.testing.assert_array_equal(text.points.seen_image, binary.points.seen_image)


def test_colmap_points_follow_the_selection(room, tmp_path):
    write_colmap_project(room, tmp_path)
    source = open_posed_source(tmp_path, NATIVE)
    np.testing.assert_allclose(source.points.positions, room.points)
    np.testing.assert_allclose(seen_by(source.points, 0), room.points[:1])
    np.testing.assert_allclose(seen_by(source.points, 4), room.points[3:5])
    # Images 4, 6, 8: point k is seen by images k and k + 1.
    source = open_posed_source(tmp_path, InputConfig(long_edge=0, start=4, stop=9, stride=2))
    np.testing.assert_allclose(source.points.positions, room.points[3:9])
    np.testing.assert_allclose(seen_by(source.points, 1), room.points[5:7])


@pytest.mark.parametrize("given", ["sparse/0", "sparse", "sparse/0/images.bin"])
def test_colmap_model_given_itself(given, room, tmp_path):
    write_colmap_binary_project(room, tmp_path / "scene")
    source = open_posed_source(tmp_path / "scene" / given, NATIVE)
    assert source.name == "scene"
    assert len(source) == 11


def test_colmap_distortion_is_removed(room, tmp_path):
    fx, fy, cx, cy = room.pinhole
    camera = {"model": "OPENCV", "parameters": (fx, fy, cx, cy, 0.1, 0.0, 0.001, 0.0)}
    source = open_posed_source(write_colmap_project(room, tmp_path, **camera), NATIVE)
    assert source.camera.fx > room.camera.fx  # the border is cropped
    assert source.camera.cx == room.camera.cx
    assert source[0].mask is None


def test_colmap_fisheye_becomes_a_pinhole_of_the_asked_field_of_view(room, tmp_path):
    fx, fy, cx, cy = room.pinhole
    camera = {"model": "OPENCV_FISHEYE", "parameters": (fx, fy, cx, cy, 0.01, 0.0, 0.0, 0.0)}
    project = write_colmap_project(room, tmp_path, **camera)
    source = open_posed_source(project, replace(NATIVE, working_field_of_view=30.0))
    half = max(source.camera.width, source.camera.height) / 2
    assert math.degrees(2 * math.atan(half / source.camera.fx)) == pytest.approx(30)
    assert source[0].mask is None


def test_colmap_lens_of_another_model_is_refused_by_name(room, tmp_path):
    fx, fy, cx, cy = room.pinhole
    write_colmap_project(room, tmp_path, model="FOV", parameters=(fx, fy, cx, cy, 0.9))
    with pytest.raises(InputError, match=r"FOV camera.*undistort"):
        open_posed_source(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("end", ["txt", "bin"])
def test_damaged_colmap_model(name, end, room, tmp_path):
    write = write_colmap_text if end == "txt" else write_colmap_binary
    write_colmap_project(room, tmp_path, write)
    file = tmp_path / "sparse" / "0" / f"{name}.{end}"
    data = file.read_bytes()
    cut = data.index(b"1 PINHOLE") + 12 if name + end == "camerastxt" else len(data) - 30
    file.write_bytes(data[:cut] if end == "bin" or name == "cameras" else b"\xff\xfe 1 2")
    with pytest.raises(InputError, match=r"cut off|no file of a COLMAP model|not a text file"):
        open_posed_source(tmp_path)


def test_colmap_without_its_images(room, tmp_path):
    write_colmap_text(room, tmp_path / "sparse" / "0", NAMES)
    with pytest.raises(InputError, match=r"are not in .*images; put them there"):
        open_posed_source(tmp_path)


def test_images_that_are_missing_are_left_out(room, tmp_path):
    write_colmap_project(room, tmp_path)
    (tmp_path / "images" / "view3.png").unlink()
    (tmp_path / "images" / "view5.png").write_bytes(b"no picture")
    source = open_posed_source(tmp_path, NATIVE)
    assert source.account.left[0].startswith("2 of 11 images, ")
    np.testing.assert_allclose(source.T_cw[[3, 4]], room.T_cw[[4, 6]], atol=1e-9)
    np.testing.assert_allclose(seen_by(source.points, 4), room.points[5:7])


def test_scannetpp_iphone(room, tmp_path):
    names = write_room_images(room, tmp_path / "8b5caf3398/iphone/rgb", "frame_{:06d}.png")
    listed = [f"video/{name}" for name in names]
    write_colmap_text(room, tmp_path / "8b5caf3398/iphone/colmap", listed)
    source = open_posed_source(tmp_path / "8b5caf3398", NATIVE)
    assert (source.kind, source.name) == ("colmap", "8b5caf3398")
    assert_is_room(source, room)
    document = nerfstudio_document(room, names)
    (tmp_path / "8b5caf3398/iphone/nerfstudio").mkdir()
    file = tmp_path / "8b5caf3398/iphone/nerfstudio/transforms.json"
    file.write_text(json.dumps(document))
    source = open_posed_source(file, NATIVE)
    assert (source.kind, source.name) == ("nerfstudio", "8b5caf3398")
    assert_is_room(source, room)


def test_nerfstudio_camera_by_frame_names_without_suffix_and_masks(room, tmp_path):
    document = nerfstudio_document(room, write_room_images(room, tmp_path, "images/{}.png"))
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    camera = {key: document.pop(key) for key in keys}
    mask = np.zeros_like(room.images[0])
    mask[:, :50] = 255
    write_image(tmp_path / "mask.png", mask)
    for frame in document["frames"]:
        frame.update(camera, file_path=frame["file_path"].removesuffix(".png"))
        frame["mask_path"] = "mask.png"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    source = open_posed_source(tmp_path / "transforms.json", NATIVE)
    assert_is_room(source, room)
    np.testing.assert_array_equal(source[2].mask, mask[..., 0] > 0)


def test_nerfstudio_applied_transform_and_scale_are_undone(room, tmp_path):
    write_nerfstudio(room, tmp_path)
    document = json.loads((tmp_path / "transforms.json").read_text())
    applied = np.array([[0, 1, 0, 0.5], [1, 0, 0, -2], [0, 0, -1, 1]])
    for frame in document["frames"]:
        T_wc = applied @ np.array(frame["transform_matrix"])
        T_wc[:, 3] *= 0.25
        frame["transform_matrix"] = T_wc.tolist()
    document.update(applied_transform=applied.tolist(), applied_scale=0.25)
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert_is_room(open_posed_source(tmp_path, NATIVE), room)


def test_blender_field_of_view_and_alpha(room, tmp_path):
    names = write_room_images(room, tmp_path, "train/r_{}.png")
    for name, image in zip(names, room.images, strict=True):
        alpha = np.full((*image.shape[:2], 1), 255, dtype=np.uint8)
        alpha[:30] = 0
        write_image(tmp_path / name, np.concatenate([alpha, image], axis=2))  # reversed: B G R A
    document = nerfstudio_document(room, [name.removesuffix(".png") for name in names])
    frames = document["frames"]
    document = {"camera_angle_x": 2 * np.arctan(0.5 / 0.7), "frames": frames}
    (tmp_path / "transforms_train.json").write_text(json.dumps(document))
    source = open_posed_source(tmp_path, NATIVE)
    assert source.camera.fx == pytest.approx(room.camera.fx)
    assert source.camera.fy == pytest.approx(room.camera.fx)
    assert source.camera.cx == pytest.approx((room.camera.width - 1) / 2)
    np.testing.assert_array_equal(source[0].image, room.images[0])
    assert not source[0].mask[:30].any()
    assert source[0].mask[30:].all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": [{"file_path": "a.png"}]}, "transform_matrix"),
        ({"frames": []}, "lists no images"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"fl_x": float("nan")}, "NaN"),
        ({"applied_transform": [[0, 0, 0, 0]] * 3}, "cannot be understood"),
    ],
)
def test_bad_transforms(change, message, room, tmp_path):
    write_nerfstudio(room, tmp_path)
    document = json.loads((tmp_path / "transforms.json").read_text()) | change
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=message):
        open_posed_source(tmp_path)


def test_renumbered():
    numbers = np.array([7, 3, 100, 0, 9, 3], dtype=np.int64)
    assert renumbered(numbers, [9, 3, 7]).tolist() == [2, 1, -1, -1, 0, 1]


def test_dtu_masks(room, tmp_path):
    source = open_posed_source(write_dtu(room, tmp_path), NATIVE)
    for i in (0, 7):
        expected = np.zeros((72, 96), dtype=bool)
        expected[40:, i:] = True
        np.testing.assert_array_equal(source[i].mask, expected)


def test_decompose_any_scale_and_sign():
    rng = np.random.default_rng(0)
    K = np.array([[700.0, 0, 310], [0, 720, 250], [0, 0, 1]])
    for scale in (1.0, -1.0, 1e-3, -250.0):
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        R *= np.sign(np.linalg.det(R))
        t = rng.normal(size=3)
        found_K, T = decompose(scale * K @ np.c_[R, t])
        np.testing.assert_allclose(found_K, K, atol=1e-9)
        np.testing.assert_allclose(T[:3], np.c_[R, t], atol=1e-11)


@pytest.mark.parametrize(
    "rows",
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        # Its determinant is not quite nothing, but the camera that comes out is singular.
        [[0, -1, 3], [-2, 3, -3], [-2, 2, 1e-15]],
    ],
)
def test_a_matrix_of_no_camera_is_said_to_be_none(rows):
    found_K, T = decompose(np.c_[np.array(rows, float), np.ones(3)])
    assert np.isnan(found_K).all()
    assert np.isnan(T).all()


def test_dtu_needs_all_images(room, tmp_path):
    write_dtu(room, tmp_path)
    (tmp_path / "image" / "000004.png").unlink()
    with pytest.raises(InputError, match="10 images but"):
        open_posed_source(tmp_path)
    (tmp_path / "cameras.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match="damaged"):
        open_posed_source(tmp_path)


def test_tum_poses_are_interpolated_and_gaps_left_out(room, tmp_path):
    write_tum(room, tmp_path)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    # Without pose 3 image 3 is interpolated; without poses 6 to 8 there is a gap of 0.16 s.
    kept = [line for i, line in enumerate(lines) if i - 1 not in (3, 6, 7, 8)]
    (tmp_path / "groundtruth.txt").write_text("\n".join(kept))
    source = open_posed_source(tmp_path, NATIVE)
    assert source.account.left[0].startswith("3 of 11 images, ")
    middle = (room.T_wc[2, :3, 3] + room.T_wc[4, :3, 3]) / 2
    np.testing.assert_allclose(np.linalg.inv(source.T_cw[3])[:3, 3], middle, atol=1e-9)
    half = source.T_cw[3, :3, :3] @ room.T_wc[2, :3, :3]
    np.testing.assert_allclose(half @ source.T_cw[2, :3, :3], source.T_cw[3, :3, :3], atol=1e-9)
    np.testing.assert_allclose(half @ half, room.T_cw[4, :3, :3] @ room.T_wc[2, :3, :3], atol=1e-2)
    np.testing.assert_allclose(source.T_cw[-2:], room.T_cw[-2:], atol=1e-9)


def test_scannet_lost_frames(room, tmp_path):
    write_scannet(room, tmp_path)
    (tmp_path / "pose" / "2.txt").write_text("-inf " * 16)
    (tmp_path / "pose" / "5.txt").unlink()
    source = open_posed_source(tmp_path, NATIVE)
    assert source.account.left[0].startswith("1 of 10 images, ")
    kept = [0, 1, 3, 4, 6, 7, 8, 9, 10]
    np.testing.assert_allclose(source.T_cw, room.T_cw[kept], atol=1e-9)
    np.testing.assert_allclose(source.timestamps, np.array(kept) / 30)


def change_matrices(folder, numbers, last_row):
    """Give the poses of these frames another last row, in whatever files they are."""
    for file in [*folder.glob("*.pose.txt"), *folder.glob("pose/*.txt")]:
        if int(re.search(r"\d+", file.name)[0]) in numbers:
            np.savetxt(file, [*np.loadtxt(file)[:3], last_row])
    if (table := folder / "traj.txt").exists():
        rows = np.loadtxt(table)
        rows[numbers, 12:] = last_row
        np.savetxt(table, rows)
    if (file := folder / "transforms.json").exists():
        document = json.loads(file.read_text())
        for frame in document["frames"]:
            if int(re.search(r"\d+", frame["file_path"])[0]) - 1 in numbers:
                frame["transform_matrix"][3] = last_row
        file.write_text(json.dumps(document))


@pytest.mark.parametrize("last", [(0.0, 0.0), (0.0, 2.0), (0.1, 1.0), (0.0, -1.0)])
@pytest.mark.parametrize(
    "write", [write_seven_scenes, write_scannet, write_replica, write_nerfstudio]
)
def test_a_pose_whose_last_row_is_not_0_0_0_1_is_none(write, last, room, tmp_path):
    last_row = [0.0, 0.0, *last]
    write(room, tmp_path)
    change_matrices(tmp_path, [2, 5], last_row)
    source = open_posed_source(tmp_path, NATIVE)
    kept = [0, 1, 3, 4, 6, 7, 8, 9, 10]
    np.testing.assert_allclose(source.T_cw, room.T_cw[kept], atol=1e-9)
    change_matrices(tmp_path, list(range(11)), last_row)
    with pytest.raises(InputError):
        open_posed_source(tmp_path, NATIVE)


def test_mirrored_poses_are_refused(room, tmp_path):
    write_replica(room, tmp_path)
    swapped = room.T_wc[:, [0, 2, 1, 3]]
    np.savetxt(tmp_path / "traj.txt", swapped.reshape(-1, 16))
    with pytest.raises(InputError):
        open_posed_source(tmp_path)
    shutil.rmtree(tmp_path / "results")
    write_nerfstudio(room, tmp_path)
    document = json.loads((tmp_path / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["transform_matrix"] = [frame["transform_matrix"][i] for i in (0, 2, 1, 3)]
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="mirror the scene"):
        open_posed_source(tmp_path)


def test_dtu_scan_projects_like_its_matrices(shared_data):
    folder = shared_data / "dtu" / "scan24"
    if not folder.is_dir():
        pytest.skip("dtu/scan24 is not on this machine")
    source = open_posed_source(folder, NATIVE)
    assert (len(source), source.scene_scale) == (49, "millimetres")
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    K = source.camera.matrix().numpy()
    matrices = np.load(folder / "cameras.npz")
    unit_ball = matrices["scale_mat_0"]
    points = unit_ball[:3, 3] + 0.5 * unit_ball[0, 0] * corners
    for i, T in enumerate(source.T_cw):
        seen = (points @ T[:3, :3].T + T[:3, 3]) @ K.T
        true = np.c_[points, np.ones(8)] @ matrices[f"world_mat_{i}"][:3].T
        assert (seen[:, 2] > 0).all()
        # The file holds single precision.
        np.testing.assert_allclose(
            seen[:, :2] / seen[:, 2:] + 0.5, true[:, :2] / true[:, 2:], atol=0.01
        )


def test_a_truth_whose_images_are_missing_says_so(room, tmp_path):
    write_colmap_project(room, tmp_path)
    for image in (tmp_path / "images").iterdir():
        image.unlink()
    with pytest.raises(InputError, match=r"images of the COLMAP model .* are not in"):
        read_true_scene(tmp_path)
    with pytest.raises(InputError, match="holds no"):
        read_true_scene(tmp_path / "images")
