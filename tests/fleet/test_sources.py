"""From words to sources, each with a folder of its own."""

import pytest

from geogs.errors import InputError
from geogs_fleet.sources import find_sources


def test_a_folder_holds_videos_and_folders_of_images(tmp_path):
    for name in ("b.mp4", "a.MOV", "notes.md", ".hidden.mp4"):
        (tmp_path / name).touch()
    (tmp_path / "frames").mkdir()
    found = find_sources([str(tmp_path)])
    assert [s.name for s in found] == ["a", "b", "frames"]
    assert found[0].address == str(tmp_path / "a.MOV")


@pytest.mark.parametrize("inside", [("0001.png", "0002.png"), ("rgb.txt", "film.mp4")])
def test_images_and_data_sets_are_one_source(tmp_path, inside):
    for name in inside:
        (tmp_path / name).touch()
    (tmp_path / "depth").mkdir()
    assert [s.address for s in find_sources([str(tmp_path)])] == [str(tmp_path)]


def test_a_list_is_relative_to_its_file_and_names_elsewhere_stay(tmp_path):
    (tmp_path / "list.txt").write_text("# ours\nclips/a.mp4\n\n https://host/x/b.mp4 \n/c d.mp4\n")
    found = find_sources([str(tmp_path / "list.txt")])
    addresses = [str(tmp_path / "clips/a.mp4"), "https://host/x/b.mp4", "/c d.mp4"]
    assert [s.address for s in found] == addresses
    assert [s.name for s in found] == ["a", "b", "c_d"]


def test_a_pattern_and_what_is_named_twice(tmp_path):
    for name in ("a1.mp4", "a2.mp4", "b.mp4"):
        (tmp_path / name).touch()
    words = [str(tmp_path / "a*.mp4"), str(tmp_path / "a2.mp4")]
    assert [s.name for s in find_sources(words)] == ["a1", "a2"]


def test_equal_names_are_told_apart_the_same_way_each_time(tmp_path):
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "clip.mp4").touch()
    words = [str(tmp_path / folder / "clip.mp4") for folder in "xy"]
    names = {s.address: s.name for s in find_sources(words)}
    assert len(set(names.values())) == 2
    assert all(name.startswith("clip-") for name in names.values())
    assert {s.address: s.name for s in find_sources(words[::-1])} == names


@pytest.mark.parametrize(
    ("word", "said"),
    [("none.mp4", "does not exist"), ("n*.mp4", "Nothing fits"), ("none.txt", "does not exist")],
)
def test_what_names_nothing_is_said(tmp_path, monkeypatch, word, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=said):
        find_sources([word])
