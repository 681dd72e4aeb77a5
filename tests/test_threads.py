"""Heavy calls hold PyTorch to one thread, whatever their caller uses, and give it back."""

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from geogs.config import MeshConfig
from geogs.evaluation import trajectory_errors
from geogs.evaluation.surfaces import reconstruction_errors, toolbox
from geogs.geometry.camera import Camera
from geogs.mesh import colour as colours
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.threads import on_one_torch_thread, thread_map
from geogs.types import Trajectory
from surface_shapes import plane

CAMERA = Camera(30.0, 30.0, 19.5, 14.5, 40, 30)
Note = Callable[..., None]


@pytest.fixture
def several_threads() -> Iterator[int]:
    """A caller who uses three threads of PyTorch."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield 3
    torch.set_num_threads(before)


@pytest.fixture
def seen() -> list[int]:
    """How many threads PyTorch had, whenever that was noted."""
    return []


@pytest.fixture
def note(seen) -> Note:
    return lambda *arguments: seen.append(torch.get_num_threads())


def wall() -> DepthMapView:
    depth = torch.full((30, 40), 2.0)
    image = np.full((30, 40, 3), 90, np.uint8)
    return DepthMapView(depth, 2 * torch.ones(30, 40), CAMERA, torch.eye(4).double(), image)


def extract(note: Note, monkeypatch: pytest.MonkeyPatch) -> None:
    extract_mesh([wall()], MeshConfig(voxel=0.1, min_component_faces=1), note)


def colour(note: Note, monkeypatch: pytest.MonkeyPatch) -> None:
    corner = np.array([[0.0, 0.0, 2.0]], np.float32)
    monkeypatch.setattr(colours, "seen_colours", noting(note, colours.seen_colours))
    colours.colour_mesh(Mesh(corner, np.zeros((0, 3), np.int32), -corner / 2), [wall()], 0.1)


def noting(note: Note, function: Callable) -> Callable:
    def noted(*arguments: object, **more: object) -> object:
        note()
        return function(*arguments, **more)

    return noted


def compare_surfaces(note: Note, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = noting(note, reconstruction_errors.sample_surface)
    monkeypatch.setattr(reconstruction_errors, "sample_surface", sample)
    errors = reconstruction_errors.evaluate_reconstruction(plane(2.0), plane(2.03), samples=2000)
    assert errors.scores.accuracy_cm == pytest.approx(3.0, abs=0.01)


def compare_vertices(note: Note, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(toolbox, "sample_surface", noting(note, toolbox.sample_surface))
    toolbox.evaluate_vertices(plane(2.0), plane(2.03), use_icp=False)


def compare_trajectories(note: Note, monkeypatch: pytest.MonkeyPatch) -> None:
    T_wc = np.tile(np.eye(4), (9, 1, 1))
    T_wc[:, :3, 3] = np.random.default_rng(0).normal(size=(9, 3))
    path = Trajectory(np.arange(9.0), T_wc, np.ones(9, bool))
    monkeypatch.setattr(trajectory_errors, "umeyama", noting(note, trajectory_errors.umeyama))
    assert trajectory_errors.evaluate_trajectory(path, path).ate_rmse_cm < 1e-9


@pytest.mark.parametrize(
    "call", [extract, colour, compare_surfaces, compare_vertices, compare_trajectories]
)
def test_a_heavy_call_has_one_thread_and_gives_the_others_back(
    call, note, seen, several_threads, monkeypatch
):
    call(note, monkeypatch)
    assert set(seen) == {1}
    assert torch.get_num_threads() == several_threads


def test_an_error_gives_the_threads_back_too(several_threads):
    @on_one_torch_thread
    def fail() -> None:
        assert torch.get_num_threads() == 1
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert torch.get_num_threads() == several_threads


def test_results_come_in_the_order_of_the_items():
    fractions: list[float] = []
    assert thread_map(lambda n: n * n, range(5), fractions.append) == [0, 1, 4, 9, 16]
    assert fractions == [0.2, 0.4, 0.6, 0.8, 1.0]


def test_calls_within_calls_share_the_threads(monkeypatch):
    monkeypatch.setattr("geogs.threads.worker_count", lambda: 3)
    before = set(threading.enumerate())

    def outer(n: int) -> list[int]:
        return thread_map(lambda k: 10 * n + k, range(7))

    for _ in range(20):
        assert thread_map(outer, range(9)) == [[10 * n + k for k in range(7)] for n in range(9)]
    assert len(set(threading.enumerate()) - before) <= 2


def test_an_error_in_a_call_within_a_call_arrives(monkeypatch):
    monkeypatch.setattr("geogs.threads.worker_count", lambda: 3)

    def fail(n: int) -> None:
        if n == 3:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        thread_map(lambda _: thread_map(fail, range(6)), range(4))


def test_after_an_interruption_what_nobody_has_begun_is_left(monkeypatch):
    monkeypatch.setattr("geogs.threads.worker_count", lambda: 2)
    begun: list[int] = []

    def work(item: int) -> None:
        begun.append(item)
        time.sleep(0.02)

    def interrupt(fraction: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        thread_map(work, range(50), interrupt)
    assert len(begun) < 25
