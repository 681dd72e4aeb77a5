"""Kernels for the CPU are compiled beside a command, once, and all of them."""

import subprocess
import sys

import pytest
import torch

from geogs.application.machine import compilation, rehearsal
from geogs.application.machine.compilation import KERNELS_OF_SEARCH, Compilation, compiling

USED = """
import sys
from pathlib import Path
from dataclasses import replace
from numba.core.dispatcher import Dispatcher
import geogs
from geogs.application.machine.compilation import KERNELS, ON_GPU, PARTS, POSED_ON_GPU
from geogs.application.machine.rehearsal import rehearse

def used():
    named = [value for module in [*sys.modules.values()] for value in vars(module).values()]
    found = [value for value in named if isinstance(value, Dispatcher)]
    return {(d.py_func.__qualname__, str(s)) for d in found for s in d.signatures}

before = set()
for part, kernels in (POSED_ON_GPU | ON_GPU).items():
    rehearse(part)
    assert len({name for name, _ in used() - before}) == kernels, used() - before
    before = used()
for part in PARTS:
    rehearse(part)
rehearsed = used()
assert len({name for name, _ in rehearsed}) == KERNELS, rehearsed
c = geogs.Config()
mapping = replace(c.mapping, render_long_edge=64, final_iterations=5)
tracking = replace(c.tracking, init_keyframes=6)
config = replace(c, mapping=mapping, tracking=tracking, input=replace(c.input, stop=18))
assert geogs.run(sys.argv[1], config, sys.argv[2], "cpu").mesh is not None
print(used() - rehearsed)
"""


@pytest.mark.system
def test_a_run_uses_nothing_that_the_rehearsal_did_not_compile(small_room, tmp_path):
    # First all is kept: a kernel that is compiled counts with its parts, one from the disk alone.
    subprocess.run([sys.executable, "-m", compilation.__name__], stdout=subprocess.DEVNULL)
    command = [sys.executable, "-c", USED, str(small_room), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


def other(code: str, start=subprocess.Popen) -> "subprocess.Popen[str]":
    return start([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def test_what_is_not_compiled_yet_is_waited_for_and_said():
    code = "import time\nfor n in range(4): print(n, flush=True); time.sleep(0.2)"
    kernels, said = Compilation([(other(code), 4)]), []
    kernels.wait(lambda stage, part: said.append((stage, part)), 2)
    assert said == [("compiling, once", 0.5), ("compiling, once", 1.0)]
    assert kernels.wait(lambda stage, part: said.append(part)) > 0.1
    assert said[2:] == [0.75, 1.0]
    assert kernels.wait(lambda stage, part: pytest.fail("all is there")) < 0.1
    kernels.stop()
    assert not kernels.is_working


def test_a_part_that_is_needed_later_is_compiled_beside_and_awaited_later():
    later = "import time\nfor n in range(3): print(n, flush=True)\ntime.sleep(60)"
    first = "for n in range(2): print(n, flush=True)\nimport time; time.sleep(60)"
    kernels, said = Compilation([(other(first), 2), (other(later), 3)]), []
    kernels.wait(lambda stage, part: said.append(part), 1)
    kernels.wait(lambda stage, part: said.append(part), 2)
    assert said == [1.0, 1.0]
    kernels.wait(lambda stage, part: said.append(part))
    assert said[2:] == [0.6, 0.8, 1.0]
    assert kernels.is_working
    kernels.stop()
    assert not kernels.is_working


def test_with_a_gpu_only_what_the_cpu_does_beside_it_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    begun = []
    monkeypatch.setattr(
        compilation.subprocess, "Popen", lambda command, **_: begun.append(command) or other("")
    )
    with compiling(torch.device("cuda")):
        assert [command[-1] for command in begun] == ["planes", "turn", "lens"]
    begun.clear()
    with compiling(torch.device("cuda"), knows_poses=True):
        assert [command[-1] for command in begun] == ["look", "planes"]


def test_a_process_that_fails_or_lasts_holds_nobody_up():
    failed = Compilation([(other("import sys; sys.exit(1)"), 4)])
    failed.wait(lambda stage, part: pytest.fail("nothing is compiled"))
    failed.stop()
    process = other("import time; time.sleep(60)")
    Compilation([(process, 4)]).stop()
    assert process.returncode not in (0, None)


def test_what_is_compiled_is_known_until_a_source_changes(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr(rehearsal, "rehearse", lambda part: None)
    assert not compilation.is_compiled()
    compilation.compile_now(["mesh"])
    assert not compilation.is_compiled()
    compilation.compile_now()
    assert compilation.is_compiled()
    with compiling(torch.device("cpu")) as kernels:
        assert kernels.wait(lambda *_: pytest.fail("all is there"), KERNELS_OF_SEARCH) < 0.1
    source = tmp_path / "some_kernels.py"
    source.touch()
    monkeypatch.setattr(compilation, "PACKAGE", tmp_path)
    assert not compilation.is_compiled()
