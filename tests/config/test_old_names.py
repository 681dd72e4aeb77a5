"""Settings under their former names: on the command line, and in the config.yaml of a result."""

import logging

import pytest

from geogs.application.results.remesh import mesh_settings
from geogs.cli.main import main
from geogs.cli.reconstruct import parse as reconstruct_options
from geogs.cli.run import parse as run_options
from geogs.config import Config, MeshConfig, ReconstructConfig
from geogs.config.leaves import leaves
from geogs.config.old_names import REMOVED, RENAMED, present_values
from geogs.errors import InputError

NOW = {leaf.name for tree in (Config, ReconstructConfig) for leaf in leaves(tree)}


def test_old_names_are_none_of_the_present_ones() -> None:
    assert set(RENAMED.values()) <= NOW
    assert not (REMOVED | set(RENAMED)) & NOW
    assert not REMOVED & set(RENAMED)


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_a_renamed_option_works_with_a_warning(old: str, caplog) -> None:
    new = RENAMED[old]
    parse = reconstruct_options if new.startswith("search.") else run_options
    leaf = next(x for tree in (ReconstructConfig, Config) for x in leaves(tree) if x.name == new)
    group, _, own = old.rpartition(".")
    switch, value = leaf.kind.base is bool, "3" if leaf.kind.base is int else "0.5"
    words = [f"--{group}.no-{own}"] if switch else [f"--{old}", value]
    with caplog.at_level(logging.WARNING):
        made = parse(["source", "--device", "cpu", *words]).config
    for name in new.replace("-", "_").split("."):
        made = getattr(made, name)
    assert made == (not switch and float(value))
    assert f"{old} is called {new} now" in caplog.text


@pytest.mark.parametrize("old", ["tracking.huber", "mapping.depth.window", "prior.no-depth"])
def test_an_option_that_is_none_any_more_says_so(old: str, capsys) -> None:
    with pytest.raises(InputError, match=r"is no longer a setting; its value is fixed\.$"):
        run_options(["source", f"--{old}", "1"])
    assert main(["run", "source", f"--{old}=1"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_saved_config_is_read_by_the_present_names(tmp_path, caplog) -> None:
    (tmp_path / "config.yaml").write_text("mesh: {detail: 2.5, close_holes: 4, max_depth: null}")
    with caplog.at_level(logging.WARNING):
        assert mesh_settings(tmp_path) == MeshConfig(detail=2.5)
    said = "mesh.close-holes, mesh.max-depth in config.yaml are no longer settings and left out."
    assert [record.getMessage() for record in caplog.records] == [said]
    old = {"share": 0.1, "deviation": 5.0, "near": 0.2}
    assert present_values(old, "sensor", "x") == {"ratio": 0.1, "deviation": 5.0}
