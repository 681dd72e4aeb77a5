"""Whole joins in one process, of parts whose truth is known."""

import json

import numpy as np
import pytest

from geogs.application.result_settings import RemeshSettings
from geogs.application.results.revise import remesh
from geogs.application.results.saved_result import load_result
from geogs.config import Config
from geogs.errors import InputError
from geogs_fleet.join.join import join_parts
from geogs_fleet.join.part import Part
from joined_parts import HALF, make_part, true_frames
from one_process import OneProcess

PLACES = [np.linspace(-0.8, 0.1, 6), np.linspace(-0.2, 0.8, 6)]


def make_parts(folder):
    """Two parts of a room and one of another."""
    make_part(folder / "a", PLACES[0], 0)
    make_part(folder / "b", PLACES[1], 1)
    make_part(folder / "x", PLACES[0], 3, paint=9)


@pytest.mark.system
@pytest.mark.parametrize("adjust", [pytest.param(False, marks=pytest.mark.long), True])
def test_two_parts_of_a_room_become_one_and_another_room_stays_apart(once, tmp_path, adjust):
    folder = once("parts-of-two-rooms", make_parts)
    parts = [Part(name, folder / name) for name in "abx"]
    joint = join_parts(parts, tmp_path / "out", Config(), OneProcess(), adjust=adjust)
    assert joint.unjoined == ("x",)
    result = load_result(tmp_path / "out")
    true = np.concatenate([true_frames(places) for places in PLACES])
    error = np.linalg.norm(result.trajectory.T_wc[:, :3, 3] - true[:, :3, 3], axis=1)
    assert error.max() < 0.01
    assert np.all(np.diff(result.trajectory.timestamps) > 0)
    sizes = [len(load_result(part.folder).disks) for part in parts[:2]]
    assert max(sizes) < len(result.disks) < 0.85 * sum(sizes)  # what both have is there once
    vertices = result.mesh.vertices
    assert np.median(np.abs(np.abs(vertices) - HALF).min(1)) < 0.005
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [video["name"] for video in summary["videos"]] == ["a", "b"]
    assert summary["apart"] == ["x"]
    assert summary["links"] >= 2
    assert summary["verdict"]["sentence"] == joint.sentence
    assert "Nothing of the others was recognised in x." in joint.sentence
    assert (tmp_path / "out" / "report" / "index.html").is_file()
    assert not (tmp_path / "out" / "join").exists()
    if not adjust:
        before = (tmp_path / "out" / "mesh.ply").stat().st_size
        remesh(RemeshSettings(tmp_path / "out"))  # the joint result is a result like others
        assert (tmp_path / "out" / "mesh.ply").stat().st_size == pytest.approx(before, rel=0.05)


def test_parts_of_different_places_are_refused(tmp_path):
    parts = [
        Part(name, make_part(tmp_path / name, PLACES[0][:2], 0, paint=k))
        for k, name in enumerate("ab")
    ]
    with pytest.raises(InputError, match="No place of one part was recognised"):
        join_parts(parts, tmp_path / "out", Config(), OneProcess())
