"""COLMAP models as scripts and other machines write them: no image is lost, and all is told."""

import shutil

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.formats.colmap import read_model
from geogs.io.sources.sniff import open_posed_source
from io_samples import gradient_image, write_image

NATIVE = InputConfig(long_edge=0)
CAMERA = "1 PINHOLE 64 48 40 41 32 24"
KEYPOINTS = "3.5 4.5 -1 8.0 9 2 1e1 2.5e+01 -1 7 8 9"


def rows(names, first=1):
    """One row of each image, at x = 1, 2, ..."""
    return [f"{k} 1 0 0 0 {k} 0 0 1 {name}" for k, name in enumerate(names, start=first)]


def write_model(folder, lines, end="\n", camera=CAMERA):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_bytes(f"# Camera list{end}{camera}{end}".encode())
    (folder / "images.txt").write_bytes(end.join(lines).encode())
    return folder


def write_images(folder, names):
    for k, name in enumerate(names):
        write_image(folder / name, gradient_image(k))


def between(lines, *extra):
    return [one for line in lines for one in (line, *extra)]


LAYOUTS = {
    "with keypoints": lambda lines: between(lines, KEYPOINTS),
    "empty lines": lambda lines: between(lines, ""),
    "no lines between": lambda lines: lines,
    "comments between": lambda lines: ["# head", *between(lines, "", "  # a comment")],
    "comments and keypoints": lambda lines: between(lines, "# points", KEYPOINTS),
    "trailing spaces": lambda lines: [f"  {line} \t " for line in between(lines, "   ")],
    "some keypoints": lambda lines: [lines[0], KEYPOINTS, *lines[1:], ""],
    "two empty lines": lambda lines: between(lines, "", ""),
    "keypoints of zeros": lambda lines: between(lines, "0 0 -1 0 0 -1 0 0 -1 0 0 -1"),
    "one keypoint": lambda lines: between(lines, "1 0 -1"),
    "tabs": lambda lines: [line.replace(" ", "\t") for line in lines],
}


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r\r\n"], ids=["LF", "CRLF", "CRCRLF"])
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_all_images_of_a_text_are_read(layout, end, tmp_path):
    names = ["0001.jpg", "2.png", "10.jpg", "a_b-c.JPG"]
    model = read_model(write_model(tmp_path, layout(rows(names)), end))
    assert [image.name for image in model.images.values()] == names
    assert [image.translation[0] for image in model.images.values()] == [1, 2, 3, 4]
    assert model.cameras[1].parameters == (40, 41, 32, 24)


@pytest.mark.parametrize("layout", [LAYOUTS["no lines between"], LAYOUTS["with keypoints"]])
def test_names_with_spaces_or_of_numbers(layout, tmp_path):
    names = ["a view.jpg", "My scan/IMG 1 (2).jpg", "0004", "5.5"]
    model = read_model(write_model(tmp_path, layout(rows(names))))
    assert [image.name for image in model.images.values()] == names


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        ([*rows(["a.jpg"]), "3.5 4.5"], "2 columns in the row of an image"),
        ([*rows(["a.jpg"]), *rows(["b.jpg"])], "two rows with the number 1"),
        (["1 1 0 0 0 0 0 0 1"], "no registered image|9 columns"),
    ],
)
def test_a_row_that_is_neither_is_refused(lines, why, tmp_path):
    write_images(tmp_path, ["a.jpg"])
    with pytest.raises(InputError, match=why):
        open_posed_source(write_model(tmp_path, lines))


@pytest.mark.parametrize("given", ["", "sparse"])
@pytest.mark.parametrize(("small", "large"), [("0", "1"), ("1", "0"), ("2", "10"), ("7", "3")])
def test_the_largest_model_is_used_and_the_others_are_told(small, large, given, tmp_path):
    names = [f"{k}.png" for k in range(9)]
    write_images(tmp_path / "images", names)
    write_model(tmp_path / "sparse" / small, rows(names[:3]))
    write_model(tmp_path / "sparse" / large, rows(names[3:8], 4))
    source = open_posed_source(tmp_path / given, NATIVE)
    assert source.name == tmp_path.name
    np.testing.assert_allclose(source.T_cw[:, 0, 3], [4, 5, 6, 7, 8])
    models, pictures = source.account.left
    assert f"sparse/{small} (3 images)" in models
    assert pictures.startswith("pictures that are not listed: 4, such as")
    shutil.rmtree(tmp_path / "sparse" / small)
    assert len(open_posed_source(tmp_path / given, NATIVE)) == 5


def test_a_model_given_itself_is_used(tmp_path):
    names = [f"{k}.png" for k in range(8)]
    write_images(tmp_path / "images", names)
    write_model(tmp_path / "sparse/0", rows(names[:3]))
    write_model(tmp_path / "sparse/1", rows(names[3:]))
    assert len(open_posed_source(tmp_path / "sparse/0", NATIVE)) == 3
    assert len(open_posed_source(tmp_path / "sparse/1/images.txt", NATIVE)) == 5


@pytest.mark.parametrize(
    "listed",
    [
        "images\\{}.png",
        "C:\\scans\\kitchen\\images\\{}.png",
        "/home/somebody/kitchen/images/{}.png",
        "video/{}.png",
        "{}.PNG",
        "{}",
    ],
)
def test_images_are_found_by_names_of_other_machines(listed, tmp_path):
    write_images(tmp_path / "images", [f"{k}.png" for k in range(4)])
    write_image(tmp_path / "masks" / "1.png", gradient_image(1))
    names = [listed.format(k) for k in range(4)]
    source = open_posed_source(
        write_model(tmp_path / "sparse" / "0", rows(names)).parents[1], NATIVE
    )
    for k, view in enumerate(source):
        np.testing.assert_array_equal(view.image, gradient_image(k))
    assert source[0].mask is None
    assert source[1].mask is not None


def test_a_fisheye_without_distortion(tmp_path):
    write_images(tmp_path, ["a.png", "b.png"])
    write_model(tmp_path, rows(["a.png", "b.png"]), camera="1 SIMPLE_FISHEYE 64 48 40 32 24")
    assert ", fisheye (" in open_posed_source(tmp_path, NATIVE).account.used[0]


@pytest.mark.parametrize("model", ["DIVISION 64 48 40 41 32 24 0.1", "EQUIRECTANGULAR 64 48 64 48"])
def test_other_cameras_are_refused_by_name(model, tmp_path):
    write_images(tmp_path, ["a.png", "b.png"])
    write_model(tmp_path, rows(["a.png", "b.png"]), camera=f"1 {model}")
    with pytest.raises(InputError, match=model.split()[0]):
        open_posed_source(tmp_path, NATIVE)
