"""A GPU is made ready beside the imports, where there is one to be used, and nothing is said."""

import ctypes
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest

from geogs.gpu import early_start


def started(monkeypatch, name: str, has_cuda: bool = True, fails: bool = False) -> list[str]:
    """The calls of a driver that there is, until its thread has ended."""
    calls: list[str] = []

    def call(function: str):
        def answer(*given) -> int:
            calls.append(f"{function} {given[-1]}" if function != "retain" else function)
            return int(fails)

        return answer

    driver = SimpleNamespace(
        cuInit=call("init"), cuDeviceGet=call("get"), cuDevicePrimaryCtxRetain=call("retain")
    )
    monkeypatch.setattr(early_start, "_has_cuda", lambda: has_cuda)
    monkeypatch.setattr(ctypes, "CDLL", lambda name: driver)
    early_start.start_gpu(name)
    for thread in threading.enumerate():
        if thread.name == "gpu":
            thread.join()
    return calls


@pytest.mark.parametrize(("name", "index"), [("auto", 0), ("cuda", 0), ("cuda:2", 2)])
def test_the_gpu_of_the_name_is_made_ready(monkeypatch, name, index):
    assert started(monkeypatch, name) == ["init 0", f"get {index}", "retain"]


@pytest.mark.parametrize("name", ["cpu", "cuda:x", "nonsense"])
def test_nothing_is_started_for_what_is_no_gpu(monkeypatch, name):
    assert started(monkeypatch, name) == []


def test_nothing_is_started_without_cuda_and_a_failure_says_nothing(monkeypatch, capsys):
    assert started(monkeypatch, "auto", has_cuda=False) == []
    assert started(monkeypatch, "auto", fails=True) == ["init 0"]
    monkeypatch.undo()
    early_start._make_ready(0)  # whatever this machine has
    assert capsys.readouterr() == ("", "")


def test_it_imports_neither_pytorch_nor_numpy():
    code = (
        "import sys; from geogs.gpu.early_start import start_gpu; start_gpu('auto');"
        "print('torch' in sys.modules, 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False False\n"
