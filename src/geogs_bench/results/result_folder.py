"""Reading the folder that ``geogs run`` or ``geogs reconstruct`` leaves."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from geogs.application.results.output_folder import read_summary
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.geometry.camera import Camera
from geogs.io.pose_files import read_frame_poses, read_tum_trajectory
from geogs.io.writers.intrinsics_file import read_camera
from geogs.io.writers.uncertainty import read_states
from geogs.types import Trajectory
from geogs_bench.results.record import StageName

_STAGE_FOLDERS: dict[StageName, str] = {
    "online": "online",
    "adjusted": "adjusted",
    "depth fusion": "depth_fusion",
    "final": "",
}


@dataclass(frozen=True)
class ResultFolder:
    """A result on disk."""

    path: Path

    @cached_property
    def summary(self) -> dict[str, Any]:
        """``summary.json``. Raises InputError if it is missing or damaged."""
        return read_summary(self.path)

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
        """The stages with files, in order of time."""
        files = ("mesh.ply", "trajectory.tum")
        return [
            stage
            for stage, folder in self._folders.items()
            if any((folder / file).is_file() for file in files)
        ]

    @property
    def _folders(self) -> dict[StageName, Path]:
        """Folders of the stages; without a refinement the result itself is the adjusted one."""
        folders = {stage: self.path / name for stage, name in _STAGE_FOLDERS.items()}
        if self.summary.get("refined", True):
            return folders
        return {
            "online": folders["online"],
            "depth fusion": folders["depth fusion"],
            "adjusted": folders["final"],
        }

    def _file(self, stage: StageName | None, name: str) -> Path | None:
        folder = self.path if stage is None else self._folders.get(stage)
        return folder / name if folder is not None and (folder / name).is_file() else None

    def mesh(self, stage: StageName | None = None) -> Surface | None:
        """The surface of a stage, or of the result, whatever its last stage; none if missing. Map
        units."""
        file = self._file(stage, "mesh.ply")
        return None if file is None else read_surface(file)

    def trajectory(self, stage: StageName, name: str = "trajectory.tum") -> Trajectory | None:
        """All poses of a stage, or the keyframes' (``keyframes.tum``); none if missing."""
        file = self._file(stage, name)
        return None if file is None else read_tum_trajectory(file)

    def poses(self) -> Trajectory | None:
        """All poses and orientations of the result, whatever its last stage, in order of time."""
        is_there = self._file(None, "trajectory.tum") is not None
        return read_frame_poses(self.path) if is_there else None

    def states(self) -> list[tuple[float, str, float]]:
        """Time, state and standard deviation of the position of every frame, by ``read_states``;
        empty if the result has no table of them. Raises InputError if that is damaged."""
        file = self.path / "trajectory_uncertainty.csv"
        return read_states(file) if file.is_file() else []

    def snapshots(self) -> list[tuple[float, Path]]:
        """Seconds and folders of the map's snapshots, in order of time."""
        folders = [p for p in self.path.glob("snapshots/*") if (p / "mesh.ply").is_file()]
        timed = [(seconds, p) for p in folders if (seconds := _number(p.name)) is not None]
        return sorted(timed)


def _number(text: str) -> float | None:
    try:
        return float(text.removesuffix("s"))
    except ValueError:
        return None
