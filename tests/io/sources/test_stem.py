"""The folder of a result has the name of its source, without the ending of a file."""

from pathlib import Path

import pytest

from geogs.io.sources.reader import without_ending


@pytest.mark.parametrize(
    ("name", "is_file", "stem"),
    [
        ("video.mp4", True, "video"),
        ("walk.2024.bag", True, "walk.2024"),
        ("no-ending", True, "no-ending"),
        ("fr1.desk", False, "fr1.desk"),
        ("camera-0", False, "camera-0"),
    ],
)
def test_only_the_ending_of_a_file_goes(tmp_path: Path, name: str, is_file: bool, stem: str):
    path = tmp_path / name
    if is_file:
        path.touch()
    else:
        path.mkdir()
    assert without_ending(name, [tmp_path / "other.mp4", path]) == stem
