"""The suite of the paper's tables: which jobs for which folders, stand-ins marked, one report."""

import json
import shutil
from pathlib import Path

import pytest

from bench_results import FakeRunner, options_of, write_truth
from flat_rooms import SIZE, flat_room
from geogs.cli import main as cli
from geogs.errors import InputError
from geogs_bench import published as paper
from geogs_bench.bench import SuitePart, run_parts, suite_parts
from geogs_bench.benchmark import Benchmark
from geogs_bench.catalogue.paper_tables import PAPER_TABLES, PAPER_TABLES_SMALL, SUITES
from geogs_bench.harness import Harness
from geogs_bench.plan import Selection
from geogs_bench.runners.runner import Runner
from geogs_bench.scoring.room_scores import TrueSurface, read_true_surface
from io_samples import write_images
from posed_layouts import write_colmap_text, write_dtu, write_scannet

pytestmark = pytest.mark.system

STAND_INS = {
    "replica-stand-in": ["synthetic-0", "synthetic-1"],
    "scannet-stand-in": ["synthetic-kinect"],
    "scannetpp-stand-in": ["synthetic-phone"],
    "dtu-stand-in": ["synthetic-0"],
    "convergence-stand-in": ["synthetic-0"],
    "ablation-init-stand-in": ["synthetic-0"],
    "ablation-update-stand-in": ["synthetic-0"],
    "ablation-pose-lr-stand-in": ["synthetic-0"],
    "ablation-losses-stand-in": ["synthetic-0"],
    "light-stand-in": ["synthetic-0", "synthetic-0-light"],
}


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch, small_room) -> list[str]:
    """Stand-ins are copies of one small room; returns the names of those that were asked for."""
    asked: list[str] = []

    def render(cells, folder, names, say) -> Path:
        for cell in cells:
            asked.append(cell.name)
            shutil.copytree(small_room, folder / cell.name)
        return folder

    known: dict[tuple, TrueSurface | None] = {}

    def surface_once(truth, camera, T_cw) -> TrueSurface | None:
        key = truth.surface.read_bytes(), truth.culling, camera, T_cw.tobytes()
        if key not in known:
            known[key] = read_true_surface(truth, camera, T_cw)
        return known[key]

    monkeypatch.setattr("geogs_bench.scoring.slam_scores.read_true_surface", surface_once)
    monkeypatch.setattr("geogs_bench.bench.render_cells", render)
    monkeypatch.setattr("geogs_bench.scoring.scores.draw", lambda *_: None)
    return asked


def parts_of(data, output, suite=PAPER_TABLES, **selection) -> list[SuitePart]:
    return suite_parts(suite, data, output, Selection(**selection), lambda text: None)


def scenes_of(parts: list[SuitePart]) -> dict[str, list[str]]:
    """Names of the scenes by that of the benchmark."""
    return {p.benchmark.name: [*dict.fromkeys(j.scene.name for j in p.jobs)] for p in parts}


def published_columns(benchmark: Benchmark) -> list[str]:
    return [c.title for layout in benchmark.layouts for c in layout.columns if c.published]


def write_data(root: Path) -> None:
    """A scene of every data set of the paper, as their users have them."""
    for name in ("room0", "office2"):
        scene = write_truth(root / "Replica" / name, name)
        write_images(scene.source / "results", ["frame000000.jpg"], *SIZE)
    scan = root / "scannet" / "scene0000_00"
    scan.mkdir(parents=True)
    write_scannet(flat_room(4), scan)
    phone = root / "data" / "8b5caf3398" / "iphone"
    names = [f"frame_{10 * i:06d}.jpg" for i in range(4)]
    write_images(phone / "rgb", names, *SIZE)
    write_colmap_text(flat_room(4), phone / "colmap", names)
    for name in ("scan24", "scan55"):
        write_dtu(flat_room(), root / "DTU" / name)
    official = root / "DTU" / "SampleSet" / "MVS Data"
    (official / "ObsMask").mkdir(parents=True)
    (official / "Points" / "stl").mkdir(parents=True)
    for number in (24, 55):
        (official / "ObsMask" / f"ObsMask{number}_10.mat").touch()


def test_without_data_every_table_has_a_marked_stand_in(tmp_path, stand_ins):
    parts = parts_of(None, tmp_path)
    assert scenes_of(parts) == STAND_INS
    assert sorted(stand_ins) == sorted({name for names in STAND_INS.values() for name in names})
    for part in parts:
        assert part.benchmark.title.endswith("(synthetic stand-in)")
        assert "stand in for the paper's scenes" in part.benchmark.notes[0]
        assert part.benchmark.published == ()
        assert published_columns(part.benchmark) == []
        folder = tmp_path / part.benchmark.name
        assert all(job.task.output.is_relative_to(folder) for job in part.jobs)


