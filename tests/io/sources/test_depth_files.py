"""Depth beside the images: which file, which unit, of which pixels."""

import json

import cv2
import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.depth_files import DepthCamera, DepthFile, registered, sampled
from geogs.io.sources.sniff import open_source
from io_samples import write_images, write_video

SENSOR = InputConfig(intrinsics="50,50,31.5,23.5", depth="sensor")


def write_depth(path, units: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), units.astype(np.uint16))


def ramp(scale: float, width: int = 64, height: int = 48) -> np.ndarray:
    """1 m at the left to 2 m at the right, in inverse depth."""
    d = np.linspace(1, 0.5, width)
    return np.broadcast_to(np.rint(scale / d), (height, width))


def test_depths_of_tum_are_those_nearest_in_time(tmp_path):
    write_images(tmp_path, ["rgb/a.png", "rgb/b.png", "rgb/c.png"])
    write_depth(tmp_path / "depth/a.png", np.full((48, 64), 5000))
    write_depth(tmp_path / "depth/b.png", np.full((48, 64), 10000))
    (tmp_path / "rgb.txt").write_text("0.00 rgb/a.png\n0.10 rgb/b.png\n0.20 rgb/c.png\n")
    (tmp_path / "depth.txt").write_text("0.012 depth/a.png\n0.085 depth/b.png\n0.4 depth/a.png\n")
    found = [f.depth for f in open_source(tmp_path, SENSOR)]
    assert [None if d is None else float(np.median(d.metres())) for d in found] == [1, 2, None]
    assert all(f.depth is None for f in open_source(tmp_path, InputConfig()))


