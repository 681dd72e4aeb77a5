"""All tables of the paper as one suite, with stand-ins if the user has no data."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from geogs_bench import published as paper
from geogs_bench.benchmark import Benchmark, Suite, SuiteTable, Variant
from geogs_bench.catalogue.ablations import (
    CONVERGENCE,
    INITIALISATION,
    LIGHT,
    LOSSES,
    MAP_UPDATE,
    POSE_RATE,
)
from geogs_bench.catalogue.data_sets import DTU, REPLICA, RGBD, SCANNET, SCANNETPP
from geogs_bench.catalogue.variants import PAPER, with_paper
from geogs_bench.data.benchmark_scene import BenchmarkScene, Option
from geogs_bench.data.motion_cells import ROOM, Cell, relighted
from geogs_bench.data.scenes import (
    find_dtu,
    find_objects,
    find_posed_rooms,
    find_relighted,
    find_rooms,
)
from geogs_synth.camera.flaws import camera_flaws


def _find_scans_or_objects(root: Path) -> list[BenchmarkScene]:
    return find_dtu(root) or find_objects(root)


def _of(benchmark: Benchmark, names: Sequence[str]) -> tuple[Variant, ...]:
    return tuple(variant for variant in benchmark.variants if variant.name in names)


def _both(benchmark: Benchmark, names: Sequence[str]) -> Benchmark:
    """The paper's rows of an ablation, with the default and with the paper's preset."""
    return replace(benchmark, variants=with_paper(_of(benchmark, names)))


_SECOND = replace(ROOM, name="synthetic-1", seed=1)
_KINECT = replace(ROOM, name="synthetic-kinect", flaws=camera_flaws("kinect"), seed=2)
_PHONE = replace(ROOM, name="synthetic-phone", flaws=camera_flaws("phone"), seed=3)
_MONOCULAR = tuple(variant for variant in SCANNET.variants if variant.name != RGBD)

PAPER_TABLES = Suite(
    "paper",
    "The tables of the paper",
    "a folder that holds any of Replica, ScanNet, ScanNet++ and DTU (see replica, scannet, "
    "scannetpp, dtu); synthetic sequences stand in for what is not there, and are marked so",
    "see replica, scannet, scannetpp, dtu",
    (
        SuiteTable(REPLICA, find_rooms, (ROOM, _SECOND)),
        SuiteTable(replace(SCANNET, variants=_MONOCULAR), find_rooms, (_KINECT,)),
        SuiteTable(SCANNETPP, find_rooms, (_PHONE,)),
        SuiteTable(replace(DTU, find=_find_scans_or_objects), find_posed_rooms, (ROOM,)),
        SuiteTable(CONVERGENCE, find_posed_rooms, (ROOM,)),
        SuiteTable(INITIALISATION, find_rooms, (ROOM,)),
        SuiteTable(_both(MAP_UPDATE, paper.ABLATION_UPDATE.columns), find_rooms, (ROOM,)),
        SuiteTable(_both(POSE_RATE, ("off", *paper.ABLATION_POSE_LR.columns)), find_rooms, (ROOM,)),
        SuiteTable(_both(LOSSES, paper.ABLATION_LOSSES.columns), find_posed_rooms, (ROOM,)),
        SuiteTable(LIGHT, find_relighted, (ROOM, relighted(ROOM))),
    ),
)

_FEW_ROWS = {
    "scannet": ("default", "paper"),
    "scannetpp": ("default", "paper"),
    "ablation-init": ("random-7", "local-plane-7"),
    "ablation-update": ("per-keyframe", "coherent"),
    "ablation-pose-lr": ("off", "4e-4"),
    "ablation-losses": ("all", "no-multi-view"),
    "light": ("default",),
}
"""Rows that the small suite runs, of the tables that have more."""
_SECONDS = 8.0
"""Time of each reconstruction from known poses."""
_COARSE = Option("mesh.voxel", "0.03")
"""Voxel size in metres for these reconstructions."""
_DENSE = (Option("mapping.disk.stride", "3"), Option("mapping.disk.edge-stride", "3"))
_DENSE_NOTE = (
    "Rows of the paper have a disk at every third pixel instead of every eighth, as the images are "
    "a fifth as wide as the paper's."
)


def _small(table: SuiteTable) -> SuiteTable:
    """Reduce a table to few rows on few small images."""
    test = table.benchmark
    rows = _of(test, _FEW_ROWS[test.name]) if test.name in _FEW_ROWS else test.variants
    coarse = (_COARSE,) if test.budgets else ()
    rows = tuple(
        replace(row, options=(*row.options, *coarse, *(_DENSE if _is_papers(row) else ())))
        for row in rows
    )
    notes = (*test.notes, _DENSE_NOTE) if any(map(_is_papers, rows)) else test.notes
    budgets = (_SECONDS,) if test.budgets else ()
    test = replace(test, variants=rows, notes=notes, budgets=budgets)
    is_pair = table.find_stand_ins is find_relighted
    cells = table.cells if is_pair else table.cells[:1]
    return SuiteTable(test, table.find_stand_ins, tuple(map(_small_cell, cells)))


def _is_papers(row: Variant) -> bool:
    return PAPER.options[0] in row.options


def _small_cell(cell: Cell) -> Cell:
    name = cell.name.replace("synthetic", "synthetic-small")
    return replace(cell, name=name, frames=48, width=160, height=120)


PAPER_TABLES_SMALL = Suite(
    "paper-small",
    "The tables of the paper, few rows of small synthetic stand-ins",
    "nothing",
    "geogs synth",
    tuple(map(_small, PAPER_TABLES.tables)),
    (Option("mapping.render-long-edge", "112"),),
    takes_data=False,
)
"""The suite for two CPU cores."""

SUITES = {suite.name: suite for suite in (PAPER_TABLES, PAPER_TABLES_SMALL)}
