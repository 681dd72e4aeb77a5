"""The matrix of motions: its cells, what is scored, tracking without a map."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geogs.application.run_settings import RunSettings
from geogs.errors import InputError
from geogs.io.writers.trajectories import write_trajectories
from geogs.types import Trajectory
from geogs_bench.data.motion_cells import FULL, SMALL, Cell, relighted, render_cells
from geogs_bench.data.scenes import find_motions, find_relighted
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.runners.runner import track_to_folder
from geogs_bench.scoring.motion_scores import compare_motion, rotation_error, score_motion
from geogs_synth.camera.flaws import Flaws, camera_flaws
from geogs_synth.sequence.replica_files import write_sequence


def _trajectory(T_wc: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(len(T_wc)) / 30, T_wc, np.ones(len(T_wc), bool))


def _poses(seed: int, count: int = 40) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T_wc = np.tile(np.eye(4), (count, 1, 1))
    T_wc[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    T_wc[:, :3, 3] = np.cumsum(rng.normal(0, 0.1, (count, 3)), 0)
    return T_wc


def test_cells_have_names_of_their_own() -> None:
    for cells in (SMALL, FULL):
        names = [cell.name for cell in cells]
        assert len(set(names)) == len(names)
    assert {cell.motion for cell in FULL} == {cell.motion for cell in FULL + SMALL}
    assert len({cell.motion for cell in FULL}) == 16
    assert sum(cell.frames * cell.width * cell.height for cell in SMALL) < 1000 * 320 * 240


def test_rotation_error_is_what_no_rotation_of_the_world_removes() -> None:
    """Against a search over rotations of the world."""
    truth = _poses(0)[:, :3, :3]
    world = Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix()
    assert rotation_error(world @ truth, truth) < 1e-6
    noise = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 0.02, (40, 3))).as_matrix()
    estimate = world @ truth @ noise
    found = rotation_error(estimate, truth)

    def error(turn: np.ndarray) -> float:
        aligned = Rotation.from_rotvec(turn).as_matrix() @ world.T @ estimate
        angles = Rotation.from_matrix(aligned.transpose(0, 2, 1) @ truth).magnitude()
        return float(np.degrees(np.sqrt((angles**2).mean())))

    turns = np.random.default_rng(2).normal(0, 0.005, (400, 3))
    assert found == pytest.approx(np.degrees(0.02 * np.sqrt(3)), rel=0.25)
    assert min(error(turn) for turn in turns) > found * (1 - 1e-6)


def test_positions_and_share() -> None:
    truth = _poses(3)
    estimate = truth.copy()
    estimate[:, :3, 3] = 0.2 * (truth[:, :3, 3] + np.random.default_rng(4).normal(0, 0.01, (40, 3)))
    kept = _trajectory(estimate)
    kept = Trajectory(kept.timestamps[:30], kept.T_wc[:30], kept.tracked[:30])
    score = compare_motion(_trajectory(truth), kept, kept)
    assert score.tracked == 75
    path = np.linalg.norm(np.diff(truth[:30, :3, 3], axis=0), axis=1).sum()
    assert score.ate == pytest.approx(1.7, rel=0.3)
    assert score.relative == pytest.approx(score.ate / path)
    assert score.rotation == pytest.approx(0, abs=1e-5)


def test_a_camera_that_only_turns_has_no_ate() -> None:
    truth = _poses(5)
    truth[:, :3, 3] = 1.0
    score = compare_motion(*[_trajectory(truth)] * 3)
    assert (score.tracked, score.ate, score.relative) == (100, None, None)
    assert score.rotation == pytest.approx(0, abs=1e-5)
    moved = _poses(6)
    stuck = moved.copy()
    stuck[:, :3, 3] = 0
    assert compare_motion(*map(_trajectory, (moved, stuck, stuck))).ate is None


def test_what_a_run_says_of_itself_is_compared_with_the_truth(tmp_path: Path) -> None:
    """Forty frames of which two are lost, two only oriented, and one is off by 5 deviations."""
    truth, estimate = _poses(7, 40), _poses(7, 40)
    estimate[4, :3, 3] += 0.005
    sequence, output = tmp_path / "walk", tmp_path / "result"
    sequence.mkdir()
    output.mkdir()
    np.savetxt(sequence / "traj.txt", truth.reshape(-1, 16))
    (sequence / "cam_params.json").write_text("{}")
    frame = np.arange(40)
    known = Trajectory(frame / 30, estimate, frame >= 4, (frame >= 2) & (frame < 4))
    write_trajectories(output, known, known.of("tracked"))
    states = ["lost"] * 2 + ["orientation only"] * 2 + ["tracked"] * 36
    rows = [
        f"{k / 30!r},{state},{0.001 if state == 'tracked' else ''},,"
        for k, state in enumerate(states)
    ]
    header = "timestamp,state,sigma_position,sigma_rotation_deg,relative_sigma_depth"
    (output / "trajectory_uncertainty.csv").write_text("\n".join([header, *rows, ""]))
    (output / "summary.json").write_text(json.dumps({"verdict": {"is_reliable": True}}))
    (scene,) = find_motions(tmp_path)
    score = score_motion(scene, ResultFolder(output))
    assert (score.tracked, score.turned) == (90, 5)
    assert score.within == pytest.approx(100 * 35 / 36)
    assert (score.is_reliable, score.is_called_reliable) == (True, True)
    assert score.ate == pytest.approx(0.5 * 3**0.5 / 6, rel=0.1)


def test_names_that_are_no_cell(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no cell flying; choose of handheld-clean, "):
        render_cells(SMALL, tmp_path, ("flying",), print)
    assert not list(tmp_path.iterdir())


def test_what_was_rendered_is_not_rendered_again(tmp_path: Path) -> None:
    (tmp_path / "still-kinect").mkdir()
    (tmp_path / "still-kinect" / "points_seen_1cm.ply").touch()
    said: list[str] = []
    assert render_cells(SMALL, tmp_path, ("still-kinect",), said.append) == tmp_path
    assert said == []


def test_a_camera_that_stands_still_has_orientations_alone(tmp_path: Path) -> None:
    """It gives no depth, so no start, and that is not a failure."""
    sequence, output = tmp_path / "still-clean", tmp_path / "result"
    (sequence / "results").mkdir(parents=True)
    image = np.random.default_rng(0).integers(0, 255, (72, 96, 3), np.uint8)
    for k in range(6):
        cv2.imwrite(str(sequence / f"results/frame{k:06d}.png"), image)
    np.savetxt(sequence / "traj.txt", np.tile(np.eye(4).ravel(), (6, 1)))
    camera = {"w": 96, "h": 72, "fx": 70, "fy": 70, "cx": 47.5, "cy": 35.5}
    (sequence / "cam_params.json").write_text(json.dumps({"camera": camera}))
    (scene,) = find_motions(tmp_path)
    assert scene.name == "still-clean"
    track_to_folder(RunSettings((scene.source,), device="cpu"), output)
    summary = json.loads((output / "summary.json").read_text())
    assert summary["frames"] == 6
    assert summary["verdict"]["sentence"].startswith("Rotation only: no shape.")
    score = score_motion(scene, ResultFolder(output))
    assert (score.tracked, score.turned, score.ate) == (0, 100, None)
    assert score.rotation == pytest.approx(0, abs=0.01)


@pytest.mark.system
@pytest.mark.long
def test_the_camera_does_not_turn_with_a_truck_ahead(tmp_path: Path) -> None:
    """It keeps its place over a sixth of the image while the street bends: with all matches alike
    the camera goes straight on, and is some 4 degrees off after these frames."""
    street, output = tmp_path / "street", tmp_path / "out"
    write_sequence(
        street, 10, 496, 150, 11, motion="driving", flaws=camera_flaws("clean"), moving=0.15,
        depth=False,
    )  # fmt: skip
    track_to_folder(RunSettings((street,), device="cpu"), output)
    found = np.loadtxt(output / "trajectory.tum")
    true = np.loadtxt(street / "traj.txt").reshape(-1, 4, 4)[:, :3, :3]
    assert len(found) == len(true)
    turned = Rotation.from_quat(found[:, 4:]).as_matrix()
    left = (turned[0].T @ turned).swapaxes(1, 2) @ (true[0].T @ true)
    angles = np.degrees(Rotation.from_matrix(left).magnitude())
    bend = np.degrees(Rotation.from_matrix(true[0].T @ true[-1]).magnitude())
    assert bend > 3
    assert angles.max() < 0.3


def test_a_pair_in_steady_and_in_changing_light_shares_its_path(tmp_path: Path) -> None:
    steady = Cell("hall", "handheld", Flaws(), 6, 64, 48)
    folder = render_cells((steady, relighted(steady)), tmp_path, (), lambda text: None)
    assert [scene.name for scene in find_relighted(folder)] == ["hall", "hall-light"]
    pair = [folder / name for name in ("hall", "hall-light")]
    np.testing.assert_array_equal(*(np.loadtxt(path / "traj.txt") for path in pair))
    depths = [cv2.imread(str(path / "results" / "depth000005.png"), -1) for path in pair]
    np.testing.assert_array_equal(*depths)
    lamps = [json.loads((path / "cam_params.json").read_text()).get("lamps") for path in pair]
    assert lamps == [None, "switched"]

    def changes(path: Path) -> np.ndarray:
        """Mean difference of each image to the one before, grey levels."""
        files = sorted((path / "results").glob("frame*.jpg"))
        images = np.stack([cv2.imread(str(file)).astype(float) for file in files])
        return np.abs(np.diff(images, axis=0)).mean((1, 2, 3))

    # Exposure wanders slowly, and the camera moves as much in both: what else changes are lamps.
    more = changes(pair[1]) - changes(pair[0])
    assert min(more[1], more[3]) > 3 * max(abs(more[0]), abs(more[2]), abs(more[4]))
