"""The errors of a result against the truth, as ``geogs eval`` finds and writes them."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.io import savemat

from box_room import CAMERA, box, circle
from geogs.application.evaluate import evaluate, find_surface
from geogs.application.result_settings import EvalSettings
from geogs.cli.eval import main
from geogs.cli.main import main as geogs_main
from geogs.errors import InputError
from geogs.geometry.lie import so3_exp
from geogs.io.pose_files import read_poses, read_tum_trajectory
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.ply_writer import write_mesh
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.types import Trajectory, Uncertainty

pytestmark = pytest.mark.system


@pytest.fixture
def result(tmp_path):
    """A result folder in its own frame and unit (1 = 4 m), and the truth in Replica layout."""
    T = circle()
    vertices, faces = box((3.0, 2.0, 1.2))
    truth, out = tmp_path / "room", tmp_path / "out"
    truth.mkdir()
    np.savetxt(truth / "traj.txt", T.reshape(-1, 16))
    write_mesh(truth / "mesh.ply", vertices, faces)
    write_mesh(truth / "points_seen_1cm.ply", vertices, faces[:0])
    R = so3_exp(torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64)).numpy()
    moved = T.copy()
    moved[:, :3, :3] = R @ T[:, :3, :3]
    moved[:, :3, 3] = (T[:, :3, 3] @ R.T + [1.0, 2.0, 3.0]) / 4
    time = np.arange(60) / 30
    write_tum_trajectory(out / "trajectory.tum", Trajectory(time, moved, np.ones(60, bool)))
    some = Trajectory(time[::6], moved[::6], np.ones(10, bool))
    write_tum_trajectory(out / "keyframes.tum", some)
    grown = vertices * [3.02 / 3, 2.02 / 2, 1.22 / 1.2]  # every wall 2 cm too far
    write_mesh(out / "mesh.ply", (grown @ R.T + [1.0, 2.0, 3.0]) / 4, faces)
    write_intrinsics(out / "intrinsics.json", CAMERA)
    return truth, out


def test_eval_command_writes_everything(result, capsys, monkeypatch):
    monkeypatch.setattr("geogs.evaluation.pages.shading._WIDTH", 120)
    truth, out = result
    mesh = str(truth / "mesh.ply")
    assert main([str(out), "--gt", str(truth), "--gt-mesh", mesh, "--samples", "20000"]).code == 0
    printed = capsys.readouterr().out
    assert "(traj.txt); 60 of 60 frames matched in time." in " ".join(printed.split())
    assert "ATE RMSE, all frames, Sim(3) aligned (cm)" in printed
    numbers = json.loads((out / "eval.json").read_text())
    assert numbers["trajectory"]["ate_rmse_cm"] < 1e-6
    assert numbers["trajectory"]["scale"] == pytest.approx(4.0)
    assert numbers["trajectory"]["pairs"] == 60
    assert numbers["keyframes"]["pairs"] == 10
    surface = numbers["reconstruction"]
    assert surface["accuracy_cm"] == pytest.approx(2.0, abs=0.1)  # a little more at the edges
    assert surface["completeness_cm"] == pytest.approx(2.0, abs=0.01)
    assert surface["completeness_ratio"] == 100.0
    page = (out / "report" / "index.html").read_text()
    assert "<h2>Surface beside the truth</h2>" in page
    assert (out / "report" / "mesh_truth.png").read_bytes().startswith(b"\x89PNG")
    assert "Trajectory over the truth" not in page  # the poses are the true ones


def test_culling_and_icp_run_from_the_command(result):
    truth, out = result
    options = EvalSettings(
        output=out, gt=truth, gt_mesh=truth / "mesh.ply", cull=True, icp=True, samples=5000,
        plots=False,
    )  # fmt: skip
    evaluation = evaluate(options)
    assert evaluation.reconstruction.accuracy_cm < 2.1
    assert evaluation.reconstruction.completeness_ratio == 100.0
    assert not (out / "report" / "mesh_truth.png").exists()


@pytest.mark.parametrize("protocol", ["samples", "vertex"])
def test_toolbox_protocols_run_from_the_command(result, protocol):
    truth, out = result
    options = EvalSettings(
        output=out, gt=truth, gt_mesh=truth / "mesh.ply", protocol=protocol, cull=True,
        samples=5000, plots=False,
    )  # fmt: skip
    evaluation = evaluate(options)
    numbers = json.loads((out / "eval.json").read_text())
    assert numbers["reconstruction"]["protocol"] == evaluation.settings["protocol"]
    page = (out / "report" / "index.html").read_text()
    if protocol == "vertex":  # eight corners, each 2 cm farther out along three axes
        assert "vertex-weighted (Splat-SLAM toolbox)" in page
        assert evaluation.reconstruction.accuracy_cm == pytest.approx(2 * 3**0.5, abs=0.01)
        assert evaluation.reconstruction.completeness_samples == 8
    else:  # 5000 samples are about 9 cm from each other, on a surface of 48 square metres
        assert "distances to samples" in page
        assert 4 < evaluation.reconstruction.accuracy_cm < 8


@pytest.mark.long
def test_object_protocol_measures_in_the_silhouettes_of_the_truth(result):
    truth, out = result
    write_mesh(truth / "near.ply", *box((3.015, 2.015, 1.215)))  # the result is 5 mm beyond
    options = EvalSettings(
        output=out, gt=truth / "traj.txt", gt_mesh=truth / "near.ply", protocol="object",
        samples=20_000, threshold=0.006,
    )  # fmt: skip
    scores = evaluate(options).reconstruction
    assert scores.accuracy_mm == pytest.approx(5, abs=0.05)
    assert scores.completeness_mm == pytest.approx(5, abs=0.01)
    assert scores.f_score > 99
    assert "Acc (mm)" in (out / "report" / "index.html").read_text()


def test_results_of_known_poses_are_not_aligned(result):
    truth, out = result
    reference = read_poses(truth)
    shifted = reference.T_wc + np.array([[0, 0, 0, 0.1]] + [[0] * 4] * 3)
    moved = Trajectory(reference.timestamps, shifted, reference.tracked)
    write_tum_trajectory(out / "trajectory.tum", moved)
    (out / "mesh.ply").unlink()
    options = EvalSettings(output=out, gt=truth, plots=False)
    assert evaluate(options).trajectory.ate_rmse_cm < 1e-6
    (out / "summary.json").write_text('{"scale": "of the poses (metres)", "frames": 60}')
    evaluation = evaluate(replace(options, plots=True))
    assert evaluation.trajectory.ate_rmse_cm == pytest.approx(10)
    for title in ("Trajectory over the truth", "Error over time"):
        assert f"<h2>{title}</h2>" in (out / "report" / "index.html").read_text()
    for name in ("trajectory_truth.png", "trajectory_error.png"):
        assert (out / "report" / name).read_bytes().startswith(b"\x89PNG")
    assert evaluation.trajectory.alignment == "none"
    assert "<td>60</td>" in (out / "report" / "index.html").read_text()
    again = evaluate(EvalSettings(output=out, gt=truth, plots=False, alignment="se3"))
    assert again.trajectory.ate_rmse_cm < 1e-6


def test_errors_are_laid_beside_what_the_run_said_of_them(result, capfd):
    truth, out = result
    found = read_tum_trajectory(out / "trajectory.tum")
    found.T_wc[:, :3, 3] += np.random.default_rng(0).normal(size=(60, 3)) * 0.01 / 4
    write_tum_trajectory(out / "trajectory.tum", found)
    states = replace(found, tracked=np.arange(60) < 50, oriented=None)
    said = np.full(1, 0.01 * 3**0.5 / 4)
    write_uncertainty(
        out / "trajectory_uncertainty.csv", states, Uncertainty(np.zeros(1), said, said, said)
    )
    write_tum_trajectory(out / "trajectory.tum", states.of("tracked"))
    (out / "mesh.ply").unlink()
    assert main([str(out), "--gt", str(truth)]).code == 0
    assert "frames within 2 sigma (%)" in capfd.readouterr().out
    numbers = json.loads((out / "eval.json").read_text())
    told = numbers["reliability"]
    assert told["frames"] == 50
    assert told["within_two_sigma"] > 0.95
    assert told["error_per_sigma"] == pytest.approx(1, abs=0.2)
    assert np.abs(np.subtract(told["observed"], told["foretold"])).max() < 0.2
    assert numbers["trajectory"]["rotations"] == "absolute"
    assert numbers["doubts"] == []
    assert "Are errors as large as predicted?" in (out / "report" / "index.html").read_text()


def test_what_speaks_against_a_comparison_is_said_before_anything_else(result, capfd):
    truth, out = result
    found = read_tum_trajectory(out / "trajectory.tum")
    slow = replace(found, timestamps=6 * found.timestamps)  # five frames a second
    write_tum_trajectory(out / "trajectory.tum", slow)
    (out / "mesh.ply").unlink()
    good = {"verdict": {"sentence": "All is well.", "is_reliable": True}}
    (out / "summary.json").write_text(json.dumps(good))
    assert main([str(out), "--gt", str(truth), "--no-plots"]).code == 0
    assert "Only 10 of 60 poses match in time" in capfd.readouterr().err.replace("\n", " ")
    page = (out / "report" / "index.html").read_text()
    assert page.index('verdict bad">Only 10 of 60') < page.index("All is well.")


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"threshold": -1.0}, "but must be"),
        ({"samples": 0}, "but must be"),
        ({"photo_every": 0}, "but must be"),
        ({"protocol": "dtu"}, "needs --dtu-data"),
        ({"photo": True}, "no images with known poses|no pictures|holds no"),
    ],
)
def test_wrong_options_are_input_errors(result, changed, match):
    truth, out = result
    with pytest.raises(InputError, match=match):
        evaluate(EvalSettings(output=out, gt=truth, plots=False, **changed))


def test_truth_is_found_beside_the_poses_or_above(result):
    truth, out = result
    mesh, points = find_surface(EvalSettings(output=out, gt=truth))
    assert (mesh.name, points.name) == ("mesh.ply", "points_seen_1cm.ply")
    (truth / "poses").mkdir()
    (truth / "traj.txt").rename(truth / "poses" / "traj.txt")
    assert find_surface(EvalSettings(output=out, gt=truth / "poses"))[0] == mesh
    given = EvalSettings(output=out, gt=truth, gt_mesh=out / "mesh.ply")
    assert find_surface(given) == (out / "mesh.ply", None)
    (truth / "mesh.ply").rename(truth / "other.ply")
    assert find_surface(EvalSettings(output=out, gt=truth))[0] == points
    with pytest.raises(InputError, match="does not exist"):
        find_surface(EvalSettings(output=out, gt=truth, gt_mesh=truth / "none.ply"))


def test_eval_without_a_surface_or_a_result(result):
    truth, out = result
    (out / "mesh.ply").unlink()
    (out / "keyframes.tum").unlink()
    evaluation = evaluate(EvalSettings(output=out, gt=truth / "traj.txt", plots=False))
    assert evaluation.reconstruction is None
    assert evaluation.keyframes is None
    with pytest.raises(InputError, match=r"no trajectory\.tum"):
        evaluate(EvalSettings(output=truth, gt=truth))
    with pytest.raises(InputError, match=r"does not exist|not a folder"):
        evaluate(EvalSettings(output=out, gt=truth / "nothing"))


def test_dtu_runs_from_the_command(tmp_path):
    """A wall of 40 mm seen by three cameras, the result 0.4 mm behind it, all in millimetres."""
    scan, out, data = tmp_path / "scan9", tmp_path / "out", tmp_path / "data"
    K = np.array([[80.0, 0, 64, 0], [0, 80, 48, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    T_cw = np.tile(np.eye(4), (3, 1, 1))
    T_cw[:, :2, 3] = [[0, 0], [-5, 0], [0, -5]]
    scale = np.diag([60.0, 60, 60, 1])
    matrices = {f"world_mat_{i}": K @ T for i, T in enumerate(T_cw)}
    scan.mkdir()
    np.savez(scan / "cameras.npz", scale_mat_0=scale, **matrices)
    for i in range(3):
        for folder, value in (("image", 90), ("mask", 255)):
            (scan / folder).mkdir(exist_ok=True)
            picture = np.full((96, 128, 3), value, np.uint8)
            picture[:, : 20 if folder == "mask" else 0] = 0  # 44 pixels left of the middle
            cv2.imwrite(str(scan / folder / f"{i:03d}.png"), picture)
    (data / "ObsMask").mkdir(parents=True)
    box_mm = np.array([[-50.0, -50, 50], [50, 50, 150]])
    observed = {"ObsMask": np.ones((21, 21, 21), np.uint8), "BB": box_mm, "Res": 5.0}
    savemat(data / "ObsMask" / "ObsMask9_10.mat", observed)
    savemat(data / "ObsMask" / "Plane9.mat", {"P": np.array([0.0, 0, 1, 0])})
    g = np.arange(-20, 20.01, 0.2)
    x, y = (a.ravel() for a in np.meshgrid(g, g))
    wall = np.stack([x, y, np.full(x.size, 100.0)], -1)
    write_mesh(data / "Points" / "stl" / "stl009_total.ply", wall, np.zeros((0, 3), int))
    corners = np.array([[-20, -20, 100.4], [20, -20, 100.4], [20, 20, 100.4], [-20, 20, 100.4]])
    # A second wall at the left, off the masks, would be 40 mm from the scan and within the box.
    corners = np.concatenate([corners, corners - [45.0, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    write_mesh(out / "mesh.ply", corners, faces)
    T_wc = np.linalg.inv(T_cw)
    poses = Trajectory(np.arange(3) / 30, T_wc, np.ones(3, bool))
    write_tum_trajectory(out / "trajectory.tum", poses)
    write_intrinsics(out / "intrinsics.json", CAMERA)
    (out / "summary.json").write_text('{"scale": "of the poses (millimetres)"}')
    words = ["--gt", str(scan), "--protocol", "dtu", "--dtu-data", str(data)]
    assert main([str(out), *words]).code == 0
    numbers = json.loads((out / "eval.json").read_text())
    assert numbers["trajectory"]["ate_max_cm"] < 1e-6
    assert numbers["trajectory"]["path_length_m"] == pytest.approx(0.005 + 0.005 * 2**0.5)
    surface = numbers["reconstruction"]
    assert surface["d2s_mm"] == pytest.approx(0.41, abs=0.01)  # up to 0.14 mm aside of a point
    assert surface["s2d_mm"] == pytest.approx(0.415, abs=0.015)
    assert surface["d2s_left_out"] == 0.0
    assert "overall (mm)" in (out / "report" / "index.html").read_text()


@pytest.mark.parametrize("place", ["", "truth", "out"])
def test_the_mesh_of_the_result_is_not_taken_for_the_truth(result, place):
    """Where true poses lie in the folder of the result, or in one inside."""
    truth, out = result
    folder = out / place
    folder.mkdir(exist_ok=True)
    poses = (truth / "traj.txt").rename(folder / "traj.txt")
    for given in (poses, folder):
        assert find_surface(EvalSettings(output=out, gt=given)) == (None, None)
    evaluation = evaluate(EvalSettings(output=out, gt=poses, plots=False))
    assert evaluation.reconstruction is None
    assert evaluation.settings["true_surface"] is None


def test_the_answer_is_what_was_found_and_not_what_lies_in_the_folder(result, capsys, monkeypatch):
    truth, out = result
    words = ["eval", str(out), "--gt", str(truth), "--no-plots", "--samples", "5000", "--json"]
    assert geogs_main(words) == 0
    errors = json.loads(capsys.readouterr().out)["errors"]
    assert errors == json.loads((out / "eval.json").read_text())
    monkeypatch.setattr("geogs.application.evaluate.write_report", lambda *_: None)
    for other in ("{", '{"trajectory": {"ate_rmse_cm": 99}}'):
        (out / "eval.json").write_text(other)
        assert geogs_main(words) == 0
        assert json.loads(capsys.readouterr().out)["errors"] == errors
