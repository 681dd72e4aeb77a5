"""``geogs demo``: three commands, and what is compiled beside them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace

import torch

from geogs.application.machine import compilation
from geogs.application.machine.compilation import Compilation
from geogs.cli import demo, run


def test_kernels_of_the_run_are_compiled_from_the_room_on(tmp_path, monkeypatch):
    kernels, events = Compilation(), []

    @contextmanager
    def compiling(device: torch.device) -> Iterator[Compilation]:
        events.append("begun")
        yield kernels
        events.append("stopped")

    def run_with(argv: Sequence[str], kernels: Compilation | None) -> int:
        events.append(kernels)
        return 0

    def command(name: str) -> SimpleNamespace:
        return SimpleNamespace(run=lambda argv: events.append(name) or 0)

    monkeypatch.setattr(compilation, "compiling", compiling)
    monkeypatch.setattr(demo, "find_command", command)
    monkeypatch.setattr(run, "main", run_with)
    assert demo.main(["-o", str(tmp_path)]).code == 0
    assert events == ["begun", "synth", kernels, "eval", "stopped"]
