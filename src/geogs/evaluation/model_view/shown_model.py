"""What the model of a page shows: a surface, paths, keyframes and disks."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from geogs.evaluation.model_view.room import Room
from geogs.evaluation.model_view.start_view import StartView
from geogs.types import FrameState


@dataclass(frozen=True)
class Colouring:
    """One way to colour the vertices of a surface."""

    name: str
    """On a button."""
    colours: UInt8[np.ndarray, "n 3"]
    """RGB."""
    legend: "Legend | None" = None
    """What the colours mean, where they are not those of the images."""


@dataclass(frozen=True)
class Legend:
    """A scale of colours."""

    title: str
    ends: tuple[str, str]
    """What the first and the last colour stand for."""
    stops: Sequence[str]
    """Colours from one end to the other, as CSS has them."""
    note: str = ""
    """What another colour means."""


@dataclass(frozen=True)
class SurfaceModel:
    """Triangles, counter-clockwise seen from free space, and their colours."""

    vertices: Float[np.ndarray, "n 3"]
    """Map units."""
    faces: Int[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "n 3"]
    """Unit, towards free space."""
    colourings: Sequence[Colouring] = ()
    """The first is shown first; without any the surface is plain."""


@dataclass(frozen=True)
class PathModel:
    """A path of the camera."""

    name: str
    points: Float[np.ndarray, "n 3"]
    """Map units."""
    states: Sequence[FrameState] | None = None
    """What is known of each point; none of a true path."""


@dataclass(frozen=True)
class KeyframeModel:
    """A camera and its image."""

    name: str
    T_wc: Float[np.ndarray, "4 4"]
    """Camera to world."""
    jpeg: bytes | None = None
    """Its image; none where that is not shown."""


@dataclass(frozen=True)
class DiskModel:
    """The disks of a map."""

    position: Float[np.ndarray, "n 3"]
    quaternion: Float[np.ndarray, "n 4"]
    """w, x, y, z."""
    scale: Float[np.ndarray, "n 2"]
    """Standard deviations, map units."""


@dataclass(frozen=True)
class ImageExtent:
    """Half the extent of a keyframe's image at depth 1."""

    right: float
    down: float


@dataclass(frozen=True)
class Lengths:
    """What a unit of the map is."""

    metres: float | None = None
    """None where that is not known."""
    note: str = ""
    """A sentence on it, for those who measure."""


@dataclass(frozen=True)
class ShownModel:
    """All that is shown, in the frame of the map, with the axes by which it stands upright."""

    axes: Float[np.ndarray, "3 3"]
    """Rows right, forward and up of the world."""
    start: StartView
    """From where it is seen first, and what it turns about."""
    lens: ImageExtent
    surface: SurfaceModel | None = None
    paths: Sequence[PathModel] = ()
    keyframes: Sequence[KeyframeModel] = ()
    disks: DiskModel | None = None
    room: Room | None = None
    """What is in the way of those who look in from outside."""
    lengths: Lengths = field(default_factory=Lengths)
    notes: Sequence[str] = field(default_factory=tuple)
    """Sentences under it, such as what was left out."""
