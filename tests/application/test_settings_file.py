"""The settings of a result are what ``--config`` takes."""

import random
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from geogs.application.settings_file import read_settings, settings_text
from geogs.cli import reconstruct, run
from geogs.cli.main import main
from geogs.config import Config, InputConfig, Preset, preset, reconstruct_preset
from geogs.config.leaves import Leaf, leaves, with_values
from geogs.errors import InputError

CPU = ("--device", "cpu")


def another(leaf: Leaf, rng: random.Random) -> object:
    """A value that a setting can have, near its default."""
    kind = leaf.kind
    tried: list[object] = [*kind.choices, leaf.default]
    if kind.base is bool:
        return not leaf.default
    if isinstance(leaf.default, int | float) and not kind.choices:
        tried += [leaf.default + 2, leaf.default * 0.75]
    allowed = [value for value in tried if kind.allows(value) and isinstance(value, kind.base)]
    return rng.choice(allowed or [leaf.default])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", get_args(Preset))
def test_settings_go_round(tmp_path: Path, name: Preset, seed: int):
    rng = random.Random(f"{name}{seed}")
    for base in (preset(name, on_gpu=bool(seed % 2)), reconstruct_preset(name)):
        config = base
        for leaf in rng.sample(leaves(base), 40):
            try:
                config = with_values(config, {leaf.path: another(leaf, rng)})
            except InputError:  # beside the other settings of its group
                continue
        file = tmp_path / "config.yaml"
        file.write_text(settings_text(config))
        assert read_settings(file, type(base)()) == config
        assert config != base


def test_what_is_printed_is_what_is_taken(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in ("run", "reconstruct"):
        changes = ["--preset", "fast", "--stride", "3", "--mesh.voxel", "1e-3"]
        assert main([command, "--print-config", *CPU, *changes]) == 0
        text = capsys.readouterr().out
        Path("c.yaml").write_text(text)
        assert main([command, "--print-config", *CPU, "--config", "c.yaml"]) == 0
        assert capsys.readouterr().out == text
        assert "stride: 3" in text


def test_the_command_line_wins_over_the_file_and_the_file_over_the_preset(tmp_path):
    file = tmp_path / "some.yaml"
    file.write_text("input: {long-edge: 300, stride: 4}\nmesh: {voxel: 1e-3}\n")
    given = ["x", *CPU, "--preset", "fast", "--config", str(file), "--stride", "2"]
    fast = preset("fast")
    found = run.parse(given).config
    assert found.input == InputConfig(long_edge=300, stride=2)
    assert found.mesh == replace(fast.mesh, voxel=0.001)
    assert found.mapping == fast.mapping
    assert reconstruct.parse(given).config.input.long_edge == 300


def test_a_former_name_is_read_from_a_file(tmp_path):
    file = tmp_path / "old.yaml"
    file.write_text("input: {field_of_view: 60}")
    assert read_settings(file, Config()).input == InputConfig(working_field_of_view=60)


def test_files_that_settings_name_are_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mask.png").touch()
    text = settings_text(Config(input=InputConfig(mask=Path("mask.png"))))
    assert f"mask: {tmp_path}/mask.png" in text


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("mapping: {windw: 3}", "mapping.windw, which is no setting here"),
        ("mapping: 3", "has mapping, which is no setting here"),
        ("input: {stride: {a: 1}}", "input.stride.a, which is no setting here"),
        ("- 1", "a value without a name"),
        ("input: {stride: zero}", "input.stride is 'zero', but must be a whole number"),
        ("input: {stride: true}", "input.stride is True, but must be"),
        ("input: {stride: 0}", "input.stride is 0, but must be"),
        ("mesh: {colour: 'off'}", "mesh.colour is 'off', but must be on or off"),
        ("input: {mask: [1, 2]}", "input.mask is"),
        ("a: *b", "not YAML of plain values"),
        ("!!python/object:os.system {}", "not YAML of plain values"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(tmp_path, text, sentence):
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_settings(file, Config())
    assert sentence in str(caught.value)


def test_an_empty_file_changes_nothing(tmp_path):
    (tmp_path / "none.yaml").write_text("# all as usual\n")
    assert read_settings(tmp_path / "none.yaml", Config()) == Config()
