"""No result is taken for another's."""

import json

from geogs.application.results.output_folder import free_folder


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
