"""Kernels that come compiled: which GPU gets which, which source is meant, what is not loaded."""

import re
import zipfile
from pathlib import Path

import pytest
import torch

from geogs.application.machine import doctor
from geogs.errors import DeviceError
from geogs.gpu import binaries, build_binaries, kernels
from geogs.gpu.binaries import MACHINE_CODE, PTX, shipped_code, shipped_sources, usable_by
from geogs.gpu.kernel_source import PACKAGE, kernel_sources, read_source
from geogs.gpu.nvrtc import Nvrtc

SOURCE = 'extern "C" __global__ void add(int n, float* x) {}\n'


class Compiler(Nvrtc):
    """Says what it was asked for instead of compiling it."""

    def __init__(self) -> None:
        self.version = "13.0"

    def compile(self, source: str, name: str, architecture: str, options) -> bytes:
        return f"{name} {len(source)} {architecture} {' '.join(options)}".encode()


@pytest.fixture
def source(tmp_path, monkeypatch) -> Path:
    """A source that came compiled, on a machine that has compiled nothing itself."""
    file = tmp_path / "package" / "add.cu"
    file.parent.mkdir()
    file.write_text(SOURCE)
    monkeypatch.setattr(binaries, "FOLDER", tmp_path / "compiled")
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path / "cache"))
    build_binaries.build(Compiler(), [file], tmp_path / "compiled")
    return file


@pytest.fixture
def machine(monkeypatch):
    """A GPU of a capability, whose driver refuses what begins so."""

    def pretend(capability: tuple[int, int], refused: tuple[bytes, ...] = ()) -> list[bytes]:
        loaded = []

        def load(code: bytes, signatures, index: int) -> dict[str, kernels.Kernel]:
            loaded.append(code)
            if code.startswith(refused):
                raise DeviceError("The driver cannot load the compiled kernels.")
            return dict.fromkeys(signatures, code.decode)

        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: capability)
        monkeypatch.setattr(kernels, "load_kernels", load)
        kernels._device_kernels.cache_clear()
        return loaded

    yield pretend
    kernels._device_kernels.cache_clear()


def used(source: Path) -> str:
    """What its kernel consists of on that machine."""
    return kernels._device_kernels(source, 0)["add"]()


@pytest.mark.parametrize(
    ("capability", "usable"),
    [
        ((7, 0), []),
        ((7, 5), ["sm_75", PTX]),
        ((8, 0), ["sm_80", PTX]),
        ((8, 7), ["sm_86", PTX]),
        ((8, 9), ["sm_89", PTX]),
        ((9, 0), ["sm_90", PTX]),
        ((10, 3), ["sm_100", PTX]),
        ((11, 0), [PTX]),
        ((12, 1), ["sm_120", PTX]),
        ((13, 0), [PTX]),
    ],
)
def test_machine_code_is_for_its_generation_and_ptx_for_all_later_ones(capability, usable):
    assert usable_by(capability) == usable


def test_what_came_is_used_and_no_compiler_is_loaded(source, machine, monkeypatch, tmp_path):
    monkeypatch.setattr(kernels, "compiler", lambda: pytest.fail("NVRTC was asked for"))
    machine((8, 6))
    options = " ".join(kernels.OPTIONS)
    assert used(source) == f"add.cu {len(SOURCE)} sm_86 {options}"
    machine((13, 0))
    assert used(source).split()[2] == PTX
    assert not (tmp_path / "cache").exists()


def test_a_changed_source_is_compiled(source, machine, monkeypatch):
    monkeypatch.setattr(kernels, "compiler", Compiler)
    machine((8, 6))
    source.write_text(SOURCE + "// another\n")
    assert list(shipped_code(read_source(source), (8, 6))) == []
    assert used(source).split()[1] == str(len(SOURCE) + 11)
    assert set(shipped_sources([source]).values()) == {0}


def test_other_options_are_compiled(source, monkeypatch):
    assert len(list(shipped_code(SOURCE, (8, 6)))) == 2
    monkeypatch.setattr(binaries, "OPTIONS", ("--std=c++17",))
    assert list(shipped_code(SOURCE, (8, 6))) == []


def test_a_driver_that_is_too_old_gets_ptx_then_what_its_own_compiler_makes(
    source, machine, monkeypatch
):
    compiled = []
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(
        kernels, "compile_cubin", lambda *asked: compiled.append(asked) or b"its own"
    )
    tried = machine((8, 9), refused=(b"add.cu",))
    assert used(source) == "its own"
    assert [code.split()[2] for code in tried[:-1]] == [b"sm_89", PTX.encode()]
    assert compiled == [(SOURCE, "add.cu", "sm_89")]
    machine((8, 9), refused=(b"add.cu", b"its own"))
    with pytest.raises(DeviceError, match="driver cannot load"):
        used(source)


def test_a_damaged_archive_is_as_none(source):
    archive = binaries.FOLDER / "sm_86.zip"
    content = archive.read_bytes()
    for damaged in (content[:-30], content.replace(b"\x00sm", b"\x00mm"), b"", b"PK"):
        archive.write_bytes(damaged)
        codes = list(shipped_code(SOURCE, (8, 6)))
        assert codes[-1].split()[2] == PTX.encode()
    where = content.index(b"\x00" * 2, 60)
    archive.write_bytes(content[: where - 40] + bytes(40) + content[where:])
    assert len(list(shipped_code(SOURCE, (8, 6)))) == 1


def test_the_same_sources_make_the_same_files(source, tmp_path):
    size = build_binaries.build(Compiler(), [source], tmp_path / "again")
    files = sorted(binaries.FOLDER.iterdir())
    assert [f.stem for f in files] == sorted((*MACHINE_CODE, PTX))
    assert size == sum(f.stat().st_size for f in files)
    for file in files:
        assert file.read_bytes() == (tmp_path / "again" / file.name).read_bytes()
        assert len(zipfile.ZipFile(file).namelist()) == 1


def test_all_that_is_ever_asked_for_is_built():
    """Every ``.cu`` file that a module names is one of those that are built, and none is left."""
    built = kernel_sources(PACKAGE.parent)
    named = set()
    for module in PACKAGE.parent.glob("geogs*/**/*.py"):
        for name in re.findall(r'"([^"\s]*)\.cu"', module.read_text()):
            pattern = re.sub(r"\{\w+\}", "*", name or module.stem)
            found = {s for s in built if s.match(f"{pattern}.cu")}
            if name != "*":
                assert found, (module, name)
                named |= found
    assert named == set(built)


def test_the_doctor_says_what_came(source, monkeypatch):
    monkeypatch.setattr(doctor, "PACKAGE", source.parent)
    text = doctor._binaries().text
    assert text == f"of all 1 sources for {', '.join(MACHINE_CODE)}, {PTX}"
    source.write_text("changed")
    assert doctor._binaries().text == "none came along"
