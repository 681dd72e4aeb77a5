"""Poses beside the images: which are read, of which camera, and which are used unasked."""

import zipfile

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.pose_priors import turned_upright
from geogs.io.sources.sniff import open_source
from io_samples import write_images
from pose_samples import (
    archived,
    walked,
    write_depth,
    write_polycam,
    write_record3d,
    write_record3d_export,
    write_stray,
    write_transforms,
    write_tum_poses,
)

PATH = walked(5)
WRITERS = [write_stray, write_record3d, write_record3d_export, write_polycam]


def found(source) -> list[np.ndarray]:
    """Camera to world of the frames."""
    return [np.linalg.inv(f.pose.T_cw.numpy()) for f in source]


@pytest.mark.parametrize("write", WRITERS)
def test_poses_of_apps_are_used_unasked(tmp_path, write):
    write(tmp_path / "a", PATH) if write is not write_stray else write_stray_into(tmp_path / "a")
    source = open_source(tmp_path / "a", InputConfig(readout=0.0))
    assert source.uses_poses
    np.testing.assert_allclose(found(source), PATH, atol=1e-7)
    without = open_source(tmp_path / "a", InputConfig(poses="none", readout=0.0))
    assert not without.uses_poses
    assert all(f.pose is None for f in without)


def write_stray_into(folder):
    folder.mkdir()
    write_stray(folder, PATH)


def test_archives_of_record3d_are_what_was_packed(tmp_path):
    archive = write_record3d(tmp_path / "room", PATH)
    source = open_source(archive, InputConfig(readout=0.0))
    assert (source.kind, source.name) == ("record3d", "room")
    assert (source.camera.fx, source.camera.fy, source.camera.cx) == (50, 51, 31)
    frames = list(source)
    assert [round(f.timestamp * 60) for f in frames] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(found(source), PATH, atol=1e-7)
    folder = list(open_source(tmp_path / "room", InputConfig(readout=0.0)))
    assert all((a.image == b.image).all() for a, b in zip(frames, folder, strict=True))
    with zipfile.ZipFile(archive, "a") as more:
        more.writestr(f"rgbd/{'7' * 5000}.jpg", b"no number of a frame")
    assert open_source(archive, InputConfig(readout=0.0)).length == len(frames)
    archive.write_bytes(archive.read_bytes()[:200])
    with pytest.raises(InputError):
        open_source(archive, InputConfig())


def test_depth_of_record3d_is_what_its_confidence_lets_through(tmp_path):
    lzfse = pytest.importorskip("lzfse")
    write_record3d(tmp_path / "room", PATH)
    depth = np.tile(1 / np.linspace(1, 0.5, 16, dtype=np.float32), (12, 1))
    depth[0, 0] = np.nan
    confidence = np.full((12, 16), 2, np.uint8)
    confidence[:, :8] = 0
    (tmp_path / "room/rgbd/1.depth").write_bytes(lzfse.compress(depth.tobytes()))
    (tmp_path / "room/rgbd/1.conf").write_bytes(lzfse.compress(confidence.tobytes()))
    source = open_source(archived(tmp_path / "room"), InputConfig(depth="sensor", readout=0.0))
    metres = [None if f.depth is None else f.depth.metres() for f in source]
    assert metres[0] is None
    assert metres[1].shape == (48, 64)
    assert (metres[1][:, :28] == 0).all()
    at = (np.arange(34, 62) + 0.5) / 4 - 0.5
    np.testing.assert_allclose(1 / metres[1][26, 34:62], 1 - 0.5 * at / 15, rtol=1e-3)


def test_pictures_of_record3d_have_its_times_and_camera_and_say_that_depth_is_elsewhere(tmp_path):
    write_record3d_export(tmp_path / "room", PATH)
    for folder in (tmp_path / "room", tmp_path / "room" / "EXR_RGBD"):
        source = open_source(folder, InputConfig(readout=0.0))
        assert (source.kind, source.name) == ("record3d", "room")
        assert (source.camera.fx, source.camera.fy, source.camera.cx) == (50, 51, 31)
        np.testing.assert_allclose([f.timestamp for f in source], 0.02 * np.arange(5))
    with pytest.raises(InputError, match=r"depth in EXR is not read; Record3D's \.r3d"):
        open_source(tmp_path / "room", InputConfig(depth="sensor"))
    assert read_calibration(tmp_path / "room" / "EXR_RGBD" / "metadata.json").fy == 51


