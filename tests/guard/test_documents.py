"""Documents of strangers: nothing is waited for, expanded, run or repeated."""

import os
import time

import pytest

from geogs.errors import InputError
from geogs.guard.documents import (
    expanded,
    read_bytes,
    read_json,
    read_text,
    read_yaml,
    whole_number,
)
from mutations import BOMB


def test_what_is_no_plain_file_is_told_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, said in (
        (tmp_path / "pipe", "no plain file"),
        (tmp_path, "is a folder"),
        (tmp_path / "none", "does not exist"),
        ("/dev/zero", "no plain file"),
        ("a\0b", "zero byte"),
    ):
        with pytest.raises(InputError, match=said):
            read_bytes(path)


def test_files_larger_than_any_such_are_not_read(tmp_path):
    with (tmp_path / "large.yaml").open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(InputError, match=r"has 1048576 MiB, more than any such file"):
        read_yaml(tmp_path / "large.yaml")


def test_text_may_begin_with_a_mark_and_must_be_utf8(tmp_path):
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfone")
    assert read_text(tmp_path / "a") == "one"
    (tmp_path / "a").write_bytes(b"\xff")
    with pytest.raises(InputError, match="not a text file in UTF-8"):
        read_text(tmp_path / "a")


@pytest.mark.parametrize("text", [BOMB, "a: &x 1\nb: *x", "[" * 5000, "!!python/name:os.system x"])
def test_yaml_neither_expands_nor_runs(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    begin = time.process_time()  # of this process, whatever else the machine does
    with pytest.raises(InputError, match="not YAML of plain values"):
        read_yaml(tmp_path / "a.yaml")
    assert time.process_time() - begin < 10
    (tmp_path / "a.yaml").write_text("a: [1, 2.5, x]\n")
    assert read_yaml(tmp_path / "a.yaml") == {"a": [1, 2.5, "x"]}


def test_sentences_do_not_repeat_what_a_file_holds(tmp_path):
    from geogs.io.pose_files import read_poses
    from geogs.io.sources.calibration_files import read_calibration
    from geogs.io.sources.formats.colmap import read_model
    from geogs.io.sources.formats.tum import open_tum
    from geogs.priors.card import load_card

    secret = "root:x:0:0:root secret:/root:/bin/bash\n"
    for name in ("a.txt", "a.json", "a.yaml", "rgb.txt", "cameras.txt", "images.txt"):
        (tmp_path / name).write_text(secret)
    readers = [
        *((read_calibration, name) for name in ("a.txt", "a.json", "a.yaml")),
        (lambda path: load_card(str(path)), "a.yaml"),
        (read_json, "a.json"), (read_poses, "a.txt"), (open_tum, ""), (read_model, ""),
    ]  # fmt: skip
    for read, name in readers:
        with pytest.raises(InputError) as error:
            read(tmp_path / name)
        assert "secret" not in str(error.value)
        assert str(tmp_path) in str(error.value)


def test_whole_numbers():
    assert whole_number(3.0) == whole_number("3") == 3
    for value in (1.5, float("nan"), float("inf"), 1e300, "x"):
        with pytest.raises((ValueError, OverflowError)):
            whole_number(value)


def test_a_user_that_nobody_knows_stays_in_the_path():
    assert str(expanded("~nobody-of-this-name/v.mp4")) == "~nobody-of-this-name/v.mp4"
