"""Kernel sources, their cache, and what is said where they cannot be used."""

import multiprocessing
from pathlib import Path

import pytest
import torch

import geogs
from geogs.errors import DeviceError
from geogs.gpu import cache, kernels
from geogs.gpu.cache import cache_key, read_cubin, write_cubin
from geogs.gpu.kernel_source import kernel_signatures, read_source
from geogs.gpu.kernels import find_cubin, kernels_for

SOURCES = sorted(Path(geogs.__file__).parent.rglob("*.cu"))
PACKAGE_TYPES = {"int", "unsigned", "float", "double", "long long"}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """A cache of its own for every test."""
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path))
    return tmp_path


def test_includes_are_inserted_once_and_parameters_are_understood(tmp_path):
    (tmp_path / "part.cuh").write_text("#pragma once\nint part;\n")
    (tmp_path / "whole.cu").write_text(
        '#include "common.cuh"\n#include "part.cuh"\n#include "part.cuh"\n'
        '// extern "C" __global__ void not_me(int a) {}\n'
        'extern "C" __global__ void __launch_bounds__(256) add(\n'
        "    int n, const float* __restrict__ x, unsigned long long *keys, double k) {}\n"
        'extern "C" __global__ void none() {}\n'
    )
    text = read_source(tmp_path / "whole.cu")
    assert text.count("int part;") == 1
    assert "warp_sum" in text
    assert "#include" not in text
    found = kernel_signatures(text)
    assert list(found) == ["add", "none"]
    assert found["add"] == ("int", "float*", "unsigned long long*", "double")
    assert found["none"] == ()


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.stem)
def test_every_source_of_the_package_is_complete(source):
    signatures = kernel_signatures(read_source(source))
    assert signatures
    for name, parameters in signatures.items():
        for kind in parameters:
            assert kind.endswith("*") or kind in PACKAGE_TYPES, name


def test_a_cubin_comes_back_and_damage_is_noticed(folder):
    key = cache_key("source", "sm_90")
    assert read_cubin(key) is None
    write_cubin(key, b"machine code")
    assert read_cubin(key) == b"machine code"
    (file,) = folder.rglob("*.cubin")
    file.write_bytes(file.read_bytes()[:-1])
    assert read_cubin(key) is None
    assert cache_key("source", "sm_90") != cache_key("source", "sm_89")
    assert cache_key("a", "b") != cache_key("ab", "")


def test_a_folder_that_cannot_be_written_is_a_warning(folder, monkeypatch, caplog):
    (folder / "file").write_text("")
    monkeypatch.setenv("GEOGS_CACHE", str(folder / "file"))
    write_cubin("key", b"code")
    assert "GEOGS_CACHE" in caplog.text


def write_again(folder: str, content: bytes) -> None:
    cache.cache_folder = lambda: Path(folder)
    for _ in range(200):
        write_cubin("shared", content)


def test_processes_that_compile_at_once_do_not_disturb_each_other(folder):
    contents = [bytes([n]) * 50_000 for n in (1, 2)]
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=write_again, args=(str(folder), c)) for c in contents]
    for writer in writers:
        writer.start()
    seen = set()
    while any(writer.is_alive() for writer in writers):
        seen.add(read_cubin("shared"))
    assert seen <= {None, *contents}
    assert read_cubin("shared") in contents
    assert len(list((folder / "kernels").iterdir())) == 1


def test_a_source_is_compiled_once_per_architecture(monkeypatch):
    compiled = []

    def compile_cubin(text: str, name: str, architecture: str) -> bytes:
        compiled.append(architecture)
        return f"{text} for {architecture}".encode()

    monkeypatch.setattr(kernels, "compile_cubin", compile_cubin)
    for architecture in ("sm_90", "sm_90", "sm_86", "sm_90"):
        cubin = find_cubin("code", "code.cu", architecture)
        assert cubin == f"code for {architecture}".encode()
    assert compiled == ["sm_90", "sm_86"]


def test_kernels_are_for_gpus():
    with pytest.raises(DeviceError, match="do not run on cpu"):
        kernels_for(SOURCES[0], torch.device("cpu"))