def test_names_of_polycam_are_times_in_microseconds(tmp_path):
    write_polycam(tmp_path / "a", PATH)
    times = [f.timestamp for f in open_source(tmp_path / "a", InputConfig(readout=0.0))]
    np.testing.assert_allclose(times, 0.25 * np.arange(5))
    write_polycam(tmp_path / "b", PATH, step=1)  # no times
    times = [f.timestamp for f in open_source(tmp_path / "b", InputConfig(readout=0.0))]
    np.testing.assert_allclose(times, np.arange(5) / 30)


def test_depth_of_polycam_is_what_its_confidence_lets_through(tmp_path):
    write_polycam(tmp_path, PATH)
    confidence = np.full((12, 16), 255, np.uint8)
    confidence[:, :8], confidence[:, 8:12] = 0, 127
    write_depth(tmp_path / "keyframes/depth/1442008775605.png", np.full((12, 16), 1500, np.uint16))
    write_depth(tmp_path / "keyframes/confidence/1442008775605.png", confidence)
    source = open_source(tmp_path, InputConfig(depth="sensor", readout=0.0))
    depths = [f.depth for f in source]
    assert [d is None for d in depths] == [True, False, True, True, True]
    metres = depths[1].metres()
    assert (metres[:, :30] == 0).all()
    assert (metres[:, 34:] == 1.5).all()


def test_depth_of_stray_scanner_is_what_its_confidence_lets_through(tmp_path):
    write_stray(tmp_path, PATH)
    source = open_source(tmp_path, InputConfig(depth="sensor", readout=0.0))
    metres = list(source)[1].depth.metres()
    assert (metres[:, :30] == 0).all()
    assert (metres[:, 34:] == 1.5).all()


def test_transforms_are_used_where_they_are_asked_for(tmp_path):
    write_transforms(tmp_path, PATH)
    assert not open_source(tmp_path, InputConfig(readout=0.0)).uses_poses
    source = open_source(tmp_path, InputConfig(poses="prior", readout=0.0))
    np.testing.assert_allclose(found(source), PATH, atol=1e-7)


def test_a_file_of_poses_is_read_at_the_times_of_the_images(tmp_path):
    write_images(tmp_path / "v", [f"{k}.png" for k in range(5)])
    write_tum_poses(tmp_path / "poses.txt", PATH, 1 / 30)
    config = InputConfig(poses=str(tmp_path / "poses.txt"), readout=0.0)
    np.testing.assert_allclose(found(open_source(tmp_path / "v", config)), PATH, atol=1e-6)
    write_tum_poses(tmp_path / "poses.txt", PATH[::2], 2 / 30)
    between = found(open_source(tmp_path / "v", config))
    np.testing.assert_allclose(between, PATH, atol=1e-6)
    write_tum_poses(tmp_path / "poses.txt", PATH[:3], 1 / 30)
    assert [f.pose is None for f in open_source(tmp_path / "v", config)] == [False] * 3 + [True] * 2


def test_poses_that_are_not_there_are_missed(tmp_path):
    write_images(tmp_path, ["a.png", "b.png"])
    with pytest.raises(InputError, match="has no poses of another tracker"):
        open_source(tmp_path, InputConfig(poses="prior"))
    with pytest.raises(InputError, match="does not exist"):
        open_source(tmp_path, InputConfig(poses=str(tmp_path / "nothing.txt")))


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_poses_turn_with_their_images(turns):
    T = PATH[3]
    upright = turned_upright(T, turns)
    # A point up and to the right of the stored image's middle, and where that is after turning.
    stored = np.array([0.3, -0.2, 1.0])
    x, y = stored[:2]
    for _ in range(turns):
        x, y = -y, x
    there = upright @ np.array([x, y, 1.0, 1.0])
    np.testing.assert_allclose(there, T @ np.append(stored, 1.0), atol=1e-12)


def test_portrait_recordings_have_poses_of_upright_images(tmp_path):
    write_stray(tmp_path, PATH, rotation=-90)
    source = open_source(tmp_path, InputConfig(depth="sensor", readout=0.0))
    assert (source.camera.width, source.camera.height) == (48, 64)
    assert (source.camera.cx, source.camera.cy) == (47 - 23.5, 31.5)
    metres = list(source)[1].depth.metres()
    assert (metres[:30] == 0).all()  # the left half as stored is above now
    assert (metres[34:] == 1.5).all()
    np.testing.assert_allclose(found(source), [turned_upright(T, 1) for T in PATH], atol=1e-7)
