"""What photographs say of themselves, and which way is up."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geogs.errors import InputError
from geogs.io.sources.posed.one_camera import common_place
from geogs.io.sources.posed.posed_set import PosedFile
from geogs_photos.photograph import find_photographs
from geogs_photos.poses import shared_cameras
from geogs_photos.upright import upright_rotation


def photograph(path, size=(64, 48), model="", equivalent=0, orientation=1):
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = model, orientation
    if equivalent:
        exif.get_ifd(0x8769)[0xA405] = equivalent
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (90, 120, 60)).save(path, exif=exif)


def test_pictures_of_one_camera_share_it_and_others_do_not(tmp_path):
    photograph(tmp_path / "a1.jpg", model="phone", equivalent=26)
    photograph(tmp_path / "a2.jpg", model="phone", equivalent=26, orientation=6)
    photograph(tmp_path / "a10.jpg", model="phone", equivalent=52)
    photograph(tmp_path / "b.png", size=(80, 60))
    (tmp_path / "c.jpg").write_bytes(b"no picture")
    (tmp_path / "notes.txt").write_text("hello")
    found = find_photographs(tmp_path)
    assert [p.name for p in found.photographs] == ["a1.jpg", "a2.jpg", "a10.jpg", "b.png"]
    assert found.damaged == ("c.jpg",)
    assert [p.quarter_turns for p in found.photographs] == [0, 1, 0, 0]
    cameras, of = shared_cameras(found.photographs, "auto")
    assert of == [0, 0, 1, 2]
    diagonal = np.hypot(64, 48)
    expected = 26 / np.hypot(36, 24) * diagonal
    assert cameras[0].calibration.fx == pytest.approx(expected)
    assert cameras[1].calibration.fx == pytest.approx(2 * expected)
    assert cameras[2].calibration.is_guess
    known, _ = shared_cameras(found.photographs[:2], "70,70,31.5,23.5")
    assert known[0].is_known
    assert known[0].calibration.fx == 70


def test_pictures_in_folders_below_have_names_with_slashes(tmp_path):
    photograph(tmp_path / "phone" / "1.jpg")
    photograph(tmp_path / "camera" / "1.jpg")
    found = find_photographs(tmp_path)
    assert [p.name for p in found.photographs] == ["camera/1.jpg", "phone/1.jpg"]


def test_a_folder_without_pictures_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no photographs"):
        find_photographs(tmp_path)
    with pytest.raises(InputError, match="no folder"):
        find_photographs(tmp_path / "nothing")


def test_the_camera_of_most_pictures_is_the_common_one(tmp_path):
    assert common_place(["a", "b", "b", "a", "b"]) == 1
    assert common_place(["a", "b"]) == 0
    assert PosedFile(tmp_path, np.eye(4)).calibration is None


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_level_cameras_tell_the_vertical_however_the_sensor_was_held(turns):
    random = np.random.default_rng(turns)
    down = np.array([0.3, -0.8, 0.52])
    down /= np.linalg.norm(down)
    rows = []
    for angle in random.uniform(-1.5, 1.5, 12):
        side = np.cross(down, [1.0, 0.2, 0.1])
        side = Rotation.from_rotvec(angle * down).apply(side / np.linalg.norm(side))
        pitch = Rotation.from_rotvec(random.uniform(0.1, 0.5) * side)
        y = pitch.apply(down)
        upright = np.stack([side, y, np.cross(side, y)])
        # A sensor whose picture has to be turned clockwise sees the world turned the other way.
        sensor = Rotation.from_euler("z", -90 * turns, degrees=True).as_matrix() @ upright
        rows.append(sensor)
    R = upright_rotation(np.stack(rows), [turns] * 12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ down, [0, 1, 0], atol=1e-6)


def test_where_all_look_the_same_way_the_mean_of_their_own_is_down():
    R_cw = np.tile(Rotation.from_euler("z", 10, degrees=True).as_matrix(), (5, 1, 1))
    R = upright_rotation(R_cw, [0] * 5)
    np.testing.assert_allclose(R @ R_cw[0, 1], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(R @ R_cw[0, 2], [0, 0, 1], atol=1e-9)
