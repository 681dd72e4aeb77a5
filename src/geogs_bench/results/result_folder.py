"""Reading the folder that ``geogs run`` or ``geogs reconstruct`` leaves."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from geogs.documents import read_json
from geogs.errors import InputError
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.geometry.camera import Camera
from geogs.io.pose_files import read_frame_poses, read_tum_trajectory
from geogs.io.writers.intrinsics_file import read_camera
from geogs.io.writers.uncertainty import read_states
from geogs.types import Trajectory
from geogs_bench.results.record import StageName

_STAGE_FOLDERS: dict[StageName, str] = {
    "online": "online", "adjusted": "adjusted", "depth fusion": "depth_fusion", "final": "",
}  # fmt: skip


TRACKED, ORIENTED = "tracked", "orientation only"
"""States of a frame that has a pose, and of one that has an orientation."""


@dataclass(frozen=True)
class FrameStates:
    """What a result says of every frame."""

    timestamps: Float64[np.ndarray, "n"]
    state: np.ndarray
    """Strings."""
    sigma_position: Float64[np.ndarray, "n"]
    """Map units; infinite where none is given."""

    def tracked_of(self, trajectory: Trajectory) -> Trajectory:
        """The poses of the frames that were tracked."""
        return self._of(trajectory, self.state == TRACKED)

    def oriented_of(self, trajectory: Trajectory) -> Trajectory:
        """The poses of the frames that have an orientation at least."""
        return self._of(trajectory, np.isin(self.state, (TRACKED, ORIENTED)))

    def _of(self, trajectory: Trajectory, chosen: Bool[np.ndarray, "n"]) -> Trajectory:
        keep = np.isin(trajectory.timestamps.round(6), self.timestamps[chosen].round(6))
        return Trajectory(
            trajectory.timestamps[keep], trajectory.T_wc[keep], trajectory.tracked[keep]
        )


@dataclass(frozen=True)
class ResultFolder:
    """A result on disk."""

    path: Path

    @cached_property
    def summary(self) -> dict[str, Any]:
        """``summary.json``. Raises InputError if it is missing or damaged."""
        file = self.path / "summary.json"
        summary = read_json(file)
        if not isinstance(summary, dict):
            raise InputError(f"{file} is damaged; it holds no summary of a run.")
        return summary

    @cached_property
    def camera(self) -> Camera:
        """The working camera. Raises InputError if ``intrinsics.json`` holds none."""
        return read_camera(self.path / "intrinsics.json")

    @property
    def map_bytes(self) -> int | None:
        """Size of the map's file."""
        file = self.path / "map.safetensors"
        return file.stat().st_size if file.is_file() else None

    def stages(self) -> list[StageName]:
        """The stages that left anything, in order of time."""
        files = ("mesh.ply", "trajectory.tum")
        return [
            stage
            for stage, folder in self._folders.items()
            if any((folder / file).is_file() for file in files)
        ]

    @property
    def _folders(self) -> dict[StageName, Path]:
        """Where the stages are; without a refinement the result itself is the adjusted one."""
        folders = {stage: self.path / name for stage, name in _STAGE_FOLDERS.items()}
        if self.summary.get("refined", True):
            return folders
        return {"online": folders["online"], "depth fusion": folders["depth fusion"],
                "adjusted": folders["final"]}  # fmt: skip

    def _file(self, stage: StageName, name: str) -> Path | None:
        folder = self._folders.get(stage)
        return folder / name if folder is not None and (folder / name).is_file() else None

    def mesh(self, stage: StageName) -> Surface | None:
        """The surface of a stage, in map units; none where there is none."""
        file = self._file(stage, "mesh.ply")
        return None if file is None else read_surface(file)

    def trajectory(self, stage: StageName, name: str = "trajectory.tum") -> Trajectory | None:
        """All poses of a stage, or the keyframes' (``keyframes.tum``); none where not there."""
        file = self._file(stage, name)
        return None if file is None else read_tum_trajectory(file)

    def final_mesh(self) -> Surface | None:
        """The surface of the result, whatever its last stage; none where there is none."""
        file = self.path / "mesh.ply"
        return read_surface(file) if file.is_file() else None

    def final_trajectory(self) -> Trajectory | None:
        """The poses of the frames whose place is known; none where there are none."""
        file = self.path / "trajectory.tum"
        return read_tum_trajectory(file) if file.is_file() else None

    def poses(self) -> Trajectory | None:
        """All poses and orientations of the result, whatever its last stage, in order of time."""
        is_there = (self.path / "trajectory.tum").is_file()
        return read_frame_poses(self.path) if is_there else None

    def uncertainty(self) -> FrameStates | None:
        """``trajectory_uncertainty.csv``; none where it is not there.

        Raises InputError if it is damaged.
        """
        file = self.path / "trajectory_uncertainty.csv"
        if not file.is_file():
            return None
        rows = read_states(file)
        times, states, sigma = zip(*rows, strict=True) if rows else ((), (), ())
        return FrameStates(np.array(times, float), np.array(states, str), np.array(sigma, float))

    def snapshots(self) -> list[tuple[float, Path]]:
        """Folders of the map after so many seconds, in order of time."""
        folders = [p for p in self.path.glob("snapshots/*") if (p / "mesh.ply").is_file()]
        timed = [(seconds, p) for p in folders if (seconds := _number(p.name)) is not None]
        return sorted(timed)


def _number(text: str) -> float | None:
    try:
        return float(text.removesuffix("s"))
    except ValueError:
        return None
