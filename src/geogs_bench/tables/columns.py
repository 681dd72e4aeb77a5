"""The columns from which the tables of the benchmarks are made."""

from collections.abc import Callable, Sequence
from typing import Literal

from geogs_bench.benchmark import Column, Layout, Published
from geogs_bench.published import PublishedTable
from geogs_bench.results.record import PLACES, Place, Record, StageName, SurfaceScore, Weighting

Value = Callable[[Record], float | None]
"""Value of a column for a record."""

_MEASURES = (
    ("Acc", "accuracy", "{unit}"),
    ("Comp", "completeness", "{unit}"),
    ("Comp.Rat", "ratio", "%"),
    ("CD", "chamfer", "{unit}"),
)
_FURTHER = (
    ("median Acc", "accuracy_median", "{unit}"),
    ("median Comp", "completeness_median", "{unit}"),
    ("F-score", "f_score", "%"),
)
_STAGES: dict[StageName, str] = {
    "online": "after the stream",
    "adjusted": "after final BA and map update",
    "depth fusion": "depth fusion",
    "final": "after refinement",
}
"""Stages of a run. The paper's online results are the second; it has no third."""
_RUN: tuple[StageName, ...] = ("online", "adjusted", "depth fusion", "final")
_POSED: tuple[StageName, ...] = ("depth fusion", "final")


def _of(found: Callable[[Record], object], name: str, factor: float = 1.0) -> Value:
    """A field of the object that ``found`` returns for a record, times ``factor``, or none."""

    def value(record: Record) -> float | None:
        scored = found(record)
        number: float | None = None if scored is None else getattr(scored, name)
        return None if number is None else factor * number

    return value


def trajectory(stage: StageName, name: str) -> Value:
    """A field of the score of a stage's trajectory."""
    return _of(lambda record: (scored := record.stage(stage)) and scored.trajectory, name)


def surface(stage: StageName, weighting: Weighting, measure: str) -> Value:
    """A field of the score of a stage's surface."""
    return _of(lambda record: (s := record.stage(stage)) and s.surface(weighting), measure)


def figure(part: Literal["cost", "motion", "photo"], name: str, factor: float = 1.0) -> Value:
    """A field of a part of a record, times ``factor``."""
    return _of(lambda record: getattr(record, part), name, factor)


def trajectory_layout(published: PublishedTable | None = None) -> Layout:
    """ATE of every stage of a run; published figures beside the paper's."""
    beside = None if published is None else Published(published, "ATE")
    stages = [stage for stage in _RUN if stage != "depth fusion"]
    return Layout(
        "Trajectory, ATE RMSE after Sim(3) alignment (cm)",
        (
            *(
                Column(
                    _STAGES[stage],
                    trajectory(stage, "ate"),
                    3,
                    beside if stage == "adjusted" else None,
                )
                for stage in stages
            ),
            *(Column(f"keyframes {_STAGES[s]}", trajectory(s, "keyframes_ate"), 3) for s in stages),
        ),
    )


def rgbd_layout(
    variant: str, published: PublishedTable | None = None, methods: Sequence[str] = ()
) -> Layout:
    """ATE of results in metres beside published figures of systems with sensor depth.

    The published figures are in the rows of a ``variant``; all methods if none is named.
    """
    if published is not None and not methods:
        methods = [row.method for row in published.rows]

    def printed(method: str) -> Value:
        def value(record: Record) -> float | None:
            if published is None or record.variant != variant:
                return None
            return published.value(record.scene, "ATE", method)

        return value

    stages = [stage for stage in _RUN if stage != "depth fusion"]
    beside = (Column(f"{method} (published)", printed(method)) for method in methods)
    source = "" if published is None else f" Published: {published.source}."
    return Layout(
        "Trajectory with the depth of the sensor, ATE RMSE after a rigid alignment (cm)",
        (*(Column(_STAGES[s], trajectory(s, "rigid_ate"), 3) for s in stages), *beside),
        f"Of results in metres alone.{source}",
    )


def surface_layout(
    weighting: Weighting, title: str, published: PublishedTable | None = None, posed: bool = False
) -> Layout:
    """Errors of the surface at each stage, with published figures beside the paper's stage.

    From known poses (``posed``) there is one stage, the result.
    """
    columns = []
    further = () if weighting == "vertices" else _FURTHER
    papers: StageName = "final" if posed else "adjusted"
    for name, measure, unit in (*_MEASURES, *further):
        stages = _POSED if posed else _RUN
        if (name, measure, unit) in further:
            stages = tuple(s for s in stages if s in (papers, "final"))
        for stage in stages:
            beside = _beside(published, name) if stage == papers else None
            shown = name if posed and stage == "final" else f"{name}, {_STAGES[stage]}"
            value = surface(stage, weighting, measure)
            columns.append(Column(f"{shown} ({unit})", value, 2, beside))
    return Layout(title, tuple(columns))


def _beside(published: PublishedTable | None, metric: str) -> Published | None:
    if published is None or all(row.metric != metric for row in published.rows):
        return None
    return Published(published, metric)


def vertex_layout(published: PublishedTable | None = None, posed: bool = False) -> Layout:
    """Errors by the vertex-weighted measure of the published SLAM tables."""
    title = "Surface, vertex-weighted (toolbox of Splat-SLAM)"
    return surface_layout("vertices", title, published, posed)


