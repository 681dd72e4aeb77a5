"""Depth by kind of place, of results with known errors: a sheet, a hole, a surface in the sky."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.ply_writer import write_mesh
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import Trajectory
from geogs_bench.bench import bench
from geogs_bench.bench_options import BenchOptions
from geogs_bench.data.motion_cells import DEPTH_CELLS
from geogs_bench.data.scenes import find_depth
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.depth_pictures import error_colours
from geogs_bench.scoring.depth_scores import one_scale, score_depth

CAMERA = Camera(100.0, 100.0, 59.5, 44.5, 120, 90)
SCALE = 0.25
"""Map units per metre of the results."""
FRAMES = 6
WALL = 3.0
BAR = (-0.1, 0.1)
"""Metres of x between which a bar stands, at 2 m: ten pixels, so it is thin."""


def poses() -> np.ndarray:
    """Sideways by 2 cm a frame, looking at the wall."""
    T_wc = np.tile(np.eye(4), (FRAMES, 1, 1))
    T_wc[:, 0, 3] = 0.02 * np.arange(FRAMES)
    return T_wc


def quads(*rectangles: tuple[float, float, float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Rectangles facing the cameras: x from, x to, y from, y to, z."""
    corners, faces = [], []
    for k, (x0, x1, y0, y1, z) in enumerate(rectangles):
        corners += [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]
        faces += [(4 * k, 4 * k + 1, 4 * k + 2), (4 * k, 4 * k + 2, 4 * k + 3)]
    return np.array(corners, float), np.array(faces)


TRUTH = ((-9, 9, -9, 9, WALL), (*BAR, -9, 9, 2.0))


