"""A run is looked at without being held up: what there is no time for is dropped."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geogs.application.viewer.browser_window import Window
from geogs.application.viewer.live_viewer import MAX_DISKS, LiveViewer
from geogs.geometry.camera import Camera
from geogs.pose_estimate import PoseEstimate
from geogs.types import Frame, MapSnapshot
from geogs.world.segments import TrackState

CAMERA = Camera(80.0, 80.0, 63.5, 47.5, 128, 96)


class FakeWindow(Window):
    """Remembers what it was to show; takes as long as it is told to."""

    clients, layer = 1, "image"

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.gate = threading.Event()
        self.gate.set()
        self.boxes = {}
        self.disks = None
        self._frusta = {}
        self._parts = {"Keyframes": []}
        self._switches = {"Keyframes": SimpleNamespace(value=True)}

    def add_checkbox(self, name, value):
        self.boxes[name] = SimpleNamespace(value=value)
        return self.boxes[name]

    def show_disks(self, disks):
        self.disks = disks
        self.calls.append("disks")

    def _frustum(self, name, T_wc, *look):
        self.calls.append(name)
        return SimpleNamespace(wxyz=None, position=T_wc[:3, 3])

    def say(self, *words):
        self.gate.wait(5)
        self.calls.append("say")

    def show_path(self, points):
        self.calls.append("show_path")

    def show_picture(self, picture):
        self.calls.append("show_picture")

    def show_camera(self, T_wc, camera, image):
        self.calls.append("show_camera")

    def show_mesh(self, mesh):
        self.calls.append("show_mesh")

    def follow(self, T_wc):
        self.calls.append("follow")

    def stand_upright(self, T_wc, size):
        pass


class FakeSlam:
    """Three keyframes, many disks."""

    camera = CAMERA

    def straightened(self, image):
        return image

    def __init__(self) -> None:
        T = [torch.eye(4, dtype=torch.float64) for _ in range(3)]
        for i, pose in enumerate(T):
            pose[0, 3] = i
        keyframes, loops = SimpleNamespace(poses=dict(enumerate(T))), SimpleNamespace(loops=[1])
        self.world, self.T_cw = SimpleNamespace(keyframes=keyframes, loops=loops), T[2]
        self.segments = SimpleNamespace(keyframe_ids=[0, 1, 2])

    def snapshot(self) -> MapSnapshot:
        n = MAX_DISKS + 1
        return MapSnapshot(
            torch.zeros(n, 3), torch.zeros(n, 4), torch.ones(n, 2), torch.full((n,), 0.5)
        )

    def depth_maps(self) -> list:
        return []


@pytest.fixture
def window() -> FakeWindow:
    return FakeWindow()


def look(viewer: LiveViewer, slam: FakeSlam, number: int = 5) -> None:
    image = np.zeros((96, 128, 3), np.uint8)
    status = PoseEstimate(TrackState.TRACKING, number, 3, MAX_DISKS + 1)
    viewer.frame(Frame(number, number / 30, image), status, slam)


def wait(viewer: LiveViewer) -> None:
    """Until the viewer's thread has shown what it was given."""
    end = time.perf_counter() + 600
    while viewer._next is not None and time.perf_counter() < end:
        time.sleep(0.005)


def test_everything_is_shown_once_and_what_moved_moves(window, monkeypatch):
    monkeypatch.setattr("geogs.application.viewer.live_viewer._MAP_SECONDS", 1e6)
    viewer, slam = LiveViewer(window, max_fraction=1.0), FakeSlam()
    look(viewer, slam)
    wait(viewer)
    frusta = [c for c in window.calls if c.startswith("/keyframes")]
    assert frusta == ["/keyframes/0", "/keyframes/1", "/keyframes/2"]
    assert len(window.disks) == MAX_DISKS // 2 + 1  # every second
    for call in ("show_path", "show_camera", "show_picture", "follow", "say"):
        assert call in window.calls
    window.calls.clear()
    slam.world.keyframes.poses[1][2, 3] = 0.5
    window.boxes["Follow"].value = False
    look(viewer, slam)
    wait(viewer)
    assert not any(c.startswith("/keyframes") for c in window.calls)
    moved = [frustum.position.tolist() for frustum in window._parts["Keyframes"]]
    assert moved == [[0, 0, 0], [-1, 0, -0.5], [-2, 0, 0]]
    assert "disks" not in window.calls  # it is too early for the map again
    assert "follow" not in window.calls


def test_a_window_that_hangs_holds_nothing_up(window):
    viewer, slam = LiveViewer(window, max_fraction=1.0), FakeSlam()
    window.gate.clear()

    def look_on() -> None:
        for number in range(200):
            look(viewer, slam, number)

    looking = threading.Thread(target=look_on, daemon=True)
    looking.start()
    looking.join(600)
    assert not looking.is_alive()
    window.gate.set()
    wait(viewer)
    assert window.calls.count("say") == 1  # the others were dropped


def test_no_more_than_its_share_of_the_time_is_used(window):
    share = 0.02
    viewer, slam = LiveViewer(window, share), FakeSlam()
    begin = time.perf_counter()
    elapsed = 0.0
    while elapsed < 1.2 or (window.calls.count("say") < 2 and elapsed < 600):
        look(viewer, slam)
        time.sleep(0.002)
        elapsed = time.perf_counter() - begin
    wait(viewer)
    elapsed = time.perf_counter() - begin
    one = 0.1  # seconds of computing that a single look takes at most
    assert window.calls.count("say") >= 2
    assert viewer.used < share * elapsed + one


def test_nobody_looking_and_a_pause_cost_nothing(window):
    viewer, slam = LiveViewer(window, max_fraction=1.0), FakeSlam()
    window.clients = 0
    look(viewer, slam)
    window.clients = 1
    window.boxes["Pause"].value = True
    look(viewer, slam)
    assert viewer.used == 0
    assert window.calls == []


def test_the_end_shows_mesh_and_verdict(window):
    viewer = LiveViewer(window)
    verdict = SimpleNamespace(sentence="Reliable.")
    source = SimpleNamespace(name="room")
    viewer.result(SimpleNamespace(mesh=object(), verdict=verdict, source=source))
    assert window.calls == ["show_mesh", "say"]
    assert not viewer._thread.is_alive()
