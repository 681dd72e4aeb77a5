"""All files of a command take their places together: disk full at each write, killed anywhere."""

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import geogs
from disk_faults import contents, every_fault, full_disk, kill
from geogs.application import rescale
from geogs.application.checkpoints.checkpoint import Checkpoint
from geogs.application.driver import Driver, Outcome, Work
from geogs.application.evaluate import evaluate
from geogs.application.export.export import export
from geogs.application.interrupt import Stop
from geogs.application.progress.run_progress import RunProgress
from geogs.application.result_settings import (
    EvalSettings,
    ExportSettings,
    RemeshSettings,
    RescaleSettings,
)
from geogs.application.results import revise, surfaces
from geogs.application.results.output_folder import claimed
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.results.surfaces import write_stage
from geogs.application.run_settings import RunSettings
from geogs.cli.main import main
from geogs.config import Config, InputConfig, MeshConfig
from geogs.errors import DeviceError, OutputError
from geogs.evaluation.model_view.levelling import Level
from geogs.io.sources.sniff import open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.ply_writer import write_mesh, write_splats
from geogs.mesh.triangle_mesh import Mesh
from geogs.stopwatch import Stopwatch
from geogs.types import MapSnapshot, MetricScale, RenderedKeyframe, Trajectory, Uncertainty
from saved_results import CAMERA, make_result

pytestmark = pytest.mark.system

FACTOR = 2.0
MESH = Mesh.from_triangles(np.eye(3, dtype=np.float32) + 9, np.array([[0, 1, 2]]))
MEASURED = ("summary.json", "report/index.html", ".geogs.json")
"""What differs between two runs: times, and sums of what holds them."""


class SavedScene:
    """What a run would have made, from a result."""

    def __init__(self, result: SavedResult) -> None:
        self._result = result
        self.stopwatch = Stopwatch()
        self.config = Config()
        self.frames = len(result.trajectory.timestamps)

    def trajectory(self) -> Trajectory:
        return self._result.trajectory

    def keyframe_trajectory(self) -> Trajectory:
        return self._result.trajectory

    def uncertainty(self) -> Uncertainty:
        times = self._result.trajectory.timestamps
        return Uncertainty(times, *(np.full(len(times), 1e-3) for _ in range(3)))

    def snapshot(self) -> MapSnapshot:
        return self._result.disks

    @cached_property
    def _renders(self) -> list[RenderedKeyframe]:
        return list(self._result.renders)

    def renders(self) -> Sequence[RenderedKeyframe]:
        return self._renders

    def renderer(self):
        return self._result.renderer

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        return self._renders

    def rows(self) -> dict:
        return {}

    def statistics(self) -> dict[str, object]:
        return {}


