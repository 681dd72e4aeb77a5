"""Reading the folder that ``geogs run`` or ``geogs reconstruct`` leaves."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from geogs.errors import InputError
from geogs.evaluation.surface import Surface, read_surface
from geogs.geometry.camera import Camera
from geogs.io.poses import read_tum_trajectory
from geogs.io.writers.intrinsics import read_camera
from geogs.types import Trajectory
from geogs_bench.record import StageName

_STAGE_FOLDERS: dict[StageName, str] = {
    "online": "online", "depth fusion": "depth_fusion", "final": "",
}  # fmt: skip


@dataclass(frozen=True)
class ResultFolder:
    """A result on disk."""

    path: Path

    @cached_property
    def summary(self) -> dict[str, Any]:
        """``summary.json``. Raises InputError if it is missing or damaged."""
        file = self.path / "summary.json"
        try:
            return json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{file} cannot be read ({error}); was the run cut off?") from error

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
        return [
            stage
            for stage, name in _STAGE_FOLDERS.items()
            if any((self.path / name / file).is_file() for file in ("mesh.ply", "trajectory.tum"))
        ]

    def mesh(self, stage: StageName) -> Surface | None:
        """The surface of a stage, in map units; none where there is none."""
        file = self.path / _STAGE_FOLDERS[stage] / "mesh.ply"
        return read_surface(file) if file.is_file() else None

    def trajectory(self, stage: StageName, name: str = "trajectory.tum") -> Trajectory | None:
        """All poses of a stage, or the keyframes' (``keyframes.tum``); none where not there."""
        file = self.path / _STAGE_FOLDERS[stage] / name
        return read_tum_trajectory(file) if file.is_file() else None

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
