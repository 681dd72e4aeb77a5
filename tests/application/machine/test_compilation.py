"""Kernels for the CPU are compiled beside a command, once, and all of them."""

import subprocess
import sys

import pytest
import torch

from geogs.application.machine import compilation, rehearsal
from geogs.application.machine.compilation import Compilation, compiling

USED = """
import sys
from pathlib import Path
from dataclasses import replace
from numba.core.dispatcher import Dispatcher
import geogs
from geogs.application.machine.compilation import ON_GPU, PARTS, POSED_ON_GPU
from geogs.application.machine.rehearsal import rehearse

def used():
    named = [value for module in [*sys.modules.values()] for value in vars(module).values()]
    found = [value for value in named if isinstance(value, Dispatcher)]
    return {(d.py_func.__qualname__, str(s)) for d in found for s in d.signatures}

for part in (*POSED_ON_GPU, *ON_GPU):
    rehearse(part)
of_gpu = used()
for part in PARTS:
    rehearse(part)
rehearsed = used()
assert of_gpu and len(rehearsed) > len(of_gpu)
c = geogs.Config()
mapping = replace(c.mapping, render_long_edge=64, final_iterations=5)
tracking = replace(c.tracking, init_keyframes=6)
config = replace(c, mapping=mapping, tracking=tracking, input=replace(c.input, stop=18))
assert geogs.run(sys.argv[1], config, sys.argv[2], "cpu").mesh is not None
print(used() - rehearsed)
"""


@pytest.mark.system
@pytest.mark.long
def test_a_run_uses_nothing_that_the_rehearsal_did_not_compile(small_room, tmp_path):
    # First all is kept: a kernel that is compiled counts with its parts, one from the disk alone.
    subprocess.run([sys.executable, "-m", compilation.__name__], stdout=subprocess.DEVNULL)
    command = [sys.executable, "-c", USED, str(small_room), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


def other(code: str, start=subprocess.Popen) -> "subprocess.Popen[str]":
    return start([sys.executable, "-c", code], text=True)


def test_what_is_not_compiled_yet_is_waited_for_and_said():
    short, long = "import time; time.sleep(0.3)", "import time; time.sleep(0.9)"
    kernels, said = Compilation({"search": other(short), "train": other(long)}), []
    kernels.wait(lambda stage, part: said.append((stage, part)), "search")
    assert set(said) == {("compiling, once", 0.0)}
    assert kernels.is_working
    assert kernels.wait(lambda stage, part: said.append((stage, part))) > 0.1
    assert said[-1] == ("compiling, once", 0.5)
    assert not kernels.is_working
    assert kernels.wait(lambda stage, part: pytest.fail("all is there")) < 0.1


def test_a_part_that_is_needed_later_is_compiled_beside_and_awaited_later():
    kernels = Compilation({"search": other(""), "mesh": other("import time; time.sleep(60)")})
    kernels.wait(lambda stage, part: None, "search")
    assert kernels.is_working
    kernels.stop()
    assert not kernels.is_working


def test_all_is_awaited_where_nobody_compiles_the_part_that_is_needed():
    kernels = Compilation({"planes": other("import time; time.sleep(0.3)"), "lens": other("")})
    kernels.wait(lambda stage, part: None, "search")
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
    failed = Compilation({"mesh": other("import sys; sys.exit(1)")})
    failed.wait(lambda stage, part: None)
    failed.stop()
    process = other("import time; time.sleep(60)")
    Compilation({"mesh": process}).stop()
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
        assert kernels.wait(lambda *_: pytest.fail("all is there"), "search") < 0.1
    source = tmp_path / "some_kernels.py"
    source.touch()
    monkeypatch.setattr(compilation, "PACKAGE", tmp_path)
    assert not compilation.is_compiled()