def test_the_paper_and_the_default_have_rows_in_every_table(tmp_path):
    for part in parts_of(None, tmp_path):
        presets = {options_of(job.task).get("preset") for job in part.jobs}
        assert presets == {None, "paper"}, part.benchmark.name
        variants = {job.variant for job in part.jobs}
        if (table := PUBLISHED.get(part.benchmark.name.removesuffix("-stand-in"))) is not None:
            assert variants >= {*table.columns, *(f"paper-{name}" for name in table.columns)}


PUBLISHED = {
    "ablation-init": paper.ABLATION_INIT,
    "ablation-update": paper.ABLATION_UPDATE,
    "ablation-pose-lr": paper.ABLATION_POSE_LR,
    "ablation-losses": paper.ABLATION_LOSSES,
}


def test_plain_rows_are_the_plain_pipeline_and_others_say_so(tmp_path):
    for part in parts_of(None, tmp_path):
        online = {j.variant for j in part.jobs if "online-results" in options_of(j.task)}
        if part.benchmark.name.startswith("ablation-pose-lr"):
            assert online == {job.variant for job in part.jobs}
        else:
            assert online <= {"online"}
        notes = " ".join(part.benchmark.notes)
        assert not online or "mapped on the way (--online-results)" in notes


def test_the_papers_scenes_are_found_in_the_folders_that_a_user_has(tmp_path, stand_ins):
    write_data(tmp_path / "mine")
    parts = parts_of(tmp_path / "mine", tmp_path / "out")
    rooms = ["room0", "office2"]
    assert {name: sorted(found) for name, found in scenes_of(parts).items()} == {
        "replica": sorted(rooms), "scannet": ["scene0000_00"], "scannetpp": ["8b5caf3398"],
        "dtu": ["scan24", "scan55"], "convergence": ["scan55"], "ablation-init": sorted(rooms),
        "ablation-update": sorted(rooms), "ablation-pose-lr": sorted(rooms),
        "ablation-losses": ["scan24"],
        "light-stand-in": ["synthetic-0", "synthetic-0-light"],
    }  # fmt: skip
    assert sorted(stand_ins) == ["synthetic-0", "synthetic-0-light"]
    asked = parts_of(tmp_path / "mine", tmp_path / "asked", scenes=("room0",))
    names = ["replica", "convergence-other", "ablation-init", "ablation-update", "ablation-pose-lr",
             "ablation-losses-other"]  # fmt: skip
    assert scenes_of(asked) == {name: ["room0"] for name in names}
    for part in parts:
        is_real = not part.benchmark.name.endswith("stand-in")
        assert bool(part.benchmark.published) == is_real
        assert bool(published_columns(part.benchmark)) == is_real


def test_other_scenes_are_run_and_marked_without_the_papers_figures(tmp_path, small_room):
    shutil.copytree(small_room, tmp_path / "mine" / "rooms" / "den")
    parts = {p.benchmark.name: p for p in parts_of(tmp_path / "mine", tmp_path / "out")}
    other = parts["replica-other"]
    assert [*dict.fromkeys(job.scene.name for job in other.jobs)] == ["den"]
    assert other.benchmark.title.endswith("(other scenes than the paper's)")
    assert published_columns(other.benchmark) == []
    assert "ablation-init-other" in parts
    assert "scannet-stand-in" in parts
    write_data(tmp_path / "mine")
    beside = scenes_of(parts_of(tmp_path / "mine", tmp_path / "beside"))
    assert "den" not in beside["replica"]
    named = parts_of(tmp_path / "mine", tmp_path / "named", scenes=("den",), variants=("default",))
    assert scenes_of(named) == {"replica-other": ["den"], "convergence-other": ["den"]}


def test_scenes_and_variants_that_are_asked_for_leave_tables_out(tmp_path, stand_ins):
    parts = parts_of(None, tmp_path, scenes=("synthetic-kinect",))
    assert scenes_of(parts) == {"scannet-stand-in": ["synthetic-kinect"]}
    assert stand_ins == ["synthetic-kinect"]
    parts = parts_of(None, tmp_path / "b", variants=("paper-coherent", "online"))
    assert {(p.benchmark.name, j.variant) for p in parts for j in p.jobs} == {
        ("replica-stand-in", "online"), ("scannet-stand-in", "online"),
        ("scannetpp-stand-in", "online"), ("ablation-update-stand-in", "paper-coherent"),
    }  # fmt: skip
    with pytest.raises(InputError, match="there is no scene attic, only synthetic-0"):
        parts_of(None, tmp_path / "c", scenes=("attic",))
    with pytest.raises(InputError, match="no table of paper has a variant fast"):
        parts_of(None, tmp_path / "d", variants=("fast",))
    with pytest.raises(InputError, match="is not a folder"):
        parts_of(tmp_path / "none", tmp_path / "e")


