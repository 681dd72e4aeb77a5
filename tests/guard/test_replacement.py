"""Files take their places together; no link is followed, and nothing foreign is deleted."""

import errno
import json
import os
import shutil
from pathlib import Path

import pytest

from disk_faults import contents, every_fault, full_disk, kill
from geogs.errors import OutputError
from geogs.guard.atomic import prepare_output_folder, unwritable, write_text
from geogs.guard.directory import Directory
from geogs.guard.replacement import _FILES, LIST, is_half_done, recover, replaced

OLD = {"mesh.ply": "old mesh", "keyframes/000001.jpg": "a", "keyframes/000002.jpg": "b"}
NEW = {"mesh.ply": "new mesh", "keyframes/000001.jpg": "c", "report/index.html": "page"}


def write(folder: Path, files: dict[str, str], what: str = "result") -> None:
    with replaced(folder, what) as new:
        for name, text in files.items():
            write_text(new / name, text)


def texts(folder: Path) -> dict[str, str]:
    return {name: data.decode() for name, data in contents(folder).items() if name != LIST}


def test_a_result_takes_the_place_of_another_and_leaves_what_is_not_of_it(tmp_path):
    write_text(tmp_path / "notes.txt", "mine")
    write_text(tmp_path / "keyframes/mine.jpg", "mine")
    write(tmp_path, OLD)
    write(tmp_path, {"export/cloud.ply": "points"}, "beside")
    write(tmp_path, {"eval.json": "errors"}, "part")
    kept = {"notes.txt": "mine", "keyframes/mine.jpg": "mine", "export/cloud.ply": "points"}
    assert texts(tmp_path) == OLD | kept | {"eval.json": "errors"}
    write_text(tmp_path / "keyframes/000002.jpg", "changed by somebody")
    write(tmp_path, NEW)
    assert texts(tmp_path) == NEW | kept | {"keyframes/000002.jpg": "changed by somebody"}
    write(tmp_path, {"summary.json": "{}"})
    assert not (tmp_path / "report").exists()
    assert json.loads((tmp_path / LIST).read_text())["files"].keys() == {"summary.json"}


def test_what_an_error_ends_leaves_all_as_it_was(tmp_path):
    write(tmp_path, OLD)
    before = contents(tmp_path)

    def fail() -> None:
        with replaced(tmp_path, "result") as new:
            write_text(new / "mesh.ply", "half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    (tmp_path / "report").write_text("a file where a folder is to be")
    with pytest.raises(OutputError, match="report is a link or no folder"):
        write(tmp_path, NEW)
    (tmp_path / "report").unlink()
    (tmp_path / "summary.json").mkdir()
    with pytest.raises(OutputError, match="json is a folder, and a file is to be there"):
        write(tmp_path, {**NEW, "summary.json": "{}"}, "part")
    (tmp_path / "summary.json").rmdir()
    assert contents(tmp_path) == before
    assert sorted(os.listdir(tmp_path)) == sorted([LIST, "keyframes", "mesh.ply"])


@pytest.mark.parametrize("name", ["keyframes", "report"])
def test_folders_that_are_links_are_refused_before_the_work(tmp_path, name):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match=rf"{name} is a link or no folder, and no link is"):
        write(tmp_path / "out", NEW)
    with pytest.raises(OutputError, match="is a link or no folder"):
        write(tmp_path / "out", NEW, "beside")
    assert os.listdir(tmp_path / "elsewhere") == []
    assert os.listdir(tmp_path / "out") == [name]


def test_files_that_are_links_are_replaced_and_not_followed(tmp_path):
    write_text(tmp_path / "precious", "mine")
    (tmp_path / "out").mkdir()
    write(tmp_path / "out", OLD)
    for name in ("mesh.ply", "keyframes/000002.jpg", LIST):
        (tmp_path / "out" / name).unlink()
        (tmp_path / "out" / name).symlink_to(tmp_path / "precious")
    write(tmp_path / "out", NEW)
    assert (tmp_path / "precious").read_text() == "mine"
    assert (tmp_path / "out/mesh.ply").read_text() == "new mesh"
    assert not (tmp_path / "out/mesh.ply").is_symlink()
    assert not (tmp_path / "out" / LIST).is_symlink()


