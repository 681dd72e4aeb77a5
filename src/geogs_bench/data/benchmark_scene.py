"""A scene of a benchmark: its source, options and truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Culling = Literal["done", "frustum", "occlusion"]
"""Culled by its provider; to be culled by the frusta; or by frusta and occlusion."""


@dataclass(frozen=True)
class Option:
    """An option of ``geogs run`` or ``geogs reconstruct``: dotted name and value as text.

    A switch has no value.
    """

    name: str
    value: str = ""

    def arguments(self) -> list[str]:
        """The option on a command line."""
        return [f"--{self.name}", self.value] if self.value else [f"--{self.name}"]


def same_surface(long_edge: str, voxel: str) -> tuple[Option, ...]:
    """Options of every method: images of one size, and the same surface from its depths."""
    return (
        Option("input.long-edge", long_edge),
        Option("mesh.voxel", voxel),
        Option("mesh.truncation", "5"),
    )


@dataclass(frozen=True)
class DtuTruth:
    """The official files that DTU's protocol needs for a scan."""

    folder: Path
    """``SampleSet/MVS Data``, with ``ObsMask`` and ``Points/stl``."""
    scan: int


@dataclass(frozen=True)
class Truth:
    """Ground truth of a scene; a part is none if it is not there."""

    poses: Path | None = None
    """Path as for ``geogs eval --gt``, or the COLMAP model of a video at 60 frames a second, with
    images named by their frames."""
    surface: Path | None = None
    """PLY in metres, in the frame of the poses."""
    points: Path | None = None
    """PLY of the points of it that the camera saw; completeness is measured on them."""
    culling: Culling = "occlusion"
    """Culling of ``surface`` to the seen part before whole meshes are compared."""
    dtu: DtuTruth | None = None


@dataclass(frozen=True)
class BenchmarkScene:
    """One sequence of a benchmark."""

    name: str
    source: Path
    """Source for ``geogs run`` or ``geogs reconstruct``."""
    truth: Truth
    options: tuple[Option, ...] = ()
    """Options of this scene, such as its intrinsics."""
    kind: Literal["room", "object", "scan", "motion", "depth"] = "room"
    """Scoring of a surface from known poses: a room in cm, an object in mm, a scan by DTU; for
    ``motion`` only the trajectory is scored, for ``depth`` only the views."""
    has_depth: bool = False
    """Whether the images have the depth of a sensor."""
