"""The harness: plans, failures, resuming, options."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bench_results import FakeRunner, options_of, write_truth
from geogs.errors import InputError
from geogs_bench.benchmark import Benchmark, Variant
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option
from geogs_bench.harness import Harness, clear
from geogs_bench.machine import machine_name, program_version
from geogs_bench.plan import Selection, make_jobs, merged
from geogs_bench.tables.columns import COST, area_layout, trajectory_layout


def benchmark(scenes: list[BenchmarkScene], **changes) -> Benchmark:
    values = {
        "name": "halls",
        "title": "Halls",
        "command": "run",
        "find": lambda root: scenes,
        "needs": "halls",
        "source": "here",
        "layouts": (trajectory_layout(), area_layout(), COST),
    }
    return Benchmark(**values | changes)


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch) -> None:
    """Scores come without their pictures, which take longer than they do."""
    monkeypatch.setattr("geogs_bench.scoring.scores.draw", lambda *_: None)


@pytest.fixture
def scenes(tmp_path) -> list[BenchmarkScene]:
    return [write_truth(tmp_path / "data" / name, name) for name in ("attic", "cellar", "hall")]


def run(test: Benchmark, scenes, output: Path, runner: FakeRunner, selection=None, **how):
    jobs = make_jobs(test, scenes, output, selection or Selection())
    return Harness(test, output, runner, lambda text: None, **how).run(jobs)


def test_every_scene_is_run_scored_and_reported(scenes, tmp_path):
    output = tmp_path / "out"
    records = run(benchmark(scenes), scenes, output, FakeRunner())
    assert [r.scene for r in records] == ["attic", "cellar", "hall"]
    first = records[0]
    assert first.error is None
    assert first.provenance.seed == 3
    assert first.provenance.commit == program_version()
    assert first.provenance.machine == machine_name()
    assert len(first.provenance.config_hash) == 12
    assert first.cost.disks == 1234
    assert first.cost.frames_per_second == 5.0
    assert [s.stage for s in first.stages] == ["online", "final"]
    text = (output / "results.md").read_text()
    assert "| mean |" in text
    assert "| attic |" in text
    assert (output / "report" / "index.html").is_file()
    assert len(json.loads((output / "results.json").read_text())) == 3


def test_a_scene_that_fails_does_not_stop_the_others(scenes, tmp_path):
    failing = {"attic": InputError("The video is empty."), "cellar": ZeroDivisionError("oh")}
    runner = FakeRunner(failing)
    records = run(benchmark(scenes), scenes, tmp_path / "out", runner)
    assert [r.error for r in records] == [
        "The video is empty.",
        "ZeroDivisionError: oh (see cellar/bench_error.txt)",
        None,
    ]
    assert "Traceback" in (tmp_path / "out" / "cellar" / "bench_error.txt").read_text()
    text = (tmp_path / "out" / "results.md").read_text()
    assert "| attic | The video is empty. |" in text
    runner.failing = {}
    again = run(benchmark(scenes), scenes, tmp_path / "out", runner)
    assert runner.done == ["attic", "cellar", "hall", "attic", "cellar"]
    assert all(record.error is None for record in again)


def test_finished_scenes_are_not_run_again_unless_something_changed(scenes, tmp_path):
    test, output, runner = benchmark(scenes), tmp_path / "out", FakeRunner()
    run(test, scenes[:1], output, runner)
    run(test, scenes[:1], output, runner)
    assert runner.done == ["attic"]
    record = (output / "attic" / "bench.json").stat().st_mtime_ns
    run(test, scenes[:1], output, runner, rescore=True)
    assert runner.done == ["attic"]
    assert (output / "attic" / "bench.json").stat().st_mtime_ns > record
    changed = Selection(options=(Option("mapping.iterations", "9"),))
    run(test, scenes[:1], output, runner, changed)
    assert runner.done == ["attic"] * 2
    run(test, scenes[:1], output, runner, changed, fresh=True)
    assert runner.done == ["attic"] * 3


def test_scenes_of_an_earlier_call_stay_in_the_tables(scenes, tmp_path):
    test, output, runner = benchmark(scenes), tmp_path / "out", FakeRunner()
    run(test, scenes[:1], output, runner)
    records = run(test, scenes[2:], output, runner)
    assert {r.scene for r in records} == {"attic", "hall"}


def test_an_interruption_stops_and_keeps_what_was_finished(scenes, tmp_path):
    runner = FakeRunner({"cellar": KeyboardInterrupt()})
    with pytest.raises(KeyboardInterrupt):
        run(benchmark(scenes), scenes, tmp_path / "out", runner)
    assert runner.done == ["attic", "cellar"]
    assert "| attic |" in (tmp_path / "out" / "results.md").read_text()
    assert not (tmp_path / "out" / "cellar" / "bench.json").exists()


def test_variants_have_folders_and_their_options_win(scenes, tmp_path):
    test = benchmark(
        scenes,
        variants=(
            Variant("slow", (Option("mapping.iterations", "20"),)),
            Variant("fast", (Option("mapping.iterations", "2"),)),
        ),
    )
    selection = Selection(options=(Option("mapping.iterations", "5"), Option("seed", "1")))
    jobs = make_jobs(test, scenes[:1], tmp_path, selection)
    assert [job.task.output for job in jobs] == [tmp_path / "attic/slow", tmp_path / "attic/fast"]
    assert [options_of(job.task)["mapping.iterations"] for job in jobs] == ["20", "2"]
    assert options_of(jobs[0].task)["seed"] == "1"
    with pytest.raises(InputError, match="no variant medium, only slow, fast"):
        make_jobs(test, scenes, tmp_path, Selection(variants=("medium",)))


def test_depth_is_used_where_it_is_there(scenes, tmp_path):
    depth = Variant("rgb-d", (Option("depth", "sensor"),), needs_depth=True)
    test = benchmark(scenes, variants=(Variant("rgb"), depth))
    scenes = [scenes[0], replace(scenes[1], has_depth=True)]
    jobs = make_jobs(test, scenes, tmp_path, Selection())
    assert [(job.scene.name, job.variant, options_of(job.task).get("depth")) for job in jobs] == [
        ("attic", "rgb", None), ("cellar", "rgb", None), ("cellar", "rgb-d", "sensor"),
    ]  # fmt: skip
    with pytest.raises(InputError, match="No scene has depth images, which rgb-d needs"):
        make_jobs(test, scenes[:1], tmp_path, Selection(variants=("rgb-d",)))


def test_budgets_and_the_baseline_make_variants(scenes, tmp_path):
    test = benchmark(scenes, command="reconstruct", budgets=(120.0,))
    selection = Selection(budgets=(20.0, 60.0), baseline=True)
    jobs = make_jobs(test, scenes[:1], tmp_path, selection)
    assert [(job.variant, job.task.command, options_of(job.task)["budget"]) for job in jobs] == [
        ("20s", "reconstruct", "20s"),
        ("60s", "reconstruct", "60s"),
        ("colour-2dgs-20s", "colour-2dgs", "20s"),
        ("colour-2dgs-60s", "colour-2dgs", "60s"),
    ]
    with pytest.raises(InputError, match="leave out --budgets"):
        make_jobs(benchmark(scenes), scenes, tmp_path, selection)


def test_later_options_win_whatever_their_spelling():
    options = merged([Option("a.b_c", "1"), Option("d")], [Option("a.b-c", "2")])
    assert options == (Option("a.b-c", "2"), Option("d"))
    assert [o.arguments() for o in options] == [["--a.b-c", "2"], ["--d"]]


def test_only_the_files_of_an_earlier_run_are_cleared_away(tmp_path):
    folder, elsewhere = tmp_path / "den", tmp_path / "mine"
    own = ["online/notes.txt", "snapshots/5/photo.png", "video.mp4", "depth_fusion/sub/mesh.ply"]
    left = ["mesh.ply", "bench.json", "online/mesh.ply", "snapshots/5/map.safetensors"]
    for name in (*own, *left):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    elsewhere.mkdir()
    (elsewhere / "mesh.ply").touch()
    (folder / "snapshots" / "7").symlink_to(elsewhere)
    assert clear(folder) == folder
    assert [name for name in own if not (folder / name).is_file()] == []
    assert [name for name in left if (folder / name).exists()] == []
    assert (elsewhere / "mesh.ply").is_file()
