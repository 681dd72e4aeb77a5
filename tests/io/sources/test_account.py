"""The account of an input: what is used, and what is not and why."""

from geogs.config import InputConfig
from geogs.io.sources.account import Account, named
from geogs.io.sources.sniff import open_source
from io_samples import write_images


def test_accounts_are_joined_and_say_each_sentence_once():
    one = Account(("camera: as given",), ("a.txt: no images",))
    other = Account(("camera: as given", "poses: 3"), ("b.txt: no images",))
    both = one + other
    assert both.used == ("camera: as given", "poses: 3")
    assert both.left == ("a.txt: no images", "b.txt: no images")
    assert both.lines("x, 2 images") == [
        "Input: x, 2 images.",
        "  camera: as given.",
        "  poses: 3.",
        "  not used: a.txt: no images.",
        "  not used: b.txt: no images.",
    ]


def test_a_long_list_names_the_first():
    assert named(["a", "b"]) == "a, b"
    assert named(["a", "b", "c", "d", "e"]) == "a, b, c and 2 more"


def test_a_folder_of_images_says_its_camera_and_size(tmp_path):
    write_images(tmp_path, ["a.png", "b.png"])
    source = open_source(tmp_path, InputConfig(intrinsics="50,50,31.5,23.5"))
    assert source.found == f"{tmp_path.name}, 2 images of 64x48 (images)"
    times = "times: 30 images a second assumed"
    assert source.account == Account(("camera: fx 50.0 pixels (as given)", times), ())
