"""Every benchmark can still be started: what it imports is there."""

import importlib
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).parents[2] / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_benchmark_imports(script: Path) -> None:
    module = importlib.import_module(script.stem)
    assert Path(module.__file__ or "") == script
