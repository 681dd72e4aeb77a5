"""Scores of results with known errors, and the tables they become."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bench_results import poses, wall, write_result, write_truth
from geogs.errors import InputError
from geogs.evaluation.surfaces.surface import Surface
from geogs.io.writers.ply_writer import write_mesh
from geogs_bench import published as paper
from geogs_bench.benchmark import Variant
from geogs_bench.catalogue.ablations import INITIALISATION, MAP_UPDATE
from geogs_bench.catalogue.data_sets import DTU, REPLICA, SCANNET, TUM
from geogs_bench.results.record import (
    Cost,
    CurvePoint,
    Provenance,
    Record,
    StageScore,
    SurfaceScore,
    TrajectoryScore,
    read_record,
    write_json,
)
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.room_scores import with_short_edges
from geogs_bench.scoring.scores import scored
from geogs_bench.tables.benchmark_report import Chapter, markdown, result_tables, write_report
from lit_rooms import lit_room

pytestmark = pytest.mark.system

FROM = Provenance("run", "abc123", "a processor, 2 cores", "cpu", 0, "0123456789ab")


@pytest.fixture
def no_pictures(monkeypatch) -> None:
    """Scores come without their pictures, which take longer than they do."""
    monkeypatch.setattr("geogs_bench.scoring.scores.draw", lambda *_: None)


def made_by(command: str) -> Record:
    """The record of a run that has not been scored."""
    return Record("", "hall", "", "", Provenance(command, "", "", "cpu", 0, ""))


def surface(weighting="vertices", value=1.0, unit="cm") -> SurfaceScore:
    return SurfaceScore(weighting, unit, value, 2 * value, 1.5 * value, 90.0)


def record(scene, variant="", ate=0.5, acc=1.0, benchmark="replica") -> Record:
    stage = StageScore("adjusted", TrajectoryScore(ate, 10, 1.0), (surface(value=acc),))
    return Record(benchmark, scene, variant, scene, FROM, Cost(10.0), (stage,))


def test_slam_stages_are_aligned_each_by_its_own_trajectory(tmp_path):
    scene = write_truth(tmp_path / "hall")
    write_result(tmp_path / "out", 0.01, 0.0)
    write_result(tmp_path / "out" / "online", 0.03, None)
    write_result(tmp_path / "out" / "adjusted", 0.02, None)
    scores = scored(made_by("run"), scene, ResultFolder(tmp_path / "out"))
    online, adjusted, final = scores.stages
    assert (online.stage, adjusted.stage, final.stage) == ("online", "adjusted", "final")
    assert adjusted.trajectory.ate == pytest.approx(2.0, rel=0.05)
    # Half of the poses are a centimetre up, half down.
    assert final.trajectory.ate == pytest.approx(1.0, rel=0.05)
    assert online.trajectory.ate == pytest.approx(3.0, rel=0.05)
    assert final.trajectory.scale == pytest.approx(4.0, rel=0.02)
    assert final.trajectory.keyframes_ate is not None
    for weighting in ("vertices", "area"):
        measured = final.surface(weighting)
        assert measured.unit == "cm"
        assert measured.accuracy < 0.3  # ICP takes out what the alignment gets wrong
    assert final.surface("area").chamfer < 0.3
    assert final.surface("area").ratio > 99
    assert (tmp_path / "out" / "report" / "bench_surface.png").is_file()
    assert (tmp_path / "out" / "report" / "bench_trajectory.png").is_file()


@pytest.mark.usefixtures("no_pictures")
def test_a_result_in_metres_is_aligned_rigidly_too(tmp_path):
    scene = write_truth(tmp_path / "hall")
    write_result(tmp_path / "out", 0.01, None)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    (plain,) = scored(made_by("run"), scene, ResultFolder(tmp_path / "out")).stages
    assert plain.trajectory.rigid_ate is None
    summary["metric_scale"] = {"origin": "depth sensor", "factor": 1.0, "deviation": 0.01}
    (tmp_path / "out" / "summary.json").write_text(json.dumps(summary))
    (metric,) = scored(made_by("run"), scene, ResultFolder(tmp_path / "out")).stages
    assert metric.trajectory.ate == plain.trajectory.ate
    # It calls itself metric at a quarter of the size: the way is off by three quarters of itself.
    truth = poses()[:, :3, 3]
    off = 75 * np.sqrt(np.square(truth - truth.mean(0)).sum(1).mean())
    assert metric.trajectory.rigid_ate == pytest.approx(off, rel=0.02)


def test_published_figures_with_depth_stand_beside_results_with_depth():
    name = "rgbd_dataset_freiburg1_desk"
    rows = [record(name, "rgb", benchmark="tum"), record(name, "rgb-d", benchmark="tum")]
    trajectory = replace(rows[1].stages[0].trajectory, rigid_ate=0.75)
    rows[1] = replace(rows[1], stages=(replace(rows[1].stages[0], trajectory=trajectory),))
    text = markdown(TUM, rows)
    table = text.split("## Trajectory with the depth of the sensor")[1].split("##")[0]
    lines = [line for line in table.splitlines() if line.startswith("|")]
    ours, theirs = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:4])
    assert "ElasticFusion (published)" in lines[0]
    assert ours[1:] == ["–"] * (len(ours) - 1)
    assert theirs[1:4] == ["0.750", "3.70", "2.53"]
    assert "Keetha" in table
    assert "Figures of SplaTAM" in text


@pytest.mark.usefixtures("no_pictures")
def test_a_result_without_refinement_is_the_papers_stage(tmp_path):
    scene = write_truth(tmp_path / "hall")
    write_result(tmp_path / "out", 0.01, 0.0, refined=False)
    write_result(tmp_path / "out" / "online", 0.03, None)
    write_result(tmp_path / "out" / "adjusted", 0.02, None)  # of an earlier run
    online, adjusted = scored(made_by("run"), scene, ResultFolder(tmp_path / "out")).stages
    assert (online.stage, adjusted.stage) == ("online", "adjusted")
    assert adjusted.trajectory.ate == pytest.approx(1.0, rel=0.05)
    assert adjusted.surface("area").chamfer < 0.3


@pytest.mark.usefixtures("no_pictures")
def test_known_poses_are_not_aligned_and_make_a_curve(tmp_path):
    scene = write_truth(tmp_path / "hall")
    result = tmp_path / "out"
    write_result(result, 0.0, 0.02, posed=True)
    write_mesh(result / "snapshots" / "5" / "mesh.ply", *wall(0.05))
    scores = scored(made_by("reconstruct"), scene, ResultFolder(result))
    (final,) = scores.stages
    assert final.trajectory is None
    # Two centimetres further away: a little less along the normals.
    assert final.surface("area").accuracy == pytest.approx(1.85, abs=0.15)
    assert final.surface("area").chamfer == pytest.approx(1.85, abs=0.15)
    (point,) = scores.curve
    assert point.seconds == 5
    assert point.surface.chamfer > 2 * final.surface("area").chamfer


@pytest.mark.long
def test_an_object_is_scored_in_millimetres_inside_its_masks(tmp_path):
    from io_samples import write_image

    scene = replace(write_truth(tmp_path / "jug"), kind="object")
    (tmp_path / "jug" / "cam_params.json").write_text(json.dumps(
        {"camera": {"w": 80, "h": 60, "fx": 60, "fy": 60, "cx": 39.5, "cy": 29.5}}
    ))  # fmt: skip
    for i in range(len(poses())):
        write_image(tmp_path / f"jug/results/frame{i:06d}.png", np.zeros((60, 80, 3), np.uint8))
        write_image(tmp_path / f"jug/results/mask{i:06d}.png", np.full((60, 80, 3), 255, np.uint8))
    write_result(tmp_path / "out", 0.0, 0.002, posed=True)
    (final,) = scored(made_by("reconstruct"), scene, ResultFolder(tmp_path / "out")).stages
    (measured,) = final.surfaces
    assert measured.unit == "mm"
    assert measured.accuracy == pytest.approx(1.85, abs=0.15)


def test_no_truth_and_no_mesh_are_sentences(tmp_path):
    scene = write_truth(tmp_path / "hall")
    write_result(tmp_path / "out", 0.0, 0.0, posed=True)
    (tmp_path / "out" / "mesh.ply").unlink()
    with pytest.raises(InputError, match="no mesh to score"):
        scored(made_by("reconstruct"), scene, ResultFolder(tmp_path / "out"))
    (tmp_path / "out" / "summary.json").write_text("{")
    with pytest.raises(InputError, match="is damaged"):
        _ = ResultFolder(tmp_path / "out").summary


def test_coarse_triangles_are_cut_without_changing_the_surface():
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0.01, 0, 1], [0.02, 0, 1], [0, 0, 1.01]])
    mesh = Surface(corners, np.array([[0, 1, 2], [3, 4, 5]]))
    fine = with_short_edges(mesh, 0.3)
    assert fine.areas.sum() == pytest.approx(mesh.areas.sum())
    a, b, c = (fine.vertices[fine.faces[:, i]] for i in range(3))
    edges = np.linalg.norm(np.stack([b - a, c - b, a - c]), axis=-1)
    assert edges.max() <= 0.3
    assert (fine.areas < 1e-3).sum() == 1  # the small one stays as it is


def test_records_survive_json_and_damage(tmp_path):
    full = replace(
        record("room0"), curve=(CurvePoint(5.0, None, surface("area")),), error="The disk was full."
    )
    write_json(tmp_path / "bench.json", full)
    assert read_record(tmp_path / "bench.json") == full
    text = (tmp_path / "bench.json").read_text()
    (tmp_path / "bench.json").write_text(text.replace('"benchmark"', '"contest"'))
    assert read_record(tmp_path / "bench.json") is None
    (tmp_path / "bench.json").write_text(text[:50])
    assert read_record(tmp_path / "bench.json") is None


def test_markdown_has_our_means_beside_published_ones_of_the_same_scenes():
    some = [record("room0", "paper", acc=1.0), record("room1", "paper", acc=2.0)]
    text = markdown(REPLICA, some)
    assert "Acc, after final BA and map update (cm) | Acc (paper)" in text
    row = [line for line in text.splitlines() if line.startswith("| room1, ")][1]
    assert "| 2.00 | 1.47 |" in row
    mean = [line for line in text.splitlines() if line.startswith("| mean ")]
    assert "| 1.50 | 1.55 |" in mean[1]  # (1.63 + 1.47) / 2: not the paper's mean of eight
    assert "not measured here (tab:replica_recon)" in text
    assert "geogs abc123" in text
    every = [record(scene, "paper", ate=0.3) for scene in paper.REPLICA_SCENES]
    mean = [line for line in markdown(REPLICA, every).splitlines() if line.startswith("| mean ")]
    assert "| 0.300 | 0.28 |" in mean[0]
    assert "| 2.09 |" in mean[1]


def test_an_ablation_compares_means_over_scenes_that_all_variants_finished(tmp_path):
    name = MAP_UPDATE.name
    rows = [
        record("a", "coherent", acc=1.0, benchmark=name),
        record("a", "per-keyframe", acc=2.0, benchmark=name),
        record("b", "coherent", acc=9.0, benchmark=name),
        replace(record("b", "per-keyframe"), benchmark=name, error="Lost.", cost=None, stages=()),
    ]
    text = markdown(MAP_UPDATE, rows)
    assert "| coherent | 1.00 | 2.09 |" in text
    assert "| per-keyframe | 2.00 | 2.16 |" in text
    assert "every variant finished: a." in text
    assert "| b, per-keyframe | Lost. |" in text
    write_report(tmp_path, MAP_UPDATE.title, [Chapter(MAP_UPDATE, rows)])
    page = (tmp_path / "report" / "index.html").read_text()
    assert "Lost." in page
    assert "2.16" in page
    assert len(json.loads((tmp_path / "results.json").read_text())) == 4


def test_published_figures_stand_beside_the_variant_they_belong_to():
    """The paper's settings, not the defaults; images alone, not depth; two minutes, not one."""

    def beside(benchmark, rows: list[Record], title: str, metric: str) -> dict[str, str]:
        table = next(t for t in result_tables(benchmark, rows) if t.title.endswith(title))
        place = table.header.index(f"{metric} (paper)")
        return {row[0]: row[place] for row in table.rows}

    names = [v.name for v in INITIALISATION.variants]
    rows = [record("room0", name, benchmark=INITIALISATION.name) for name in names]
    table = beside(INITIALISATION, rows, "(toolbox of Splat-SLAM)", "Acc")
    assert table == dict.fromkeys(names, "–") | {
        "paper-random-7": "2.77", "paper-random-10": "2.37",
        "paper-local-plane-7": "2.09", "paper-local-plane-10": "1.98",
    }  # fmt: skip
    both = replace(REPLICA, variants=(Variant("default"), Variant("paper")))
    rows = [record("room0", name) for name in ("default", "paper")]
    assert beside(both, rows, "(toolbox of Splat-SLAM)", "Acc") == {"default": "–", "paper": "1.63"}
    rows = [record(s, name) for name in ("default", "paper") for s in paper.REPLICA_SCENES]
    assert beside(both, rows, "alignment (cm)", "ATE") == {"default": "–", "paper": "0.28"}
    detail = beside(both, rows, "Splat-SLAM): every scene", "Acc")
    assert (detail["office4, paper"], detail["office4, default"]) == ("2.89", "–")
    rows = [record("scene0000_00", name, benchmark="scannet") for name in ("paper", "rgb-d")]
    of_paper = paper.SCANNET.value("scene0000_00", "ATE")
    table = beside(SCANNET, rows, "Sim(3) alignment (cm)", "ATE")
    assert table == {"paper": f"{of_paper:.2f}", "rgb-d": "–"}
    score = StageScore("final", None, (surface("points", unit="mm"),))
    names = ("default-120s", "paper-60s", "paper-120s", "colour-2dgs")
    rows = [replace(record("scan24", name), stages=(score,)) for name in names]
    assert beside(DTU, rows, "DTU's protocol", "CD") == {
        "default-120s": "–", "paper-60s": "–", "paper-120s": "0.53", "colour-2dgs": "–"
    }  # fmt: skip
    # A column without a figure is left out.
    others = [record("attic", "default"), record("attic", "paper")]
    assert all("(paper)" not in "".join(t.header) for t in result_tables(both, others))


