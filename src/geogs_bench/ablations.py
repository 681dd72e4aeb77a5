"""Benchmarks that compare variants of the settings on whatever scenes there are."""

from geogs_bench import published as paper
from geogs_bench.benchmark import Benchmark, Variant
from geogs_bench.columns import (
    COST,
    area_layout,
    dtu_layout,
    trajectory_layout,
    vertex_layout,
)
from geogs_bench.layouts.posed_rooms import find_any_posed
from geogs_bench.layouts.replica import find_relighted, find_rooms
from geogs_bench.scene import Option

_ROOMS = (
    "Replica or any rooms in its layout: <scene>/results, <scene>/traj.txt and a true surface; "
    "without a folder a synthetic room is made"
)
_POSED = "DTU scans with the official files, or objects, or rooms (see dtu, objects, rooms)"
_WHERE = "see geogs bench list"

# The final refinement of the map would hide what the variants did before it.
_NO_REFINEMENT = (Option("mapping.final-iterations", "0"), Option("mapping.no-final-depth"))


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
            f"{name}-{iterations}",
            (
                *_set(ablation__initialisation=name.replace("-", "_"), iterations=str(iterations)),
                *_NO_REFINEMENT,
            ),
        )
        for name in ("random", "local-plane")
        for iterations in (7, 10)
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_INIT,),
    ("The map as it stands after the final bundle adjustment, without refinement.",),
    synthetic=True,
)

MAP_UPDATE = Benchmark(
    "ablation-update",
    "Ablation: after a correction, one similarity for all disks, one per keyframe, or a blend",
    "run",
    find_rooms,
    _ROOMS,
    _WHERE,
    (vertex_layout(paper.ABLATION_UPDATE), area_layout(), COST),
    (
        Variant("per-keyframe", (*_set(ablation__map_update="per_keyframe"), *_NO_REFINEMENT)),
        Variant("coherent", (*_set(ablation__map_update="coherent"), *_NO_REFINEMENT)),
        Variant("blended", (*_set(ablation__map_update="blended"), *_NO_REFINEMENT)),
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_UPDATE,),
    ("The map directly after its update by the final bundle adjustment, without refinement.",),
    synthetic=True,
)

POSE_RATE = Benchmark(
    "ablation-pose-lr",
    "Sensitivity to the learning rate of the pose step",
    "run",
    find_rooms,
    _ROOMS,
    _WHERE,
    (trajectory_layout(paper.ABLATION_POSE_LR), COST),
    tuple(
        Variant(rate, (*_set(pose_lr=rate), *_NO_REFINEMENT))
        for rate in paper.ABLATION_POSE_LR.columns
    ),
    paper.REPLICA_SCENES,
    (paper.ABLATION_POSE_LR,),
    synthetic=True,
)

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
        Variant("no-multi-view", _set(loss__l1_weight="0", loss__ncc_weight="0")),
        Variant("no-normal-consistency", _set(loss__normal_consistency_weight="0")),
        Variant("no-smoothness", _set(loss__smoothness_weight="0")),
        Variant("all", _set(loss__smoothness_weight="0.02")),
        Variant("no-depth", _set(loss__depth_weight="0")),
        Variant("no-distortion", _set(loss__distortion_weight="0")),
        Variant("no-opacity", _set(loss__opacity_weight="0")),
        Variant("no-l1", _set(loss__l1_weight="0")),
        Variant("no-ncc", _set(loss__ncc_weight="0")),
    ),
    published=(paper.ABLATION_LOSSES,),
    notes=(
        "L_ds is off by default here: no-smoothness is the default, from which every other row "
        "differs by one loss, and all is the default with L_ds at 0.02.",
        "The paper's maps start from sparse points; ours from searched depths, which stay in "
        "every row, so that the losses weigh less.",
    ),
    budgets=(120.0,),
    synthetic=True,
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

ABLATIONS = (INITIALISATION, MAP_UPDATE, POSE_RATE, LOSSES, CONVERGENCE, LIGHT)
