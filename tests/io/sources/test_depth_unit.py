"""The unit of sensor depth: given, stated by files, assumed where it can be, checked by poses."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.depth_check import MeasuredView, ratio_to_depth
from geogs.io.sources.depth_files import DepthUnit
from geogs.io.sources.depth_unit import ChosenDepth
from geogs.io.sources.sniff import open_source
from io_samples import write_image, write_images
from pose_samples import write_depth

WIDTH, HEIGHT = 160, 120
CAMERA = {"fx": 150, "fy": 150, "cx": 79.5, "cy": 59.5, "w": WIDTH, "h": HEIGHT}
ROOM = (1.2, 3.9)
"""Nearest and farthest distance in a room, metres."""


def config(**settings) -> InputConfig:
    return InputConfig(intrinsics="150,150,79.5,59.5", **settings)


def distances(near: float, far: float) -> np.ndarray:
    return np.tile(np.linspace(near, far, WIDTH), (HEIGHT, 1))


def write_tum(folder, units: np.ndarray, count: int = 3):
    """A sequence in TUM's layout with the same depth at every image."""
    names = [f"{k / 10:.1f}" for k in range(count)]
    write_images(folder / "rgb", [f"{name}.png" for name in names], WIDTH, HEIGHT)
    for name in names:
        write_depth(folder / f"depth/{name}.png", units)
    for kind in ("rgb", "depth"):
        rows = (f"{name} {kind}/{name}.png\n" for name in names)
        (folder / f"{kind}.txt").write_text("".join(rows))
    return folder


def write_scannet(folder, units: np.ndarray):
    write_images(folder, ["color/0.jpg", "color/1.jpg"], WIDTH, HEIGHT)
    write_depth(folder / "depth/0.png", units)
    return folder


def stored(metres: np.ndarray, per_metre: float) -> np.ndarray:
    return np.rint(metres * per_metre).astype(np.uint16)


def median_of(source) -> float:
    return float(np.median(next(iter(source)).depth.metres()))


@pytest.mark.parametrize("room", [ROOM, (0.5, 1.2), (0.9, 8.0), (1.7, 2.3)])
def test_depths_in_the_unit_of_the_data_set_are_taken_without_a_doubt(tmp_path, room):
    write_tum(tmp_path, stored(distances(*room), 5000))
    source = open_source(tmp_path, config(depth="sensor"))
    assert median_of(source) == pytest.approx(sum(room) / 2, rel=0.01)
    (said,) = (line for line in source.account.used if line.startswith("sensor depth"))
    assert said.startswith("sensor depth beside 3 of 3 images, 1/5000 m a unit (TUM's), median ")
    assert source.account.left == ()


@pytest.mark.parametrize("room", [ROOM, (0.6, 2.0), (1.0, 6.0), (2.2, 4.0)])
def test_millimetres_that_would_be_read_as_fifths_of_them_are_not(tmp_path, room):
    write_tum(tmp_path, stored(distances(*room), 1000))
    with pytest.raises(
        InputError, match=r"1/5000 m a unit \(TUM's\), but .* give --depth-unit 1000"
    ):
        open_source(tmp_path, config(depth="sensor"))
    left_alone = open_source(tmp_path, config(depth="auto"))
    assert not left_alone.uses_depth
    assert "give --depth-unit 1000 or 5000" in left_alone.account.left[0]
    given = open_source(tmp_path, config(depth="sensor", depth_unit=1000.0))
    assert median_of(given) == pytest.approx(sum(room) / 2, rel=0.01)
    assert "1/1000 m a unit (as given)" in given.account.used[1]


def test_a_near_scene_that_was_measured_in_millimetres_and_converted_is_right(tmp_path):
    """All values are multiples of five: millimetres times five, as TUM's own."""
    write_tum(tmp_path, 5 * stored(distances(0.2, 0.6), 1000))
    assert median_of(open_source(tmp_path, config(depth="sensor"))) == pytest.approx(0.4, rel=0.02)


def test_fifths_of_millimetres_that_would_be_read_as_millimetres_are_not(tmp_path):
    write_scannet(tmp_path, stored(distances(*ROOM), 5000))
    with pytest.raises(InputError, match=r"1/1000 m a unit \(usual\).* give --depth-unit 5000"):
        open_source(tmp_path, config(depth="sensor"))


def test_a_street_in_millimetres_is_far_and_right(tmp_path):
    write_scannet(tmp_path, stored(distances(2.0, 60.0), 1000))
    assert median_of(open_source(tmp_path, config(depth="sensor"))) == pytest.approx(31, rel=0.02)


