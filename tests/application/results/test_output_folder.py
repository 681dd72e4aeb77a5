"""No result is replaced unasked; no empty folder is left."""

import json
from pathlib import Path

import pytest

from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.output_folder import (
    chosen_folder,
    claimed,
    content,
    free_folder,
    is_complete,
)
from geogs.errors import OutputError


class Heard(RunProgress):
    """What was said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def write(self, text: str) -> None:
        self.said.append(text)


def put(folder: Path, summary: str = '{"source": "video.mp4"}') -> Path:
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text(summary)
    return folder


def test_a_result_without_a_named_folder_gets_one_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    heard = Heard()
    assert chosen_folder(None, "video", False, heard) == Path("out/video")
    assert not heard.said
    put(Path("out/video"))
    put(Path("out/video-2"), "[]")
    assert chosen_folder(None, "video", False, heard) == Path("out/video-3")
    assert heard.said == [
        "out/video holds the result of video.mp4, which stays; this result goes to out/video-3."
    ]
    assert chosen_folder(None, "video", True, heard) == Path("out/video")


@pytest.mark.parametrize("summary", ['{"source": "b"}', "[]", "{", '{"source": "\\u001b[31m"}'])
def test_a_named_folder_with_a_result_is_refused(tmp_path, summary):
    folder = put(tmp_path / "kept", summary)
    with pytest.raises(OutputError, match="--overwrite to replace it") as caught:
        chosen_folder(folder, "other", False)
    assert str(caught.value).isprintable()
    assert chosen_folder(folder, "other", True) == folder
    assert chosen_folder(tmp_path / "new", "other", False) == tmp_path / "new"
    (tmp_path / "of-others").mkdir()
    (tmp_path / "of-others" / "notes.txt").write_text("mine")
    assert chosen_folder(tmp_path / "of-others", "x", False) == tmp_path / "of-others"


def test_an_earlier_result_of_the_same_source_may_be_replaced(tmp_path):
    folder = put(tmp_path / "kept", '{"source": "b", "fingerprint": "ab12"}')
    heard = Heard()
    assert chosen_folder(folder, "b", False, heard, lambda: "ab12") == folder
    assert heard.said == [f"{folder} holds the result of b; a complete new one replaces it."]
    with pytest.raises(OutputError, match="--overwrite to replace it"):
        chosen_folder(folder, "b", False, heard, lambda: "cd34")
    with pytest.raises(OutputError, match="--overwrite to replace it"):
        chosen_folder(folder, "b", False, heard)


def test_a_write_that_was_interrupted_counts_as_a_result(tmp_path):
    folder = tmp_path / "killed"
    folder.mkdir()
    part = folder / "part"
    part.mkdir()
    part.rename(folder / f".geogs.{part.stat().st_ino}.ready")
    assert content(folder) == "a result"
    assert free_folder(folder) == tmp_path / "killed-2"


def test_only_a_result_that_came_to_its_end_is_complete(tmp_path):
    for name, summary in {"a": {"interrupted": False}, "b": {"interrupted": True}, "c": {}}.items():
        folder = put(tmp_path / name, json.dumps(summary))
        assert not is_complete(folder)
        (folder / "mesh.ply").write_bytes(b"a mesh")
        assert is_complete(folder) is (name == "a")
    assert not is_complete(tmp_path / "missing")


def test_a_folder_that_was_made_for_nothing_goes_again(tmp_path):
    for wanted in (tmp_path / "out" / "room", tmp_path):
        with pytest.raises(KeyboardInterrupt), claimed(wanted):
            raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    with claimed(tmp_path / "out" / "room") as folder:
        (folder / "summary.json").write_text("{}")
    assert (tmp_path / "out" / "room" / "summary.json").is_file()
