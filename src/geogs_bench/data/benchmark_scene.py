"""A scene of a benchmark: what to read, how, and what is known of the truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Culling = Literal["done", "frustum", "occlusion"]
"""Culled by its provider; to be culled by the frusta; and by what hides it, too."""


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
    """What every method gets: images of one size, and the same surface from its depths."""
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
    """What a result can be compared with; a part is none where it is not there."""

    poses: Path | None = None
    """Path as for ``geogs eval --gt``, or the COLMAP model of a video at 60 frames a second, whose
    images are called by their frames."""
    surface: Path | None = None
    """PLY in metres, in the frame of the poses."""
    points: Path | None = None
    """PLY of what the camera saw of it; completeness is measured on them."""
    culling: Culling = "occlusion"
    """How ``surface`` is to be cut down to what the camera saw before whole meshes are compared."""
    dtu: DtuTruth | None = None


@dataclass(frozen=True)
class BenchmarkScene:
    """One sequence of a benchmark."""

    name: str
    source: Path
    """What ``geogs run`` or ``geogs reconstruct`` reads."""
    truth: Truth
    options: tuple[Option, ...] = ()
    """What this scene needs, such as its intrinsics."""
    kind: Literal["room", "object", "scan", "motion", "depth"] = "room"
    """How a surface from known poses is scored: as a room in cm, an object in mm, or by DTU; of a
    motion the trajectory alone is scored, of depth the views alone."""
    has_depth: bool = False
    """Whether the images come with the depth of a sensor."""
