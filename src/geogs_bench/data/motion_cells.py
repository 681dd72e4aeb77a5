"""Synthetic sequences that benchmarks render: rooms, and the matrix of motions and cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from geogs.errors import InputError
from geogs.threads import available_cores
from geogs_synth.camera.flaws import CameraKind, Flaws, camera_flaws
from geogs_synth.motion.motion_kinds import ROOM_MOTIONS, LampKind, MotionKind

if TYPE_CHECKING:
    from geogs_synth.raycast.raycaster import Raycaster


@dataclass(frozen=True)
class Cell:
    """One sequence of the matrix."""

    name: str
    motion: MotionKind
    flaws: Flaws
    frames: int
    width: int
    height: int
    moving: float = 0.0
    """Fraction of the image that moves."""
    seed: int = 0
    """Seed of the scene and of the path."""
    lamps: LampKind = "steady"
    """Whether the light changes during the sequence."""

    @property
    def place(self) -> MotionKind:
        """Motion that names the scene, one of :data:`PLACES`."""
        return self.motion if self.motion in PLACES else "handheld"


ROOM = Cell("synthetic-0", "handheld", Flaws(), 280, 640, 480)
"""A room with a path that comes back to its start."""


def relighted(cell: Cell) -> Cell:
    """The same path in changing light, with a camera that adapts its exposure."""
    flaws = replace(cell.flaws, gain_drift=0.7, colour_drift=0.1, vignetting=0.3)
    return replace(cell, name=f"{cell.name}-light", flaws=flaws, lamps="switched")


PLACES: tuple[MotionKind, ...] = (
    "handheld", "dining", "driving", "corridor", "white-panel", "weak-link",
)  # fmt: skip
"""One motion for each kind of scene."""


def _cell(
    motion: MotionKind, camera: CameraKind, frames: int, size: tuple[int, int], moving: float = 0.0
) -> Cell:
    name = f"{motion}-{camera}" + (f"-moving-{100 * moving:.0f}" if moving else "")
    return Cell(name, motion, camera_flaws(camera), frames, *size, moving)


def _single_flaws() -> tuple[Cell, ...]:
    """Rotations at 60 degrees a second, each with one flaw of the Kinect."""
    flaws = {
        "readout": Flaws(readout=0.03),
        "blur": Flaws(exposure=0.016),
        "readout-and-blur": Flaws(readout=0.03, exposure=0.016),
        "light": Flaws(gain_drift=0.5, colour_drift=0.1, vignetting=0.3),
        "noise": Flaws(noise=5.0, jpeg=60),
    }
    return tuple(
        Cell(f"turning-60-{name}", "turning-60", flaw, 120, *_LARGER)
        for name, flaw in flaws.items()
    )


_QVGA = (320, 240)
_LARGER = (400, 300)
_STREET = (800, 242)

SMALL: tuple[Cell, ...] = (
    _cell("handheld", "clean", 75, _QVGA),
    _cell("handheld", "clean", 75, _QVGA, 0.33),
    _cell("handheld-5hz", "clean", 45, _QVGA),
    _cell("slow-handheld", "phone", 75, _QVGA),
    _cell("walking", "phone", 60, _QVGA),
    _cell("turning-60", "clean", 75, _QVGA),
    _cell("turning-60", "kinect", 60, _QVGA),
    _cell("pure-rotation", "clean", 60, _QVGA),
    _cell("rest-start", "clean", 90, _QVGA),
    _cell("jerks", "clean", 75, _QVGA),
    _cell("still", "kinect", 30, _QVGA),
    _cell("driving", "clean", 60, (496, 150)),
    _cell("corridor", "kinect", 60, _QVGA),
    *(_cell(motion, "phone", 64, _QVGA) for motion in ("white-panel", "weak-link")),
)
"""Cells for two CPU cores."""

FULL: tuple[Cell, ...] = (
    *(
        _cell(motion, camera, 120 if motion != "handheld-5hz" else 70, _LARGER)
        for motion in ROOM_MOTIONS
        for camera in ("clean", "phone", "kinect")
    ),
    *_single_flaws(),
    # A lens whose focal length varies by 2 % to either side, and a stabilised one.
    Cell("handheld-focusing", "handheld", Flaws(focusing=0.02), 120, *_LARGER),
    Cell("walking-stabilised", "walking", Flaws(stabilisation=0.015), 120, *_LARGER),
    _cell("handheld", "action", 120, _LARGER),
    *(
        _cell(motion, "clean", 120, _LARGER, moving)
        for motion in ("handheld", "walking")
        for moving in (0.15, 0.33)
    ),
    _cell("handheld", "phone", 120, _LARGER, 0.33),
    _cell("driving", "clean", 125, _STREET),
    _cell("driving", "action", 125, _STREET),
    _cell("driving", "clean", 125, _STREET, 0.15),
    *(_cell("corridor", camera, 120, _LARGER) for camera in ("clean", "phone", "kinect")),
    *(
        _cell(motion, camera, 64, _LARGER)
        for motion in ("white-panel", "weak-link")
        for camera in ("clean", "phone", "kinect")
    ),
)
"""All motions, all flaws."""

DEPTH_CELLS: tuple[Cell, ...] = (
    Cell("room-0", "handheld", Flaws(), 100, 400, 300),
    Cell("room-1", "handheld", Flaws(), 100, 400, 300, seed=1),
    Cell("dining-0", "dining", Flaws(), 100, 400, 300),
    Cell("dining-1", "dining", Flaws(), 100, 400, 300, seed=1),
    Cell("street-0", "driving", Flaws(), 60, 496, 150),
)
"""Cells whose depth is compared: rooms, rooms of thin things, a street."""


def render_cells(
    cells: Sequence[Cell], folder: Path, names: Sequence[str], say: Callable[[str], None]
) -> Path:
    """Render the cells of the given names (all if there are none) that are not there yet.

    Returns ``folder``, in which each cell has its own folder.

    Raises:
        InputError: no cell has one of the names.
        OutputError: the folder cannot be written.
    """
    known = [cell.name for cell in cells]
    if strangers := [name for name in names if name not in known]:
        raise InputError(f"there is no cell {strangers[0]}; choose of {', '.join(known)}.")
    missing = [c for c in cells if (not names or c.name in names) and not _is_there(c, folder)]
    seeds = sorted({cell.seed for cell in missing})
    for place, seed in ((place, seed) for place in PLACES for seed in seeds):
        some = [cell for cell in missing if (cell.place, cell.seed) == (place, seed)]
        raycaster = _raycaster(place, seed) if some else None
        for cell in some:
            say(f"rendering {cell.name}")
            _render(cell, folder / cell.name, raycaster)
    return folder


def _is_there(cell: Cell, folder: Path) -> bool:
    """Whether a cell is complete: the points are written last."""
    return any((folder / cell.name).glob("points_seen_*.ply"))


def _raycaster(place: MotionKind, seed: int) -> "Raycaster":
    from geogs_synth.raycast.raycaster import Raycaster
    from geogs_synth.sequence.location import make_scene

    return Raycaster(make_scene(place, seed), available_cores())


def _render(cell: Cell, folder: Path, raycaster: "Raycaster | None") -> None:
    from geogs_synth.sequence.replica_files import write_sequence

    write_sequence(
        folder,
        cell.frames,
        cell.width,
        cell.height,
        cell.seed,
        motion=cell.motion,
        flaws=cell.flaws,
        moving=cell.moving,
        lamps=cell.lamps,
        threads=available_cores(),
        raycaster=raycaster,
    )