def test_pictures_of_eight_bits_are_no_distances(tmp_path):
    write_tum(tmp_path, distances(30, 255).astype(np.uint8))
    with pytest.raises(InputError, match=r"no sensor measures|--depth-unit"):
        open_source(tmp_path, config(depth="sensor"))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera.yaml", "# DepthMapFactor: 5000.0\nCamera.fx: 150\nRGBD.DepthMapFactor: 1000.0\n"),
        ("orb.yml", "%YAML:1.0\n---\nDepthMapFactor: 1000\n"),
        ("nice.yaml", "cam:\n  H: 120\n  png_depth_scale: 1000.0 #for depth images\n"),
        ("config.json", json.dumps({"depth_scale": 1000.0, "depth_max": 5})),
        ("realsense.json", json.dumps({"sensor": {"depthScale": 0.001}})),
        ("stated.json", json.dumps({"depth_unit": "mm"})),
        ("cam_params.json", json.dumps({"camera": {**CAMERA, "scale": 1000}})),
        ("_info.txt", "m_versionNumber = 4\nm_depthShift = 1000\n"),
        ("settings.ini", "[depth]\ndepth_units=0.001\n"),
    ],
)
def test_a_file_beside_the_images_states_the_unit(tmp_path, name, text):
    write_tum(tmp_path, stored(distances(*ROOM), 1000))
    (tmp_path / name).write_text(text)
    source = open_source(tmp_path, config(depth="sensor"))
    assert median_of(source) == pytest.approx(sum(ROOM) / 2, rel=0.01)
    assert f"1/1000 m a unit ({name}), median 2." in source.account.used[1]


def test_a_file_among_many_pictures_states_the_unit(tmp_path):
    write_tum(tmp_path, stored(distances(*ROOM), 1000))
    for k in range(60):
        (tmp_path / f"{k:03d}.png").write_bytes(b"")
    (tmp_path / "camera.yaml").write_text("DepthMapFactor: 1000\n")
    source = open_source(tmp_path, config(depth="sensor"))
    assert "1/1000 m a unit (camera.yaml)" in source.account.used[1]


def test_a_stated_unit_that_gives_unusual_distances_is_taken_and_said(tmp_path):
    write_tum(tmp_path, stored(distances(*ROOM), 5000))
    (tmp_path / "camera.yaml").write_text("DepthMapFactor: 256\n")
    source = open_source(tmp_path, config(depth="sensor"))
    assert median_of(source) == pytest.approx(sum(ROOM) / 2 * 5000 / 256, rel=0.01)
    assert source.account.used[1].endswith("m, which is unusual for a sensor: is the unit right?")


def test_replica_without_its_camera_and_in_millimetres(tmp_path):
    write_images(tmp_path, ["results/frame000000.jpg", "results/frame000001.jpg"], WIDTH, HEIGHT)
    write_depth(tmp_path / "results/depth000000.png", stored(distances(*ROOM), 1000))
    with pytest.raises(InputError, match=r"Replica's\), but .* give --depth-unit 1000 or 6553.5"):
        open_source(tmp_path, config(depth="sensor"))
    write_depth(tmp_path / "results/depth000000.png", stored(distances(*ROOM), 6553.5))
    assert median_of(open_source(tmp_path, config(depth="sensor"))) == pytest.approx(2.55, abs=0.02)


def test_files_that_do_not_agree_or_are_unclear_are_named(tmp_path):
    write_tum(tmp_path, stored(distances(*ROOM), 5000))
    (tmp_path / "a.json").write_text('{"depth_scale": 1}')
    unclear = open_source(tmp_path, config(depth="sensor"))
    assert median_of(unclear) == pytest.approx(sum(ROOM) / 2, rel=0.01)
    assert unclear.account.left == ("unit of depth 1 in a.json: units a metre, or metres a unit?",)
    (tmp_path / "b.yaml").write_text("depth_scale: 1000\n")
    (tmp_path / "c.yaml").write_text("depth_factor: 5000\n")
    differ = open_source(tmp_path, config(depth="sensor"))
    expected = "units of depth per metre that differ: 1000 (b.yaml) and 5000 (c.yaml)"
    assert differ.account.left == (expected,)


def test_a_unit_that_nothing_has_use_for_is_an_error(tmp_path):
    write_tum(tmp_path, stored(distances(*ROOM), 5000))
    with pytest.raises(InputError, match="no depth is used; add --depth sensor"):
        open_source(tmp_path, config(depth_unit=1000.0))


