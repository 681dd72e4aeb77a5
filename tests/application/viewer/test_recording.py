"""A recording of a run is written, and holds what it should."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from box_room import box, circle
from geogs.application.viewer.recording import Recorder
from geogs.errors import InputError, OutputError
from geogs.extras import install_command
from geogs.geometry.camera import Camera
from geogs.mesh.triangle_mesh import Mesh
from geogs.pose_estimate import PoseEstimate
from geogs.types import Frame, MapSnapshot, Trajectory
from geogs.world.segments import TrackState

CAMERA = Camera(80.0, 80.0, 63.5, 47.5, 128, 96)


class FakeSlam:
    """A camera on a circle, and a few disks."""

    camera = CAMERA

    def __init__(self) -> None:
        self.poses = circle()
        self.T_cw = None

    def keyframe_trajectory(self) -> Trajectory:
        return Trajectory(np.arange(10) / 30, self.poses[:10], np.ones(10, bool))

    def snapshot(self) -> MapSnapshot:
        turn = torch.tensor([[1.0, 0, 0, 0]]).expand(50, 4)
        return MapSnapshot(torch.rand(50, 3), turn, torch.ones(50, 2), torch.full((50,), 0.5))


def test_keyframes_map_and_mesh_are_recorded(tmp_path):
    pytest.importorskip("rerun", reason="rerun is not installed")
    path, slam = tmp_path / "new" / "run.rrd", FakeSlam()
    recorder = Recorder(path)
    random = np.random.default_rng(0)
    image = random.integers(0, 255, (96, 128, 3), dtype=np.uint8)
    for number in range(12):
        slam.T_cw = torch.from_numpy(np.linalg.inv(slam.poses[number]))
        status = PoseEstimate(TrackState.TRACKING, number, number // 2, 50)
        recorder.frame(Frame(number, number / 30, image), status, slam)
    vertices, faces = box((3.0, 2.0, 1.2))
    result = SimpleNamespace(
        trajectory=slam.keyframe_trajectory(),
        mesh=Mesh.from_triangles(vertices, faces),
        verdict=SimpleNamespace(sentence="Reliable, it says."),
    )
    recorder.result(result)
    content = path.read_bytes()
    assert content[:3] == b"RRF"
    for name in (b"/world/camera/image", b"/world/disks", b"/world/mesh", b"/world/path"):
        assert name in content
    # Five of the twelve frames are keyframes, each with a JPEG image of about ten kilobytes.
    one = len(image.tobytes()) * 0.3
    assert 3 * one < len(content) < 12 * one


def test_a_file_that_cannot_be_written_and_a_missing_library_are_sentences(tmp_path, monkeypatch):
    import sys

    pytest.importorskip("rerun", reason="rerun is not installed")
    with pytest.raises(OutputError, match="cannot be written"):
        Recorder(tmp_path)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=re.escape(install_command("record"))):
        Recorder(tmp_path / "a.rrd")
