"""Finding, verifying and reading weights files, and the command that lists them."""

import hashlib
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from droid_state import public_state
from geogs.application.progress.run_progress import RunProgress
from geogs.application.run import run
from geogs.application.run_settings import RunSettings
from geogs.cli.main import main
from geogs.config import Config, TrackingConfig, preset
from geogs.errors import InputError
from geogs.networks import weights_files
from geogs.networks.tensor_files import read_tensors
from geogs.networks.weights_files import CATALOGUE, checksum, find_weights, weights_folders
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.flow.droid import DroidFlow
from geogs.tracking.flow.operator_choice import build_operator, operator_found
from geogs.tracking.tracker import lone_tracker
from geogs.world.grid import SampleGrid
from tracking_scenes import CAMERA

TENSORS = {"a.weight": torch.arange(6.0).reshape(2, 3), "a.bias": torch.tensor([1.0])}


@pytest.fixture(autouse=True)
def places(tmp_path, monkeypatch) -> dict[str, Path]:
    """No weights but those that a test puts somewhere."""
    monkeypatch.delenv("GEOGS_CACHE", raising=False)
    monkeypatch.delenv("GEOGS_WEIGHTS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(weights_files, "PACKAGED", tmp_path / "package")
    found = {
        "variable": tmp_path / "mine",
        "cache": tmp_path / "cache" / "geogs" / "weights",
        "package": tmp_path / "package",
    }
    for folder in found.values():
        folder.mkdir(parents=True)
    return found


def put(path: Path) -> Path:
    path.write_bytes(b"weights of " + path.parent.name.encode())
    return path


# --- finding -----------------------------------------------------------------------------------


def test_order_is_given_then_variable_then_cache_then_package(places, tmp_path, monkeypatch):
    for name in ("package", "cache", "variable"):
        path = put(places[name] / "droid.pth")
        monkeypatch.setenv("GEOGS_WEIGHTS", str(places["variable"]))
        assert find_weights("droid") == path
    given = put(tmp_path / "given.pth")
    assert find_weights("droid", str(given)) == given


def test_the_variable_may_be_a_file_of_any_name(places, monkeypatch):
    put(places["cache"] / "droid.pth")
    path = put(places["variable"] / "my-droid.pth")
    monkeypatch.setenv("GEOGS_WEIGHTS", str(path))
    assert find_weights("droid") == path
    assert find_weights("own") == path


def test_a_file_known_for_something_else_is_left_alone(places, monkeypatch):
    cached = put(places["cache"] / "flow.safetensors")
    monkeypatch.setenv("GEOGS_WEIGHTS", str(put(places["variable"] / "droid.pth")))
    assert find_weights("own") == cached
    assert find_weights("droid") == places["variable"] / "droid.pth"


def test_of_several_files_the_first_of_the_catalogue_is_taken(places):
    put(places["cache"] / "metric3d-vit-small.onnx")
    put(places["package"] / "depth-anything-v2-small.onnx")
    assert find_weights("prior").name == "depth-anything-v2-small.onnx"


def test_the_cache_is_geogs_own_where_that_is_set(tmp_path, monkeypatch):
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path / "kept"))
    assert weights_folders()[0] == tmp_path / "kept" / "weights"


def test_what_is_not_there_is_told(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"There is no weights file .*nowhere.pth\."):
        find_weights("droid", str(tmp_path / "nowhere.pth"))
    with pytest.raises(InputError, match=r"No weights for the operator droid .*geogs weights"):
        find_weights("droid")
    monkeypatch.setenv("GEOGS_WEIGHTS", str(tmp_path / "gone"))
    with pytest.raises(InputError, match=r"GEOGS_WEIGHTS is .*gone, which does not exist\."):
        find_weights("own")


# --- checksums ---------------------------------------------------------------------------------


def test_without_a_published_checksum_nothing_is_claimed(places):
    found = checksum(put(places["cache"] / "droid.pth"))
    assert found.actual == hashlib.sha256(b"weights of weights").hexdigest()
    assert found.verdict == "no checksum is published, not verified"
    assert not found.is_wrong


