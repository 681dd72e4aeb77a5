"""Image sets with known poses: one camera for all images, selection, masks, invalid poses."""

import json
import logging

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.posed.sniff import open_posed_source
from io_samples import gradient_image, write_image

NATIVE = InputConfig(long_edge=0)


def write_replica(folder, poses, size=(64, 48)):
    for i in range(len(poses)):
        write_image(folder / "results" / f"frame{i:06d}.png", gradient_image(i, *size))
    np.savetxt(folder / "traj.txt", np.reshape(poses, (-1, 16)), fmt="%.17g")
    camera = {"w": size[0], "h": size[1], "fx": 60.0, "fy": 59.0, "cx": 31.0, "cy": 23.0}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def moves(n):
    """Camera to world, one step to the right each."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = np.arange(n)
    return poses


def test_replica(tmp_path):
    source = open_posed_source(write_replica(tmp_path / "room", moves(4)), NATIVE)
    assert (source.kind, source.name, len(source), source.scene_scale) == (
        "replica", "room", 4, "metres",
    )  # fmt: skip
    assert (source.camera.fx, source.camera.cy, source.camera.width) == (60.0, 23.0, 64)
    np.testing.assert_allclose(source.T_cw[:, 0, 3], [0, -1, -2, -3])
    for i, view in enumerate(source):
        assert (view.index, view.mask) == (i, None)
        np.testing.assert_array_equal(view.image, gradient_image(i))
        np.testing.assert_array_equal(view.T_cw, source.T_cw[i])
    np.testing.assert_allclose(source.timestamps, np.arange(4) / 30)


def test_selection_and_working_size(tmp_path):
    write_replica(tmp_path, moves(7))
    config = InputConfig(long_edge=32, start=1, stop=6, stride=2)
    source = open_posed_source(tmp_path, config)
    np.testing.assert_allclose(source.T_cw[:, 0, 3], [-1, -3, -5])
    assert source[-1].image.shape == (24, 32, 3)
    assert source.camera.fx == pytest.approx(30)
    assert source.camera.cx == pytest.approx(15.25)
    with pytest.raises(IndexError):
        source[3]


def test_invalid_poses_are_left_out(tmp_path, caplog):
    poses = moves(5)
    poses[1, 0, 0] = np.nan
    poses[3] = 0
    with caplog.at_level(logging.WARNING):
        source = open_posed_source(write_replica(tmp_path, poses), NATIVE)
    np.testing.assert_allclose(source.T_cw[:, 0, 3], [0, -2, -4])
    assert "2 of 5" in caplog.text


def test_folder_without_poses(tmp_path):
    write_image(tmp_path / "a.png", gradient_image(0))
    with pytest.raises(InputError, match="no images with known poses"):
        open_posed_source(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        open_posed_source(tmp_path / "nowhere")
