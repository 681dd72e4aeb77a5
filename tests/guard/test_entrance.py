"""One thread of one process changes a system, and by whole images."""

import functools
import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

import geogs
from geogs.errors import InputError
from geogs.guard.entrance import Entrance, changes_system
from quick_systems import quick_config
from tracking_scenes import render, sideways

CAMERA = geogs.Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
NOISE = np.random.default_rng(3).integers(0, 255, (72, 200, 3)).astype(np.uint8)


def image(number: int) -> np.ndarray:
    """Texture that moves to the left by two pixels an image."""
    return np.ascontiguousarray(NOISE[:, 2 * number : 2 * number + 96])


def system(**more) -> geogs.Slam:
    return geogs.Slam(CAMERA, quick_config(final_iterations=5), device="cpu", **more)


class Counter:
    """Counts, and can be held up within a count."""

    def __init__(self) -> None:
        self.entrance = Entrance()
        self.count = 0
        self.inside, self.on = threading.Event(), threading.Event()

    @changes_system
    def add(self, waits: bool = False) -> int:
        self.inside.set()
        if waits:
            assert self.on.wait(30)
        self.count = self.count + 1
        return self.count if waits else self.add_one_more()

    @changes_system
    def add_one_more(self) -> int:
        return self.count


def test_another_thread_is_refused_while_one_is_at_work_and_let_in_after_it():
    counter = Counter()
    with ThreadPoolExecutor(1) as other:
        first = other.submit(counter.add, waits=True)
        assert counter.inside.wait(30)
        with pytest.raises(InputError, match="Another thread is at work"):
            counter.add()
        counter.on.set()
        assert first.result() == 1
    assert counter.add() == 2


def test_every_method_that_changes_a_system_has_the_entrance():
    slam = system()
    changing = ("process", "end_stream", "adjust", "refine", "finish", "place_found", "rescale")
    with ThreadPoolExecutor(1) as other, slam.entrance.entered():
        for name in changing:
            arguments = {"process": (image(0),), "place_found": (None,), "rescale": (None,)}
            call = other.submit(getattr(slam, name), *arguments.get(name, ()))
            with pytest.raises(InputError, match="Another thread"):
                call.result()
    assert slam.frames == 0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of forks with threads
def test_a_forked_child_is_refused_in_a_sentence_and_can_make_its_own():
    slam = system()
    for number in range(3):
        slam.process(image(number))
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        try:
            with pytest.raises(InputError, match="before the process was forked"):
                slam.process(image(3))
            with pytest.raises(InputError, match="before the process was forked"):
                slam.trajectory()
            own = system()
            states = [own.process(image(number)).state.value for number in range(4)]
            os.write(writer, f"{own.frames} {states[0]}".encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        said = pipe.read()
    os.waitpid(child, 0)
    assert said == b"4 initializing"
    assert slam.process(image(3)).frames == 4


def raised_in(slam: geogs.Slam, monkeypatch, act, number: int = 3) -> None:
    """Do something in the middle of the processing of an image."""
    track = slam.executor.track

    def interrupted(*arguments):
        act()
        return track(*arguments)

    monkeypatch.setattr(slam.executor, "track", interrupted)
    try:
        slam.process(image(number))
    finally:
        monkeypatch.setattr(slam.executor, "track", track)


def test_ctrl_c_waits_for_the_end_of_an_image(monkeypatch):
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    slam = system()
    for number in range(3):
        slam.process(image(number))
    with pytest.raises(KeyboardInterrupt):
        raised_in(slam, monkeypatch, lambda: signal.raise_signal(signal.SIGINT))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert slam.pose.frames == slam.frames == 4
    for number in range(4, 8):
        slam.process(image(number))
    times = slam.trajectory().timestamps
    assert len(times) == 8
    assert (np.diff(times) > 0).all()


@pytest.mark.parametrize("cause", ["interrupted twice", "error"])
def test_after_an_image_that_was_cut_off_none_follows(cause, monkeypatch):
    slam = system()
    slam.process(image(0))

    def cut() -> None:
        if cause == "error":
            raise MemoryError
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(MemoryError if cause == "error" else KeyboardInterrupt):
        raised_in(slam, monkeypatch, cut, 1)
    with pytest.raises(InputError, match="cut off"):
        slam.process(image(2))
    assert slam.frames == 1


def test_a_handler_of_the_program_stays(monkeypatch):
    came = []
    before = signal.signal(signal.SIGINT, lambda *_: came.append(True))
    try:
        slam = system()
        raised_in(slam, monkeypatch, lambda: signal.raise_signal(signal.SIGINT), 0)
    finally:
        signal.signal(signal.SIGINT, before)
    assert came == [True]
    assert slam.frames == 1


def poses() -> np.ndarray:
    """Of a whole run: started, tracked, adjusted and mapped."""
    slam = system()
    for number, T in enumerate(sideways(18, 0.05)):
        slam.process(render(T, CAMERA)[0], number / 30)
    slam.finish()
    assert len(slam.snapshot()) > 10
    return slam.trajectory().T_wc


@functools.cache
def expected_poses() -> np.ndarray:
    return poses()


def usual_settings() -> tuple[object, ...]:
    return torch.get_default_dtype(), torch.get_num_threads(), np.geterr()["divide"]


@pytest.mark.system
@pytest.mark.parametrize(
    "setting",
    [
        pytest.param("inference mode", marks=pytest.mark.long),
        "double",
        pytest.param("NumPy raises", marks=pytest.mark.long),
        pytest.param("no grad", marks=pytest.mark.long),
    ],
)
def test_settings_of_a_program_change_no_pose_and_stay(setting):
    expected = expected_poses()
    before = usual_settings()
    if setting == "inference mode":
        with torch.inference_mode():
            found = poses()
            assert torch.is_inference_mode_enabled()
    elif setting == "no grad":
        with torch.no_grad():
            found = poses()
            assert not torch.is_grad_enabled()
    elif setting == "double":
        torch.set_default_dtype(torch.float64)
        try:
            found = poses()
            assert torch.get_default_dtype() == torch.float64
        finally:
            torch.set_default_dtype(torch.float32)
    else:
        with np.errstate(all="raise"):
            found = poses()
            assert np.geterr()["divide"] == "raise"
    assert (found == expected).all()
    assert usual_settings() == before