def test_another_file_of_a_published_name_is_not_read(places):
    path = places["package"] / "flow.safetensors"
    save_file(TENSORS, path)
    (places["package"] / "SHA256SUMS").write_text(f"01064c6d{'0' * 56}  flow.safetensors\n")
    assert checksum(path).verdict.startswith("WRONG checksum, 01064c6d0")
    with pytest.raises(InputError, match=r"its SHA-256 begins with \w{8}, not 01064c6d; get it ag"):
        read_tensors(path)


def test_packaged_weights_are_checked_against_their_list(places):
    path = put(places["package"] / "flow.safetensors")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    (places["package"] / "SHA256SUMS").write_text(f"{digest}  flow.safetensors\n")
    assert checksum(path).verdict == "checksum verified"
    path.write_bytes(b"cut off")
    assert checksum(path).is_wrong
    assert checksum(put(places["cache"] / "flow.safetensors")).published == ""


def test_names_of_the_catalogue_are_unique():
    names = [known.name for known in CATALOGUE]
    assert len(names) == len(set(names))


# --- reading -----------------------------------------------------------------------------------


@pytest.mark.parametrize("legacy", [False, True])
def test_checkpoints_are_read(tmp_path, legacy):
    path = tmp_path / "some.pth"
    torch.save(TENSORS, path, _use_new_zipfile_serialization=not legacy)
    found = read_tensors(path)
    assert found.keys() == TENSORS.keys()
    assert torch.equal(found["a.weight"], TENSORS["a.weight"])


def test_safetensors_are_read(tmp_path):
    save_file(TENSORS, tmp_path / "some.safetensors")
    assert torch.equal(read_tensors(tmp_path / "some.safetensors")["a.bias"], TENSORS["a.bias"])


