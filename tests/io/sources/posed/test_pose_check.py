"""The check of poses against images passes for the true conventions and names the wrong ones."""

import json

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.posed.conventions import conventions_for
from geogs.io.sources.posed.matching import Matcher
from geogs.io.sources.posed.pose_check import check_poses, judge, with_focal_length
from geogs.io.sources.sniff import open_posed_source
from io_samples import write_image
from posed_layouts import (
    OPENGL,
    quaternion_wxyz,
    render_room,
    write_nerfstudio,
    write_replica,
    write_room_images,
    write_tum,
)

pytestmark = pytest.mark.system

NATIVE = InputConfig(long_edge=0)
# Camera-to-world rotations as others write them: columns are their x, y and z.
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # OpenCV axes of those of the camera
BODY = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


@pytest.fixture(scope="module")
def room():
    return render_room(14, 4, 320, 240)


@pytest.fixture(scope="module")
def folder(room, tmp_path_factory):
    return write_replica(room, tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def matched(room, folder):
    """Pairs of the images with their camera: which they are does not depend on good poses."""
    matcher = Matcher(with_poses(folder, room.T_wc))
    return matcher.pairs(8), matcher.camera


def turned(axes):
    """Camera-to-world poses of cameras with other axes."""
    turn = np.eye(4)
    turn[:3, :3] = axes
    return lambda T_wc: T_wc @ turn


def with_poses(folder, T_wc):
    """The source of ``folder`` with other camera-to-world poses in its file."""
    np.savetxt(folder / "traj.txt", T_wc.reshape(-1, 16), fmt="%.17g")
    return open_posed_source(folder, NATIVE)


MISTAKES = {
    "OpenGL axes": turned(np.diag([1.0, -1, -1])),
    "the inverse poses": np.linalg.inv,
    "the inverse poses .* in OpenGL axes": lambda T: OPENGL @ np.linalg.inv(T),
    "look along [+]y with z up": turned(Z_UP),
    "look along -y with z down": turned(Z_UP.T),
    "a body that looks along [+]x": turned(BODY),
}


def test_true_poses_pass(room, folder):
    check = check_poses(with_poses(folder, room.T_wc))
    assert check.warning is None
    assert check.pairs == 13  # all images
    assert check.given.error < 0.0015  # 0.5 pixels
    assert check.given.in_front > 0.97


def test_world_does_not_matter(room, folder, matched):
    world = np.eye(4)
    world[:3, :3] = 40 * np.array([[0.0, 1, 0], [0.6, 0, 0.8], [0.8, 0, -0.6]])
    T_wc = world @ room.T_wc
    T_wc[:, :3, :3] /= 40
    assert judge(with_poses(folder, T_wc), *matched).warning is None


@pytest.mark.parametrize("mistake", MISTAKES)
def test_wrong_convention_is_named(mistake, room, folder, matched):
    source = with_poses(folder, MISTAKES[mistake](room.T_wc))
    with pytest.raises(InputError, match=rf"look like .*{mistake}.*: .*(column|invert)"):
        judge(source, *matched)


def test_each_remedy_is_right(room, folder):
    """What ``correct`` does to the poses that a mistake makes gives the true relative poses."""
    corrected = set()
    for mistake in MISTAKES.values():
        T_cw = np.linalg.inv(mistake(room.T_wc))
        for convention in conventions_for("replica"):
            right = convention.correct(T_cw)
            if np.allclose(right[1] @ np.linalg.inv(right[0]), room.T_cw[1] @ room.T_wc[0]):
                corrected.add(convention.name)
    assert len(corrected) == len(MISTAKES)


def test_quaternions_with_w_first(room, tmp_path):
    write_tum(room, tmp_path)
    rows = [
        (100 + 0.04 * i, *T[:3, 3], *quaternion_wxyz(T[:3, :3])) for i, T in enumerate(room.T_wc)
    ]
    np.savetxt(tmp_path / "groundtruth.txt", rows, fmt="%.12f")
    with pytest.raises(InputError, match="order w x y z"):
        check_poses(open_posed_source(tmp_path, NATIVE))


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (lambda T: T @ OPENGL, "cameras in OpenCV axes.*: negate"),
        (lambda T: np.linalg.inv(T @ OPENGL), "inverse .* in OpenCV axes .*: invert.* negate"),
        (np.linalg.inv, "inverse poses [^:]*round[)] [(][^:]*: invert the matrices[.]"),
    ],
    ids=["OpenCV axes", "inverse in OpenCV axes", "inverse"],
)
def test_nerfstudio_expects_opengl_axes(mistake, message, room, matched, tmp_path):
    write_nerfstudio(room, tmp_path)
    document = json.loads((tmp_path / "transforms.json").read_text())
    assert judge(open_posed_source(tmp_path, NATIVE), *matched).warning is None
    for frame in document["frames"]:
        frame["transform_matrix"] = mistake(np.array(frame["transform_matrix"])).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=message):
        judge(open_posed_source(tmp_path, NATIVE), *matched)


def test_poses_of_other_images_only_warn(room, folder, matched):
    shuffled = room.T_wc[np.random.default_rng(1).permutation(len(room.T_wc))]
    check = judge(with_poses(folder, shuffled), *matched)
    assert "explain the images badly" in check.warning


