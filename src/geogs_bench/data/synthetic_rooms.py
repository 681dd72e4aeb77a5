"""A synthetic room for benchmarks that were given no data."""

from collections.abc import Callable
from pathlib import Path

from geogs.errors import InputError

_FRAMES, _WIDTH, _HEIGHT = 280, 640, 480
"""As long as the path takes to come back to its start."""


def synthetic_rooms(
    folder: Path, seeds: tuple[int, ...], on_frame: Callable[[int], None] = lambda index: None
) -> Path:
    """Render a room for each seed below ``folder``, unless it is there; returns ``folder``.

    Raises:
        OutputError: it cannot be written.
    """
    from geogs_synth.sequence.replica_files import write_sequence

    for seed in seeds:
        room = folder / f"synthetic-{seed}"
        # Written last, so that a room which was cut off is made again.
        if not (room / "points_seen_1cm.ply").is_file():
            write_sequence(room, _FRAMES, _WIDTH, _HEIGHT, seed, depth=False, on_frame=on_frame)
    return folder


def no_data(name: str, needs: str, source: str) -> InputError:
    """What to say where a benchmark was given no folder and cannot make its data."""
    return InputError(f"{name} needs a folder: {needs}; from {source}.")
