"""Signals ask to stop once and quit the second time; what fails says how to go on."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from geogs.application.checkpoints.run_state import RunMetadata
from geogs.application.interrupt import Interrupted, Interruption
from geogs.application.machine.device import gpu_errors_in_a_sentence
from geogs.application.run import continued
from geogs.application.run_settings import RunSettings
from geogs.errors import DeviceError, InputError, TrackingLost

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
WAY = " geogs run --resume out goes on."


@pytest.mark.parametrize("first", SIGNALS)
@pytest.mark.parametrize("second", SIGNALS)
def test_the_first_signal_asks_and_the_second_quits(first, second):
    before = [signal.getsignal(n) for n in SIGNALS]
    with Interruption() as stop:
        os.kill(os.getpid(), first)
        assert stop.requested
        assert stop.code == 128 + first
        with pytest.raises(Interrupted) as quits:
            os.kill(os.getpid(), second)
        assert quits.value.code == 128 + second
    assert [signal.getsignal(n) for n in SIGNALS] == before


@pytest.mark.parametrize("number", SIGNALS)
def test_work_that_stops_at_a_safe_point_ends_with_the_code_of_the_signal(number):
    stop = Interruption()

    def work() -> None:
        with stop, gpu_errors_in_a_sentence(lambda: WAY):
            os.kill(os.getpid(), number)
            stop.check()

    with pytest.raises(Interrupted) as ended:
        work()
    assert ended.value.code == 128 + number
    assert str(ended.value) == WAY.strip()
    with stop:
        assert stop.code == 130, "of the signals in this block there is none"


@pytest.mark.parametrize("kind", [InputError, TrackingLost])
def test_a_source_that_was_cut_off_has_no_fault(kind):
    def work(stop: Interruption) -> None:
        with stop:
            if stop is asked:
                os.kill(os.getpid(), signal.SIGTERM)
            raise kind("The pipe ended before its first image.")

    asked = Interruption()
    with pytest.raises(Interrupted, match="The pipe ended before its first image") as ended:
        work(asked)
    assert ended.value.code == 143
    with pytest.raises(kind):
        work(Interruption())


def test_a_signal_that_is_ignored_asks_for_nothing():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interruption() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.requested
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_the_second_signal_names_the_way_on():
    with pytest.raises(KeyboardInterrupt) as quits, gpu_errors_in_a_sentence(lambda: WAY):
        raise KeyboardInterrupt
    assert str(quits.value) == WAY.strip()


def test_of_blocks_in_blocks_the_inner_one_names_the_way_on():
    inner = gpu_errors_in_a_sentence(lambda: WAY)
    with pytest.raises(KeyboardInterrupt) as quits, gpu_errors_in_a_sentence(), inner:
        raise KeyboardInterrupt
    assert str(quits.value) == WAY.strip()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (torch.cuda.OutOfMemoryError("tried to allocate"), "The memory of the GPU is full"),
        (RuntimeError("CUDA error: unspecified launch failure\nmore"), "The GPU failed"),
        (RuntimeError("CUDA error: device not ready"), "The GPU failed"),
        (torch.AcceleratorError("CUDA error: an illegal memory access (Xid 31)"), "The GPU failed"),
    ],
)
def test_a_gpu_that_fails_is_told_with_the_way_on(error, said):
    with pytest.raises(DeviceError) as failed, gpu_errors_in_a_sentence(lambda: WAY):
        raise error
    assert str(failed.value).startswith(said)
    assert str(failed.value).endswith(WAY)
    assert "\n" not in str(failed.value)


def test_errors_of_ours_stay_what_they_are():
    with pytest.raises(RuntimeError, match="shapes"), gpu_errors_in_a_sentence(lambda: WAY):
        raise RuntimeError("shapes do not fit")


def test_a_run_that_lost_its_gpu_goes_on_on_the_cpu_where_that_is_asked_for():
    settings = RunSettings((Path("/videos/v.mp4"),))
    facts = RunMetadata(settings, "cuda", "0", None)
    on_cpu = replace(settings, device="cpu")
    assert continued(facts, on_cpu, Path("out")).device == "cpu"
    assert continued(facts, settings, Path("out")).device == "cuda"
    with pytest.raises(InputError, match="only go on there"):
        continued(replace(facts, device="cpu"), replace(settings, device="cuda"), Path("out"))
