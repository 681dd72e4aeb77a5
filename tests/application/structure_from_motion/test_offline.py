"""A video without tracking: chosen frames by structure from motion, the others against them."""

import json

import numpy as np
import pytest
import torch

from geogs.application.structure_from_motion import chosen_frames, offline
from geogs.application.structure_from_motion.offline import beginning_with
from geogs.camera.shutter.shutter import Shutter
from geogs.cli.main import main
from geogs.config import InputConfig
from geogs.geometry.umeyama import umeyama
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.sniff import open_source
from geogs.types import Frame
from geogs_photos.localise import Localiser
from io_samples import write_image, write_video
from posed_layouts import render_room
from posed_scene import BRIEF

FRAMES = 12


@pytest.mark.parametrize(("interval", "begins_with"), [(33, 0.02), (200, 0.0)])
def test_a_readout_found_of_few_images_a_second_is_left_to_their_residuals(
    tmp_path, interval, begins_with
):
    images = [np.full((48, 64, 3), 8 * k, np.uint8) for k in range(12)]
    write_video(tmp_path / "video.mp4", images, [interval * k for k in range(12)])
    video = open_source(tmp_path / "video.mp4", InputConfig("50,50,31.5,23.5"))
    found = video.with_shutter(Shutter(0.02, "found"))
    assert beginning_with(video, found).shutter.readout == begins_with


@pytest.mark.system
@pytest.mark.usefixtures("no_report")
def test_every_frame_gets_its_pose_and_there_is_a_mesh(tmp_path, monkeypatch, capfd):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(chosen_frames, "MIN_FRAMES", FRAMES // 2)
    monkeypatch.setattr(offline, "reconstruct_preset", lambda _: BRIEF)
    place, others = Localiser.place, list[int]()

    def place_but_one(self: Localiser, frame: Frame) -> np.ndarray | None:
        others.append(frame.index)
        return None if len(others) == 2 else place(self, frame)

    monkeypatch.setattr(Localiser, "place", place_but_one)
    room = render_room(FRAMES, 3, 240, 180)
    for k, image in enumerate(room.images):
        write_image(tmp_path / "video" / f"{k:03d}.png", image)
    c, output = room.camera, tmp_path / "out"
    code = main([
        "run", str(tmp_path / "video"), "-o", str(output), "--sfm", "--device", "cpu",
        "--intrinsics", f"{c.fx},{c.fy},{c.cx},{c.cy}",
    ])  # fmt: skip
    said = capfd.readouterr().err
    assert code in (0, 3), said
    summary = json.loads((output / "summary.json").read_text())
    assert summary["frames"] == FRAMES
    assert summary["keyframes"] == FRAMES // 2
    assert summary["offline"]["placed_against_the_map"] == FRAMES // 2 - 1
    assert summary["offline"]["placed_afterwards"] == 1
    assert summary["verdict"]["lost"] == 0
    assert (output / "mesh.ply").is_file()
    places = read_tum_trajectory(output / "trajectory.tum").T_wc[:, :3, 3].copy()
    truth = room.T_wc[:, :3, 3].copy()
    scale, R, t = (x.numpy() for x in umeyama(*map(torch.from_numpy, (places, truth))))
    error = np.linalg.norm(scale * places @ R.T + t - truth, axis=1)
    extent = np.linalg.norm(truth[:, None] - truth, axis=2).max()
    assert error.max() < 0.02 * extent