def area_layout(posed: bool = False) -> Layout:
    """Errors by the measure that depends neither on tessellation nor on sampling."""
    return surface_layout("area", "Surface, area-weighted, exact distances", None, posed)


def dtu_layout(published: PublishedTable | None = None) -> Layout:
    """Errors by DTU's protocol."""
    return surface_layout("points", "Surface, DTU's protocol", published, posed=True)


def photo_layout() -> Layout:
    """Photo-consistency of held-out images."""
    return Layout(
        "Photo-consistency of held-out views across the mesh",
        (
            Column("agreement, holes count 0 (%)", figure("photo", "score")),
            Column("mean NCC", figure("photo", "ncc"), 3),
            Column("median NCC", figure("photo", "ncc_median"), 3),
            Column("coverage (%)", figure("photo", "coverage")),
            Column("held-out views", figure("photo", "views"), 0),
        ),
        "Not a distance: no true surface was there.",
    )


def motion_layout() -> Layout:
    """Scores of every motion."""
    return Layout(
        "Motions",
        (
            Column("frames tracked (%)", figure("motion", "tracked"), 1),
            Column("orientation only (%)", figure("motion", "turned"), 1),
            Column("ATE over path (%)", figure("motion", "relative"), 3),
            Column("ATE (cm)", figure("motion", "ate"), 2),
            Column("rotation (degrees)", figure("motion", "rotation"), 2),
            Column("within 3 sigma (%)", figure("motion", "within"), 1),
            Column("is reliable", figure("motion", "is_reliable"), 0),
            Column("is called so", figure("motion", "is_called_reliable"), 0),
        ),
        "Over the tracked frames; positions after a Sim(3) alignment, orientations after that of "
        "the world's axes. A camera that hardly moves has no ATE. Reliable (1) are an ATE below a "
        "twentieth of the path's extent and no more than a fifth of the frames lost.",
    )


_PLACES: tuple[tuple[str, str, str, int], ...] = (
    ("Within 5 % of the true depth (% of the pixels; holes are wrong)", "within_5", "", 1),
    ("Within 2 % of the true depth (% of the pixels; holes are wrong)", "within_2", "", 1),
    (
        "Surface in front of the true one by more than 5 % (% of the pixels)",
        "in_front",
        "Fringes around things, and sheets that close the gaps between them.",
        2,
    ),
    ("Surface behind the true one by more than 5 % (% of the pixels)", "behind", "", 2),
    (
        "Covered (% of the pixels)",
        "covered",
        "In the sky: where a surface is that should not be there.",
        1,
    ),
    ("Median error of the depth (%), where there is a surface", "median_error", "", 2),
    ("Median error of the normals (degrees)", "normal", "", 1),
    ("Share of all pixels whose depth is known (%)", "share", "Kinds overlap.", 2),
)
"""Title, field, note and digits of every table of depth by kind of region."""


def place_layouts() -> tuple[Layout, ...]:
    """A table for each measure of depth, with a column for each kind of region."""
    return tuple(
        Layout(title, tuple(Column(p, place(p, name), digits) for p in PLACES), note)
        for title, name, note, digits in _PLACES
    )


def place(kind: Place, name: str) -> Value:
    """A field of the scores of a kind of region."""
    return _of(lambda record: record.place(kind), name)


def efficiency_layout(published: PublishedTable) -> Layout:
    """Size and error of the model, with published figures beside ours."""

    def column(title: str, metric: str, value: Value, digits: int) -> Column:
        return Column(title, value, digits, Published(published, metric))

    chamfer = _of(_surface_of_result, "chamfer")
    return Layout(
        "Model efficiency",
        (
            column("thousand disks", "thousand disks", figure("cost", "disks", 1e-3), 1),
            column("map (MB)", "MB", figure("cost", "map_bytes", 1e-6), 2),
            column("CD ({unit})", "CD", chamfer, 2),
        ),
        "MB are those of the map's file; a disk has ten numbers of four bytes.",
    )


def curve_layout(seconds: Sequence[int]) -> Layout:
    """Error of the surface after ``seconds``, and of the result."""

    def after(moment: int) -> Value:
        return _of(
            lambda r: next((p.surface for p in r.curve if p.seconds == moment), None), "chamfer"
        )

    moments = (Column(f"CD after {s} s ({{unit}})", after(s)) for s in seconds)
    result = Column("CD of the result ({unit})", _of(_surface_of_result, "chamfer"))
    return Layout("Convergence", (*moments, result))


def _surface_of_result(record: Record) -> SurfaceScore | None:
    """Score of the result, by DTU's protocol if that was measured, else area-weighted."""
    final = record.stage("final")
    return None if final is None else final.surface("points") or final.surface("area")


COST = Layout(
    "Cost",
    (
        Column("frames", figure("cost", "frames"), 0),
        Column("seconds", figure("cost", "seconds"), 1),
        Column("frames/s", figure("cost", "frames_per_second")),
        Column("peak memory (GB)", figure("cost", "peak_memory_bytes", 1e-9)),
        Column("peak GPU memory (GB)", figure("cost", "peak_gpu_memory_bytes", 1e-9)),
        Column("thousand disks", figure("cost", "disks", 1e-3), 1),
        Column("map (MB)", figure("cost", "map_bytes", 1e-6)),
    ),
    "Seconds are of the whole command; frames/s of SLAM count all up to the last frame.",
)
