"""The options of ``geogs bench``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from geogs.config import Seed
from geogs.config.setting import Basic, Positional, Positive, Settings, Time


@dataclass(frozen=True)
class BenchOptions(Settings):
    """Run a benchmark on your copy of its data, score it, write the tables.

    ``geogs bench list`` says which there are, what data each needs and where to get it. What was
    finished before in the same folder is not run again.
    """

    name: Annotated[str, Positional()]
    """Which benchmark, or list."""
    data: Annotated[Path | None, Positional(required=False)] = None
    """Folder of the data set; without one some benchmarks render synthetic rooms."""
    output: Annotated[Path | None, Basic("-o")] = None
    """Folder for the results; out/bench-NAME if none is given."""
    scenes: str = ""
    """Only these scenes, or rows of the board, by their names with commas between."""
    variants: str = ""
    """Only these variants of an ablation, with commas between."""
    known_poses: bool = False
    """Rooms: reconstruct from known poses instead of SLAM."""
    small: bool = False
    """Motions and paper: few short sequences of small images, for two CPU cores."""
    budgets: Annotated[tuple[Positive, ...], Time] = ()
    """From known poses: seconds given to each reconstruction, several with commas between."""
    baseline: bool = False
    """From known poses: 2D Gaussian splatting with colour beside it, in the same time (gsplat)."""
    depth_fusion: bool = False
    """Score the keyframes' depths fused without the disks, too: what the disks add to them."""
    device: str = "auto"
    """As in geogs run."""
    seed: Seed = 0
    """As in geogs run."""
    preset: str = ""
    """As in geogs run and geogs reconstruct; without one, what they choose."""
    set: tuple[str, ...] = ()
    """Any option of geogs run or geogs reconstruct (--set mapping.iterations=12); repeatable."""
    result: Path | None = None
    """Edges: score this result of the one sequence DATA, and run nothing."""
    against: Path | None = None
    """Board: a record of earlier, beside which to say what is worse and better than noise."""
    fresh: bool = False
    """Run everything again."""
    rescore: bool = False
    """Score what was run before again."""
