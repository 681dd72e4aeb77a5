"""What may be told a run that is gone on with, beside where it is."""

from dataclasses import replace
from pathlib import Path

import pytest

from geogs.application.checkpoints import run_state
from geogs.application.checkpoints.run_state import RunMetadata
from geogs.application.run import continued
from geogs.application.run_settings import RunSettings
from geogs.cli.run import parse
from geogs.config import Config, InputConfig, MeshConfig
from geogs.errors import InputError

BEGUN = RunSettings((Path("/data/a.mp4"),), Config(seed=7, input=InputConfig(stride=2)))
OUT = Path("/results/a")


class Saved:
    """A checkpoint that says nothing but with which settings the run was begun."""

    def __init__(self, output: Path) -> None:
        assert output == OUT
        self.metadata = RunMetadata(BEGUN, "cpu", "", None)
        self.settings = BEGUN


@pytest.fixture(autouse=True)
def _saved(monkeypatch):
    monkeypatch.setattr(run_state, "SavedRun", Saved)


def settings(*argv: str, device: str = "cpu") -> RunSettings:
    """With which the command would go on."""
    options = parse(["--resume", str(OUT), *argv])
    asked = RunSettings(**{name: getattr(options, name) for name in vars(BEGUN)})
    return continued(RunMetadata(BEGUN, device, "", None), asked, OUT)


def test_the_run_goes_on_as_it_was_begun():
    assert settings() == replace(BEGUN, device="cpu")


def test_what_changes_neither_poses_nor_map_may_be_given():
    config = replace(BEGUN.config, mesh=MeshConfig(voxel=0.02, colour=False))
    assert settings(
        "--mesh.voxel", "0.02", "--mesh.no-colour", "--checkpoint-every", "5", "--depth-mesh",
        "--online-results", "--device", "cpu", "-o", str(OUT),
    ) == replace(
        BEGUN, config=config, checkpoint_every=5.0, depth_mesh=True, online_results=True,
        device="cpu", output=OUT,
    )  # fmt: skip
    assert settings("--device", "cuda:1", device="cuda").device == "cuda:1"
    assert settings(device="cuda").device == "cuda"
    assert settings("--seed", "7", "--stride", "2") == settings()


@pytest.mark.parametrize(
    "argv",
    ["--seed 8", "--stride 1", "--mapping.iterations 3", "-o /elsewhere", "--preset fast",
     "--mask other.png", "--tracking.weights /a/flow.safetensors", "--preset default"],
)  # fmt: skip
def test_what_would_compute_something_else_is_refused(argv):
    with pytest.raises(InputError, match=r"--resume goes on with .*; leave out"):
        settings(*argv.split())


def test_the_video_may_lie_elsewhere_by_now():
    """Whether it is the same is told by its fingerprint, when it is open."""
    assert settings("/moved/a.mp4").source == (Path("/moved/a.mp4"),)


@pytest.mark.parametrize("address", ["camera:0", "-", "rtsp://host/path", "play:/data/a.mp4"])
def test_what_does_not_wait_is_not_gone_on_with(address):
    with pytest.raises(InputError, match="A live source cannot be read again"):
        settings("--", address)


def test_the_kind_of_device_stays():
    with pytest.raises(InputError, match="The run was on cpu, and can only go on there"):
        settings("--device", "cuda")


def test_files_are_named_so_that_they_are_found_from_elsewhere(tmp_path, monkeypatch):
    (tmp_path / "camera.txt").touch()
    monkeypatch.chdir(tmp_path)
    config = Config(input=InputConfig(intrinsics="camera.txt"))
    found = RunSettings((Path("a.mp4"),), config, Path("out")).absolute()
    assert found.source == (tmp_path / "a.mp4",)
    assert found.config.input.intrinsics == str(tmp_path / "camera.txt")
    assert found.config.tracking == config.tracking
    assert found.output is None
    assert RunSettings().absolute().config.input.intrinsics == "auto"
