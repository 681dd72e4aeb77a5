"""A rough mesh from what tracking knows, while the map is still to be made."""

from dataclasses import replace

import numpy as np
import pytest

from geogs.application import tracked_video
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.surfaces import PREVIEW, preview
from geogs.application.run import run
from geogs.application.run_settings import RunSettings
from geogs.config import InputConfig
from geogs.guard.replacement import replaced
from geogs.mesh.mesh_file import read_mesh
from quick_systems import quick_config

FRAMES = 20


class Looked(RunProgress):
    """Looks into the folder when the map is begun."""

    def __init__(self, folder) -> None:
        self.folder, self.said = folder, []
        self.seen = None

    def write(self, text: str) -> None:
        self.said.append(text)

    def stage(self, name: str, fraction: float) -> None:
        if name == "mapping" and self.seen is None:
            self.seen = (
                (self.folder / PREVIEW).read_bytes() if (self.folder / PREVIEW).is_file() else b""
            )


@pytest.mark.system
@pytest.mark.usefixtures("no_report")
def test_it_is_there_before_the_map_and_gone_with_the_result(small_room, tmp_path, monkeypatch):
    monkeypatch.setattr(tracked_video, "MIN_PREVIEW_KEYFRAMES", 0)
    config = quick_config(pose_iterations=0, final_iterations=10)
    config = replace(config, input=InputConfig(stop=FRAMES))
    output = tmp_path / "out"
    looked = Looked(output)
    result = run(RunSettings((small_room,), config, output, "cpu"), looked)
    assert looked.seen
    (said,) = [text for text in looked.said if "rough preview" in text]
    assert str(output / PREVIEW) in said
    assert not (output / PREVIEW).exists()
    slam = result.scene
    rough, mesh = preview(slam), result.mesh
    (tmp_path / "seen.ply").write_bytes(looked.seen)
    assert len(read_mesh(tmp_path / "seen.ply").faces) == len(rough.faces) > 100
    # Most of it is where the map has its surface.
    places = np.random.default_rng(0).permutation(len(mesh.vertices))[:4000]
    extent = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    nearest = [np.linalg.norm(mesh.vertices[places] - v, axis=1).min() for v in rough.vertices[::7]]
    assert np.median(nearest) < 0.02 * extent


def test_it_is_part_of_the_result_that_is_being_made(tmp_path):
    (tmp_path / "mine.ply").write_text("of the user")
    with replaced(tmp_path, "result") as new:
        with replaced(tmp_path, "part") as part:
            (part / PREVIEW).write_text("rough")
        assert (tmp_path / PREVIEW).read_text() == "rough"
        (new / "mesh.ply").write_text("whole")
    assert sorted(p.name for p in tmp_path.glob("*.ply")) == ["mesh.ply", "mine.ply"]
