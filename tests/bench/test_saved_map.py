"""One map before its correction, moved by several rules: the stream is run once."""

import json

import numpy as np
import pytest

from geogs.io.pose_files import read_tum_trajectory
from geogs.io.writers.map_file import load_map
from geogs_bench.data.benchmark_scene import Option
from geogs_bench.runners.runner import FOLDER, Runner
from geogs_bench.runners.task import Task

pytestmark = pytest.mark.system

TINY = {
    "stop": "16", "mapping.render-long-edge": "64", "mapping.iterations": "1",
    "mapping.pose-iterations": "0", "mapping.final-iterations": "0",
    "tracking.init-keyframes": "6", "mapping.depth.planes": "48", "device": "cpu",
}  # fmt: skip


@pytest.mark.usefixtures("no_report")
def test_every_rule_moves_the_same_map_by_the_same_correction(small_room, tmp_path):
    rules = ["per_keyframe", "coherent"]
    checkpoints = []
    for rule in rules:
        options = {**TINY, "mapping.ablation.map-update": rule}
        given = (*(Option(k, v) for k, v in options.items()), Option("loop.no-enabled"))
        Runner().run(Task("update", small_room, tmp_path / rule, given))
        manifest = tmp_path / FOLDER / "checkpoint" / "manifest.json"
        checkpoints.append((manifest.stat().st_mtime_ns, manifest.read_text()))
    assert checkpoints[0] == checkpoints[1]
    poses = [read_tum_trajectory(tmp_path / r / "trajectory.tum").T_wc for r in rules]
    assert np.array_equal(*poses)
    maps = [load_map(tmp_path / r / "map.safetensors") for r in rules]
    assert len(maps[0]) == len(maps[1]) > 100
    moved = np.abs(np.asarray(maps[0].position) - np.asarray(maps[1].position)).max()
    assert 0 < moved < 0.1
    assert not json.loads((tmp_path / rules[0] / "summary.json").read_text())["refined"]
