"""No result is taken for another's; no empty folder is left."""

import json

import pytest

from geogs.application.results.output_folder import claimed, free_folder


def test_sources_of_one_name_get_folders_of_their_own(tmp_path):
    wanted = tmp_path / "images"
    assert free_folder(wanted, "a") == wanted
    wanted.mkdir()
    assert free_folder(wanted, "a") == wanted
    (wanted / "summary.json").write_text(json.dumps({"fingerprint": "a"}))
    assert free_folder(wanted, "a") == wanted
    assert free_folder(wanted, "b") == tmp_path / "images-2"
    (tmp_path / "images-2").mkdir()
    (tmp_path / "images-2" / "summary.json").write_text('{"source": "images"}')
    assert free_folder(wanted, "b") == tmp_path / "images-3"


def test_a_folder_that_was_made_for_nothing_goes_again(tmp_path):
    for wanted in (tmp_path / "out" / "room", tmp_path):
        with pytest.raises(KeyboardInterrupt), claimed(wanted):
            raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    with claimed(tmp_path / "out" / "room") as folder:
        (folder / "summary.json").write_text("{}")
    assert (tmp_path / "out" / "room" / "summary.json").is_file()