class SavedWork(Work):
    """A run that has nothing more to compute."""

    def __init__(self, scene: SavedScene, images: Path) -> None:
        self.scene = scene
        self.source = open_source([images], InputConfig(intrinsics="70,72,40,29"))

    outcome = Outcome.FINISHED

    def complete(self, driver: Driver, checkpoint: Checkpoint, new: Path) -> Outcome:
        write_stage(new, self.scene, driver.progress, "online")
        return self.outcome


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A result with everything in it."""
    folder = make_result(tmp_path_factory.mktemp("made"))
    disks = geogs.load_result(folder).disks
    write_splats(folder / "splats.ply", disks, np.full((len(disks), 3), 0.25))
    write_intrinsics(folder / "intrinsics.json", CAMERA)
    write_mesh(folder / "mesh.ply", MESH.vertices, MESH.faces, None, MESH.normals)
    (folder / "summary.json").write_text('{"source": "planes", "scale": "arbitrary", "frames": 5}')
    (folder / "report").mkdir()
    return folder


@pytest.fixture
def quick(monkeypatch) -> None:
    """What takes time and is the same each time is not computed."""
    surface = Mesh(MESH.vertices + 1, MESH.faces, MESH.normals)
    monkeypatch.setattr(surfaces, "extract_mesh", lambda *_: surface)
    found = MetricScale("a known distance", FACTOR, 0.01)
    monkeypatch.setattr(rescale, "find_scale", lambda *_: found)
    for module in ("results.result_page", "evaluate"):  # pages without a model
        monkeypatch.setattr(f"geogs.application.{module}.shown_model", lambda *_, **__: None)
    level = Level(np.eye(3), None)
    for module in ("result_page", "saved_result"):
        monkeypatch.setattr(f"geogs.application.results.{module}.upright", lambda *_: level)
    monkeypatch.setattr("geogs.mapping.rendered.averaged_over_planes", lambda depth, *_: depth)


def a_run(scene: SavedScene, images: Path) -> Callable[[Path], object]:
    """``geogs run`` without its computations; ``geogs reconstruct`` has the same driver."""

    def work(folder: Path) -> None:
        settings = RunSettings((images,), Config(), folder, "cpu", checkpoint_every=0.0)
        with claimed(folder) as output:
            device = torch.device("cpu")
            driver = Driver(settings, output, device, RunProgress(), Stop())
            driver.complete(SavedWork(scene, images))

    return work


@pytest.fixture
def commands(made, tmp_path) -> dict[str, Callable[[Path], object]]:
    """By name, what each command does to the folder of a result."""
    images = tmp_path / "images"
    images.mkdir()
    for n in range(2):
        cv2.imwrite(str(images / f"{n}.png"), np.full((60, 80, 3), 90 * n, np.uint8))
    exports = {
        f"export {to}": lambda folder, to=to: export(ExportSettings(folder, to, device="cpu"))
        for to in ("colmap", "kitti")
    }
    truth = made / "trajectory.tum"
    return {
        "run": a_run(SavedScene(load_result(made)), images),
        "mesh": lambda folder: revise.remesh(RemeshSettings(folder, MeshConfig(), device="cpu")),
        "scale": lambda folder: rescale.rescale(RescaleSettings(folder, "height:1.6", "cpu")),
        "eval": lambda folder: evaluate(
            EvalSettings(folder, truth, surface=False, alignment="none", plots=False)
        ),
        **exports,
    }


NAMES = ["run", "mesh", "scale", "eval", "export colmap", "export kitti"]


@pytest.fixture
def begun(made, commands, tmp_path) -> Callable[[str], dict[str, bytes]]:
    """Makes the folder of a result that a command may work on; its files."""

    def fill(command: str) -> dict[str, bytes]:
        folder, ran = tmp_path / "out", tmp_path / "ran"
        if command == "run" and not ran.exists():  # only into a folder with a list of its files
            commands["run"](ran)
            commands["mesh"](ran)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(ran if command == "run" else made, folder)
        return contents(folder)

    return fill


def same(found: dict[str, bytes], wanted: dict[str, bytes]) -> bool:
    """Whether files are the same but for times."""
    names = wanted.keys() - {*MEASURED}
    return found.keys() == wanted.keys() and all(found[n] == wanted[n] for n in names)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("command", NAMES)
def test_a_full_disk_leaves_the_former_result(begun, commands, tmp_path, command):
    folder = tmp_path / "out"
    before, times = begun(command), 0
    step = 2 if command in ("run", "export colmap") else 1  # each file is opened and synchronised
    for _ in every_fault(full_disk, folder, lambda: commands[command](folder), step):
        assert contents(folder) == before
        times += 1
    assert times >= 8
    assert contents(folder) != before


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("command", NAMES)
def test_a_command_that_is_killed_is_undone_or_completed_by_the_next(
    begun, commands, tmp_path, command
):
    folder = tmp_path / "out"
    begun(command)
    commands[command](folder)
    new = contents(folder)
    old, completed = begun(command), 0
    # Every point is tried in tests/guard/test_replacement.py; here, that commands go that way.
    step = 7 if command in ("run", "export colmap") else 2
    for _ in every_fault(kill, folder, lambda: commands[command](folder), step):
        load_result(folder)
        with claimed(folder):
            pass
        found = contents(folder)
        assert found == old or same(found, new)
        if found != old:
            completed += 1
            begun(command)
    assert completed > 0


@pytest.mark.usefixtures("quick")
def test_scaling_what_cannot_be_scaled_further_says_so_and_changes_nothing(begun, tmp_path, capsys):
    folder = tmp_path / "out"
    for said in ({}, {"factor": "much"}, {"factor": 0}, {"factor": [1]}, 3, {"factor": 1e400}):
        begun("scale")
        (folder / "summary.json").write_text(json.dumps({"metric_scale": said}))
        before = contents(folder)
        assert main(["scale", str(folder), "--from", "height:1.6", "--device", "cpu"]) == 2
        assert "does not say by which factor it is metric" in capsys.readouterr().err
        assert contents(folder) == before


def refusal(work: Callable[[], object]) -> str:
    """What is said where something cannot be written; nothing where it was."""
    try:
        work()
    except OutputError as error:
        return str(error)
    return ""


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("command", NAMES)
def test_links_in_the_folder_lead_no_command_out_of_it(begun, commands, tmp_path, command):
    elsewhere, folder = tmp_path / "elsewhere", tmp_path / "out"
    names = ["keyframes", "report", "online", "depth_fusion", "snapshots", "export"]
    names += [f"export/{to}" for to in ("colmap", "kitti")]
    for name in names:
        begun(command)
        place = folder / name
        if place.is_dir():
            shutil.rmtree(elsewhere, ignore_errors=True)
            shutil.move(place, elsewhere)
        else:
            elsewhere.mkdir(exist_ok=True)
        place.parent.mkdir(exist_ok=True)
        place.symlink_to(elsewhere)
        outside, inside = contents(elsewhere), contents(folder)
        said = refusal(lambda: commands[command](folder))
        assert not said or (name.partition("/")[0] in said and contents(folder) == inside)
        assert contents(elsewhere) == outside
        assert place.is_symlink()


@pytest.mark.usefixtures("quick")
def test_the_same_run_writes_the_same_bytes(commands, tmp_path):
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        commands["run"](folder)
    one, other = map(contents, folders)
    assert len(one) > 15
    assert same(one, other)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("outcome", [Outcome.STOPPED, Outcome.MEMORY_FULL])
def test_an_interrupted_run_never_replaces_a_complete_result(
    commands, tmp_path, monkeypatch, outcome
):
    folder = tmp_path / "kept"
    commands["run"](folder)
    before = contents(folder)
    assert json.loads((folder / "summary.json").read_text())["interrupted"] is False
    monkeypatch.setattr(SavedWork, "outcome", outcome)
    for number in (2, 3):  # what was interrupted before is not replaced either
        with suppress(DeviceError):
            commands["run"](folder)
        beside = tmp_path / f"kept-{number}"
        assert json.loads((beside / "summary.json").read_text())["interrupted"] is True
        assert (beside / "trajectory.tum").is_file()
        assert contents(folder) == before
    monkeypatch.setattr(SavedWork, "outcome", Outcome.FINISHED)
    commands["run"](beside)  # the end of a resumed run
    assert json.loads((beside / "summary.json").read_text())["interrupted"] is False
