"""Threads of the command share heaps."""

import subprocess
import sys

import pytest

COUNT = """
import ctypes, sys, threading
from geogs_start import _share_heaps

if {shared}:
    _share_heaps()
c = ctypes.CDLL(None)
c.malloc.restype = ctypes.c_void_p
c.fopen.restype = ctypes.c_void_p
together = threading.Barrier(6)

def take():
    together.wait()
    for _ in range(100):
        c.malloc(1000)
    together.wait()

threads = [threading.Thread(target=take) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
file = ctypes.c_void_p(c.fopen(sys.argv[1].encode(), b"w"))
c.malloc_info(0, file)
c.fclose(file)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc alone has heaps by thread")
def test_threads_share_two_heaps(tmp_path, monkeypatch):
    monkeypatch.delenv("MALLOC_ARENA_MAX", raising=False)
    heaps = {}
    for shared in (False, True):
        table = tmp_path / f"{shared}.xml"
        subprocess.run(
            [sys.executable, "-c", COUNT.format(shared=shared), str(table)], check=True, timeout=60
        )
        heaps[shared] = table.read_text().count("<heap nr=")
    if heaps[False] <= 2:
        pytest.skip("the C library makes no more than two heaps here anyway")
    assert heaps[True] <= 2
