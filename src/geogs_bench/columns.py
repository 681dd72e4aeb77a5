"""The columns from which the tables of the benchmarks are made."""

from collections.abc import Callable, Sequence

from geogs_bench.benchmark import Column, Layout, Published
from geogs_bench.published import PublishedTable
from geogs_bench.record import Record, StageName, StageScore, Weighting

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


def ate(stage: StageName) -> Callable[[Record], float | None]:
    """RMSE over all frames."""

    def value(record: Record) -> float | None:
        scored = record.stage(stage)
        return scored.trajectory.ate if scored and scored.trajectory else None

    return value


def keyframes_ate(stage: StageName) -> Callable[[Record], float | None]:
    """RMSE over the keyframes."""

    def value(record: Record) -> float | None:
        scored = record.stage(stage)
        return scored.trajectory.keyframes_ate if scored and scored.trajectory else None

    return value


def surface(
    stage: StageName, weighting: Weighting, measure: str
) -> Callable[[Record], float | None]:
    """A field of a surface score."""

    def value(record: Record) -> float | None:
        scored = record.stage(stage)
        found = scored.surface(weighting) if scored else None
        return None if found is None else getattr(found, measure)

    return value


def cost(name: str, factor: float = 1.0) -> Callable[[Record], float | None]:
    """A field of what the run took, times ``factor``."""

    def value(record: Record) -> float | None:
        found = None if record.cost is None else getattr(record.cost, name)
        return None if found is None else factor * found

    return value


def trajectory_layout(published: PublishedTable | None = None) -> Layout:
    """ATE of every stage of a run; published figures beside the paper's."""
    beside = None if published is None else Published(published, "ATE")
    stages = [stage for stage in _RUN if stage != "depth fusion"]
    return Layout(
        "Trajectory, ATE RMSE after Sim(3) alignment (cm)",
        (
            *(
                Column(_STAGES[stage], ate(stage), 3, beside if stage == "adjusted" else None)
                for stage in stages
            ),
            *(Column(f"keyframes {_STAGES[s]}", keyframes_ate(s), 3) for s in stages),
        ),
    )


def rgbd_layout(
    variant: str, published: PublishedTable | None = None, methods: Sequence[str] = ()
) -> Layout:
    """ATE of results in metres beside published figures of systems that were given depth, too.

    The published stand in the rows of a ``variant``; all methods of the table if none is named.
    """
    if published is not None and not methods:
        methods = [row.method for row in published.rows]

    def rigid(stage: StageName) -> Callable[[Record], float | None]:
        def value(record: Record) -> float | None:
            scored = record.stage(stage)
            return scored.trajectory.rigid_ate if scored and scored.trajectory else None

        return value

    def printed(method: str) -> Callable[[Record], float | None]:
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
        (*(Column(_STAGES[stage], rigid(stage), 3) for stage in stages), *beside),
        f"Of results in metres alone.{source}",
    )


def surface_layout(
    weighting: Weighting,
    title: str,
    published: PublishedTable | None = None,
    posed: bool = False,
) -> Layout:
    """Errors of the surface at each stage; published figures beside those of the paper's stage.

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
    """The vertex-weighted measure of the published SLAM tables."""
    title = "Surface, vertex-weighted (toolbox of Splat-SLAM)"
    return surface_layout("vertices", title, published, posed)


def area_layout(posed: bool = False) -> Layout:
    """The measure that depends neither on tessellation nor on sampling."""
    return surface_layout("area", "Surface, area-weighted, exact distances", None, posed)


def dtu_layout(published: PublishedTable | None = None) -> Layout:
    """DTU's protocol."""
    return surface_layout("points", "Surface, DTU's protocol", published, posed=True)


def photo_layout() -> Layout:
    """Agreement of held-out images."""

    def field(name: str) -> Callable[[Record], float | None]:
        return lambda record: None if record.photo is None else getattr(record.photo, name)

    return Layout(
        "Photo-consistency of held-out views across the mesh",
        (
            Column("agreement, holes count 0 (%)", field("score")),
            Column("mean NCC", field("ncc"), 3),
            Column("median NCC", field("ncc_median"), 3),
            Column("coverage (%)", field("coverage")),
            Column("held-out views", field("views"), 0),
        ),
        "Not a distance: no true surface was there.",
    )


def motion_layout() -> Layout:
    """How every motion was followed."""

    def field(name: str) -> Callable[[Record], float | None]:
        return lambda record: None if record.motion is None else getattr(record.motion, name)

    return Layout(
        "Motions",
        (
            Column("frames tracked (%)", field("tracked"), 1),
            Column("orientation only (%)", field("turned"), 1),
            Column("ATE over path (%)", field("relative"), 3),
            Column("ATE (cm)", field("ate"), 2),
            Column("rotation (degrees)", field("rotation"), 2),
            Column("within 3 sigma (%)", field("within"), 1),
            Column("is reliable", field("is_reliable"), 0),
            Column("is called so", field("is_called_reliable"), 0),
        ),
        "Over the tracked frames; positions after a Sim(3) alignment, orientations after that of "
        "the world's axes. A camera that hardly moves has no ATE. Reliable (1) are an ATE below a "
        "twentieth of the path's extent and no more than a fifth of the frames lost.",
    )


def result_layout() -> Layout:
    """The last stage of runs and of reconstructions, in one table."""

    def last(record: Record) -> StageScore | None:
        return record.stages[-1] if record.stages else None

    def field(measure: str, *weightings: Weighting) -> Callable[[Record], float | None]:
        def value(record: Record) -> float | None:
            stage = last(record)
            found = [s for w in weightings if stage and (s := stage.surface(w))]
            return getattr(found[0], measure) if found else None

        return value

    def last_ate(record: Record) -> float | None:
        stage = last(record)
        return stage.trajectory.ate if stage and stage.trajectory else None

    def agreement(record: Record) -> float | None:
        return None if record.photo is None else record.photo.score

    surfaces: tuple[Weighting, Weighting] = ("area", "points")
    return Layout(
        "Results",
        (
            Column("ATE after the stream (cm)", ate("online"), 3),
            Column("ATE of the result (cm)", last_ate, 3),
            Column("Acc ({unit})", field("accuracy", *surfaces)),
            Column("Comp ({unit})", field("completeness", *surfaces)),
            Column("Comp.Rat (%)", field("ratio", "area"), 1),
            Column("CD ({unit})", field("chamfer", *surfaces)),
            Column("agreement of held-out images (%)", agreement, 1),
            Column("thousand disks", cost("disks", 1e-3), 1),
            Column("seconds", cost("seconds"), 1),
        ),
        "Of the result, whichever stage that is: rooms in cm, area-weighted, objects in mm, DTU by "
        "its protocol where the official files are there.",
    )


COST = Layout(
    "Cost",
    (
        Column("frames", cost("frames"), 0),
        Column("seconds", cost("seconds"), 1),
        Column("frames/s", cost("frames_per_second")),
        Column("peak memory (GB)", cost("peak_memory_bytes", 1e-9)),
        Column("peak GPU memory (GB)", cost("peak_gpu_memory_bytes", 1e-9)),
        Column("thousand disks", cost("disks", 1e-3), 1),
        Column("map (MB)", cost("map_bytes", 1e-6)),
    ),
    "Seconds are of the whole command; frames/s of SLAM count all up to the last frame.",
)