def test_curves_are_drawn(tmp_path):
    curve = tuple(CurvePoint(s, 10, surface("area", 1 / s)) for s in (1.0, 2.0))
    made = [replace(record("scan24"), curve=curve)]
    write_report(tmp_path, DTU.title, [Chapter(DTU, made)])
    assert (tmp_path / "report" / "dtu-convergence.png").is_file()
    assert "dtu-convergence.png" in (tmp_path / "report" / "index.html").read_text()


def test_published_tables_are_complete_and_their_means_are_those_printed():
    tables = paper.REPLICA_SURFACE, paper.SCANNETPP, paper.SCANNET, paper.DTU, paper.TUM_RGBD
    for table in tables:
        for row in table.rows:
            assert len(row.values) == len(table.columns)
            # The paper rounds some means down, and some to a tenth.
            assert np.mean(row.values) == pytest.approx(row.mean, abs=0.04)
    assert paper.DTU.value("scan55", "CD") == 0.34
    assert paper.DTU.mean(["scan24", "scan37"], "CD") == pytest.approx(0.71)
    assert paper.DTU.mean(["other"], "CD") is None


@pytest.mark.long
def test_without_a_true_surface_held_out_images_judge_the_mesh(tmp_path):
    from geogs_bench.data.benchmark_scene import BenchmarkScene, Truth
    from geogs_synth.scene.textured_scene import scene_mesh
    from posed_layouts import render_room, write_dtu

    room = render_room(6, 12, 160, 120)
    scene = BenchmarkScene("scan7", write_dtu(room, tmp_path / "scan7"), Truth(), kind="scan")
    write_result(tmp_path / "out", 0.0, None, posed=True)
    write_mesh(tmp_path / "out" / "mesh.ply", *scene_mesh(lit_room(3).scene))
    with pytest.raises(InputError, match="held no image out"):
        scored(made_by("reconstruct"), scene, ResultFolder(tmp_path / "out"))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    scores = []
    for held_out in ([1, 4], ["000001.png", "000004.png"]):
        (tmp_path / "out" / "summary.json").write_text(json.dumps(summary | {"held_out": held_out}))
        found = scored(made_by("reconstruct"), scene, ResultFolder(tmp_path / "out"))
        assert found.stages == ()
        scores.append(found.photo)
    assert scores[0] == scores[1]
    assert scores[0].views == 2
    assert scores[0].ncc_median > 0.8
    record = Record("dtu", "scan7", "120s", "scan7/120s", FROM, Cost(9.0), photo=scores[0])
    assert "held-out views |" in markdown(DTU, [record])