def test_budgets_and_the_baseline_concern_known_poses_alone(tmp_path):
    parts = parts_of(None, tmp_path, budgets=(20.0,), baseline=True)
    commands = {p.benchmark.name: {j.task.command for j in p.jobs} for p in parts}
    assert commands["convergence-stand-in"] == {"reconstruct", "colour-2dgs"}
    assert commands["replica-stand-in"] == {"run"}
    for part in parts:
        budgets = {options_of(job.task).get("budget") for job in part.jobs}
        assert budgets == ({"20s"} if part.benchmark.budgets else {None})


def test_options_exist_and_every_row_differs(tmp_path):
    for suite in SUITES.values():
        for part in parts_of(None, tmp_path / suite.name, suite):
            settings = {
                (j.scene.name, json.dumps(Runner().settings(j.task), default=str))
                for j in part.jobs
            }
            assert len(settings) == len(part.jobs)


def test_the_small_suite_is_small_and_has_every_table(tmp_path):
    parts = parts_of(None, tmp_path, PAPER_TABLES_SMALL)
    assert [*scenes_of(parts)] == [*STAND_INS]
    assert sum(len(part.jobs) for part in parts) <= 26
    for part in parts:
        assert all(
            name.startswith("synthetic-small-") for name in scenes_of([part])[part.benchmark.name]
        )
        assert part.benchmark.budgets in ((), (8.0,))


def test_one_report_has_the_tables_of_all_and_goes_on_where_it_stopped(tmp_path):
    runner, said = FakeRunner({"synthetic-1": InputError("The video is empty.")}), []
    parts = parts_of(None, tmp_path, variants=("default", "per-keyframe"))
    parts = [p for p in parts if p.benchmark.name.split("-")[0] in ("replica", "light", "ablation")]

    def harness(benchmark: Benchmark, folder: Path) -> Harness:
        return Harness(benchmark, folder, runner, said.append)

    chapters = run_parts("The tables", parts, tmp_path, harness)
    names = ["replica-stand-in", "ablation-update-stand-in", "light-stand-in"]
    assert [chapter.benchmark.name for chapter in chapters] == names
    records = json.loads((tmp_path / "results.json").read_text())
    assert [r["benchmark"] for r in records] == [names[0]] * 2 + [names[1]] + [names[2]] * 2
    for record in records:
        assert (tmp_path / record["folder"] / "bench.json").is_file()
    text = (tmp_path / "results.md").read_text()
    for chapter in chapters:
        assert f"# {chapter.benchmark.title}\n" in text
    assert "| synthetic-1, default | The video is empty. |" in text
    assert "(paper)" not in text
    page = (tmp_path / "report" / "index.html").read_text()
    assert "light-stand-in: Trajectory" in page
    assert page.count("Steady and changing light on the same path (synthetic stand-in)") == 1
    ran = len(runner.done)
    run_parts("The tables", parts, tmp_path, harness)
    assert runner.done[ran:] == ["synthetic-1"]
    assert said.count("  done before") == ran - 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["paper", "{data}", "--small"], "paper-small renders its own sequences; leave out"),
        (["paper", "--result", "{data}"], "--result is for edges; paper scores its own"),
        (["paper", "--small", "--set", "mapping.foo=3"], "has no option --mapping.foo"),
        (["papers"], "did you mean paper"),
        (["tum", "--small"], "--small is for motions and paper; tum has one size"),
    ],
)
def test_wrong_calls_are_one_sentence(tmp_path, capsys, arguments, sentence):
    argv = [text.format(data=tmp_path) for text in arguments]
    assert cli.main(["bench", *argv, "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_command_makes_a_table_of_a_stand_in(tmp_path, capsys):
    output = tmp_path / "out"
    call = ["bench", "paper", "--small", "-o", str(output), "--device", "cpu",
            "--variants", "all", "--set", "search.least-steps=20",
            "--set", "search.steps-per-view=1", "--budgets", "1"]  # fmt: skip
    assert cli.main(call) == 0, capsys.readouterr().err
    (record,) = json.loads((output / "results.json").read_text())
    assert (record["benchmark"], record["scene"]) == (
        "ablation-losses-stand-in",
        "synthetic-small-0",
    )
    assert record["cost"]["map_bytes"] > 40 * record["cost"]["disks"]
    assert "ablation-losses-stand-in: Surface" in capsys.readouterr().out
