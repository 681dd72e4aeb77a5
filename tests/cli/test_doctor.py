"""``geogs doctor``: findings, what is to be mended, exit codes."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from geogs.application.machine import doctor
from geogs.cli import doctor as command
from geogs.cli.answer import shown
from geogs.errors import DeviceError
from geogs.gpu import cache, installation, kernels

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def main(argv: list[str]) -> int:
    """The command, whose end is printed."""
    return shown(command.main(argv))


@pytest.fixture
def machine(monkeypatch):
    """Pretend a driver (newest CUDA version or None) and a build of PyTorch."""

    def pretend(driver, build, available=False, module=False) -> None:
        monkeypatch.setattr(installation, "driver_cuda", lambda: driver)
        monkeypatch.setattr(torch.version, "cuda", build)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
        path = __file__ if module else f"{__file__}-not-there"
        monkeypatch.setattr(installation, "_KERNEL_MODULE", type(installation._KERNEL_MODULE)(path))

    return pretend


@pytest.fixture
def untested(monkeypatch) -> None:
    """Nothing is compiled, compared or timed."""
    monkeypatch.setattr(doctor.compilation, "is_compiled", lambda: True)
    monkeypatch.setattr(doctor, "_self_test", lambda device: ())


def test_healthy_cpu_machine(machine, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path))
    monkeypatch.setattr(doctor, "cache_from_source", lambda source: __file__)
    machine(None, None)
    assert main([]) == 0
    text = capsys.readouterr().out
    for name in ("Python", "PyTorch", "OpenCV", "numba", "video", "kernel cache", "self-test"):
        assert name in text
    assert "There is no NVIDIA driver on this machine" in text
    assert "a GPU needs one and a CUDA build of PyTorch" in text
    assert "OK" in text
    assert "BAD" not in text
    assert "ms forward and backward" in text
    assert text.rstrip().endswith("everything works")


@pytest.mark.usefixtures("untested")
def test_a_python_that_keeps_no_bytecode_is_slow(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(doctor, "cache_from_source", lambda source: str(tmp_path / "none.pyc"))
    assert main(["--device", "cpu"]) == 0
    text = capsys.readouterr().out
    assert "unset PYTHONDONTWRITEBYTECODE, or run" in text
    assert str(Path(torch.__file__).parent) in text


def test_wrong_results_fail(monkeypatch, capsys):
    def wrong(*args, **kwargs):
        output = true_render(*args, **kwargs)
        return replace(output, normal=1.01 * output.normal)

    true_render = doctor.render
    monkeypatch.setattr(doctor, "render", wrong)
    assert main(["--device", "cpu"]) == 2
    text = capsys.readouterr().out
    assert "BAD" in text
    assert "To mend:\n  - The renderer gives wrong results on cpu" in text


def test_crash_of_the_renderer_is_one_line(monkeypatch, capsys):
    def crash(*args, **kwargs):
        raise RuntimeError("no kernel image is available\nand more")

    monkeypatch.setattr(doctor, "render", crash)
    assert main(["--device", "cpu"]) == 2
    text = capsys.readouterr().out
    assert "does not run on cpu (RuntimeError: no kernel image is available)." in text


def test_agreement_bounds():
    assert doctor.Agreement(1e-5, 1e-4).is_good
    assert not doctor.Agreement(1e-2, 1e-4).is_good
    assert not doctor.Agreement(1e-5, float("nan")).is_good


@pytest.mark.parametrize(
    ("driver", "build", "module", "words"),
    [
        (None, None, False, "no NVIDIA driver on this machine; a GPU needs one and a CUDA build"),
        (None, "13.0", False, "no NVIDIA driver on this machine; a GPU needs one."),
        ((13, 0), None, False, "was built without CUDA; install a CUDA build of PyTorch"),
        (None, None, True, "was built without CUDA"),
        ((12, 4), "13.0", False, "supports CUDA 12.4, but this PyTorch was built for CUDA 13.0"),
        ((13, 0), "13.0", False, "PyTorch finds no GPU"),
        ((13, 0), "12.8", False, "PyTorch finds no GPU"),
    ],
)
def test_why_there_is_no_gpu(machine, driver, build, module, words):
    machine(driver, build, module=module)
    problem = installation.gpu_problem()
    assert problem is not None
    assert words in problem
    assert problem.endswith(".")
    assert "\n" not in problem
    with pytest.raises(DeviceError, match="Until then use --device cpu"):
        installation.require_device("cuda")


def test_no_problem_where_there_is_a_gpu(machine, monkeypatch):
    machine((13, 0), "13.0", available=True)
    assert installation.gpu_problem() is None
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert installation.require_device("cuda") == torch.device("cuda", 0)
    assert installation.require_device("cuda:1") == torch.device("cuda", 1)
    with pytest.raises(DeviceError, match="no GPU 2; this machine has 2"):
        installation.require_device("cuda:2")


@pytest.mark.parametrize("name", ["gpu", "", "mps", "cuda:x"])
def test_unknown_devices(name):
    with pytest.raises(DeviceError, match="use cpu"):
        installation.require_device(name)


@pytest.mark.usefixtures("untested")
def test_driver_without_cuda_build_is_to_be_mended(machine, capsys):
    machine((13, 0), None)
    assert main([]) == 0  # the CPU works all the same
    text = capsys.readouterr().out
    assert "To mend:\n  - This machine has an NVIDIA driver, but this PyTorch" in text


def test_cache_state(monkeypatch, tmp_path):
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path / "new"))
    assert cache.cache_state() == cache.CacheState(0, 0, None)
    cache.write_cubin("key", b"12345")
    assert cache.cache_state() == cache.CacheState(1, 32 + 5, None)
    (tmp_path / "file").touch()
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path / "file"))
    assert cache.cache_state().problem
    assert doctor._cache(is_needed=False).problem is None
    problem = doctor._cache(is_needed=True).problem
    assert problem is not None
    assert "every start compiles them again; set GEOGS_CACHE" in problem


def test_gpus_and_driver_are_named(machine, monkeypatch):
    machine((13, 1), "13.0", available=True)
    gpu = SimpleNamespace(name="Test GPU", total_memory=24 * 2**30, major=9, minor=0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: gpu)
    monkeypatch.setattr(installation, "driver_release", lambda: "580.65.06")
    found = list(doctor._gpus())
    assert [f.name for f in found] == ["GPU 0", "GPU 1", "driver"]
    assert found[1].text == "Test GPU, 24.0 GiB, capability 9.0"
    assert found[2].text == "580.65.06, supports CUDA 13.1"
    assert not any(f.problem for f in found)


def test_kernels_that_do_not_compile(monkeypatch):
    def broken(folder, device):
        raise DeviceError("The CUDA kernels in x.cu do not compile: line 3")

    monkeypatch.setattr(kernels, "prepare_kernels", broken)
    finding = doctor._kernels(torch.device("cuda"))
    assert finding.is_fatal
    assert finding.problem == "The CUDA kernels in x.cu do not compile: line 3"


def test_missing_compiler(monkeypatch):
    def missing():
        raise DeviceError("The CUDA 13 run-time compiler (libnvrtc) is missing; install it.")

    monkeypatch.setattr(kernels, "compiler", missing)
    assert "libnvrtc" in (doctor._compiler().problem or "")


def test_all_kernels_are_prepared(monkeypatch, tmp_path):
    (tmp_path / "a" / "cuda").mkdir(parents=True)
    for name in ("a/cuda/one.cu", "a/two.cu", "a/common.cuh"):
        (tmp_path / name).touch()
    asked = []
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(
        kernels, "kernels_for", lambda s, d: asked.append(s.name) or {"x": 1, "y": 2}
    )
    assert kernels.prepare_kernels(tmp_path, torch.device("cuda")) == 4
    assert sorted(asked) == ["one.cu", "two.cu"]


@pytest.mark.gpu
@NEEDS_GPU
def test_gpu_machine(capsys):
    assert main([]) == 0
    text = capsys.readouterr().out
    for name in ("GPU 0", "driver", "NVRTC", "kernels"):
        assert name in text
    assert "cuda renderer against its specification" in text
