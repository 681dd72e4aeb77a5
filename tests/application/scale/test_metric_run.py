"""A whole run in metres: by a depth sensor, and by a distance that is known."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.application.run import run
from geogs.application.run_settings import RunSettings
from geogs.application.scale.known_length import (
    KnownDistances,
    measurable_run,
    scale_by_distances,
    scale_source,
)
from geogs.config import Config
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source

pytestmark = pytest.mark.system

FRAMES = 26


def quick(depth: str) -> Config:
    c = Config()
    mapping = replace(
        c.mapping, render_long_edge=64, iterations=2, pose_iterations=1, final_iterations=10,
        final_depth=False, depth=replace(c.mapping.depth, planes=48),
    )  # fmt: skip
    return replace(
        c,
        input=replace(c.input, stop=FRAMES, depth=depth, readout=0.0),
        tracking=replace(c.tracking, init_keyframes=6),
        mapping=mapping,
    )


def truth(room: Path) -> np.ndarray:
    return np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)[:FRAMES]


def extent(T_wc: np.ndarray) -> float:
    """Root of the mean squared distance from the middle of a path."""
    centres = T_wc[:, :3, 3]
    return float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))


@pytest.mark.long
def test_measured_depth_makes_metres(small_room, tmp_path, no_report):
    result = run(
        RunSettings((small_room,), quick("sensor"), tmp_path / "out", "cpu", scale_from="sensor")
    )
    trajectory = result.trajectory
    assert trajectory.tracked.all()
    assert extent(trajectory.T_wc) == pytest.approx(extent(truth(small_room)), rel=0.02)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["scale"] == "metric (depth sensor)"
    assert summary["metric_scale"] == {
        "origin": "depth sensor", "factor": 1.0, "deviation": pytest.approx(0.005),
    }  # fmt: skip
    for render in result.renders:
        exact = cv2.imread(
            str(small_room / f"results/depth{round(30 * render.timestamp):06d}.png"), -1
        )
        exact = cv2.resize(exact / 6553.5, (64, 48), interpolation=cv2.INTER_NEAREST)
        depth = render.depth.cpu().numpy()
        assert np.median(np.abs(depth / exact - 1)[depth > 0]) < 0.02


@pytest.mark.long
def test_a_known_distance_makes_metres(small_room, tmp_path, no_report):
    # Two pixels of the twelfth frame, and how far their points are apart.
    depth = cv2.imread(str(small_room / "results/depth000012.png"), -1) / 6553.5
    camera = open_source(small_room).camera
    (a, b) = ((30, 60), (96, 66))
    ends = [
        depth[v, u] * np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1])
        for u, v in (a, b)
    ]
    metres = np.linalg.norm(ends[0] - ends[1])
    known = f"12:{a[0]},{a[1]},{b[0]},{b[1]}={metres}m"
    result = run(
        RunSettings((small_room,), quick("none"), tmp_path / "out", "cpu", scale_from=known)
    )
    assert extent(result.trajectory.T_wc) == pytest.approx(
        extent(truth(small_room)), rel=0.05
    )  # of a map of 64 x 48 pixels that was hardly trained
    said = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert said["scale"] == "metric (a known distance)"
    # Poses, map and depths have grown alike: the same two pixels say that a unit is a metre.
    source = scale_source(known)
    assert isinstance(source, KnownDistances)
    calibration = open_source(small_room).calibration
    again = scale_by_distances(measurable_run(result.scene), source, calibration)
    assert again.factor == pytest.approx(1, abs=1e-3)


def test_a_scale_that_cannot_be_had_is_refused_before_the_run(small_room, tmp_path):
    settings = RunSettings((small_room,), quick("none"), tmp_path / "out", "cpu")
    with pytest.raises(InputError, match="needs measured depth"):
        run(replace(settings, scale_from="sensor"))
    with pytest.raises(InputError, match="is not understood"):
        run(replace(settings, scale_from="a mile"))
    assert not (tmp_path / "out").exists()
