"""Hand-made truths and results whose errors are known, for the tests of benchmarks."""

import json
from pathlib import Path

import numpy as np

from geogs.geometry.camera import Camera
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.ply_writer import write_mesh
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import Trajectory
from geogs_bench.data.benchmark_scene import BenchmarkScene, Truth
from geogs_bench.runners.runner import Runner
from geogs_bench.runners.task import Task

SCALE = 0.25
"""Map units per metre of the results."""


def wall(offset: float = 0.0, n: int = 41) -> tuple[np.ndarray, np.ndarray]:
    """A bent wall of 2 x 2 m in front of the cameras, moved away from them by ``offset`` metres."""
    u, v = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    vertices = np.stack([u, v, 2 + 0.3 * np.sin(2 * u) + 0.2 * v * v + offset], -1).reshape(-1, 3)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def options_of(task: Task) -> dict[str, str | None]:
    return {option.name: option.value for option in task.options}


def poses(n: int = 20) -> np.ndarray:
    """Cameras (to world) on an arc, looking at the wall."""
    T = np.tile(np.eye(4), (n, 1, 1))
    t = np.linspace(-0.5, 0.5, n)
    T[:, :3, 3] = np.stack([t, 0.2 * np.sin(5 * t), -0.3 * t * t], -1)
    return T


def write_truth(folder: Path, name: str = "hall") -> BenchmarkScene:
    """The wall and its poses; nothing has to be read from the source."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "traj.txt", poses().reshape(-1, 16))
    write_mesh(folder / "mesh.ply", *wall())
    truth = Truth(folder / "traj.txt", folder / "mesh.ply", culling="done")
    return BenchmarkScene(name, folder, truth)


def write_result(
    folder: Path,
    pose_noise: float,
    wall_offset: float | None,
    posed: bool = False,
    refined: bool = True,
) -> None:
    """A result with a known error; in map units unless the poses are known. No offset, no mesh."""
    s = 1.0 if posed else SCALE
    T = poses()
    T[:, 1, 3] += pose_noise * np.where(np.arange(len(T)) % 2, 1, -1)
    T[:, :3, 3] *= s
    trajectory = Trajectory(np.arange(len(T)) / 30, T, np.ones(len(T), bool))
    folder.mkdir(parents=True, exist_ok=True)
    write_tum_trajectory(folder / "trajectory.tum", trajectory)
    keyframes = Trajectory(trajectory.timestamps[::3], T[::3], trajectory.tracked[::3])
    write_tum_trajectory(folder / "keyframes.tum", keyframes)
    if wall_offset is not None:
        vertices, faces = wall(wall_offset)
        write_mesh(folder / "mesh.ply", s * vertices, faces)
    write_intrinsics(folder / "intrinsics.json", Camera(60.0, 60.0, 39.5, 29.5, 80, 60), None)
    summary = {
        "frames": len(T),
        "refined": refined,
        "disks": 1234,
        "device": "cpu",
        "frames_per_second": {"until_stream_end": 5.0},
        "peak_memory_bytes": 2_000_000_000,
        "seconds": {"total": 4.0},
    }
    (folder / "summary.json").write_text(json.dumps(summary))


class FakeRunner(Runner):
    """Leaves a hand-made trajectory; fails for the sources that it is told to."""

    def __init__(self, failing: dict[str, BaseException] | None = None) -> None:
        self.failing = failing or {}
        self.done: list[str] = []

    def settings(self, task: Task) -> dict[str, object]:
        return {"seed": 3, **options_of(task)}

    def run(self, task: Task) -> None:
        self.done.append(task.source.name)
        if task.source.name in self.failing:
            raise self.failing[task.source.name]
        write_result(task.output, 0.01, None)
        write_result(task.output / "online", 0.03, None)