def test_depths_that_are_listed_and_not_there_are_none(tmp_path, caplog):
    """They were taken for there, and the run was monocular without a word."""
    write_images(tmp_path, ["rgb/a.png", "rgb/b.png"])
    (tmp_path / "rgb.txt").write_text("0.00 rgb/a.png\n0.10 rgb/b.png\n")
    (tmp_path / "depth.txt").write_text("0.00 depth/a.png\n0.10 depth/b.png\n")
    with pytest.raises(InputError, match=r"depth\.txt names 2 pictures of depth, of which none is"):
        open_source(tmp_path, SENSOR)
    auto = open_source(tmp_path, InputConfig(depth="auto"))
    assert not auto.uses_depth
    assert "names 2 pictures of depth, of which none is there" in auto.account.left[0]
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth/a.png").write_bytes(b"no picture")
    (tmp_path / "depth/b.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"none of its pictures of depth can be read, such as .*a"):
        open_source(tmp_path, SENSOR)
    (tmp_path / "depth/b.png").unlink()
    write_depth(tmp_path / "depth/a.png", np.full((48, 64), 5000))
    source = open_source(tmp_path, SENSOR)
    assert "1 of 2 pictures of depth are missing, such as b.png" in caplog.text
    beside = "sensor depth beside 1 of 2 images, 1/5000 m a unit (TUM's), median 1 m"
    assert beside in source.account.used
    (tmp_path / "depth.txt").write_text("5.00 depth/a.png\n")
    with pytest.raises(InputError, match="is near that of an image"):
        open_source(tmp_path, SENSOR)


def test_depths_of_replica_have_the_scale_of_their_camera(tmp_path):
    write_images(tmp_path, ["results/frame000000.jpg", "results/frame000001.jpg"])
    write_depth(tmp_path / "results/depth000001.png", ramp(2000))
    camera = {"w": 64, "h": 48, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "scale": 2000}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    first, second = open_source(tmp_path, InputConfig(depth="auto"))
    assert first.depth is None
    np.testing.assert_allclose(second.depth.metres(), ramp(2000) / 2000, rtol=1e-3)
    camera["scale"] = 0
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    with pytest.raises(InputError, match="scale of the depths is no number"):
        open_source(tmp_path, InputConfig())


def test_depths_of_7_scenes_are_brought_to_the_colour_camera(tmp_path):
    write_images(tmp_path, ["frame-000000.color.png"], 640, 480)
    units = np.full((480, 640), 2000)
    units[:, 300:310] = 65535
    write_depth(tmp_path / "frame-000000.depth.png", units)
    (frame,) = open_source(tmp_path, InputConfig(depth="sensor", long_edge=0))
    depth = frame.depth.metres()
    # A pixel u of depth is seen at 320 + 525 ((u - 320) / 585 - 0.025 / 2).
    hole = [320 + 525 * ((u - 320) / 585 - 0.0125) for u in (300, 309)]
    assert (depth[200:280, round(hole[0]) + 1 : round(hole[1])] == 0).all()
    assert (depth[200:280, 320:400] == 2).mean() > 0.99
    assert (depth[:, :25] == 0).all()


def test_depths_of_scannet_are_smaller_than_its_images(tmp_path):
    write_images(tmp_path, ["color/0.jpg", "color/1.jpg"], 128, 96)
    write_depth(tmp_path / "depth/0.png", ramp(1000, 32, 24))
    source = open_source(tmp_path, InputConfig(intrinsics="100,100,63.5,47.5", depth="sensor"))
    assert source.kind == "scannet"
    first, second = source
    assert second.depth is None
    metres = first.depth.metres()
    u = (np.arange(128) + 0.5) / 4 - 0.5
    inner = slice(4, -4)
    np.testing.assert_allclose(1 / metres[40, inner], (1 - 0.5 * u / 31)[inner], rtol=2e-3)


def test_recordings_of_stray_scanner(tmp_path):
    images = [np.full((48, 64, 3), 40 + k, np.uint8) for k in range(3)]
    write_video(tmp_path / "rgb.mp4", images)
    write_depth(tmp_path / "depth/000001.png", np.full((12, 16), 1500))
    (tmp_path / "camera_matrix.csv").write_text("50.0,0.0,31.5\n0.0,50.0,23.5\n0.0,0.0,1.0\n")
    source = open_source(tmp_path, InputConfig(depth="sensor"))
    assert (source.kind, source.camera.fx) == ("stray", 50)
    depths = [f.depth for f in source]
    assert [d is None for d in depths] == [True, False, True]
    assert (depths[1].metres() == 1.5).all()


def test_a_source_without_depth_says_so(tmp_path):
    write_images(tmp_path, ["a.png", "b.png"])
    with pytest.raises(InputError, match="has no depth of a sensor"):
        open_source(tmp_path, SENSOR)
    assert not open_source(tmp_path, InputConfig(depth="auto")).uses_depth


def test_pictures_that_cannot_be_read_are_no_depth(tmp_path):
    (tmp_path / "depth.png").write_bytes(b"no picture")
    assert DepthFile(tmp_path / "depth.png").metres() is None


def test_surfaces_are_interpolated_and_edges_are_not():
    depth = np.full((4, 8), 2.0, np.float32)
    depth[:, 4:], depth[:, 0] = 4.0, 0.0
    y = np.full((1, 4), 1.5, np.float32)
    x = np.array([[2.5, 3.4, 3.6, 0.3]], np.float32)
    np.testing.assert_allclose(sampled(depth, x, y)[0], [2, 2, 4, 0], rtol=1e-6)


def test_registering_is_projecting_point_by_point():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 3, (12, 16)).astype(np.float32)
    depth[3, 4] = 0
    sensor = DepthCamera(Camera(20.0, 21.0, 7.5, 5.5, 16, 12), (-0.1, 0.05, 0.02))
    colour = Calibration(18.0, 18.0, 8.0, 6.0, (0.1, -0.2, 0.0, 0.0), 20, 14)
    found = registered(depth, sensor, colour)
    expected = np.zeros((14, 20))
    K = colour.camera().matrix().numpy()
    for v in range(12):
        for u in range(16):
            z = float(depth[v, u])
            if z == 0:
                continue
            X = np.array([(u - 7.5) / 20 * z - 0.1, (v - 5.5) / 21 * z + 0.05, z + 0.02])
            D = np.array([0.1, -0.2, 0, 0])
            pixel = cv2.projectPoints(X[None], np.zeros(3), np.zeros(3), K, D)[0][0, 0]
            c, r = (round(float(p)) for p in pixel)
            if 0 <= c < 20 and 0 <= r < 14 and (expected[r, c] == 0 or X[2] < expected[r, c]):
                expected[r, c] = X[2]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
