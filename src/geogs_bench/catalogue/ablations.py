"""Benchmarks that compare variants of the settings on whatever scenes there are."""

from geogs_bench import published as paper
from geogs_bench.benchmark import Benchmark, Variant
from geogs_bench.data.benchmark_scene import Option
from geogs_bench.data.mixed_scenes import find_mixed
from geogs_bench.data.posed_scenes import find_any_posed
from geogs_bench.data.replica_scenes import find_relighted, find_rooms
from geogs_bench.tables.columns import (
    COST,
    area_layout,
    dtu_layout,
    result_layout,
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
_PAPER = Option("preset", "paper")


def _set(**values: str) -> tuple[Option, ...]:
    """Mapping options; two underscores stand for the dot between groups."""
    names = {name: f"mapping.{name.replace('__', '.').replace('_', '-')}" for name in values}
    return tuple(Option(names[name], value) for name, value in values.items())


INITIALISATION = Benchmark(
    "ablation-init",
    "Ablation: disks started on local planes, or isotropic with a random orientation",
    "run",
    find_rooms,
    _ROOMS,
    _WHERE,
    (vertex_layout(paper.ABLATION_INIT), area_layout(), COST),
    tuple(
        Variant(
            f"{prefix}{name}-{iterations}",
            (
                *options,
                *_set(ablation__initialisation=name.replace("-", "_"), iterations=str(iterations)),
                *_NO_REFINEMENT,
            ),
        )
        for prefix, options in (("", ()), ("paper-", (_PAPER,)))
        for name in ("random", "local-plane")
        for iterations in (7, 10)
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_INIT,),
    (
        "The map as it stands after the final bundle adjustment, without refinement.",
        "Disks of both starts are of the same scales; the random ones lie anyhow. Rows that begin "
        "with paper have the preset of that name.",
    ),
    synthetic=True,
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
    synthetic=True,
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
        Variant("off", (*_set(pose_iterations="0"), *_NO_REFINEMENT)),
        *(
            Variant(rate, (*_set(pose_lr=rate, pose_every="1"), *_NO_REFINEMENT))
            for rate in paper.ABLATION_POSE_LR.columns
        ),
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_POSE_LR,),
    (
        "The trajectory after the stream is the measure: the final bundle adjustment starts from "
        "these poses and ends at its own minimum.",
    ),
    synthetic=True,
)

_LOSSES = {
    "multi-view": ("loss__l1_weight", "loss__ssim_weight", "loss__ncc_weight"),
    "normal-consistency": ("loss__normal_consistency_weight",),
    "smoothness": ("loss__smoothness_weight",),
    "distortion": ("loss__distortion_weight",),
    "depth": ("loss__depth_weight",),
    "opacity": ("loss__opacity_weight",),
    "l1": ("loss__l1_weight",),
    "ssim": ("loss__ssim_weight",),
    "ncc": ("loss__ncc_weight",),
}
_ALL_LOSSES = _set(loss__smoothness_weight="0.02", loss__ssim_weight="0.2")

LOSSES = Benchmark(
    "ablation-losses",
    "Ablation: the losses of the map, each left out",
    "reconstruct",
    find_any_posed,
    _POSED,
    _WHERE,
    (
        dtu_layout(paper.ABLATION_LOSSES),
        area_layout(posed=True),
        vertex_layout(posed=True),
        COST,
    ),
    (
        Variant("all", _ALL_LOSSES),
        *(
            Variant(f"no-{name}", (*_ALL_LOSSES, *_set(**dict.fromkeys(weights, "0"))))
            for name, weights in _LOSSES.items()
        ),
    ),
    published=(paper.ABLATION_LOSSES,),
    notes=(
        "The row all has every term, L_ds at 0.02 and L_ssim at 0.2 included, which the defaults "
        "leave out; every other row lacks one of them.",
        "The paper's maps start from sparse points; ours from searched depths, which stay in "
        "every row, so that the losses weigh less.",
    ),
    budgets=(120.0,),
    synthetic=True,
)

PAPER = Benchmark(
    "paper",
    "The default beside the paper's choices",
    "run",
    find_mixed,
    "any mix of rooms, 7-Scenes, objects and DTU scans, in folders of the given one",
    _WHERE,
    (result_layout(), trajectory_layout(), area_layout(), COST),
    (Variant("default"), Variant("paper", (_PAPER,))),
    notes=("Objects and scans are reconstructed from their known poses in 120 s.",),
    synthetic=True,
    by_kind=True,
)

CONVERGENCE = Benchmark(
    "convergence",
    "Error of the surface over time, from known poses",
    "reconstruct",
    find_any_posed,
    _POSED,
    _WHERE,
    (dtu_layout(), area_layout(posed=True), COST),
    (Variant("", (Option("snapshots", "5,10,20,40,60,90"),)),),
    notes=("The last point of each curve is the result itself.",),
    budgets=(120.0,),
    synthetic=True,
)

LIGHT = Benchmark(
    "light",
    "Steady and changing light on the same path",
    "run",
    find_relighted,
    "pairs of rooms <scene> and <scene>-light on the same path (see rooms)",
    "any rendered room in this layout",
    (trajectory_layout(), area_layout(), COST),
)

ABLATIONS = (PAPER, INITIALISATION, MAP_UPDATE, POSE_RATE, LOSSES, CONVERGENCE, LIGHT)
