"""``geogs bench`` end to end: a generated room at tiny settings, and what can go wrong."""

import json
import shutil
from pathlib import Path

import pytest

from geogs.cli import main as cli
from geogs_bench.bench import find_benchmark, listing
from geogs_bench.plan import Selection, find_scenes, make_jobs
from geogs_bench.runners.runner import Runner

pytestmark = pytest.mark.system

TINY = [
    "mapping.render-long-edge=96", "mapping.disk.stride=2", "input.stride=12",
    "search.least-steps=20", "search.steps-per-view=1", "mesh.voxel=0.08", "no-check-poses",
]  # fmt: skip


@pytest.fixture(scope="module")
def room(small_room, tmp_path_factory) -> Path:
    """The folder above a room of a few small frames."""
    folder = tmp_path_factory.mktemp("bench") / "rooms"
    shutil.copytree(small_room, folder / "den")
    return folder


@pytest.mark.long
def test_a_benchmark_runs_scores_and_resumes(room, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("geogs.evaluation.pages.shading._WIDTH", 120)
    output = tmp_path / "out"
    settings = [word for text in TINY for word in ("--set", text)]
    call = ["bench", "rooms", str(room), "--known-poses", "--budgets", "1", "-o", str(output),
            "--device", "cpu", *settings]  # fmt: skip
    code, done = cli.main(call), capsys.readouterr()
    assert code == 0, done.err
    assert "rooms-known-poses: den 1s" in done.err
    assert "Acc (cm)" in done.out
    (record,) = json.loads((output / "results.json").read_text())
    assert record["variant"] == "1s"
    assert record["error"] is None
    assert record["provenance"]["device"] == "cpu"
    assert record["cost"]["frames"] == 5
    assert record["cost"]["disks"] > 0
    assert record["cost"]["map_bytes"] > 0
    (stage,) = record["stages"]
    assert {s["weighting"] for s in stage["surfaces"]} == {"vertices", "area"}
    assert all(0 < s["accuracy"] < 30 for s in stage["surfaces"])
    assert (output / "den" / "1s" / "report" / "bench_surface.png").is_file()
    page = (output / "report" / "index.html").read_text()
    assert "../den/1s/report/bench_surface.png" in page
    assert "| den, 1s |" in (output / "results.md").read_text()
    assert cli.main(call) == 0
    assert "done before" in capsys.readouterr().err


def test_a_failing_scene_is_exit_code_2_with_its_reason_in_the_tables(room, tmp_path, capsys):
    output = tmp_path / "out"
    call = ["bench", "rooms", str(room), "-o", str(output), "--set", "input.stop=1"]
    assert cli.main([*call, "--device", "cpu"]) == 2
    assert "Traceback" not in capsys.readouterr().err
    (record,) = json.loads((output / "results.json").read_text())
    assert record["error"]
    assert record["error"].split()[0] in (output / "results.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["replica"], "replica needs a folder: the unpacked Replica.zip"),
        (["replicas", "/nowhere"], "did you mean replica"),
        (["tum", "/nowhere"], "/nowhere is not a folder"),
        (["tum", "{room}"], "holds no scene of tum"),
        (["rooms", "{room}", "--scenes", "attic"], "has no scene attic, only den"),
        (["rooms", "{room}", "--variants", "fast"], "has no variant fast"),
        (["rooms", "{room}", "--set", "=3"], "is no setting"),
        (["rooms", "{room}", "--budgets", "20"], "leave out --budgets"),
        (["tum", "{room}", "--known-poses"], "--known-poses is for rooms"),
        (
            ["rooms", "{room}", "--known-poses", "--budgets", "soon"],
            "budgets is ('soon',), but must be",
        ),
    ],
)
def test_wrong_options_are_one_sentence(room, tmp_path, capsys, arguments, sentence):
    argv = [text.format(room=room) for text in arguments]
    assert cli.main(["bench", *argv, "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert "Traceback" not in error
    assert error.count("\n") == 1


def test_the_list_names_every_benchmark_with_its_data(capsys):
    assert cli.main(["bench", "list"]) == 0
    text = capsys.readouterr().out
    assert text.strip() == listing()
    for name in ("replica", "scannet", "scannetpp", "tum", "7scenes", "dtu", "rooms", "objects",
                 "ablation-init", "ablation-update", "ablation-pose-lr", "ablation-losses",
                 "convergence", "light", "paper"):  # fmt: skip
        assert f"{name}\n" in text


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("mapping.foo=3", "error: geogs run has no option --mapping.foo; "),
        (
            "mapping.iterations=x",
            "error: mapping.iterations is 'x', but must be a whole number from 0",
        ),
    ],
)
def test_a_wrong_setting_is_found_before_anything_runs(room, tmp_path, capsys, setting, sentence):
    call = ["bench", "rooms", str(room), "-o", str(tmp_path / "out"), "--set", setting]
    assert cli.main(call) == 2
    error = capsys.readouterr().err
    assert error.startswith(sentence)
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_options_of_the_ablations_exist_and_make_a_difference(room):
    counts = {
        "ablation-update": 3, "ablation-pose-lr": 6, "ablation-losses": 8, "ablation-init": 8,
        "replica": 3, "convergence": 2,
    }  # fmt: skip
    for name, count in counts.items():
        benchmark = find_benchmark(name)
        jobs = make_jobs(benchmark, find_scenes(benchmark, room), Path("out"), Selection())
        settings = {json.dumps(Runner().settings(job.task), default=str) for job in jobs}
        assert len(jobs) == len(settings) == count
