"""Reconstructions that were cut off and go on: checkpoints, their file, the command."""

import json
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from geogs.application.checkpoints.checkpoint import checkpoint_folder, write_checkpoint
from geogs.application.reconstruct import ReconstructState, fingerprint, read_work
from geogs.cli import main as cli
from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.reconstruction import Reconstruction
from posed_scene import DEFAULT, SMALL, ball_and_wall, depth_errors, surface_points, vertices
from stopped_commands import stop

pytestmark = pytest.mark.system


def interrupted(scene: Reconstruction, fraction: float) -> None:
    """Finish a reconstruction up to a part of its training."""

    def interrupt(name: str, done: float) -> None:
        if name == "training" and done >= fraction:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scene.finish(progress=interrupt)


def write_work(output: Path, scene: Reconstruction) -> None:
    """A checkpoint of its work."""
    write_checkpoint(checkpoint_folder(output), ReconstructState("these", scene.settle()))


@pytest.fixture(scope="module")
def whole() -> Reconstruction:
    """One that nothing disturbed."""
    scene = ball_and_wall(far=10.0)
    scene.finish()
    return scene


@pytest.mark.long
@pytest.mark.parametrize("fraction", [0.0, 0.6])
def test_work_that_was_cut_off_is_gone_on_with(whole, tmp_path, fraction):
    first = ball_and_wall(far=10.0)
    interrupted(first, fraction)
    write_work(tmp_path, first)
    state = read_work(tmp_path, "these")
    assert state.seconds > 0
    second, stages = ball_and_wall(far=10.0), []
    second.resume(state, lambda stage, _: stages.append(stage))
    assert set(stages) == {"training"}
    assert second.elapsed > state.seconds
    assert second.mapper.table.place.steps == whole.mapper.table.place.steps
    counts = len(second.snapshot()), len(whole.snapshot())
    assert abs(counts[0] - counts[1]) < 0.05 * counts[1]
    errors, wanted = depth_errors(second), depth_errors(whole)
    print(f"medians {np.median(errors):.5f} and {np.median(wanted):.5f}")
    assert np.median(errors) < 1.15 * np.median(wanted)


@pytest.fixture(scope="module")
def half(tmp_path_factory) -> tuple[Reconstruction, Path]:
    """One that was cut off in the middle of its training, and where its checkpoint lies."""
    scene, output = ball_and_wall(), tmp_path_factory.mktemp("half")
    interrupted(scene, 0.5)
    write_work(output, scene)
    return scene, output


def test_a_restored_mapper_is_the_same(half):
    first, output = half
    second = ball_and_wall()
    state = read_work(output, "these")
    second._work_on(state)
    second._place_keyframes()
    assert second.mapper.table.place == first.mapper.table.place
    assert second.mapper.table.unit == first.mapper.table.unit
    for a, b in zip(first.mapper.views.values(), second.mapper.views.values(), strict=True):
        assert a.row.partners == b.row.partners
        assert a.row.search == b.row.search
        assert torch.equal(a.constants.prior_depth, b.constants.prior_depth)
    for a, b in zip(
        first.mapper.table.disks.parameters, second.mapper.table.disks.parameters, strict=True
    ):
        assert torch.equal(a, b)
    assert torch.equal(first.mapper.table.disks.steps, second.mapper.table.disks.steps)
    for name in ("first", "second"):
        rows = zip(
            getattr(first.mapper.table.disks, name),
            getattr(second.mapper.table.disks, name),
            strict=True,
        )
        assert all(torch.equal(a, b) for a, b in rows)


def test_a_wrong_checkpoint_is_one_sentence(half, tmp_path):
    with pytest.raises(InputError, match="nothing to resume"):
        read_work(tmp_path, "these")
    with pytest.raises(InputError, match="other settings or images"):
        read_work(half[1], "those")


def test_fingerprints_change_with_settings_and_images():
    names = ["a.png", "b.png"]
    own = fingerprint(DEFAULT, None, names)
    assert own == fingerprint(ReconstructConfig(), None, names)
    assert own != fingerprint(SMALL, None, names)
    assert own != fingerprint(DEFAULT, 8, names)
    assert own != fingerprint(DEFAULT, None, names[:1])


@pytest.mark.usefixtures("no_report")
def test_an_interrupted_command_resumes(small_room, tmp_path, capsys):
    """Ctrl-C in the training leaves a result and a checkpoint; the rest is done later."""
    call = [
        "reconstruct", small_room, "-o", tmp_path, "--stride", 6, "--mapping.render-long-edge", 96,
        "--search.least-steps", 60, "--search.steps-per-view", 10, "--search.no-repeat",
        "--device", "cpu",
    ]  # fmt: skip
    checkpoint = tmp_path / "checkpoint" / "manifest.json"
    said = stop([*map(str, call)], signal.SIGINT, checkpoints=1)
    assert f"--resume {tmp_path} continues" in said
    assert json.loads((tmp_path / "summary.json").read_text())["interrupted"] is True
    assert checkpoint.is_file()
    go_on = [*map(str, call), "--resume", str(tmp_path)]
    assert cli.main([*go_on, "--mapping.disk.stride", "9"]) == 2
    said = capsys.readouterr().err
    assert "other settings" in said.splitlines()[-1]
    assert "Traceback" not in said
    assert cli.main(go_on) == 0
    assert "Continuing after" in capsys.readouterr().err
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["interrupted"] is False
    assert "depth" not in summary["seconds"]
    assert not checkpoint.parent.exists()
    assert cli.main(go_on) == 2
    assert "nothing to resume" in capsys.readouterr().err.splitlines()[-1]
    seen = vertices(small_room / "points_seen_1cm.ply")
    accuracy = cKDTree(seen).query(surface_points(tmp_path / "mesh.ply"))[0]
    assert np.median(accuracy) < 0.02
