"""ATE against known noise and against evo; association; when a comparison is doubted."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.evaluation.rotation_errors import rotation_angle
from geogs.evaluation.trajectory_errors import associate, doubts, evaluate_trajectory
from geogs.geometry.lie import se3_exp, so3_exp
from geogs.io.pose_files import read_poses
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import Trajectory


def wiggle(n: int = 200, seed: int = 0) -> Trajectory:
    """A smooth closed path of about 12 m with turning camera, 30 poses a second."""
    t = torch.linspace(0, 2 * torch.pi, n, dtype=torch.float64)
    position = torch.stack([2 * t.cos(), 1.5 * t.sin(), 0.3 * (3 * t).sin()], -1)
    rotation = so3_exp(torch.stack([0.2 * t.sin(), t, 0.1 * (2 * t).cos()], -1))
    T = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = rotation, position
    return Trajectory(np.arange(n) / 30, T.numpy(), np.ones(n, bool))


def moved(reference: Trajectory, scale: float, noise: np.ndarray) -> Trajectory:
    """The reference seen from another frame, scaled, after adding ``noise`` to its positions."""
    S = se3_exp(torch.tensor([1.0, -3.0, 0.5, 0.7, -1.1, 0.4], dtype=torch.float64)).numpy()
    T = reference.T_wc.copy()
    T[:, :3, 3] += noise
    T = S @ T
    T[:, :3, 3] *= scale
    return Trajectory(reference.timestamps, T, reference.tracked)


def test_sim3_removes_frame_and_scale():
    reference = wiggle()
    errors = evaluate_trajectory(moved(reference, 0.37, np.zeros((200, 3))), reference)
    assert errors.ate_max_cm < 1e-9
    assert errors.scale == pytest.approx(1 / 0.37, rel=1e-12)
    assert errors.rotation_rmse_deg < 1e-6
    steps = np.diff(reference.T_wc[:, :3, 3], axis=0)
    assert errors.path_length_m == pytest.approx(np.linalg.norm(steps, axis=1).sum())
    assert np.abs(errors.aligned - reference.T_wc).max() < 1e-9
    se3 = evaluate_trajectory(moved(reference, 1.0, np.zeros((200, 3))), reference, alignment="se3")
    assert se3.scale == 1.0
    assert se3.ate_max_cm < 1e-9
    raw = evaluate_trajectory(reference, reference, alignment="none")
    assert raw.ate_rmse_cm == 0.0


def test_known_noise_gives_its_size():
    """2 cm noise per axis: RMSE is 2 sqrt(3) cm less the little that 7 parameters absorb."""
    n = 2000
    reference = wiggle(n)
    noise = np.random.default_rng(1).normal(size=(n, 3)) * 0.02
    errors = evaluate_trajectory(moved(reference, 2.0, noise), reference)
    expected = 100 * np.sqrt((noise**2).sum(1).mean() * (1 - 7 / (3 * n)))
    assert errors.ate_rmse_cm == pytest.approx(expected, rel=2e-3)
    assert errors.ate_mean_cm < errors.ate_rmse_cm < errors.ate_max_cm
    assert errors.ate_std_cm**2 + errors.ate_mean_cm**2 == pytest.approx(errors.ate_rmse_cm**2)


def test_rotation_error_is_the_angle():
    reference = wiggle(50)
    twist = so3_exp(torch.tensor([0.0, np.radians(3.0), 0.0], dtype=torch.float64)).numpy()
    T = reference.T_wc.copy()
    T[:, :3, :3] = T[:, :3, :3] @ twist
    errors = evaluate_trajectory(Trajectory(reference.timestamps, T, reference.tracked), reference)
    assert errors.rotation_rmse_deg == pytest.approx(3.0, abs=1e-9)
    tiny = so3_exp(torch.tensor([[0.0, 0.0, 1e-7]], dtype=torch.float64)).numpy()
    assert rotation_angle(tiny, np.eye(3)[None])[0] == pytest.approx(np.degrees(1e-7), rel=1e-6)


def test_association_is_mutual_nearest_within_the_limit():
    reference = np.array([0.00, 0.10, 0.20, 0.30, 0.40])
    estimate = np.array([0.405, 0.115, 0.095, 0.29, 0.26])
    i, j = associate(reference, estimate, 0.02)
    assert i.tolist() == [1, 3, 4]
    assert j.tolist() == [2, 3, 0]
    i, j = associate(reference, estimate, 0.07)
    assert i.tolist() == [1, 3, 4]  # 0.26 is nearer to 0.30, which has 0.29
    assert associate(reference, estimate[:0], 1.0)[0].tolist() == []


def test_subset_of_frames_is_compared_by_time():
    reference = wiggle(100)
    every = slice(3, None, 7)
    part = Trajectory(
        reference.timestamps[every] + 0.004, reference.T_wc[every], reference.tracked[every]
    )
    errors = evaluate_trajectory(part, reference)
    assert errors.pairs == len(part.timestamps)
    assert errors.ate_max_cm < 1e-9


def test_what_cannot_be_aligned_is_an_input_error():
    reference = wiggle(30)
    late = Trajectory(reference.timestamps + 100, reference.T_wc, reference.tracked)
    with pytest.raises(InputError, match=r"Only 0 poses match within 0\.02 s"):
        evaluate_trajectory(late, reference)
    straight = Trajectory(
        reference.timestamps, np.tile(np.eye(4), (30, 1, 1)), np.ones(30, dtype=bool)
    )
    straight.T_wc[:, 0, 3] = np.arange(30)
    with pytest.raises(InputError, match="cannot be aligned"):
        evaluate_trajectory(straight, reference)


def test_orientations_alone_are_aligned_by_themselves():
    reference = wiggle(40)
    world = so3_exp(torch.tensor([0.4, -1.0, 0.3], dtype=torch.float64)).numpy()
    turned = np.tile(np.eye(4), (40, 1, 1))
    turned[:, :3, :3] = world @ reference.T_wc[:, :3, :3]
    errors = evaluate_trajectory(
        Trajectory(reference.timestamps, turned, np.zeros(40, bool)), reference
    )
    assert errors.rotation_rmse_deg < 1e-5
    assert errors.scale == 1
    places = reference.T_wc[:, :3, 3]
    spread = np.sqrt(((places - places.mean(0)) ** 2).sum(1).mean())
    assert errors.ate_rmse_cm == pytest.approx(100 * spread)


def test_poses_that_are_not_finite_take_no_part():
    reference = wiggle(60)
    estimate = moved(reference, 0.5, np.zeros((60, 3)))
    estimate.T_wc[5, 0, 3] = np.nan
    reference.T_wc[9] = np.inf
    errors = evaluate_trajectory(estimate, reference)
    assert errors.pairs == 58
    assert errors.ate_max_cm < 1e-9
    assert json.loads(json.dumps(errors.as_dict()))["pairs"] == 58


def test_bad_rows_of_a_replica_file_keep_the_time_of_the_others(tmp_path):
    reference = wiggle(40)
    rows = reference.T_wc.reshape(40, 16).copy()
    rows[7] = np.nan
    rows[8] = 0
    rows[21, 3] = np.inf
    np.savetxt(tmp_path / "traj.txt", rows)
    read = read_poses(tmp_path)
    assert len(read.timestamps) == 37
    errors = evaluate_trajectory(moved(reference, 3.0, np.zeros((40, 3))), read)
    assert errors.pairs == 37
    assert errors.ate_max_cm < 1e-6


@pytest.mark.parametrize("with_scale", [True, False])
def test_evo_agrees(tmp_path, with_scale):
    evo = Path(sys.executable).with_name("evo_ape")
    if not evo.is_file():
        pytest.skip("evo_ape is not installed beside this Python")
    reference = wiggle(150)
    noise = np.random.default_rng(2).normal(size=(150, 3)) * 0.03
    estimate = moved(reference, 0.6 if with_scale else 1.0, noise)
    shift = np.random.default_rng(3).uniform(-0.008, 0.008, 150)
    estimate = Trajectory(estimate.timestamps + shift, estimate.T_wc, estimate.tracked)
    estimate = Trajectory(*(a[::3] for a in (estimate.timestamps, estimate.T_wc, estimate.tracked)))
    write_tum_trajectory(tmp_path / "gt.tum", reference)
    write_tum_trajectory(tmp_path / "est.tum", estimate)
    ours = evaluate_trajectory(
        read_poses(tmp_path / "est.tum"),
        read_poses(tmp_path / "gt.tum"),
        alignment="sim3" if with_scale else "se3",
    )
    command = [evo, "tum", "gt.tum", "est.tum", "-as" if with_scale else "-a", "-v"]
    command += ["--t_max_diff", "0.02", "--save_results", "ape.zip"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=1800,
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "MPLBACKEND": "Agg"},
    ).stdout  # fmt: skip
    import zipfile

    with zipfile.ZipFile(tmp_path / "ape.zip") as results:
        theirs = json.loads(results.read("stats.json"))
    assert ours.ate_rmse_cm == pytest.approx(100 * theirs["rmse"], abs=1e-6)
    assert ours.ate_mean_cm == pytest.approx(100 * theirs["mean"], abs=1e-6)
    assert ours.ate_median_cm == pytest.approx(100 * theirs["median"], abs=1e-6)
    assert ours.ate_max_cm == pytest.approx(100 * theirs["max"], abs=1e-6)
    assert ours.pairs == int(re.search(r"Compared (\d+) absolute pose pairs", output)[1])
    if with_scale:
        scale = float(re.search(r"Scale correction: ([\d.]+)", output)[1])
        assert ours.scale == pytest.approx(scale, abs=1e-6)


def swing(n: int = 50, seconds: float = 0.1, size: float = 2.0, width: float = 1.0) -> Trajectory:
    t = np.linspace(0, 5, n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = size * np.sin(t)
    T[:, 1, 3], T[:, 2, 3] = width * size * np.cos(t), 0.3 * width * size * np.sin(3 * t)
    return Trajectory(seconds * np.arange(n), T, np.ones(n, bool))


def noisy(trajectory: Trajectory, noise: float, scale: float = 1.0) -> Trajectory:
    T = trajectory.T_wc.copy()
    T[:, :3, 3] = scale * (T[:, :3, 3] + np.random.default_rng(0).normal(size=(len(T), 3)) * noise)
    return Trajectory(trajectory.timestamps, T, trajectory.tracked)


def said(
    estimate: Trajectory, reference: Trajectory, alignment: str = "sim3", is_metric: bool = False
) -> list[str]:
    errors = evaluate_trajectory(estimate, reference, 0.02, alignment)
    return doubts(errors, estimate, reference, 0.02, is_metric)


def test_nothing_speaks_against_a_usual_comparison():
    assert said(noisy(swing(), 0.01, 0.2), swing()) == []
    every_third = Trajectory(*(x[::3] for x in (swing().timestamps, swing().T_wc, swing().tracked)))
    assert said(noisy(swing(), 0.01), every_third) == []  # a truth with fewer poses
    assert said(noisy(every_third, 0.01), swing()) == []
    assert said(noisy(swing(), 0.01), swing(), is_metric=True) == []
    assert said(noisy(swing(), 0.01), swing(), "se3") == []


def test_few_poses_that_match_in_time():
    """50 frames at 5 Hz, and true poses that count 30 a second."""
    sentences = said(noisy(swing(seconds=0.2), 0.01), swing(seconds=1 / 30))
    assert any("Only 9 of 50 poses match in time" in s for s in sentences)
    some = Trajectory(*(x[::7] for x in (swing().timestamps, swing().T_wc, swing().tracked)))
    [sentence] = said(noisy(swing(), 0.01), some)
    assert "Only 8 of 50 estimated poses are compared" in sentence
    few = swing(n=5)
    assert "5 poses are so few" in said(noisy(few, 0.01), few)[0]


def test_an_alignment_that_is_not_determined():
    assert "so straight" in said(noisy(swing(width=0.001), 0.01), swing(width=0.001))[0]
    [still] = said(noisy(swing(size=0.001), 0.01), swing(size=0.001))
    assert "hardly moved" in still


@pytest.mark.parametrize("alignment", ["sim3", "se3"])
def test_units_that_cannot_be(alignment):
    estimate = noisy(swing(), 0.01, scale=0.01)  # says metres, is in hundreds of them
    sentences = said(estimate, swing(), alignment, is_metric=True)
    assert any("as large as the estimated one" in s for s in sentences)
    millimetres = swing(size=2000.0)
    assert any("metres a second" in s for s in said(noisy(millimetres, 1.0), millimetres))
