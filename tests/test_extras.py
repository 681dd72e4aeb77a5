"""The command that a message names installs into the Python that runs, from where geogs is from."""

import json
import shlex
import sys
from importlib.metadata import PackageNotFoundError
from types import SimpleNamespace

import pytest

from geogs import extras
from geogs.extras import install_command


@pytest.mark.parametrize(
    ("url", "what"),
    [
        (None, ["geogs[viewer]"]),
        ("", ["geogs[viewer]"]),
        ("{", ["geogs[viewer]"]),
        ("[]", ["geogs[viewer]"]),
        (json.dumps({"url": "https://x.org/g.whl", "archive_info": {}}), ["geogs[viewer]"]),
        (json.dumps({"url": "file:///tmp/g.whl", "archive_info": {}}), ["geogs[viewer]"]),
        (json.dumps({"url": "file:///a%20b/geogs", "dir_info": {}}), ["/a b/geogs[viewer]"]),
        (
            json.dumps({"url": "file:///src/geogs", "dir_info": {"editable": True}}),
            ["-e", "/src/geogs[viewer]"],
        ),
    ],
)
def test_an_extra_comes_from_where_geogs_is_from(monkeypatch, url, what):
    found = SimpleNamespace(read_text=lambda _: url)
    monkeypatch.setattr(extras, "distribution", lambda _: found)
    words = shlex.split(install_command("viewer"))
    assert words == [sys.executable, "-m", "pip", "install", *what]


def test_a_folder_of_sources_that_is_not_installed_names_the_index(monkeypatch):
    def missing(_: str) -> None:
        raise PackageNotFoundError

    monkeypatch.setattr(extras, "distribution", missing)
    assert install_command("ros").endswith("'geogs[ros]'")
