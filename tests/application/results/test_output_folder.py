"""No file of an earlier result stays beside a new one, and no result is taken for another's."""

import json

from geogs.application.results.output_folder import free_folder, remove_previous_output

OURS = [
    "summary.json", "mesh.ply", "eval.json", "map.safetensors", "keyframes/000012.jpg",
    "keyframes/000012.mask.png", "keyframes/rows.safetensors", "report/index.html",
    "report/mesh_truth.png", "depth_fusion/mesh.ply", "adjusted/trajectory.tum",
]  # fmt: skip
THEIRS = ["notes.txt", "keyframes/mine.jpg", "export/tum/trajectory.txt", "checkpoint/manifest"]


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def fill(folder, names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("old")


def test_only_files_of_a_result_are_removed(tmp_path):
    fill(tmp_path, [*OURS, *THEIRS, "online/mesh.ply"])
    remove_previous_output(tmp_path, new_stages=["online"])
    assert files(tmp_path) == {*THEIRS, "online/mesh.ply"}
    assert not (tmp_path / "report").exists()
    remove_previous_output(tmp_path)
    assert files(tmp_path) == set(THEIRS)


def test_links_are_not_followed(tmp_path):
    fill(tmp_path / "elsewhere", ["000001.jpg"])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "keyframes").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "out" / "mesh.ply").symlink_to(tmp_path / "elsewhere" / "000001.jpg")
    remove_previous_output(tmp_path / "out")
    assert files(tmp_path / "elsewhere") == {"000001.jpg"}


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