def wall(x: float, factor: float, texture: np.ndarray, camera: Camera) -> MeasuredView:
    """A wall 2 m ahead of a camera at ``x``; its depth is stored times a factor."""
    scale = 2.0 / camera.fx / 0.005  # pixels of the texture, of 5 mm, for one of the image
    A = np.array([[scale, 0, x / 0.005 + 100], [0, scale, 60]], dtype=np.float64)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    grey = cv2.warpAffine(texture, A, (camera.width, camera.height), flags=flags)
    T_cw = np.eye(4)
    T_cw[0, 3] = -x
    metres = np.full((camera.height, camera.width), 2.0 * factor, np.float32)
    return MeasuredView(grey, metres, T_cw)


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    noise = np.random.default_rng(3).uniform(0, 255, (900, 1400)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), 3)
    return cv2.normalize(blurred, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.mark.parametrize("factor", [0.2, 1.0, 1.3107, 1000.0])
def test_parallax_tells_the_ratio_of_distances(texture, factor):
    camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
    views = [wall(x, factor, texture, camera) for x in (0.0, 0.1, 0.25)]
    pairs = [(views[0], views[1]), (views[0], views[2])]
    assert ratio_to_depth(pairs, camera) == pytest.approx(1 / factor, rel=0.01)
    assert ratio_to_depth([(views[0], views[0])], camera) is None
    assert ratio_to_depth([], camera) is None


def test_poses_correct_an_assumed_unit_and_contradict_a_stated_one():
    assumed = ChosenDepth(True, DepthUnit(5000.0, "TUM's"), "sensor depth", 0.4)
    assert assumed.checked(None, False, "x") is assumed
    assert assumed.checked(1.1, False, "x") is assumed
    assert assumed.checked(1.5, True, "x") is assumed
    found = assumed.checked(5.1, False, "x")
    assert (found.unit.per_metre, found.median) == (1000.0, pytest.approx(2.0))
    assert found.account.used == (
        "sensor depth, 1/1000 m a unit (by the poses; 1/5000 m a unit (TUM's) was assumed), "
        "median 2 m",
    )
    with pytest.raises(InputError, match=r"distances are 3.28 times those of the depth sensor;"):
        assumed.checked(3.28, False, "x")
    stated = ChosenDepth(True, DepthUnit(5000.0, "as given", True), "sensor depth", 0.4)
    with pytest.raises(InputError, match=r"\(--depth-unit 1000 would fit\)"):
        stated.checked(5.1, False, "x")


def write_walk(folder, texture: np.ndarray, per_metre: float):
    """TUM's layout of a walk along a wall 2 m ahead, and a file of its poses."""
    camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
    rows = []
    for k in range(24):
        view = wall(0.03 * k, 1.0, texture, camera)
        name = f"{k / 30:.6f}"
        write_image(folder / f"rgb/{name}.png", np.repeat(view.grey[..., None], 3, axis=2))
        write_depth(folder / f"depth/{name}.png", stored(view.metres, per_metre))
        rows.append(name)
    for kind in ("rgb", "depth"):
        text = "".join(f"{name} {kind}/{name}.png\n" for name in rows)
        (folder / f"{kind}.txt").write_text(text)
    poses = "".join(f"{name} {0.03 * k} 0 0 0 0 0 1\n" for k, name in enumerate(rows))
    (folder / "poses.tum").write_text(poses)
    return InputConfig(
        intrinsics="300,300,159.5,119.5", depth="sensor", poses=str(folder / "poses.tum")
    )


def test_poses_tell_the_unit_of_the_depth_beside_them(tmp_path, texture):
    asked = write_walk(tmp_path, texture, 1000.0)
    source = open_source(tmp_path, asked)
    assert median_of(source) == pytest.approx(2.0, rel=1e-3)
    assert (
        "1/1000 m a unit (by the poses; 1/5000 m a unit (TUM's) was assumed)"
        in (source.account.used[1])
    )
    with pytest.raises(InputError, match=r"distances are 1\.5 times those"):
        open_source(tmp_path, replace(asked, depth_unit=1500.0))
    with pytest.raises(InputError, match="give --depth-unit 1000 or 5000"):
        open_source(tmp_path, replace(asked, poses="none"))


def test_poses_that_agree_leave_the_unit(tmp_path, texture):
    source = open_source(tmp_path, write_walk(tmp_path, texture, 5000.0))
    assert source.account.used[1].endswith("1/5000 m a unit (TUM's), median 2 m")
