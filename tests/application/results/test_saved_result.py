"""A result that was written can be used again."""

import json
import math
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import geogs
from geogs.application.results.verdict import Verdict
from geogs.errors import InputError
from geogs.geometry.lie import se3_exp
from geogs.io.writers.keyframe_folder import image_path, read_image
from geogs.io.writers.map_file import load_map_file, save_map
from geogs.io.writers.trajectories import write_trajectories
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.types import Uncertainty
from saved_results import (
    CAMERA,
    DEPTH_CAMERA,
    IDS,
    MASKED,
    ORIGIN,
    UNIT,
    depth_of_the_scene,
    disks_of_the_scene,
    make_result,
    poses_of_the_scene,
)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return geogs.load_result(make_result(tmp_path_factory.mktemp("result")))


def test_keyframes_come_with_what_the_run_had(result):
    assert [k.keyframe_id for k in result.keyframes] == IDS
    assert (result.camera, result.depth_camera) == (CAMERA, DEPTH_CAMERA)
    own = poses_of_the_scene()
    for k, T_own in zip(result.keyframes, own, strict=True):
        truth = UNIT * depth_of_the_scene(T_own, DEPTH_CAMERA)
        depth, known = k.depth, k.depth > 0
        assert known.mean() > (0.45 if k.keyframe_id == IDS[MASKED] else 0.95)
        assert np.quantile(np.abs(depth / truth - 1)[known], 0.8) < 5e-3
        assert k.image.shape == (60, 80, 3)
        np.testing.assert_allclose(np.linalg.norm(k.normal, axis=-1)[known], 1.0, atol=1e-4)
        assert ((k.normal * DEPTH_CAMERA.rays().numpy()).sum(-1)[known] < 0).all()
    masked = result.keyframes[MASKED]
    assert (masked.depth[:, 20:] == 0).all()
    assert (masked.weight[:, 20:] == 0).all()
    assert result.keyframes[1].timestamp == pytest.approx(2 / 30)
    np.testing.assert_array_equal(result.trajectory.tracked, True)


def test_the_map_can_be_seen_from_anywhere_with_any_camera(result):
    T_own = se3_exp(torch.tensor([0.3, -0.1, 0.2, 0.05, -0.1, 0.02], dtype=torch.float64))
    T_cw = T_own.clone()
    T_cw[:3, 3] = UNIT * T_own[:3, 3] - T_own[:3, :3] @ torch.from_numpy(ORIGIN)
    camera = geogs.Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
    maps = result.render(T_cw, camera)
    truth = UNIT * depth_of_the_scene(T_own.numpy(), camera)
    known = maps.depth > 0
    assert known.mean() > 0.9
    assert np.quantile(np.abs(maps.depth / truth - 1)[known], 0.8) < 5e-3


def test_disks_are_in_the_world_for_those_who_only_want_them(result):
    disks = geogs.load_map(result.folder / "map.safetensors")
    expected = disks_of_the_scene().position.double() * UNIT + torch.from_numpy(ORIGIN)
    np.testing.assert_allclose(disks.position, expected, rtol=1e-6)
    np.testing.assert_array_equal(result.disks.scale, disks.scale)


def test_positions_and_scales_are_kept_once_and_those_of_older_files_are_read(tmp_path, result):
    """In the map's own frame, to the last digit; older files have them in the world beside it."""
    path = make_result(tmp_path) / "map.safetensors"
    own, said = load_file(path), load_map_file(path)
    assert not {"position", "scale"} & set(own)
    for name, part in (("map_position", "position"), ("map_scale", "scale")):
        assert torch.equal(own[name], getattr(disks_of_the_scene(), part))
    with safe_open(path, "pt") as file:
        header = file.metadata()
    assert header["version"] == "2"  # what older programs say cannot be read
    older = own | {"position": said.disks.position, "scale": said.disks.scale}
    save_file(older, path, header | {"version": "1"})
    for disks in (geogs.load_map(path), load_map_file(path).disks):
        assert torch.equal(disks.position, said.disks.position)
        assert torch.equal(disks.scale, said.disks.scale)
    again = geogs.load_result(tmp_path).views.disks
    for name in ("position", "quaternion", "scale", "opacity"):
        assert torch.equal(getattr(again, name), getattr(disks_of_the_scene(), name))
    views = json.loads(header["metadata"])
    for wrong in ({"unit": 0.0}, {"unit": "wide"}, {"origin": [1.0, 2.0]}, {"origin": None}):
        changed = json.dumps(views | {"views": views["views"] | wrong})
        save_file(own, path, header | {"metadata": changed})
        with pytest.raises(InputError, match="does not say where its disks are"):
            geogs.load_map(path)
    save_file({n: t for n, t in own.items() if n != "map_scale"}, path, header)
    with pytest.raises(InputError, match="its scale is missing or misshapen"):
        geogs.load_map(path)


