"""Each promise of SECURITY.md names the tests that hold it, and these exist."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODEL = re.search(
    r"^## Threat model\n(.*?)^## ", (ROOT / "SECURITY.md").read_text(), re.MULTILINE | re.DOTALL
)[1]
ADVERSARIES = dict(re.findall(r"^\*\*(\w+)\*\*(.*?)(?=^\*\*|\Z)", MODEL, re.MULTILINE | re.DOTALL))
NAMED = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", MODEL)


def test_the_hostile_are_those_that_there_are():
    assert [*ADVERSARIES] == [
        "Files", "Results", "Checkpoints", "Names", "Servers", "Pages", "Neighbours", "Programs",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ADVERSARIES)
def test_each_promise_names_a_test_and_what_is_not_promised_is_said(name):
    points = re.findall(r"^- (.*)$", ADVERSARIES[name], re.MULTILINE)
    *promises, last = points
    assert last.startswith("Not promised: ")
    assert promises
    assert [promise for promise in promises if "`tests/" not in promise] == []


@pytest.mark.parametrize(("path", "name"), NAMED, ids=lambda part: part)
def test_the_tests_that_are_named_exist(path, name):
    tree = ast.parse((ROOT / path).read_text())
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_nothing_else_is_named_as_a_test():
    assert len(NAMED) == MODEL.count("`tests/") > 20
