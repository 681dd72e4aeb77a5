"""Content of a page's model: a surface, paths, keyframes and disks."""

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
    """Label of its button."""
    colours: UInt8[np.ndarray, "n 3"]
    """RGB."""
    legend: "Legend | None" = None
    """Legend of the colours; none for those of the images."""


@dataclass(frozen=True)
class Legend:
    """A scale of colours."""

    title: str
    ends: tuple[str, str]
    """Values of the first and the last colour."""
    stops: Sequence[str]
    """CSS colours from one end to the other."""
    note: str = ""
    """Meaning of an additional colour."""


@dataclass(frozen=True)
class TextureModel:
    """An image of a surface."""

    uv: Float[np.ndarray, "n 2"]
    """Place of each vertex in the image, from 0 to 1, rightwards and downwards."""
    jpeg: bytes


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
    texture: TextureModel | None = None
    """Shown before any of these, if there is one."""


@dataclass(frozen=True)
class PathModel:
    """A path of the camera."""

    name: str
    points: Float[np.ndarray, "n 3"]
    """Map units."""
    states: Sequence[FrameState] | None = None
    """State of each point; none for a true path."""


@dataclass(frozen=True)
class KeyframeModel:
    """A camera and its image."""

    name: str
    T_wc: Float[np.ndarray, "4 4"]
    """Camera to world."""
    jpeg: bytes | None = None
    """Its image; none if it is not shown."""


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
    """Unit of length of the map."""

    metres: float | None = None
    """Metres per map unit; none where unknown."""
    note: str = ""
    """A sentence on the unit, for measurements in the page."""

    @property
    def name(self) -> str:
        """Name of a map unit in plots."""
        return {1.0: "m", 0.001: "mm"}.get(self.metres or 0.0, "map units")


@dataclass(frozen=True)
class ShownModel:
    """The shown model, in the frame of the map, with its upright axes."""

    axes: Float[np.ndarray, "3 3"]
    """Rows right, forward and up of the world."""
    start: StartView
    """Start view; its target is the centre of rotation."""
    lens: ImageExtent
    surface: SurfaceModel | None = None
    paths: Sequence[PathModel] = ()
    keyframes: Sequence[KeyframeModel] = ()
    disks: DiskModel | None = None
    room: Room | None = None
    """Walls and ceiling that occlude a view from outside."""
    lengths: Lengths = field(default_factory=Lengths)
    notes: Sequence[str] = field(default_factory=tuple)
    """Sentences under the model, such as on omitted parts."""