def write_sequence(folder: Path, *, sky: bool = False, depths: bool = True) -> Path:
    """A textured wall behind a bar; the sky above y = 0 is there in the depth images alone."""
    results = folder / "results"
    results.mkdir(parents=True)
    rng = np.random.default_rng(0)
    u = np.arange(CAMERA.width)
    for k, T_wc in enumerate(poses()):
        coarse = rng.integers(0, 255, (CAMERA.height // 3, CAMERA.width // 3, 3), np.uint8)
        image = coarse.repeat(3, 0).repeat(3, 1)
        cv2.imwrite(str(results / f"frame{k:06d}.png"), image)
        x = (u - CAMERA.cx) / CAMERA.fx * 2.0 + T_wc[0, 3]
        row = np.where((x > BAR[0]) & (x < BAR[1]), 2.0, WALL)
        depth = np.tile(row, (CAMERA.height, 1))
        if sky:
            depth[: CAMERA.height // 2] = 0
        if depths:
            cv2.imwrite(str(results / f"depth{k:06d}.png"), (1000 * depth).astype(np.uint16))
    np.savetxt(folder / "traj.txt", poses().reshape(-1, 16))
    camera = {"fx": 100.0, "fy": 100.0, "cx": 59.5, "cy": 44.5, "w": 120, "h": 90, "scale": 1000.0}
    document = {"camera": camera, "motion": "driving"} if sky else {"camera": camera}
    (folder / "cam_params.json").write_text(json.dumps(document))
    write_mesh(folder / "mesh.ply", *quads(*TRUTH))
    return folder


def write_result(folder: Path, *rectangles: tuple[float, float, float, float, float]) -> Path:
    """A result in map units whose world is turned and moved."""
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    T_wc = poses()
    T_wc[:, :3, :3] = turn @ T_wc[:, :3, :3]
    T_wc[:, :3, 3] = SCALE * T_wc[:, :3, 3] @ turn.T + [5, 6, 7]
    folder.mkdir(parents=True)
    times = np.arange(FRAMES) / 30
    write_tum_trajectory(folder / "trajectory.tum", Trajectory(times, T_wc, np.ones(FRAMES, bool)))
    vertices, faces = quads(*rectangles)
    write_mesh(folder / "mesh.ply", SCALE * vertices @ turn.T + [5, 6, 7], faces)
    write_intrinsics(folder / "intrinsics.json", CAMERA, None)
    summary = {"frames": FRAMES, "device": "cpu", "seconds": {"total": 4.0}, "seed": 3}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.mark.parametrize("depths", [True, False])
def test_a_perfect_result_is_right_everywhere_whatever_its_unit(tmp_path, depths) -> None:
    (scene,) = find_depth(write_sequence(tmp_path / "hall", depths=depths))
    result = ResultFolder(write_result(tmp_path / "out", *TRUTH))
    scores, views = score_depth(scene, result)
    assert [s.place for s in scores] == ["all", "open", "edge", "thin", "behind thin"]
    assert len(views) == FRAMES
    for score in scores:
        assert score.within_2 > 99, score
        assert score.in_front < 0.5
        assert score.behind < 0.5
        assert score.median_error < 0.1
    by_name = {s.place: s for s in scores}
    assert by_name["all"].normal < 0.1
    assert by_name["all"].share == pytest.approx(100)
    assert by_name["thin"].share == pytest.approx(100 * 10 / 120, abs=0.5)
    assert by_name["behind thin"].share == pytest.approx(100 * 40 / 120, abs=0.5)


def test_a_sheet_beside_the_bar_stands_in_front_behind_a_thin_thing(tmp_path) -> None:
    """From the bar's right edge 0.2 m (ten pixels of 120) on, at the depth of the bar."""
    (scene,) = find_depth(write_sequence(tmp_path / "hall"))
    sheet = (BAR[1], BAR[1] + 0.2, -9.0, 9.0, 2.0)
    scores, _ = score_depth(scene, ResultFolder(write_result(tmp_path / "out", *TRUTH, sheet)))
    by_name = {s.place: s for s in scores}
    assert by_name["all"].in_front == pytest.approx(100 * 10 / 120, abs=0.5)
    assert by_name["all"].within_5 == pytest.approx(100 * 110 / 120, abs=0.5)
    assert by_name["behind thin"].in_front == pytest.approx(100 * 10 / 40, abs=1)
    assert by_name["thin"].in_front < 0.5
    assert by_name["open"].in_front < 0.5
    assert by_name["all"].covered == pytest.approx(100)
    assert by_name["all"].behind < 0.5


def test_a_bar_that_is_missing_lies_behind_and_a_hole_is_wrong(tmp_path) -> None:
    (scene,) = find_depth(write_sequence(tmp_path / "hall"))
    left = (-9.0, -0.3, -9.0, 9.0, WALL)  # to 10 pixels left of the first camera's middle
    right = (0.0, 9.0, -9.0, 9.0, WALL)
    scores, views = score_depth(scene, ResultFolder(write_result(tmp_path / "out", left, right)))
    by_name = {s.place: s for s in scores}
    seen = np.mean([np.isfinite(v.found)[v.places["thin"]].mean() for v in views])
    assert 0.3 < seen < 0.8  # of the bar's place, where the wall behind shows
    assert by_name["thin"].behind == pytest.approx(100 * seen, abs=1)
    assert by_name["thin"].within_5 < 0.5
    assert by_name["thin"].in_front < 0.5
    assert by_name["all"].covered == pytest.approx(100 * 110 / 120, abs=0.5)
    holes = 100 - by_name["all"].covered
    assert by_name["all"].within_5 <= 100 - holes


def test_of_the_sky_a_surface_in_it_is_told(tmp_path) -> None:
    (scene,) = find_depth(write_sequence(tmp_path / "road", sky=True))
    bar = (*BAR, 0.0, 9.0, 2.0)
    ground = ((-9.0, 9.0, 0.0, 9.0, WALL), bar)
    scores, _ = score_depth(scene, ResultFolder(write_result(tmp_path / "clear", *ground)))
    sky = next(s for s in scores if s.place == "sky")
    assert sky.covered < 0.5
    assert sky.share == pytest.approx(50, abs=1)
    assert sky.within_5 is None
    wall = ((-9.0, 9.0, -0.6, 9.0, WALL), bar)  # 20 of its 45 rows
    scores, views = score_depth(scene, ResultFolder(write_result(tmp_path / "high", *wall)))
    sky = next(s for s in scores if s.place == "sky")
    assert sky.covered == pytest.approx(100 * 20 / 45, abs=1.5)
    assert (error_colours(views[0].view.depth, views[0].found)[44 - 10] == (200, 0, 0)).all()


def test_a_sequence_at_another_rate_has_the_true_poses_of_its_own_times(tmp_path) -> None:
    """As ``geogs synth`` writes a street: the lists of TUM beside, and no depth in them."""
    folder = write_sequence(tmp_path / "road", sky=True)
    times = np.arange(FRAMES) / 10
    names = (f"{t:.6f} results/frame{k:06d}.png" for k, t in enumerate(times))
    (folder / "rgb.txt").write_text("\n".join(names))
    T_wc = poses()
    T_wc[:, 0, 3] *= 4  # so far that another frame's pose would show
    known = np.ones(FRAMES, bool)
    write_tum_trajectory(folder / "groundtruth.txt", Trajectory(times, T_wc, known))
    ground = ((-9.0, 9.0, 0.0, 9.0, WALL), (*BAR, 0.0, 9.0, 2.0))
    write_mesh(folder / "mesh.ply", *quads(*ground))
    result = write_result(tmp_path / "out", *ground)
    write_tum_trajectory(result / "trajectory.tum", Trajectory(times, T_wc, known))
    write_mesh(result / "mesh.ply", *quads(*ground))
    (scene,) = find_depth(folder)
    scores, _ = score_depth(scene, ResultFolder(result))
    by_name = {s.place: s for s in scores}
    assert by_name["all"].within_2 > 99
    assert by_name["thin"].within_2 > 99
    assert by_name["sky"].share == pytest.approx(100 * 45 / 90, abs=1)
    assert by_name["sky"].covered < 0.5


def test_the_scale_is_the_median_of_all_views_not_of_each() -> None:
    true = [np.full((4, 4), 2.0), np.full((4, 4), 2.0)]
    true[0][0], true[1][0, 0] = 0, np.inf
    own = [np.full((4, 4), 0.5), np.full((4, 4), 0.4)]
    own[1][1, 1] = np.inf
    found = one_scale(true, own)
    assert found[0][1, 1] == pytest.approx(2.5)
    assert found[1][2, 2] == pytest.approx(2.0)
    with pytest.raises(InputError, match="no view"):
        one_scale([np.zeros((4, 4))], [np.ones((4, 4))])


def test_a_result_of_another_shape_is_refused(tmp_path) -> None:
    (scene,) = find_depth(write_sequence(tmp_path / "hall"))
    result = write_result(tmp_path / "out", *TRUTH)
    write_intrinsics(result / "intrinsics.json", replace(CAMERA, width=100), None)
    with pytest.raises(InputError, match="100 x 75"):
        score_depth(scene, ResultFolder(result))
    (result / "mesh.ply").unlink()
    with pytest.raises(InputError, match="no mesh"):
        score_depth(scene, ResultFolder(result))


def test_an_earlier_result_is_scored_by_the_command(tmp_path) -> None:
    sequence = write_sequence(tmp_path / "hall")
    result = write_result(tmp_path / "out", *TRUTH)
    done = bench(BenchOptions("edges", sequence, tmp_path / "scores", result=result), print)
    (chapter,) = done.chapters
    (record,) = chapter.records
    assert record.place("thin").within_5 > 99
    assert record.cost.seconds == 4.0
    (saved,) = json.loads((tmp_path / "scores" / "results.json").read_text())
    assert [p["place"] for p in saved["places"]] == [p.place for p in record.places]
    assert "| hall | 100.0 |" in (tmp_path / "scores" / "results.md").read_text()
    picture = cv2.imread(str(result / "report" / "bench_depth.png"))
    assert picture.shape == (5 * 90, 5 * 120, 3)
    with pytest.raises(InputError, match="is for edges"):
        bench(BenchOptions("rooms", sequence, result=result), print)
    with pytest.raises(InputError, match="needs the sequence"):
        bench(BenchOptions("edges", result=result), print)


def test_sequences_with_depth_are_found_in_every_layout(tmp_path) -> None:
    write_sequence(tmp_path / "hall")
    bare = write_sequence(tmp_path / "bare", depths=False)
    (bare / "mesh.ply").unlink()
    kinect = tmp_path / "kinect"
    (kinect / "rgb").mkdir(parents=True)
    for name in ("rgb.txt", "depth.txt"):
        (kinect / name).write_text("0.0 rgb/0.png\n")
    found = {scene.name: scene for scene in find_depth(tmp_path)}
    assert list(found) == ["hall", "kinect"]
    assert {scene.kind for scene in found.values()} == {"depth"}
    assert found["kinect"].truth.poses is None
    assert len({cell.name for cell in DEPTH_CELLS}) == len(DEPTH_CELLS)
