"""People who cross the view do not pull the poses of frames along that show little else."""

from pathlib import Path

import numpy as np
import pytest

from geogs.application.structure_from_motion.completion import as_seen
from geogs.camera.straight_view import StraightView
from geogs.config import InputConfig
from geogs.io.sources.sniff import open_source
from geogs_photos import incremental_mapping
from geogs_photos.completion import place_lost
from geogs_synth.sequence.replica_files import write_sequence

LOST = range(6, 11)
"""Frames that people fill to a half."""


def errors(room: Path) -> np.ndarray:
    """How far the lost frames of a video come to lie from where they were taken, metres."""
    write_sequence(room, 18, 240, 180, 233, motion="handheld-5hz", moving=0.5)
    T_wc = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)
    source = open_source((room,), InputConfig())
    poses = [None if k in LOST else np.linalg.inv(T) for k, T in enumerate(T_wc)]
    seen_by = as_seen(StraightView(source.camera, source.camera))
    found = place_lost(list(source), poses, seen_by, 0, lambda *_: None)
    assert set(found.numbers) == set(LOST)
    centres = np.linalg.inv(found.T_cw)[:, :3, 3]
    return np.linalg.norm(centres - T_wc[list(found.numbers), :3, 3], axis=1)


@pytest.mark.system
@pytest.mark.long
def test_lost_frames_stand_to_the_room_and_not_to_people(tmp_path):
    pytest.importorskip("pycolmap")
    assert errors(tmp_path).max() < 0.03


@pytest.mark.long
@pytest.mark.system
def test_matches_that_are_not_close_pull_lost_frames_along_with_people(tmp_path, monkeypatch):
    """What the other test looks at is hard."""
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(incremental_mapping, "_keep_within", lambda *_: None)
    assert errors(tmp_path).max() > 0.08
