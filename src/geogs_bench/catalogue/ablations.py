"""Benchmarks that compare variants of the settings on any scenes."""

from dataclasses import replace

from geogs_bench import published as paper
from geogs_bench.benchmark import Benchmark, Variant
from geogs_bench.catalogue.variants import DEFAULT, ONLINE_RESULTS, PAPER, with_paper
from geogs_bench.data.benchmark_scene import Option
from geogs_bench.data.motion_cells import ROOM, relighted
from geogs_bench.data.scenes import find_any_posed, find_relighted, find_rooms
from geogs_bench.tables.columns import (
    COST,
    area_layout,
    curve_layout,
    dtu_layout,
    efficiency_layout,
    trajectory_layout,
    vertex_layout,
)

_ROOMS = (
    "Replica or any rooms in its layout: <scene>/results, <scene>/traj.txt and a true surface; "
    "without a folder a synthetic room is made"
)
_POSED = "DTU scans with the official files, or objects, or rooms (see dtu, objects, rooms)"
_WHERE = "see geogs bench list"

# The final refinement of the map would hide what the variants did before it.
_NO_REFINEMENT = (Option("mapping.final-iterations", "0"),)


def _set(**values: str) -> tuple[Option, ...]:
    """Mapping options; two underscores become the dot between groups."""
    names = {name: f"mapping.{name.replace('__', '.').replace('_', '-')}" for name in values}
    return tuple(Option(names[name], value) for name, value in values.items())


_SNAPSHOTS = (2, 5, 10, 20, 40, 60, 90)
"""Seconds at which the map's error is measured during the run."""

INITIALISATION = Benchmark(
    "ablation-init",
    "Ablation: disks started on local planes, or isotropic with a random orientation",
    "run",
    find_rooms,
    _ROOMS,
    _WHERE,
    (vertex_layout(paper.ABLATION_INIT), area_layout(), COST),
    with_paper(
        [
            Variant(
                f"{name}-{steps}",
                (
                    *_set(ablation__initialisation=name.replace("-", "_"), iterations=str(steps)),
                    *_NO_REFINEMENT,
                ),
            )
            for name in ("random", "local-plane")
            for steps in (7, 10)
        ]
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_INIT,),
    (
        "The map as it stands after the final bundle adjustment, without refinement.",
        "The random disks lie anyhow and have the scales of 3DGS. Rows that begin with paper have "
        "the preset of that name; all are mapped on the way.",
    ),
    cells=(ROOM,),
)

MAP_UPDATE = Benchmark(
    "ablation-update",
    "Ablation: one map before its correction, moved as one, by keyframe, or by a blend",
    "update",
    find_rooms,
    _ROOMS,
    _WHERE,
    (vertex_layout(paper.ABLATION_UPDATE), area_layout(), COST),
    tuple(
        Variant(
            name,
            (
                *_set(ablation__map_update=name.replace("-", "_")),
                *_NO_REFINEMENT,
                Option("loop.no-enabled"),
            ),
        )
        for name in ("per-keyframe", "coherent", "blended")
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_UPDATE,),
    (
        "The stream is run once, without loops; its map is kept, and every rule moves that one map "
        "by the same final bundle adjustment. Seconds are of the first row alone.",
    ),
    cells=(ROOM,),
)

POSE_RATE = Benchmark(
    "ablation-pose-lr",
    "Pose refinement: off, and its learning rate",
    "run",
    find_rooms,
    _ROOMS,
    _WHERE,
    (trajectory_layout(paper.ABLATION_POSE_LR), COST),
    (
        Variant("off", (*_set(pose_iterations="0"), *_NO_REFINEMENT, ONLINE_RESULTS)),
        *(
            Variant(rate, (*_set(pose_lr=rate, pose_every="1"), *_NO_REFINEMENT, ONLINE_RESULTS))
            for rate in paper.ABLATION_POSE_LR.columns
        ),
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_POSE_LR,),
    (
        "The trajectory after the stream is the measure: the final bundle adjustment starts from "
        "these poses and ends at its own minimum. All rows are mapped on the way "
        "(--online-results).",
    ),
    cells=(ROOM,),
)

_LOSSES = {
    "multi-view": ("loss__l1_weight", "loss__ssim_weight", "loss__ncc_weight"),
    "normal-consistency": ("loss__normal_consistency_weight",),
    "smoothness": ("loss__smoothness_weight",),
    "distortion": ("loss__distortion_weight",),
    "l1": ("loss__l1_weight",),
    "ssim": ("loss__ssim_weight",),
    "ncc": ("loss__ncc_weight",),
}
_ALL_LOSSES = _set(
    ablation__start="points", loss__smoothness_weight="0.02", loss__ssim_weight="0.2"
)

LOSSES = Benchmark(
    "ablation-losses",
    "Ablation: the losses of the map, each left out",
    "reconstruct",
    find_any_posed,
    _POSED,
    _WHERE,
    (dtu_layout(paper.ABLATION_LOSSES), area_layout(posed=True), vertex_layout(posed=True), COST),
    (
        Variant("all", _ALL_LOSSES),
        *(
            Variant(f"no-{name}", (*_ALL_LOSSES, *_set(**dict.fromkeys(weights, "0"))))
            for name, weights in _LOSSES.items()
        ),
    ),
    scenes=("scan24",),
    published=(paper.ABLATION_LOSSES,),
    notes=(
        "All rows start from sparse points. The row all has every term of the paper, L_ds at 0.02 "
        "and L_ssim at 0.2 included, which the default leaves out; every other row lacks one.",
    ),
    budgets=(120.0,),
    cells=(ROOM,),
)

CONVERGENCE = Benchmark(
    "convergence",
    "Error of the surface over time, and the size of its model, from known poses",
    "reconstruct",
    find_any_posed,
    _POSED,
    _WHERE,
    (
        efficiency_layout(paper.DTU_EFFICIENCY),
        curve_layout(_SNAPSHOTS),
        dtu_layout(),
        area_layout(posed=True),
        COST,
    ),
    tuple(
        replace(v, options=(*v.options, Option("snapshots", ",".join(map(str, _SNAPSHOTS)))))
        for v in (DEFAULT, PAPER)
    ),
    scenes=("scan55",),
    published=(paper.DTU_EFFICIENCY,),
    notes=(
        "The last point of each curve is the result itself. The paper has the curves in a figure, "
        "without numbers; its table prints CD in cm, which is in fact mm.",
        "--baseline adds 2D Gaussian splatting with colour, by gsplat on an NVIDIA GPU.",
    ),
    budgets=(120.0,),
    cells=(ROOM,),
)

LIGHT = Benchmark(
    "light",
    "Steady and changing light on the same path",
    "run",
    find_relighted,
    "pairs of rooms <scene> and <scene>-light on the same path (see rooms); without a folder a "
    "pair is rendered",
    "geogs synth --lamps switched, or any rendered room in this layout",
    (trajectory_layout(), area_layout(), COST),
    (DEFAULT, PAPER),
    notes=(
        "The paper shows pictures of its robustness to light, without numbers. In the pair that is "
        "rendered other lamps are on in each third of the sequence, and exposure and white balance "
        "wander.",
    ),
    cells=(ROOM, relighted(ROOM)),
)

ABLATIONS = (INITIALISATION, MAP_UPDATE, POSE_RATE, LOSSES, CONVERGENCE, LIGHT)
