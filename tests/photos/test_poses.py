"""Poses of rendered photographs against the truth; what is left out, and why."""

import json
import re
import sys

import numpy as np
import pytest
import torch

from geogs.cli.main import main
from geogs.errors import InputError
from geogs.extras import install_command
from geogs.geometry.umeyama import umeyama
from geogs.io.sources.formats.colmap import open_colmap
from geogs_photos.photo_features import PhotoFeatures, find_features
from geogs_photos.photograph import find_photographs
from geogs_photos.poses import Entry, find_poses, reasons
from geogs_photos.pycolmap_library import load_colmap
from io_samples import write_image
from posed_layouts import render_room

FRAMES = 9


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A walk through a room, one picture of something else, a bare one and one that is broken."""
    pytest.importorskip("pycolmap")
    folder = tmp_path_factory.mktemp("photos")
    room = render_room(FRAMES, 3, 320, 240)
    for i, image in enumerate(room.images):
        write_image(folder / f"{i}.png", image)
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    write_image(folder / "other.png", noise)
    write_image(folder / "bare.png", np.full((240, 320, 3), 128, np.uint8))
    (folder / "broken.jpg").write_bytes(b"\xff\xd8 no more")
    return folder, room


def test_features_lie_where_they_are_seen():
    image = np.full((120, 160, 3), 40, np.uint8)
    for x, y in ((40, 30), (100, 80), (60, 90)):
        image[y - 4 : y + 5, x - 4 : x + 5] = 220
    found = find_features(image)
    for x, y in ((40, 30), (100, 80), (60, 90)):
        assert np.linalg.norm(found.keypoints[:, :2] - (x, y), axis=1).min() < 0.1
    assert np.linalg.norm(found.descriptors.astype(float), axis=1).mean() == pytest.approx(
        512, 0.02
    )
    mask = np.zeros((120, 160), bool)
    mask[:, :70] = True
    assert find_features(image, mask).keypoints[:, 0].max() < 75
    assert len(find_features(np.zeros((50, 50, 3), np.uint8))) == 0


@pytest.mark.system
def test_places_are_found_and_what_is_left_out_is_named(photographs, tmp_path, capfd):
    folder, room = photographs
    stages = []
    found = find_poses(
        find_photographs(folder), tmp_path, "auto", 0, lambda stage, _: stages.append(stage)
    )
    assert capfd.readouterr() == ("", "")
    assert list(dict.fromkeys(stages)) == ["features", "matching", "finding poses", "adjusting"]
    why = dict(found.left_out)
    assert why["broken.jpg"] == "cannot be read"
    assert "features" in why["bare.png"]
    assert why["other.png"] == "shows nothing that another photograph shows"
    posed = open_colmap(tmp_path, folder)
    assert sorted(file.path.name for file in posed.files) == [f"{i}.png" for i in range(FRAMES)]
    T_wc = np.linalg.inv(np.stack([file.T_cw for file in posed.files]))
    truth = room.T_wc
    places = (torch.from_numpy(T[:, :3, 3].copy()) for T in (T_wc, truth))
    scale, R, t = (x.numpy() for x in umeyama(*places))
    error = np.linalg.norm(scale * T_wc[:, :3, 3] @ R.T + t - truth[:, :3, 3], axis=1)
    extent = np.linalg.norm(truth[:, None, :3, 3] - truth[:, :3, 3], axis=2).max()
    assert error.max() < 0.02 * extent
    camera = posed.files[0].calibration
    assert camera.fx == pytest.approx(room.camera.fx, rel=0.02)


@pytest.mark.system
@pytest.mark.usefixtures("no_report")
def test_the_command_goes_from_photographs_to_a_mesh(photographs, tmp_path, capfd):
    folder, room = photographs
    c = room.camera
    code = main([
        "reconstruct", str(folder), "--sfm", "-o", str(tmp_path), "--device", "cpu",
        "--intrinsics", f"{c.fx},{c.fy},{c.cx},{c.cy}", "--search.steps-per-view", "1",
        "--search.least-steps", "20", "--search.no-repeat", "--mapping.render-long-edge", "96",
    ])  # fmt: skip
    said = capfd.readouterr()
    assert code == 0, said.err
    assert f"{FRAMES} of {FRAMES + 3} photographs have a pose" in said.err
    assert "Traceback" not in said.err
    assert (tmp_path / "mesh.ply").is_file()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["kind"] == "photographs"
    assert {out["image"] for out in summary["left_out"]} == {"other.png", "bare.png", "broken.jpg"}


def test_reasons_say_what_was_missing():
    some = PhotoFeatures(np.ones((200, 4), np.float32), np.zeros((200, 128), np.uint8))
    entries = [Entry(f"{k}.jpg", 0, some) for k in range(8)]
    kept = np.zeros((8, 8), int)
    kept[:3, :3] = kept[3:6, 3:6] = 80
    kept[6, 0] = kept[0, 6] = 21
    parts = [{"0.jpg", "1.jpg", "2.jpg"}, {"3.jpg", "4.jpg", "5.jpg"}]
    why = dict(reasons(entries, kept, parts))
    assert sorted(why) == ["3.jpg", "4.jpg", "5.jpg", "6.jpg", "7.jpg"]
    assert "a part of 3 photographs" in why["4.jpg"]
    assert "21 matches, with 0.jpg" in why["6.jpg"]
    assert why["7.jpg"] == "shows nothing that another photograph shows"


def test_without_pycolmap_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=re.escape(install_command("photos"))):
        load_colmap()


def test_two_photographs_are_too_few(tmp_path):
    pytest.importorskip("pycolmap")
    for k in range(2):
        write_image(tmp_path / f"{k}.png", np.zeros((32, 32, 3), np.uint8))
    with pytest.raises(InputError, match="three or more"):
        find_poses(find_photographs(tmp_path), tmp_path / "m", "auto", 0, lambda *_: None)


def test_photographs_of_different_things_end_in_a_sentence(tmp_path):
    pytest.importorskip("pycolmap")
    random = np.random.default_rng(0)
    for k in range(3):
        write_image(tmp_path / f"{k}.png", random.integers(0, 255, (64, 64, 3), dtype=np.uint8))
    with pytest.raises(InputError, match="only 0 of 3 photographs show something"):
        find_poses(find_photographs(tmp_path), tmp_path / "m", "auto", 0, lambda *_: None)