def with_camera(room, folder, **changed):
    """The source of ``folder`` with true poses and other intrinsics."""
    source = with_poses(folder, room.T_wc)
    c = source.camera
    numbers = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "k1": 0, "k2": 0, "p1": 0, "p2": 0}
    words = ",".join(str(value) for value in (numbers | changed).values())
    return open_posed_source(folder, InputConfig(long_edge=0, intrinsics=words))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"fx": 160.0, "fy": 162.3}, r"focal length of 22[345] pixels, not 160"),
        ({"fx": 310.0, "fy": 314.4}, r"focal length of 22[345] pixels, not 310"),
        ({"fx": 280.0}, r"fy / fx = 1\.01\d, not 0\.811"),
        ({"k1": -0.3}, r"at the rim, as where a lens"),
    ],
    ids=["wide", "narrow", "squeezed", "bent"],
)
def test_intrinsics_that_do_not_fit_are_refused(changed, message, room, folder):
    with pytest.raises(InputError, match=message):
        check_poses(with_camera(room, folder, **changed))


@pytest.mark.parametrize("factor", [0.98, 1.0, 1.02])
def test_intrinsics_that_are_nearly_right_pass(factor, room, folder):
    c = room.camera
    source = with_camera(room, folder, fx=c.fx * factor, fy=c.fy * factor)
    assert check_poses(source).warning is None


def test_an_unknown_focal_length_is_told_by_poses_and_images(room, tmp_path):
    write_replica(room, tmp_path)
    (tmp_path / "cam_params.json").unlink()
    assumed = open_posed_source(tmp_path, NATIVE)
    assert assumed.is_focal_guess
    assert "assumed" in assumed.account.used[0]
    found = with_focal_length(assumed)
    assert found.camera.fx == pytest.approx(226.5, rel=0.01)  # of pixels that are 1.4 % from square
    assert "estimated from images and poses" in found.account.used[0]
    assert with_focal_length(found) is found


def test_a_focal_length_that_images_do_not_tell_is_asked_for(room, tmp_path):
    write_replica(room, tmp_path)
    (tmp_path / "cam_params.json").unlink()
    for path in (tmp_path / "results").iterdir():
        write_image(path, np.full((240, 320, 3), 90, dtype=np.uint8))
    with pytest.raises(InputError, match="give --intrinsics"):
        with_focal_length(open_posed_source(tmp_path, NATIVE))


def test_mirrored_images_and_poses_of_the_neighbours_are_named(room, folder, matched):
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    with pytest.raises(InputError, match="mirrored"):
        judge(with_poses(folder, flip @ room.T_wc @ flip), *matched)
    with pytest.raises(InputError, match=r"poses of the (next image|image before)"):
        judge(with_poses(folder, np.roll(room.T_wc, 1, axis=0)), *matched)


def test_a_single_wrong_pose_is_named(room, folder, matched):
    T_wc = room.T_wc.copy()
    T_wc[6, :3, 3] += 0.5
    check = judge(with_poses(folder, T_wc), *matched)
    assert "frame000006" in check.warning


def test_images_without_texture_cannot_be_checked(room, tmp_path):
    write_replica(room, tmp_path)
    for path in (tmp_path / "results").iterdir():
        write_image(path, np.full((240, 320, 3), 90, dtype=np.uint8))
    check = check_poses(open_posed_source(tmp_path, NATIVE))
    assert (check.given, check.pairs) == (None, 0)
    assert "could not be checked" in check.warning


def test_one_image(room, tmp_path):
    write_replica(room, tmp_path)
    check = check_poses(open_posed_source(tmp_path, InputConfig(long_edge=0, stop=1)))
    assert "could not be checked" in check.warning


def test_unordered_photographs(room, tmp_path):
    """Neighbours in the list show different things; those turned alike are tried then."""
    order = np.random.default_rng(0).permutation(len(room.images))
    names = write_room_images(room, tmp_path, "results/frame{:06d}.png", 100)
    for k, i in enumerate(order):
        (tmp_path / names[i]).rename(tmp_path / f"results/frame{k:06d}.png")
    write_replica_files(room, tmp_path, room.T_wc[order])
    check = check_poses(open_posed_source(tmp_path, NATIVE))
    assert check.warning is None
    assert check.pairs >= 4


def write_replica_files(room, folder, T_wc):
    np.savetxt(folder / "traj.txt", T_wc.reshape(-1, 16), fmt="%.17g")
    c = room.camera
    entry = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
    (folder / "cam_params.json").write_text(json.dumps({"camera": entry}))


@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        ("rooms/living-room-2", 0.4),
        ("rooms/staircase", 0.4),
        ("objects/horse", 0.4),
        ("dtu/scan24", 0.4),
        ("7scenes-redkitchen/seq-01", 2.5),  # its poses are a few centimetres off
    ],
)
def test_real_sequences(name, pixels, shared_data):
    if not (shared_data / name).is_dir():
        pytest.skip(f"{name} is not on this machine")
    source = open_posed_source(shared_data / name, InputConfig(long_edge=640))
    matcher = Matcher(source)
    pairs = matcher.pairs(8)
    check = judge(source, pairs, matcher.camera)
    assert check.warning is None
    assert check.pairs >= 6
    assert check.given.error * 640 < pixels
    assert check.given.in_front > 0.95
    true = source.T_cw
    for mistake in MISTAKES.values():
        source.T_cw = np.linalg.inv(mistake(np.linalg.inv(true)))
        with pytest.raises(InputError, match="look like"):
            judge(source, pairs, matcher.camera)