def test_loaded_disks_are_rendered_as_they_are(result):
    disks = geogs.load_map(result.folder / "map.safetensors")
    T_cw = torch.from_numpy(result.views.T_cw[0])
    alone = geogs.render(disks, DEPTH_CAMERA, T_cw).median_depth
    depth = torch.from_numpy(result.keyframes[0].depth)
    shown = (depth > 0) & (alone > 0)
    assert shown.float().mean() > 0.9
    assert ((alone - depth).abs() / depth)[shown].median() < 1e-3


def test_lost_frames_are_known_from_the_table(tmp_path):
    folder = make_result(tmp_path)
    times = geogs.load_result(folder).trajectory.timestamps
    rows = [f"{float(t)!r},{'lost' if i == 1 else 'tracked'},1,1,1" for i, t in enumerate(times)]
    (folder / "trajectory_uncertainty.csv").write_text("\n".join(["timestamp,state", *rows]))
    found = geogs.load_result(folder).trajectory
    assert found.tracked.tolist() == [True, False, True, True, True]
    for others in ([], ["77.5,tracked,1,1,1"], [row.replace("tracked", "lost") for row in rows]):
        (folder / "trajectory_uncertainty.csv").write_text("\n".join(["timestamp,state", *others]))
        with pytest.raises(InputError, match="names no tracked frame of"):
            _ = geogs.load_result(folder).trajectory


def test_frames_without_a_place_come_back_between_the_others(tmp_path):
    folder = make_result(tmp_path)
    whole = geogs.load_result(folder).trajectory
    tracked = np.array([True, False, True, False, True])
    seen = replace(whole, tracked=tracked, oriented=np.array([False, True, False, False, False]))
    write_trajectories(folder, seen, whole)
    write_uncertainty(folder / "trajectory_uncertainty.csv", seen, Uncertainty(*np.zeros((4, 0))))
    rows = (folder / "trajectory.tum").read_text().splitlines()[1:]
    assert [float(row.split()[0]) for row in rows] == whole.timestamps[tracked].tolist()
    (turned,) = (folder / "orientations.tum").read_text().splitlines()[1:]
    assert turned.split()[:4] == [repr(float(whole.timestamps[1])), "0.0", "0.0", "0.0"]
    found = geogs.load_result(folder).trajectory
    assert found.states == ["tracked", "orientation only", "tracked", "lost", "tracked"]
    np.testing.assert_allclose(found.T_wc[tracked], whole.T_wc[tracked], atol=1e-12)
    np.testing.assert_allclose(found.T_wc[1, :3, :3], whole.T_wc[1, :3, :3], atol=1e-12)
    assert np.ptp(found.T_wc[2:, :3, 3], axis=0).max() > 0


def change_views(path, **changes) -> None:
    """Write a map anew with other numbers in what it says of its views; None takes one away."""
    with safe_open(path, "pt") as file:
        header = file.metadata()
    metadata = json.loads(header["metadata"])
    views = {**metadata["views"], **changes}
    metadata["views"] = {name: value for name, value in views.items() if value is not None}
    save_file(load_file(path), path, {**header, "metadata": json.dumps(metadata)})


def test_a_map_that_tells_no_reach_of_its_planes_averages_over_twice_its_spread(tmp_path):
    path = make_result(tmp_path) / "map.safetensors"
    for spread, reach in ((0.003, 0.006), (1e6, 2e6)):
        change_views(path, max_spread=spread, plane_reach=None)
        loaded = geogs.load_result(tmp_path)
        assert loaded.renderer.rules.plane_reach == reach
        keyframe = loaded.keyframes[0]
        assert ((keyframe.depth > 0) == (keyframe.weight > 0)).all()
    change_views(path, plane_reach=float("nan"))
    with pytest.raises(InputError, match="was it changed"):
        _ = geogs.load_result(tmp_path).views


def test_all_that_a_keyframe_has_is_an_array_and_shown_by_its_size(result):
    for keyframe in result.keyframes:
        arrays = [v for v in (getattr(keyframe, f.name) for f in fields(keyframe)) if np.ndim(v)]
        assert len(arrays) == (6 if keyframe.mask is not None else 5)
        assert {type(array) for array in arrays} == {np.ndarray}
        assert keyframe.T_cw.dtype == np.float64
        assert "depth=30×40" in repr(keyframe)
        assert len(repr(keyframe)) < 400
    assert [k.mask is not None for k in result.keyframes].count(True) == 1


