"""Which results words name, and what cannot be joined; Ray is not needed to find that out."""

import json

import pytest

from geogs.errors import InputError, OutputError
from geogs_fleet import join_run
from geogs_fleet.fleet_options import JoinOptions
from geogs_fleet.join_run import _names, finished_results, run_join


def test_a_result_is_one_and_a_fleet_is_all_that_are_done(tmp_path):
    for name in ("fleet/b", "fleet/a", "fleet/failed", "lone"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "map.safetensors").touch()
    (tmp_path / "fleet" / "without").mkdir()
    states = {"b": "done", "a": "done", "failed": "failed", "without": "done", "../lone": "done"}
    rows = [{"name": name, "state": state} for name, state in states.items()]
    (tmp_path / "fleet" / "fleet.json").write_text(json.dumps({"sources": [*rows, 3]}))
    assert finished_results(str(tmp_path / "lone")) == [tmp_path / "lone"]
    assert finished_results(str(tmp_path / "fleet")) == [tmp_path / f"fleet/{n}" for n in "ab"]
    for nothing in (tmp_path, tmp_path / "none", "s3://bucket/result"):
        assert finished_results(str(nothing)) == []
    (tmp_path / "fleet" / "fleet.json").write_text("{")
    with pytest.raises(InputError):
        finished_results(str(tmp_path / "fleet"))


def test_equal_names_are_told_apart(tmp_path):
    folders = [tmp_path / "x" / "a", tmp_path / "y" / "a", tmp_path / "b", tmp_path / "z" / "a"]
    assert _names(folders) == ["a", "a-2", "b", "a-3"]


@pytest.mark.parametrize("output", ["", "s3://bucket/joined"])
def test_the_joint_result_needs_a_folder(output):
    with pytest.raises(InputError, match="needs a folder that all machines see"):
        run_join(JoinOptions(("a", "b"), output=output))


@pytest.mark.parametrize("kept", ['{"source": "a + b"}', '{"source": "video.mp4"}', "{", "[]"])
def test_a_result_is_replaced_only_where_that_is_asked_for(tmp_path, monkeypatch, kept):
    def begun(address: str) -> None:
        raise InterruptedError

    monkeypatch.setattr(join_run, "ray_cluster", begun)
    summary = tmp_path / "summary.json"
    summary.write_text(kept)
    with pytest.raises(OutputError, match="--overwrite to replace it"):
        run_join(JoinOptions(("a", "b"), output=str(tmp_path)))
    assert [*tmp_path.iterdir()] == [summary]
    assert summary.read_text() == kept
    for options in (
        JoinOptions(("a", "b"), output=str(tmp_path), overwrite=True),
        JoinOptions(("a", "b"), output=str(tmp_path / "new")),
    ):
        with pytest.raises(InterruptedError):
            run_join(options)
