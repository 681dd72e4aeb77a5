"""The reference is the one that the docstrings make, and they say what there is to say."""

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

import geogs
from reference_page import PARTS, document

PAGE = Path(__file__).parents[1] / "docs" / "reference.md"
ELSEWHERE = {
    "Config": "configuration.md",
    "ReconstructConfig": "configuration.md",
    "GaussianMap": "what is trained",
    "open_posed_source": "as open_source",
    "application": "api.md",
    "__version__": "",
}
"""What has no entry, and where it stands."""
NAMES = [name for part in PARTS.values() for name in part if re.fullmatch(r"geogs[\w.]+", name)]


def test_the_page_is_that_of_the_docstrings():
    assert PAGE.read_text() == document(), "python tests/reference_page.py > docs/reference.md"


def test_every_public_name_has_an_entry():
    entries = set(re.findall(r"^### geogs\.(\w+)$", document(), re.MULTILINE))
    assert entries == set(geogs.__all__) - ELSEWHERE.keys()


@pytest.mark.parametrize("name", [*NAMES, "geogs.Slam.process", "geogs.Slam.__init__"])
def test_help_names_every_argument_of_a_function_that_explains_some(name):
    _, *parts = name.split(".")
    found = geogs
    if parts[0] == "config":
        found = importlib.import_module("geogs.config")
        parts = parts[1:]
    for part in parts:
        found = getattr(found, part)
    said = inspect.getdoc(found)
    assert said
    if "Args:" in said:
        arguments = [n for n in inspect.signature(found).parameters if n != "self"]
        assert [n for n in arguments if n not in said] == []
    if parts[-1] == "process":
        assert [w for w in ("uint8", "seconds", "map units", "InputError") if w not in said] == []


def test_each_error_that_an_entry_names_exists():
    tree = ast.parse((Path(geogs.__file__).parent / "errors.py").read_text())
    known = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
    named = set(re.findall(r"\b(\w+(?:Error|Lost))\b", document()))
    assert "InputError" in named
    assert named <= known