def test_a_dtu_scan_is_scored_by_its_own_protocol_in_millimetres(tmp_path):
    import shutil

    from scipy.io import savemat

    from flat_rooms import flat_room
    from geogs_bench.data.scenes import find_dtu
    from posed_layouts import write_dtu

    shutil.rmtree(write_dtu(flat_room(), tmp_path / "scan7") / "mask")
    official = tmp_path / "SampleSet" / "MVS Data"
    (official / "ObsMask").mkdir(parents=True)
    (official / "Points" / "stl").mkdir(parents=True)
    vertices, faces = wall(n=121)
    box = np.array([[-12.0, -12, 0], [12, 12, 48]])
    mask = {"ObsMask": np.ones((25, 25, 49), np.uint8), "BB": box, "Res": 1.0}
    savemat(official / "ObsMask" / "ObsMask7_10.mat", mask)
    savemat(official / "ObsMask" / "Plane7.mat", {"P": np.array([[0.0], [0], [1], [0]])})
    write_mesh(official / "Points" / "stl" / "stl007_total.ply", 10 * vertices, faces)
    (scene,) = find_dtu(tmp_path)
    write_result(tmp_path / "out", 0.0, None, posed=True)
    write_mesh(tmp_path / "out" / "mesh.ply", 10 * vertices + [0, 0, 0.5], faces)
    (final,) = scored(made_by("reconstruct"), scene, ResultFolder(tmp_path / "out")).stages
    (measured,) = final.surfaces
    assert (measured.weighting, measured.unit) == ("points", "mm")
    # Half a millimetre away, a little less along the normals.
    assert measured.chamfer == pytest.approx(0.47, abs=0.04)
