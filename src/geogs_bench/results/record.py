"""What is kept of one run: how it was made, what it cost, how far it is from the truth."""

import json
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from geogs.documents import UNUSABLE, read_json
from geogs.errors import InputError
from geogs.io.writers.atomic import write_text

T = TypeVar("T")

Weighting = Literal["area", "vertices", "points"]
"""Means over the area of the surfaces (NICE-SLAM), over the vertices of the meshes (the toolbox of
Splat-SLAM), or over thinned points (DTU)."""
StageName = Literal["online", "adjusted", "depth fusion", "final"]
"""After the stream; after the final bundle adjustment and the map's update, where the paper ends;
the keyframes' depths fused without the disks; after the refinement that the paper has not, or from
known poses the result."""

Place = Literal["all", "open", "edge", "thin", "behind thin", "bare", "grazing", "sky"]
PLACES: tuple[Place, ...] = get_args(Place)
"""Kinds of place in a view: ``all`` has depth, ``open`` is none of those after it; these overlap,
but for the sky."""


@dataclass(frozen=True)
class SurfaceScore:
    """Distances between a surface and the true one, in ``unit``; ratios in percent."""

    weighting: Weighting
    unit: Literal["cm", "mm"]
    accuracy: float
    completeness: float
    chamfer: float
    ratio: float | None = None
    """Part of the truth nearer than ``threshold``."""
    precision: float | None = None
    """Part of the result nearer than ``threshold``."""
    f_score: float | None = None
    threshold: float | None = None
    accuracy_median: float | None = None
    completeness_median: float | None = None


@dataclass(frozen=True)
class TrajectoryScore:
    """Absolute trajectory error after Sim(3) alignment, cm."""

    ate: float
    """RMSE over all frames."""
    pairs: int
    """Poses compared."""
    scale: float
    keyframes_ate: float | None = None
    """RMSE over the keyframes alone, with an alignment of their own."""
    rigid_ate: float | None = None
    """RMSE over all frames after a rigid alignment, cm; none unless the result is in metres."""


@dataclass(frozen=True)
class PhotoScore:
    """How well held-out images agree across the surface; without any surface truth."""

    score: float
    """Mean correlation over all textured pixels, 0 where the mesh has a hole, percent."""
    ncc: float
    """Mean over the pixels that could be compared, -1 to 1."""
    ncc_median: float
    coverage: float
    """Part of the masks that could be compared, percent."""
    views: int
    """Held-out views."""
    window: int
    """Side of the correlation window, pixels."""


@dataclass(frozen=True)
class MotionScore:
    """How a camera's motion was followed."""

    tracked: float
    """Frames that have a pose, percent."""
    turned: float = 0.0
    """Frames of which an orientation is given, but no position, percent."""
    rotation: float | None = None
    """RMSE of the orientations, degrees; none where nothing was tracked."""
    ate: float | None = None
    """RMSE of the positions after Sim(3) alignment, cm; none where the camera hardly moved."""
    relative: float | None = None
    """The same over the length of the way, percent."""
    within: float | None = None
    """Positions within three of the deviations that the system claims, percent; none where it
    claims none."""
    is_called_reliable: bool | None = None
    """What the system says of the whole; none where it says nothing."""
    is_reliable: bool | None = None
    """Whether the ATE is below a twentieth of the true path's extent and at most a fifth of the
    frames are lost; none where there is no ATE."""


@dataclass(frozen=True)
class PlaceScore:
    """Depth of the mesh in the places of one kind; percent of their pixels where no unit is said.

    Of the sky no more is known than whether there is a surface in it.
    """

    place: Place
    share: float
    """Part of all pixels whose true depth is known."""
    covered: float
    """Pixels that show the mesh."""
    median_error: float | None = None
    """Percent of the depth, where it is seen."""
    within_2: float | None = None
    """Off by no more than 2 %; holes are wrong."""
    within_5: float | None = None
    """Off by no more than 5 %; holes are wrong."""
    in_front: float | None = None
    """Nearer than the truth by more than 5 %: fringes and sheets."""
    behind: float | None = None
    """Farther than the truth by more than 5 %."""
    normal: float | None = None
    """Median angle between the normals, degrees; none where no true plane is there."""


@dataclass(frozen=True)
class StageScore:
    """A result as it stood at a stage."""

    stage: StageName
    trajectory: TrajectoryScore | None = None
    surfaces: tuple[SurfaceScore, ...] = ()

    def surface(self, weighting: Weighting) -> SurfaceScore | None:
        """The score of a weighting."""
        return next((s for s in self.surfaces if s.weighting == weighting), None)


@dataclass(frozen=True)
class CurvePoint:
    """The map after so many seconds."""

    seconds: float
    disks: int | None
    surface: SurfaceScore


@dataclass(frozen=True)
class Provenance:
    """How a result came about."""

    command: str
    commit: str
    """Commit of the program, with ``+`` where files were changed; its version without a history."""
    machine: str
    device: str
    seed: int
    config_hash: str


@dataclass(frozen=True)
class Cost:
    """What a run took."""

    seconds: float
    """Wall clock of the whole command, reading and writing included."""
    frames: int | None = None
    frames_per_second: float | None = None
    """Online, for SLAM; over everything else."""
    peak_memory_bytes: int | None = None
    peak_gpu_memory_bytes: int | None = None
    disks: int | None = None
    map_bytes: int | None = None
    stages: dict[str, float] = field(default_factory=dict)
    """Seconds by name of the part."""


@dataclass(frozen=True)
class Record:
    """One row: a scene of a benchmark in one variant."""

    benchmark: str
    scene: str
    variant: str
    folder: str
    """Folder of the result, relative to that of the benchmark."""
    provenance: Provenance
    cost: Cost | None = None
    stages: tuple[StageScore, ...] = ()
    photo: PhotoScore | None = None
    motion: MotionScore | None = None
    places: tuple[PlaceScore, ...] = ()
    curve: tuple[CurvePoint, ...] = ()
    error: str | None = None
    """Why there are no numbers."""

    def stage(self, name: StageName) -> StageScore | None:
        """The scores of a stage."""
        return next((s for s in self.stages if s.stage == name), None)

    def place(self, name: str) -> PlaceScore | None:
        """The scores of a kind of place."""
        return next((s for s in self.places if s.place == name), None)


def write_json(path: Path, value: Any) -> None:
    """Write a record (or a list of them) as JSON."""
    plain = [asdict(v) for v in value] if isinstance(value, list) else asdict(value)
    write_text(path, json.dumps(plain, indent=2) + "\n")


def read_record(path: Path) -> Record | None:
    """Read what :func:`write_json` wrote; none where there is nothing or it is damaged."""
    try:
        return read_dataclass(Record, read_json(path))
    except (InputError, *UNUSABLE):
        return None


def read_dataclass(kind: type[T], values: dict[str, Any]) -> T:
    """A dataclass from its dict; unknown names are an error, so that old files are not misread."""
    hints = get_type_hints(kind)
    names = {f.name for f in fields(kind)}  # type: ignore[arg-type]  # always a dataclass
    if unknown := set(values) - names:
        raise InputError(f"{kind.__name__} has no {', '.join(sorted(unknown))}.")
    return kind(**{name: _read(hints[name], value) for name, value in values.items()})


def _read(hint: Any, value: Any) -> Any:
    """A value of a field: dataclasses and tuples of them are made again."""
    if value is None:
        return None
    if get_origin(hint) in (Union, UnionType):
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) is tuple:
        return tuple(_read(get_args(hint)[0], v) for v in value)
    return read_dataclass(hint, value) if is_dataclass(hint) else value  # type: ignore[arg-type]