class Trap:
    """Would write a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.write_text, (self.path, "sprung")


def test_what_would_run_code_is_not_run(tmp_path):
    sprung = tmp_path / "sprung"
    torch.save({"a": Trap(sprung)}, tmp_path / "trap.pth")
    (tmp_path / "plain.pth").write_bytes(pickle.dumps({"a": Trap(sprung)}, protocol=2))
    for name in ("trap.pth", "plain.pth"):
        with pytest.raises(InputError, match="could run any program"):
            read_tensors(tmp_path / name)
    assert not sprung.exists()


@pytest.mark.parametrize("name", ["cut.pth", "cut.safetensors", "text.pth", "empty.pth"])
def test_damage_is_told_in_one_sentence(tmp_path, name):
    path = tmp_path / name
    whole = tmp_path / "whole"
    if name == "cut.safetensors":
        save_file(TENSORS, whole)
    else:
        torch.save(TENSORS, whole)
    content = {"cut": whole.read_bytes()[:-40], "text": b"<html>not found</html>", "empty": b""}
    path.write_bytes(content[path.stem])
    with pytest.raises(InputError, match="is damaged, or no") as caught:
        read_tensors(path)
    assert "\n" not in str(caught.value)


def test_more_than_tensors_is_told(tmp_path):
    torch.save({"epoch": 3, **TENSORS}, tmp_path / "training.pth")
    with pytest.raises(InputError, match=r"holds more than named tensors \(such as epoch\)"):
        read_tensors(tmp_path / "training.pth")
    torch.save([TENSORS["a.bias"]], tmp_path / "list.pth")
    with pytest.raises(InputError, match="holds no named tensors"):
        read_tensors(tmp_path / "list.pth")


# --- the command -------------------------------------------------------------------------------


def test_the_list_tells_where_files_are_and_where_they_are_had(places, capsys):
    path = put(places["cache"] / "droid.pth")
    assert main(["weights"]) == 0
    out = capsys.readouterr().out
    assert f"{path} (no checksum is published, not verified)" in out
    assert out.count("not here") == len(CATALOGUE) - 1
    for known in CATALOGUE:
        assert all(text in out for text in (known.name, known.origin, known.licence))


def test_verify_tells_what_a_file_holds(tmp_path, capsys):
    path = tmp_path / "droid.pth"
    torch.save(TENSORS, path)
    assert main(["weights", "verify", str(path)]) == 0
    out = capsys.readouterr().out
    assert hashlib.sha256(path.read_bytes()).hexdigest() in out
    assert "2 tensors, 7 numbers" in out
    assert "not verified" in out


def test_verify_ends_with_2_where_a_file_cannot_be_used(places, tmp_path, capsys):
    wrong = places["package"] / "flow.safetensors"
    save_file(TENSORS, wrong)
    (places["package"] / "SHA256SUMS").write_text(f"{'0' * 64}  flow.safetensors\n")
    broken = tmp_path / "droid.pth"
    broken.write_bytes(b"no weights")
    for path, sentence in (
        (tmp_path / "none.pth", "does not exist; give a file that does."),
        (wrong, "is not the published file of that name"),
        (broken, "is damaged, or no PyTorch checkpoint."),
    ):
        assert main(["weights", "verify", str(path)]) == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert error.count("\n") == 1
    assert main(["weights", "verify"]) == 2
    assert "needs a file" in capsys.readouterr().err


# --- choosing the operator ---------------------------------------------------------------------


def test_the_configuration_names_the_operator(places):
    grid = SampleGrid(CAMERA)
    for name in ("auto", "classical"):
        assert isinstance(build_operator(TrackingConfig(operator=name), grid), ClassicalFlow)
    path = places["cache"] / "droid.pth"
    torch.save(public_state(), path)
    assert isinstance(build_operator(TrackingConfig(operator="droid"), grid), DroidFlow)
    config = TrackingConfig(operator="droid", weights=str(path))
    assert isinstance(lone_tracker(CAMERA, Config(tracking=config)).map.operator, DroidFlow)


def test_the_papers_preset_takes_the_network_where_it_is_found_and_says_so(places, tmp_path):
    grid, paper = SampleGrid(CAMERA), preset("paper").tracking
    # A file that is not known by name may be for anything.
    save_file(TENSORS, places["cache"] / "other.safetensors")
    assert isinstance(build_operator(paper, grid), ClassicalFlow)
    (sentence,) = said_of_the_operator(preset("paper"), tmp_path)
    assert "by the classical operator, as there is no droid.pth" in sentence
    assert str(places["cache"]) in sentence
    path = places["cache"] / "droid.pth"
    torch.save(public_state(), path)
    assert isinstance(build_operator(paper, grid), DroidFlow)
    (sentence,) = said_of_the_operator(preset("paper"), tmp_path)
    assert sentence == f"note: image motion is measured by DROID-SLAM's network, {path}."
    given = tmp_path / "mine.pth"
    torch.save(public_state(), given)
    chosen = replace(paper, weights=str(given))
    assert isinstance(build_operator(chosen, grid), DroidFlow)
    assert str(given) in str(operator_found(chosen))
    with pytest.raises(InputError, match=r"no weights file .*none\.pth"):
        build_operator(replace(paper, weights=str(tmp_path / "none.pth")), grid)


@pytest.mark.parametrize("name", ["default", "fast", "accurate"])
def test_other_presets_take_no_network_that_lies_about(places, tmp_path, name):
    torch.save(public_state(), places["cache"] / "droid.pth")
    assert isinstance(build_operator(preset(name).tracking, SampleGrid(CAMERA)), ClassicalFlow)
    assert said_of_the_operator(preset(name), tmp_path) == []


def said_of_the_operator(config: Config, folder: Path) -> list[str]:
    """What a run says before it finds that there is no video."""
    said = Said()
    with pytest.raises(InputError):
        run(RunSettings((folder / "none.mp4",), config, device="cpu"), said)
    return [sentence for sentence in said.sentences if "image motion" in sentence]


class Said(RunProgress):
    def __init__(self) -> None:
        self.sentences: list[str] = []

    def write(self, text: str) -> None:
        self.sentences.append(text)


@pytest.mark.parametrize("name", ["own", "droid"])
def test_an_operator_without_weights_is_told(name):
    with pytest.raises(InputError, match=f"No weights for the operator {name} were found"):
        build_operator(TrackingConfig(operator=name), SampleGrid(CAMERA))