def test_a_list_from_somebody_else_deletes_nothing(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    write_text(tmp_path / "precious.txt", "mine")
    write_text(out / "precious.txt", "mine")
    (out / "there").symlink_to(tmp_path)
    with Directory.opened(tmp_path) as place:
        digest = place.sha256("precious.txt")
    outside = ["../precious.txt", str(tmp_path / "precious.txt"), "there/precious.txt", "..", ""]
    wrong = {"precious.txt": "0" * 64, **dict.fromkeys(outside, digest)}
    for said in ({"files": wrong}, {"files": 3}, [], "text"):
        (out / LIST).write_text(json.dumps(said))
        write(out, {"mesh.ply": "mesh"})
        assert texts(tmp_path)["precious.txt"] == texts(out)["precious.txt"] == "mine"
    (out / LIST).unlink()
    os.mkfifo(out / LIST)
    write(out, {"mesh.ply": "mesh"})


def test_folders_of_new_files_that_were_made_elsewhere_are_left_alone(tmp_path):
    for name in (".geogs.7.ready", ".geogs.8.new", ".geogs.new"):
        write_text(tmp_path / name / "precious.txt", "theirs")
    write_text(tmp_path / "precious.txt", "mine")
    before = contents(tmp_path)
    assert not is_half_done(tmp_path)
    recover(tmp_path)
    assert contents(tmp_path) == before


def test_a_result_without_a_list_is_not_mixed_with_a_new_one(tmp_path):
    write_text(tmp_path / "map.safetensors", "of an earlier geogs")
    with pytest.raises(OutputError, match=r"no list of its files .*: delete it, or give another"):
        write(tmp_path, NEW)
    write(tmp_path, NEW, "part")
    assert texts(tmp_path) == NEW | {"map.safetensors": "of an earlier geogs"}


@pytest.mark.parametrize("what", ["result", "part", "beside"])
def test_a_full_disk_leaves_all_as_it_was(tmp_path, what):
    write(tmp_path, OLD)
    before = contents(tmp_path)
    times = 0
    for _ in every_fault(full_disk, tmp_path, lambda: write(tmp_path, NEW, what)):
        assert contents(tmp_path) == before
        assert not is_half_done(tmp_path)
        times += 1
    assert times > 2 * len(NEW)
    assert NEW.items() <= texts(tmp_path).items()


def test_what_cannot_be_written_is_named_as_it_would_be(tmp_path):
    with full_disk(tmp_path, 2), pytest.raises(OutputError) as caught:
        write(tmp_path, NEW)
    assert str(caught.value).startswith(f"{tmp_path / 'mesh.ply'} cannot be written (No space")


@pytest.mark.parametrize("what", ["result", "part", "beside"])
def test_a_process_that_is_killed_leaves_old_or_new_to_the_next(tmp_path, what):
    folder = tmp_path / "out"

    def anew() -> dict[str, bytes]:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        write(folder, OLD)
        return contents(folder)

    old = anew()
    write(folder, NEW, what)
    new, found = contents(folder), []
    anew()
    for _ in every_fault(kill, folder, lambda: write(folder, NEW, what)):
        assert is_half_done(folder) or shown(contents(folder)) in (shown(old), shown(new))
        recover(folder)
        found.append(contents(folder))
        assert found[-1] in (old, new)
        assert not any(name.endswith((".new", ".ready")) for name in os.listdir(folder))
        anew()
    assert found.count(old) > 10
    assert found.count(new) > 5


def shown(files: dict[str, bytes]) -> dict[str, bytes]:
    """Those that other programs see."""
    return {name: data for name, data in files.items() if not name.startswith(".geogs.")}


@pytest.mark.parametrize("what", ["result", "part", "beside"])
@pytest.mark.parametrize("when", ["at first", "between", "at last"])
def test_a_folder_that_is_swapped_for_a_link_keeps_its_files(tmp_path, what, when):
    out = tmp_path / "out"
    elsewhere = tmp_path / "elsewhere"
    for folder in (out, elsewhere):
        folder.mkdir()
    (elsewhere / "mesh.ply").write_text("of somebody else")

    def swap(moment: str) -> None:
        if moment == when:
            out.rename(tmp_path / "moved")
            out.symlink_to(elsewhere)

    def work() -> None:
        with replaced(out, what) as new:
            swap("at first")
            write_text(new / "keyframes/000001.jpg", "c")
            swap("between")
            write_text(new / "mesh.ply", "new mesh")
            swap("at last")

    with pytest.raises(OutputError, match=f"another folder.*the files are in {tmp_path}/moved"):
        work()
    assert texts(elsewhere) == {"mesh.ply": "of somebody else"}
    assert texts(tmp_path / "moved") == {"mesh.ply": "new mesh", "keyframes/000001.jpg": "c"}
    assert not list(elsewhere.glob(".geogs*"))


@pytest.mark.parametrize("name", ["mesh.ply", "summary.json", "trajectory.tum", "splats.ply"])
def test_folders_with_the_names_of_files_are_refused_before_the_work(tmp_path, name):
    (tmp_path / name).mkdir()
    refused = pytest.raises(OutputError, match=f"{name} is a folder, and a file is to be there")
    with refused, replaced(tmp_path, "result"):
        raise AssertionError("the work has begun")
    assert os.listdir(tmp_path) == [name]


def test_the_files_that_are_looked_at_are_those_of_results():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    assert [name for name in _FILES if f"`{name}`" not in page] == []


@pytest.mark.parametrize("name", ["out", "a/b/out"])
def test_a_link_that_leads_nowhere_is_named_with_what_it_names(tmp_path, name):
    link = tmp_path / name
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(tmp_path / "not there")
    with pytest.raises(OutputError, match=f"is a link to {tmp_path}/not there, which does not"):
        prepare_output_folder(link)
    assert not (tmp_path / "not there").exists()


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE])
def test_where_too_many_files_are_open_another_folder_is_no_remedy(number):
    said = str(unwritable(Path("out"), OSError(number, os.strerror(number))))
    assert said.endswith("raise the limit of open files (ulimit -n).")
    assert "another" not in said
