"""Files are found by the names that other machines and programs give them."""

import unicodedata

import pytest

from geogs.io.sources.named_files import NamedFiles, elsewhere, unlisted


def touched(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("images/0001.jpg", "images/0001.jpg"),
        ("./images/0001.jpg", "images/0001.jpg"),
        ("0001.jpg", "images/0001.jpg"),
        (r"images\0001.jpg", "images/0001.jpg"),
        (r".\images\0001.jpg", "images/0001.jpg"),
        (r"C:\Users\me\My scans\images\0001.jpg", "images/0001.jpg"),
        ("D:/scans/images/left/0001.jpg", "images/left/0001.jpg"),
        ("/home/somebody/scene 2/images/0001.jpg", "images/0001.jpg"),
        ("/mnt/scene/images/0001.jpg", "images/0001.JPG"),
        (r"\\server\share\0001.JPG", "images/0001.jpg"),
        ("images/0001", "images/0001.png"),
        (r"images\0001", "images/0001.JPEG"),
        ("images/frame.0001", "images/frame.0001.jpg"),
        ("images/IMG_0001.HEIC", "images/IMG_0001.jpg"),
        ("images/a view.jpg ", "images/a view.jpg"),
        (unicodedata.normalize("NFD", "images/Küche 1.jpg"), "images/Küche 1.jpg"),
        ("images/Küche 1.jpg", unicodedata.normalize("NFD", "images/Küche 1.jpg")),
        (r"..\images\0001.jpg", "images/0001.jpg"),
        ("Images/0001.jpg", "images/0001.jpg"),
    ],
)
def test_a_file_is_found(name, there, tmp_path):
    folder = touched(tmp_path, there, "images/0002.jpeg", "other/0001.bmp")
    found = NamedFiles(folder, folder / "images").find([name])
    assert [file.resolve() for file in found] == [(folder / there).resolve()]


@pytest.mark.parametrize(
    "name",
    [
        "images/0003.jpg",
        "",
        ".",
        "images",
        r"..\..\secret.jpg",
        r"C:\x\..\..\..\outside.jpg",
        "a\0b.jpg",
        "images/0001.png",
        "images/0001x.jpg",
    ],
)
def test_nothing_else_is_found(name, tmp_path):
    touched(tmp_path, "outside/../secret.jpg", "outside.jpg")
    folder = touched(tmp_path / "scene", "images/0001.jpg", "images/0002.png")
    assert NamedFiles(folder, folder / "images").find([name]) == [None]


def test_the_longest_tail_wins(tmp_path):
    touched(tmp_path, "0001.jpg", "left/0001.jpg", "right/0001.jpg")
    names = [f"/data/{side}/0001.jpg" for side in ("left", "right")]
    found = NamedFiles(tmp_path).find(names)
    assert found == [tmp_path / "left/0001.jpg", tmp_path / "right/0001.jpg"]


def test_two_names_never_share_a_file_by_guess(tmp_path):
    touched(tmp_path, "0001.jpg", "0002.jpg")
    names = ["left/0001.jpg", "right/0001.jpg", "left/0002.jpg", "0002.jpg"]
    assert NamedFiles(tmp_path).find(names) == [None, None, None, tmp_path / "0002.jpg"]


def test_names_that_differ_in_case_alone_are_told_apart(tmp_path):
    touched(tmp_path, "a.jpg", "A.jpg")
    assert NamedFiles(tmp_path).find(["a.jpg", "A.jpg"]) == [tmp_path / "a.jpg", tmp_path / "A.jpg"]
    assert NamedFiles(tmp_path).find(["a.JPG"]) == [None]


def test_files_found_elsewhere_and_files_not_listed_are_told(tmp_path):
    touched(tmp_path, "images/1.jpg", "images/2.jpg", "images/3.jpg", "images/notes.txt")
    files = NamedFiles(tmp_path / "images")
    names = ["1.jpg", r".\2.jpg"]
    assert elsewhere(names, files.find(names)).used == ()
    names = ["video/1.jpg", "2.png", "none.jpg"]
    found = files.find(names)
    (said,) = elsewhere(names, found).used
    assert said.startswith("images that lie elsewhere than listed: 2, such as")
    (said,) = unlisted(found).left
    assert said == f"pictures that are not listed: 1, such as {tmp_path / 'images/3.jpg'}"
