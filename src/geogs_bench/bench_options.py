"""The options of ``geogs bench``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from geogs.config import Seed
from geogs.config.setting import Basic, Positional, Positive, Settings, Time


@dataclass(frozen=True)
class BenchOptions(Settings):
    """Run a benchmark on your copy of its data, score the results and write tables.

    ``geogs bench list`` lists the benchmarks, with the data that each needs and where to get it.
    Runs that were finished before in the same folder are not repeated.
    """

    name: Annotated[str, Positional()]
    """Name of the benchmark, or list."""
    data: Annotated[Path | None, Positional(required=False)] = None
    """Folder of the data set; some benchmarks render synthetic rooms if it is left out."""
    output: Annotated[Path | None, Basic("-o")] = None
    """Folder for the results; out/bench-NAME by default."""
    scenes: str = ""
    """Names of the scenes, or of the rows of the board, to run, with commas between; all by
    default."""
    variants: str = ""
    """Names of the variants of an ablation to run, with commas between; all by default."""
    known_poses: bool = False
    """Reconstruct rooms from known poses instead of running SLAM; for the benchmark rooms."""
    small: bool = False
    """Use few short sequences of small images, for two CPU cores; for motions and paper."""
    budgets: Annotated[tuple[Positive, ...], Time] = ()
    """Time limits of each reconstruction from known poses, with commas between: one run for each
    limit."""
    baseline: bool = False
    """Also run 2D Gaussian splatting with colour, by gsplat, in the same time; for reconstructions
    from known poses."""
    depth_fusion: bool = False
    """Also score the surface of the keyframes' fused depth maps alone, to show what the disks
    add."""
    device: str = "auto"
    """As in geogs run."""
    seed: Seed = 0
    """As in geogs run."""
    preset: str = ""
    """As in geogs run and geogs reconstruct, with their default."""
    set: tuple[str, ...] = ()
    """An option of geogs run or geogs reconstruct, such as --set mapping.iterations=12; can be
    repeated."""
    result: Path | None = None
    """Score this result of the sequence DATA instead of running it; for the benchmark edges."""
    against: Path | None = None
    """Earlier record to compare with: the figures that changed by more than their noise are listed;
    for the board."""
    constants: tuple[str, ...] = ()
    """Constants of modules, such as geogs.depth.edges:CONTRAST, with commas between, which are
    halved and doubled; for the benchmark sensitivity, on the rows of the board."""
    fresh: bool = False
    """Repeat finished runs."""
    rescore: bool = False
    """Score finished runs again, without repeating them."""
