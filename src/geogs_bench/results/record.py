"""Record of one run: its provenance, cost and errors."""

import json
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from geogs.errors import InputError
from geogs.guard.atomic import write_text
from geogs.guard.documents import UNUSABLE, read_json

T = TypeVar("T")

Weighting = Literal["area", "vertices", "points"]
"""Means over the area of the surfaces (NICE-SLAM), over the vertices of the meshes (the toolbox of
Splat-SLAM), or over thinned points (DTU)."""
StageName = Literal["online", "adjusted", "depth fusion", "final"]
"""After the stream; after the final bundle adjustment and the map's update, as in the paper; the
keyframes' depths fused without the disks; after the refinement, which the paper has not, or the
result from known poses."""

Place = Literal["all", "open", "edge", "thin", "behind thin", "bare", "grazing", "sky"]
PLACES: tuple[Place, ...] = get_args(Place)
"""Kinds of region in a view: ``all`` has depth, ``open`` is none of those after it; these overlap,
except for the sky."""


@dataclass(frozen=True)
class SurfaceScore:
    """Distances between a surface and the true one, in ``unit``; ratios in percent."""

    weighting: Weighting
    unit: Literal["cm", "mm"]
    accuracy: float
    completeness: float
    chamfer: float
    ratio: float | None = None
    """Fraction of the truth nearer than ``threshold``."""
    precision: float | None = None
    """Fraction of the result nearer than ``threshold``."""
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
    """RMSE over the keyframes alone, with their own alignment."""
    rigid_ate: float | None = None
    """RMSE over all frames after a rigid alignment, cm; none unless the result is in metres."""


@dataclass(frozen=True)
class PhotoScore:
    """Photo-consistency of held-out images across the surface; needs no true surface."""

    score: float
    """Mean correlation over all textured pixels, 0 where the mesh has a hole, percent."""
    ncc: float
    """Mean over the pixels that could be compared, -1 to 1."""
    ncc_median: float
    coverage: float
    """Fraction of the masks that could be compared, percent."""
    views: int
    """Held-out views."""
    window: int
    """Side of the correlation window, pixels."""


@dataclass(frozen=True)
class MotionScore:
    """Errors of a camera's estimated motion."""

    tracked: float
    """Frames that have a pose, percent."""
    turned: float = 0.0
    """Frames with an orientation but no position, percent."""
    rotation: float | None = None
    """RMSE of the orientations, degrees; none if nothing was tracked."""
    ate: float | None = None
    """RMSE of the positions after Sim(3) alignment, cm; none if the camera hardly moved."""
    relative: float | None = None
    """The same over the length of the path, percent."""
    within: float | None = None
    """Positions within three of their predicted standard deviations, percent; none if none were
    predicted."""
    is_called_reliable: bool | None = None
    """The system's own verdict; none if it gives none."""
    is_reliable: bool | None = None
    """Whether the ATE is below a twentieth of the true path's extent and at most a fifth of the
    frames are lost; none without an ATE."""


@dataclass(frozen=True)
class PlaceScore:
    """Depth of the mesh in the regions of one kind; in percent of their pixels unless stated.

    In the sky only the presence of a surface is known.
    """

    place: Place
    share: float
    """Fraction of all pixels with a known true depth."""
    covered: float
    """Pixels that show the mesh."""
    median_error: float | None = None
    """Median error where the mesh is seen, percent of the depth."""
    within_2: float | None = None
    """Errors of at most 2 %; holes are wrong."""
    within_5: float | None = None
    """Errors of at most 5 %; holes are wrong."""
    in_front: float | None = None
    """Nearer than the truth by more than 5 %: fringes and sheets."""
    behind: float | None = None
    """Farther than the truth by more than 5 %."""
    normal: float | None = None
    """Median angle between the normals, degrees; none without a true plane."""


@dataclass(frozen=True)
class StageScore:
    """Scores of a result at a stage."""

    stage: StageName
    trajectory: TrajectoryScore | None = None
    surfaces: tuple[SurfaceScore, ...] = ()

    def surface(self, weighting: Weighting) -> SurfaceScore | None:
        """The score with a weighting."""
        return next((s for s in self.surfaces if s.weighting == weighting), None)


@dataclass(frozen=True)
class CurvePoint:
    """Scores of the map after ``seconds``."""

    seconds: float
    disks: int | None
    surface: SurfaceScore


@dataclass(frozen=True)
class Provenance:
    """Provenance of a result."""

    command: str
    commit: str
    """Commit of the program, with ``+`` if files were changed; its version without a history."""
    machine: str
    device: str
    seed: int
    config_hash: str


@dataclass(frozen=True)
class Cost:
    """Cost of a run."""

    seconds: float
    """Wall-clock time of the whole command, with reading and writing."""
    frames: int | None = None
    frames_per_second: float | None = None
    """Of the stream for SLAM; over the whole run otherwise."""
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
    """Reason for missing numbers."""

    def stage(self, name: StageName) -> StageScore | None:
        """The scores of a stage."""
        return next((s for s in self.stages if s.stage == name), None)

    def place(self, name: str) -> PlaceScore | None:
        """The scores of a kind of region."""
        return next((s for s in self.places if s.place == name), None)


def write_json(path: Path, value: Any) -> None:
    """Write a record (or a list of them) as JSON."""
    plain = [asdict(v) for v in value] if isinstance(value, list) else asdict(value)
    write_text(path, json.dumps(plain, indent=2) + "\n")


def read_record(path: Path) -> Record | None:
    """Read a record of :func:`write_json`; none if the file is missing or damaged."""
    try:
        return read_dataclass(Record, read_json(path))
    except (InputError, *UNUSABLE):
        return None


def read_dataclass(kind: type[T], values: dict[str, Any]) -> T:
    """Make a dataclass from a dict; unknown names are an error, so old files are not misread."""
    hints = get_type_hints(kind)
    names = {f.name for f in fields(kind)}  # type: ignore[arg-type]  # always a dataclass
    if unknown := set(values) - names:
        raise InputError(f"{kind.__name__} has no {', '.join(sorted(unknown))}.")
    return kind(**{name: _read(hints[name], value) for name, value in values.items()})


def _read(hint: Any, value: Any) -> Any:
    """Value of a field; dataclasses and tuples of them are restored."""
    if value is None:
        return None
    if get_origin(hint) in (Union, UnionType):
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) is tuple:
        return tuple(_read(get_args(hint)[0], v) for v in value)
    return read_dataclass(hint, value) if is_dataclass(hint) else value  # type: ignore[arg-type]
