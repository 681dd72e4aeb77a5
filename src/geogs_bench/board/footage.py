"""Input of the board's commands: synthetic sequences of fixed seeds, and data sets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from geogs.errors import OutputError
from geogs.evaluation.true_scene import read_true_scene
from geogs.guard.atomic import write_text
from geogs_bench.board.commands import run_geogs
from geogs_synth.camera.flaws import CameraKind
from geogs_synth.motion.motion_kinds import MotionKind

_MARK = "footage.txt"
"""Written last, so that an incomplete or outdated sequence is made again."""


@dataclass(frozen=True)
class Size:
    """Number of frames of a sequence, and their size."""

    frames: int
    width: int
    height: int
    stride: int = 1
    """Stride of the frames that are used."""


@dataclass(frozen=True)
class Footage:
    """A sequence of ``geogs synth``."""

    name: str
    motion: MotionKind
    camera: CameraKind
    seed: int
    on_cpu: Size
    on_gpu: Size
    gap: tuple[float, float] = (0.0, 0.0)
    """Fractions of the sequence between which frames are left out: the camera was paused."""


@dataclass(frozen=True)
class KeptFootage:
    """A sequence of a data set, below the folder that the user gives."""

    name: str
    folder: str
    on_cpu: str
    """Options that make the sequence small enough for two cores."""
    on_gpu: str = ""


@dataclass(frozen=True)
class FootagePlace:
    """A sequence on disk."""

    folder: Path
    title: str
    """Description; only results of equal descriptions are compared."""
    frames: int
    """Number of frames on disk."""
    options: str = ""
    """Options of commands on this sequence."""

    @property
    def words(self) -> dict[str, str]:
        """Values for the names in a command's template."""
        return {
            "folder": str(self.folder),
            "video": str(self.folder / "video.mp4"),
            "camera": str(self.folder / "cam_params.json"),
        }


def render(footage: Footage, root: Path, on_gpu: bool, say: Callable[[str], None]) -> FootagePlace:
    """Render a sequence below ``root`` with ``geogs synth``, unless it is there.

    Raises:
        OutputError: it cannot be written.
    """
    size = footage.on_gpu if on_gpu else footage.on_cpu
    folder = root / footage.name
    made_of = repr(replace(footage, on_cpu=size, on_gpu=size))
    missing = [i for i in range(size.frames) if _is_missing(i / size.frames, footage)]
    used = f"--stride {size.stride}" if size.stride > 1 else ""
    title = (
        f"{footage.motion}, {footage.camera}, seed {footage.seed}: {size.frames - len(missing)} "
        f"images of {size.width} x {size.height} {used}"
    )
    place = FootagePlace(folder, title.rstrip(), size.frames - len(missing), used)
    if (folder / _MARK).is_file() and (folder / _MARK).read_text() == made_of:
        return place
    say(f"rendering {footage.name}")
    options = {
        "motion": footage.motion,
        "camera": footage.camera,
        "frames": size.frames,
        "width": size.width,
        "height": size.height,
        "seed": footage.seed,
    }
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    command = ["synth", str(folder), *words, "--video", "--no-depth"]
    spent, last_line = run_geogs(command, root / f"{footage.name}.log")
    if spent.code:
        raise OutputError(f"{footage.name} cannot be rendered: {last_line}")
    _cut(folder, missing)
    write_text(folder / _MARK, made_of)
    return place


def find(footage: KeptFootage, root: Path | None, on_gpu: bool) -> FootagePlace | None:
    """Find a sequence of a data set below ``root``; none if it is not there."""
    folder = None if root is None else root / footage.folder
    if folder is None or not folder.is_dir():
        return None
    options = footage.on_gpu if on_gpu else footage.on_cpu
    frames = len(read_true_scene(folder).trajectory.timestamps)
    return FootagePlace(folder, f"{footage.folder} {options}".rstrip(), frames, options)


def frames_used(command: Sequence[str], frames: int) -> int:
    """Number of frames that a command uses of a sequence of ``frames``, by its options."""
    said = dict(pairwise(command))
    start = int(said.get("--start", 0))
    stride = int(said.get("--stride", 1))
    return len(range(start, min(frames, int(said.get("--stop", frames))), stride))


def _is_missing(moment: float, footage: Footage) -> bool:
    begin, end = footage.gap
    return begin <= moment < end


def _cut(folder: Path, missing: list[int]) -> None:
    """Remove frames from a sequence that lists its images with their times."""
    names = {f"frame{index:06d}.jpg" for index in missing}
    for name in names:
        (folder / "results" / name).unlink()
    if names:
        lines = (folder / "rgb.txt").read_text().splitlines(keepends=True)
        kept = (line for line in lines if Path(line.split()[-1]).name not in names)
        write_text(folder / "rgb.txt", "".join(kept))