@pytest.mark.parametrize(
    ("said", "depth"),
    [(0.02, 0.02), (None, float("inf")), (1, 1.0)],
    ids=["known", "unknown", "whole"],
)
def test_the_verdict_of_a_run_is_read_back(tmp_path, said, depth):
    own = Verdict(True, "Reliable.", 0.0, 0.1, 0.01, 0.2, depth, joined=0.9)
    summary = {"verdict": {**asdict(own), "depth": said}}
    (make_result(tmp_path) / "summary.json").write_text(json.dumps(summary))
    assert geogs.load_result(tmp_path).verdict == own


@pytest.mark.parametrize("verdict", ["good", 7, [], {"sentence": "Reliable."}, {"lost": "x"}])
def test_a_verdict_that_is_none_is_refused(tmp_path, verdict):
    (make_result(tmp_path) / "summary.json").write_text(json.dumps({"verdict": verdict}))
    with pytest.raises(InputError, match=r"summary.json is damaged; its verdict is none"):
        _ = geogs.load_result(tmp_path).verdict


def test_a_result_of_given_poses_has_no_verdict(tmp_path):
    (make_result(tmp_path) / "summary.json").write_text(json.dumps({"verdict": None}))
    assert geogs.load_result(tmp_path).verdict is None


def test_without_images_all_else_is_there(tmp_path):
    result = geogs.load_result(make_result(tmp_path, with_images=False))
    keyframe = result.keyframes[0]
    assert keyframe.image is None
    assert (keyframe.depth > 0).mean() > 0.95


def test_what_cannot_be_used_is_told_in_a_sentence(tmp_path, result):
    with pytest.raises(InputError, match=r"holds no result of geogs"):
        geogs.load_result(tmp_path)
    save_map(tmp_path / "map.safetensors", disks_of_the_scene(), {"source": "old"})
    with pytest.raises(InputError, match="an older geogs wrote it; run again"):
        geogs.load_result(tmp_path)
    cut = image_path(tmp_path, IDS[1])
    for content in (None, b"", b"no JPEG"):
        if content is not None:
            cut.parent.mkdir(exist_ok=True)
            cut.write_bytes(content)
        with pytest.raises(InputError, match=r"000002.jpg is missing or damaged"):
            read_image(cut)
    with pytest.raises(InputError, match=r"summary.json does not exist"):
        _ = result.summary
    assert result.mesh is None


def changed_map(folder, change_views=None, **tensors):
    """Write the map of a result anew, with other tensors or other numbers of its views."""
    path = folder / "map.safetensors"
    with safe_open(path, "pt") as file:
        header = file.metadata()
    said = json.loads(header["metadata"])
    if change_views is not None:
        change_views(said["views"])
    save_file({**load_file(path), **tensors}, path, {**header, "metadata": json.dumps(said)})


@pytest.mark.parametrize(
    "dtype", [torch.float64, torch.float16, torch.complex64, torch.uint16, torch.int8, torch.bool]
)
def test_tensors_of_another_type_are_refused(tmp_path, result, dtype):
    for name, tensor in load_file(result.folder / "map.safetensors").items():
        if tensor.dtype is not dtype:
            make_result(tmp_path)
            changed_map(tmp_path, **{name: torch.zeros(tensor.shape, dtype=dtype)})
            with pytest.raises(InputError, match=r"not of float32|was it changed"):
                geogs.load_result(tmp_path)


@pytest.mark.parametrize("name", ["camera", "render_camera"])
@pytest.mark.parametrize(
    "numbers",
    [
        {"fx": 1e-300}, {"fy": 1e300}, {"cx": 1e200}, {"cy": math.nan}, {"fx": -50.0},
        {"width": 16384, "height": 16384}, {"width": 1 << 40}, {"width": 161, "height": 121},
    ],
)  # fmt: skip
def test_cameras_that_no_keyframe_has_are_refused(tmp_path, name, numbers):
    make_result(tmp_path)
    changed_map(tmp_path, lambda views: views[name].update(numbers))
    with pytest.raises(InputError, match="was it changed"):
        geogs.load_result(tmp_path)


@pytest.mark.parametrize("with_images", [True, False])
def test_no_map_alone_asks_for_huge_depth_maps(tmp_path, with_images):
    """Neither without images, nor where those that it names are not there."""
    make_result(tmp_path, with_images)
    for path in (tmp_path / "keyframes").glob("*.jpg"):
        path.unlink()
    huge = {"width": 16384, "height": 16384}

    def change(views):
        views["camera"].update(huge)
        views["render_camera"].update(huge, fx=9000.0, fy=9000.0)

    changed_map(tmp_path, change)
    with pytest.raises(InputError, match="far larger than any"):
        geogs.load_result(tmp_path)
