"""What a dry run foretells: stages, folder, time and memory by earlier results."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from geogs.application.plan import earlier_results, expected_seconds, plan_for, run_stages
from geogs.application.run_settings import RunSettings
from geogs.cli.main import main
from geogs.config import CalibrationConfig, Config, InputConfig
from geogs.geometry.camera import Camera
from geogs.io.sources.sniff import open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from io_samples import write_images

CAMERA = Camera(80.0, 80.0, 31.5, 23.5, 64, 48)
LAST = ("frames", "bundle adjustment", "mapping", "mesh", "report")


def put(folder: Path, frames: int, seconds: float, **other: object) -> None:
    folder.mkdir(parents=True)
    write_intrinsics(folder / "intrinsics.json", CAMERA)
    summary = {
        "frames": frames, "seconds": {"total": seconds}, "peak_memory_bytes": 2**30,
        "interrupted": False, "device": "cpu",
    }  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary | other))


@pytest.mark.parametrize(
    ("intrinsics", "readout", "refine", "calibrates"),
    [
        ("auto", "auto", True, True), ("auto", 0.0, False, False), ("auto", 0.0, True, True),
        ("70,72,40,29", 0.0, True, False),
    ],
)  # fmt: skip
def test_stages_follow_from_what_is_known(tmp_path, intrinsics, readout, refine, calibrates):
    write_images(tmp_path, [f"{k}.png" for k in range(3)], 80, 60)
    config = Config(
        input=InputConfig(intrinsics, readout=readout), calibration=CalibrationConfig(refine)
    )
    source = open_source([tmp_path], config.input)
    settings = RunSettings((tmp_path,), config)
    found = run_stages(settings, source, maps_at_end=True)
    assert found == (("calibration", *LAST) if calibrates else LAST)
    assert "map refinement" in run_stages(settings, source, maps_at_end=False)
    assert run_stages(replace(settings, sfm=True), source, maps_at_end=True) == ()


def test_time_is_that_of_results_beside_it(tmp_path):
    put(tmp_path / "a", 100, 60.0)
    put(tmp_path / "stopped", 100, 1.0, interrupted=True)
    put(tmp_path / "gpu", 100, 2.0, device="NVIDIA H200")
    put(tmp_path / "none", 0, 3.0)
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "summary.json").write_text("[")
    known = list(earlier_results(tmp_path, "cpu"))
    assert [result.seconds for result in known] == [60.0]
    assert [result.seconds for result in earlier_results(tmp_path, "cuda")] == [2.0]
    for times in (0.25, 1, 4, 9):
        low, high = expected_seconds(known, times * known[0].pixels)
        assert low < 60 * times < high or times == 9
        assert low < 60 * times**0.8 < high
    plan = plan_for(LAST, tmp_path / "new", 200, CAMERA, "cpu")
    assert plan.lines()[-2].endswith(f", by 1 earlier result in {tmp_path}/.")
    assert plan.lines()[-1].startswith("Memory: about 1.0 GB")


@pytest.mark.parametrize("frames", [None, 50])
def test_what_nothing_tells_is_unknown(tmp_path, frames):
    plan = plan_for(LAST, tmp_path / "new", frames, CAMERA, "cpu")
    assert (plan.seconds, plan.memory) == (None, None)
    assert plan.lines()[-1].startswith("Time and memory: unknown, as ")


def test_a_dry_run_says_what_would_be_done_and_does_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_images(tmp_path / "images", [f"{k}.png" for k in range(4)], 80, 60)
    put(Path("out/images"), 4, 30.0)
    words = ["run", "images", "--intrinsics", "70,72,40,29", "--device", "cpu", "--dry-run"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "Result: out/images-2, made on " in text
    assert "Stages: calibration, frames, bundle adjustment, mapping, mesh, report." in text
    assert main([*words, "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)["plan"]
    assert plan["output"] == "out/images-2"
    assert plan["seconds"][0] < 30 < plan["seconds"][1]
    assert main([*words, "-o", "out/images"]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert [path.name for path in Path("out").iterdir()] == ["images"]
